"""Readers of recordings: one module per format, all yielding the same values; and the recorder of our own.

`open_dataset("euroc:PATH")` gives a `vislam.core.recording.Recording`; a bare path is recognised by what is in it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from vislam.config import CalibrationConfig
from vislam.core.errors import DataError, UsageError
from vislam.core.kinds import Kinds, lacking
from vislam.core.recording import Problems, Recording
from vislam.datasets import bags
from vislam.datasets.calibrated import calibrated, with_imu_rate
from vislam.datasets.formats import asl, kitti, phone, tum, video
from vislam.datasets.sensor_files import sensor_readings
from vislam.datasets.stream import FileRecording, Survey

__all__ = ["READERS", "FileRecording", "Problems", "Reader", "Survey", "open_dataset", "sensor_readings", "survey"]


class Reader(Protocol):
    """What a module offers that reads one format."""

    LOOKS_FOR: str

    def recognises(self, path: Path, /) -> bool:
        """Return whether the path looks like a recording in this format."""
        ...

    def survey(self, path: Path, /) -> Survey:
        """Return what the recording holds, with what is wrong with it; never raises for bad content."""
        ...


READERS = Kinds[Reader](
    "vislam.readers",
    {"euroc": asl, "tum": tum, "kitti": kitti, "video": video, "phone": phone, "bag": bags},
    lacking("LOOKS_FOR", "recognises", "survey"),
)


def open_dataset(uri: str, calibration: CalibrationConfig | None = None) -> Recording:
    """Open `FORMAT:PATH` or a bare path as a recording, with the calibration files that are named instead of its own.

    Raises:
        UsageError: there is no such format.
        DataError: the path holds no recording of the format, or one that cannot be replayed.
    """
    found = survey(uri)
    return FileRecording(with_imu_rate(calibrated(found, calibration or CalibrationConfig())))


def survey(uri: str) -> Survey:
    """Return what `FORMAT:PATH` or a bare path holds, for `open_dataset` and `vislam doctor`; raises as it does.

    A bag's topics may be given behind it: `bag:PATH,cam0=/left/image_raw,imu=/imu`; of a film `chapters=one`.
    """
    name, path, options = _split(uri)
    try:
        reader = _reader(name, path)
        if not options:
            return reader.survey(path)
        if reader is bags:
            return bags.survey_with(path, _options(uri, options))
        if reader is video:
            return video.survey_with(path, _options(uri, options))
        raise UsageError(f"'{options}' in {uri}: only a bag or a film takes options, and {path} is none")
    except OSError as error:  # a folder that may not be entered, a disk that fails
        raise DataError(f"{error.filename or path} cannot be read: {error.strerror or error}") from error


def _reader(name: str, path: Path) -> Reader:
    """Return the reader of format `name`, or the one that recognises the path when it is empty."""
    if not path.exists():
        raise DataError(f"{path} does not exist; give the folder or file of a recording")
    if path.is_dir() and not any(path.iterdir()):
        raise DataError(f"{path} is empty; looked for {_wanted(name)}")
    fitting = [known for known, reader in READERS.items() if reader.recognises(path)]
    if name and name not in fitting:
        hint = f"; it looks like {fitting[0]}:{path}" if fitting else ""
        raise DataError(f"{path} is no {name} recording: looked for {_wanted(name)}{hint}")
    if not fitting:
        raise DataError(f"{path} is no recording that vislam knows: looked for {_wanted(name)}")
    return READERS[name or fitting[0]]


def _split(uri: str) -> tuple[str, Path, str]:
    """Return format (empty: to be recognised), path and options; a path that exists may contain colon and comma."""
    name, colon, rest = uri.partition(":")
    if not colon or (name not in READERS and _exists(uri)):
        return "", *_path_and_options(uri)
    if name not in READERS:
        raise UsageError(f"no format '{name}' in '{uri}'; known formats: {', '.join(READERS)}")
    return name, *_path_and_options(rest)


def _exists(text: str) -> bool:
    return _path_and_options(text)[0].exists()


def _path_and_options(text: str) -> tuple[Path, str]:
    """Return path and options, `,name=value` behind a path that exists."""
    whole, (first, _, options) = Path(text), text.partition(",")
    if not options or whole.exists() or "=" not in options or not Path(first).exists():
        return whole, ""
    return Path(first), options


def _options(uri: str, options: str) -> dict[str, str]:
    parts = options.split(",")
    if wrong := [part for part in parts if "=" not in part]:
        raise UsageError(f"'{wrong[0]}' in {uri} is no option; write bag:PATH,cam0=/topic,imu=/topic")
    return dict(part.split("=", 1) for part in parts)


def _wanted(name: str) -> str:
    if name:
        return READERS[name].LOOKS_FOR
    return ", ".join(f"{reader.LOOKS_FOR} ({known})" for known, reader in READERS.items())
