"""Where measurements come from: a recording on disk in one of several formats, or a simulated world."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vislam.config import CalibrationConfig, Config, VibrationConfig, validated
from vislam.core.errors import DataError, UsageError
from vislam.core.recording import Recording
from vislam.hw.sensors import INERTIAL_KINDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vislam.datasets.stream import Survey
    from vislam.sim import MeasuredInertial

_SCHEMES = re.compile(r"(?:[a-z]+:)+")
_SHIPPED = "gtsam"  # the package that brings a table of real tracks
_SHIPPED_TABLE = "eqvio_processed_30s.csv"
_SENSORS = re.compile(rf"virtual-cart(,|$)|({'|'.join(INERTIAL_KINDS)})(:[^+]*)?\+|serial:")


def open_source(uri: str, seed: int = 0, calibration: CalibrationConfig | None = None) -> Recording:
    """Open a recording on disk or a simulated one.

    On disk: `euroc:PATH`, `tum:PATH`, `kitti:PATH`, `video:PATH`, `phone:PATH`, `bag:PATH`, or a bare path. Rendered:
    `sim:WORLD`.
    Vision simulated as points, on a world's motion or on the real IMU of a recording with truth: `points:WORLD` or
    `points:PATH`. Real tracks without images: `eqvio:FILE`, or `eqvio:gtsam` for the table that GTSAM's package brings.
    To bags and to all that are not on disk options are appended as `,option=value`. Calibration files that are named
    take the place of a recording's own.

    Raises UsageError for an unknown format, world or option, or for calibration files of a source that takes none;
    DataError when the recording cannot be used.
    """
    scheme, _, rest = uri.partition(":")
    if scheme in ("sim", "points", "eqvio") and calibration is not None and calibration != CalibrationConfig():
        raise UsageError(f"{uri} knows its sensors exactly; leave the calibration files away")
    if scheme == "sim":
        from vislam.sim import open_world

        name, options = _options(uri, rest)
        return open_world(name, seed=seed, **options)
    if scheme == "points":
        from vislam.sim import POINT_WORLD_NAMES, open_points

        name, options = _options(uri, rest)
        return open_points(name if name in POINT_WORLD_NAMES else measured_inertial(name), seed=seed, **options)
    if scheme == "eqvio":
        return _given_tracks(*_options(uri, rest))
    from vislam.datasets import open_dataset

    return open_dataset(uri, calibration)


def recorded_path(source: str) -> Path | None:
    """Return where a source, also a live one that replays it, is read from; None for worlds and sensors."""
    scheme, name, _ = split_source(source.removeprefix("replay:"))
    if scheme == "eqvio:" and name == _SHIPPED:
        return _shipped_tracks()
    return None if is_world(scheme, name) or _SENSORS.match(source) else Path(name)


def split_source(source: str) -> tuple[str, str, str]:
    """Return schemes with their colons ("points:euroc:"), the name or path, and ",option=value"s; each may be empty."""
    first, comma, options = source.partition(",")
    match = _SCHEMES.match(first)
    scheme = match[0] if match else ""
    return scheme, first[len(scheme) :], comma + options


def is_world(scheme: str, name: str) -> bool:
    """Whether a source's name is no path: it is simulated altogether, or comes with a package."""
    if scheme == "points:":  # what is recorded does without the simulator in memory
        from vislam.sim import POINT_WORLD_NAMES

        return name in POINT_WORLD_NAMES
    return scheme == "sim:" or (scheme == "eqvio:" and name == _SHIPPED)


def measured_inertial(uri: str) -> MeasuredInertial:
    """Read the inertial data and the truth of a recording (`euroc:PATH` or a bare path); images are not needed.

    What the truth's body is turned, displaced and late against the IMU is fitted and undone, where it is beyond chance.
    Raises DataError when it lacks an IMU, its noise or truth.
    """
    from vislam.core.recording import Problems
    from vislam.datasets import survey
    from vislam.sim import POINT_WORLD_NAMES, MeasuredInertial
    from vislam.trajectory.truth_fit import fit_truth

    try:
        found = survey(uri)
    except DataError as error:
        raise DataError(f"{error}; simulated motions are: {', '.join(POINT_WORLD_NAMES)}") from error
    if found.errors:
        raise found.errors[0]
    problems = Problems()
    truth = None if found.truth is None else found.truth(problems)
    if not found.has_imu or found.imu_noise is None or truth is None:
        lacks = "an IMU" if not found.has_imu or found.imu_noise is None else "truth"
        raise DataError(f"{uri} lacks {lacks}; simulated vision on a real IMU needs inertial data and true poses")
    t_ns, values = _samples(found)
    name, gyro, accel = found.root.resolve().name, values[:, :3], values[:, 3:]
    fit = fit_truth(t_ns, gyro, accel, truth)
    return MeasuredInertial(name, t_ns, gyro, accel, found.imu_noise, fit.of_imu(truth), found.rig, fit)


