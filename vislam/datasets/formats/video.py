"""A plain video file with the stamps of its frames beside it, and optionally an IMU.

For `ride.mp4`: `ride.csv` (one row a frame, stamp in ns), `ride.yaml` (a camera's sensor file), and, if there is an
IMU, `ride.imu.csv` (or `ride.gyro.csv` and `ride.accel.csv`) and `ride.imu.yaml` in the ASL layout. Every stamp must be
from the clock that stamps the IMU.

An MP4 without `ride.csv` has its frames stamped by its own table of times. Of a GoPro's, the IMU in its telemetry is
by that clock, too, and is read where `ride.imu.yaml` states its noise; later chapters are one film with the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vislam.config import validated
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.geometry import invert
from vislam.core.recording import Problems, noted
from vislam.datasets.calibration import CAMERA_EXAMPLE, read_camera, read_imu
from vislam.datasets.images import ImageList
from vislam.datasets.imu_pairs import ImuRows
from vislam.datasets.imu_tables import Pair, pair_in
from vislam.datasets.loaders import check_film, open_video
from vislam.datasets.stream import Survey, image_list
from vislam.datasets.tables import Row, film_stamps, read_frame_stamps
from vislam.datasets.telemetry import (
    Film,
    JoinedTelemetry,
    Telemetry,
    frame_times_ns,
    is_mp4,
    joined_film,
    later_chapters,
    open_joined,
    open_telemetry,
)
from vislam.imu import ImuNoise

SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm")
LOOKS_FOR = f"a video file ({', '.join(SUFFIXES)})"


def recognises(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


@dataclass(frozen=True, slots=True)
class FilmOptions:
    """Options of a film behind its path, as `video:GX010001.MP4,chapters=one`."""

    chapters: Literal["all", "one"] = "all"  # one: the file that is named alone


def survey(path: Path) -> Survey:
    """Return what a video and the files beside it hold; what is wrong with them is in `errors`."""
    return survey_with(path, {})


def survey_with(path: Path, options: Mapping[str, str]) -> Survey:
    """Return what a video holds, with its options; raises UsageError for an option that is none."""
    return _survey(path, validated(FilmOptions, options, f"video:{path}").chapters == "all")


def _survey(path: Path, joined: bool) -> Survey:
    problems = Problems()
    errors: list[DataError] = []
    imu_file, imu_noise, T_body_imu = None, None, np.eye(4)
    cameras: tuple[ImageList, ...] = ()
    film: Film | None = None
    joined = joined and not film_stamps(path).is_file() and not path.with_suffix(".imu.csv").is_file()
    rig, telemetry = None, _telemetry(path, joined)
    findings = [] if telemetry is None else telemetry.findings()
    if (why := _why_unused(path)) and telemetry is not None and telemetry.has_imu:
        findings.append(Finding("warning", f"the IMU of the telemetry is not used: {why}", path.name, ""))
    samples: ImuRows | None = telemetry if telemetry is not None and telemetry.has_imu and not why else None
    with noted(errors):
        if not path.with_suffix(".imu.csv").is_file() and (pair := pair_in(path.parent, path.stem)) is not None:
            samples, stated = pair
            findings.append(stated)
        if path.with_suffix(".imu.csv").is_file():
            imu_file = path.with_suffix(".imu.csv")
        if imu_file is not None or samples is not None:
            imu_noise, T_body_imu = _imu(path)
        if not path.with_suffix(".yaml").is_file():
            raise DataError(f"{path.with_suffix('.yaml')} is missing; write the calibration into it: {CAMERA_EXAMPLE}")
        file = read_camera(path.with_suffix(".yaml"))
        rig = Rig((file.camera,), (invert(T_body_imu) @ file.T_body_cam,))
    with noted(errors):
        film = joined_film(path) if joined and is_mp4(path) and later_chapters(path) != ([], "") else None
        own_clock = path.with_suffix(".imu.csv").is_file() or isinstance(samples, Pair)
        cameras = (_frames(path, problems, own_clock) if film is None else _of_film(film, path, problems),)
        check_film(path, cameras[0], rig, problems)
    return Survey(
        format="video",
        root=path,
        cameras=cameras,
        video=path,
        later_videos=() if film is None else tuple((one.path, one.first_frame) for one in film.chapters[1:]),
        rig=rig,
        imu_file=imu_file,
        samples=samples,
        imu_noise=imu_noise,
        findings=(*findings, *(() if film is None else film.findings)),
        problems=problems,
        errors=tuple(errors),
    )


def _imu(path: Path) -> tuple[ImuNoise, NDArray[np.float64]]:
    sensor = path.with_suffix(".imu.yaml")
    if not sensor.is_file():
        raise DataError(f"{sensor} is missing; write the IMU's noise into it, see docs/formats.md")
    return read_imu(sensor)


def _frames(path: Path, problems: Problems, own_clock: bool) -> ImageList:
    stamps = film_stamps(path)
    if stamps.is_file():
        return image_list("cam0", path.parent, read_frame_stamps(stamps, problems), problems)
    if is_mp4(path) and not own_clock:  # else the IMU would have another
        return image_list("cam0", path.parent, _own_times(path), problems)
    open_video(path).release()  # a film that cannot be read is what is wrong first
    raise DataError(f"{stamps} is missing; write one row a frame into it: the time of its exposure in ns")


def _own_times(path: Path) -> Iterator[Row[str]]:
    return ((t_ns, str(frame)) for frame, t_ns in enumerate(frame_times_ns(path).tolist()))


def _of_film(film: Film, path: Path, problems: Problems) -> ImageList:
    stamps = np.concatenate([chapter.frames_ns for chapter in film.chapters]).tolist()
    return image_list("cam0", path.parent, ((t_ns, str(frame)) for frame, t_ns in enumerate(stamps)), problems)


def _telemetry(path: Path, joined: bool) -> Telemetry | JoinedTelemetry | None:
    """Return a GoPro's telemetry; what is wrong with the file is reported where its frames are looked for."""
    try:
        return open_joined(path) if joined else open_telemetry(path)
    except DataError:
        return None


def _why_unused(path: Path) -> str:
    """Return why the IMU of a telemetry is left aside, empty where it is not."""
    if path.with_suffix(".imu.csv").is_file():
        return f"{path.with_suffix('.imu.csv').name} takes its place"
    if (stamps := film_stamps(path)).is_file():
        return f"its clock is the video's, and {stamps.name} stamps the frames by another"
    if not path.with_suffix(".imu.yaml").is_file():
        return f"write its noise into {path.with_suffix('.imu.yaml').name}, see docs/formats.md"
    return ""