def without_idle_cameras(recording: Recording, config: Config) -> Recording:
    """Return a recording that reads cam0 alone where the others are not used: mono, and without a map."""
    from vislam.datasets.stream import FileRecording
    from vislam.frontend import knows_scale, mode_for

    is_one = not knows_scale(mode_for(config.frontend, recording.rig))  # one camera, by that it knows no scale
    if isinstance(recording, FileRecording) and is_one:
        recording.cameras_read = 1 if not config.map.enabled else len(recording.rig.cameras)
    return recording


def shaken(recording: Recording, vibration: VibrationConfig) -> Recording:
    """Return a recording with the vibration of another one in its inertial samples, where the settings ask for that.

    Raises UsageError when the recording has no IMU, DataError when there is no such vibration.
    """
    if vibration.recording is None:
        return recording
    from vislam.datasets import survey
    from vislam.sim.faults.vibration import ShakenRecording, Vibration

    if recording.imu_noise is None:
        raise UsageError(f"{recording.name} has no IMU that could vibrate; leave --imu.vibration.recording away")
    found = survey(vibration.recording)
    if not found.has_imu:
        raise DataError(f"{vibration.recording} has no inertial data to take vibration from")
    t_ns, values = _samples(found)
    shaking = Vibration(t_ns, values, vibration.begin_s, vibration.length_s, vibration.above_hz)
    return ShakenRecording(recording, shaking, vibration.gain)


def _samples(found: Survey) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps [N] and calibrated samples [N, 6] of a recording with inertial data."""
    from vislam.core.recording import Problems
    from vislam.datasets.tables import in_time_order

    problems = Problems()
    rows = list(in_time_order(found.imu_rows(problems), problems, "imu"))
    values = np.array([row[1] for row in rows]).reshape(-1, 6)
    if found.imu_calibration is not None:
        values = found.imu_calibration.apply_to(values)
    return np.array([row[0] for row in rows], dtype=np.int64), values


def _given_tracks(name: str, options: dict[str, str]) -> Recording:
    """Open a table of real tracks, with the noise model and the fitted truth of the recording that `truth` names."""
    from vislam.datasets.formats.eqvio import TrackOptions, TrackRecording

    chosen = validated(TrackOptions, options, "tracks")
    path = _shipped_tracks() if name == _SHIPPED else Path(name)
    if chosen.truth is None:
        return TrackRecording(path, chosen)
    known = measured_inertial(chosen.truth)
    return TrackRecording(path, chosen, known.truth, known.noise)


def _shipped_tracks() -> Path:
    """Return the table of real tracks that comes with GTSAM, which is not imported for it."""
    spec = find_spec(_SHIPPED)
    folders = [] if spec is None or spec.submodule_search_locations is None else spec.submodule_search_locations
    path = next((Path(folder) / "Data" / _SHIPPED_TABLE for folder in folders), None)
    if path is None or not path.is_file():
        raise DataError(f"the installed gtsam brings no Data/{_SHIPPED_TABLE}; give the path of a table: eqvio:FILE")
    return path


def _options(uri: str, rest: str) -> tuple[str, dict[str, str]]:
    """Split `NAME,option=value,...`; raises UsageError for a part without `=`, and for the seed, which is the run's."""
    name, *parts = rest.split(",")
    for part in parts:
        if "=" not in part:
            raise UsageError(f"'{part}' in {uri} is no option; write {uri.partition(',')[0]},option=value")
        if part.startswith("seed="):
            raise UsageError(f"{uri} takes its seed from the run; give --{part.replace('=', ' ')} in place of it")
    return name, dict(part.split("=", 1) for part in parts)
