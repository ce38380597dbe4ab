"""Inertial samples and feature tracks in one table, as EqVIO's preprocessing writes them: real tracks without images.

GTSAM's package brings such a table of the first 30 s of EuRoC's V1_01 (`eqvio_processed_30s.csv`). A row is a `meta`
value (camera, its pose in the IMU, what noise was assumed), an `imu` sample or a `vision_feature`: one landmark seen in
one frame, in coordinates of the plane z = 1, lens undone.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import rotation_from_quaternion_xyzw, transform
from vislam.core.messages import Array, Frame, ImuSample, Observations
from vislam.core.reading import opened
from vislam.core.recording import Problems
from vislam.datasets.tables import Row, check_size, in_time_order, parse_seconds, read_rows
from vislam.imu import ImuNoise
from vislam.trajectory import Trajectory

Stamps = NDArray[np.int64]

_MAX_FILE_BYTES = 256 * 2**20  # read whole; 30 s take 2.7 MB
_STAMP, _FRAME, _LANDMARK, _IMU, _SEEN, _KEY = 1, 4, 5, slice(6, 12), slice(18, 20), 20  # columns
_COLUMNS = 22
_FIRST_COLUMN = "row_type"
_MAX_NORMALISED = 5.0  # 79 degrees off the axis: no pinhole image reaches further
_MAX_FOCAL_PX = 1e5
_MAX_ID = 2**62
_CAMERA = ("camera_fx", "camera_fy")
_POSE = ("T_ci_tx", "T_ci_ty", "T_ci_tz", "T_ci_qx", "T_ci_qy", "T_ci_qz", "T_ci_qw")
_NOISE = ("input_var_gyr", "input_var_acc", "input_var_gyr_bias_walk", "input_var_acc_bias_walk")  # squared densities


@dataclass(frozen=True, slots=True)
class TrackOptions:
    """What can be chosen of a recording of tracks; times in seconds from its first frame."""

    truth: str | None = None  # recording (as for `vislam run`) that has IMU, its noise model and true poses
    start_s: Annotated[float, Field(ge=0.0)] = 0.0
    duration_s: Annotated[float, Field(ge=0.5)] | None = None  # None: to the end


@dataclass(frozen=True, slots=True, eq=False)
class TrackTable:
    """What a table of tracks holds.

    Attributes:
        meta: its values by name, as text.
        imu_t_ns: stamps [N] of the samples, strictly increasing.
        imu: angular rate and specific force [N, 6] in the IMU's frame.
        frame_t_ns: stamps [F] of the frames.
        seen: for every frame the ids [n] of the landmarks, ascending, and where they are [n, 2] on the plane z = 1.
    """

    meta: dict[str, str]
    imu_t_ns: Stamps
    imu: Array
    frame_t_ns: Stamps
    seen: tuple[tuple[NDArray[np.int64], Array], ...]


class TrackRecording:
    """A recording (see `vislam.core.recording.Recording`) whose frames carry real tracks and no images.

    The camera is an ideal one of the table's focal lengths, wide enough for all that was seen.
    """

    def __init__(
        self,
        path: Path,
        options: TrackOptions | None = None,
        truth: Trajectory | None = None,
        noise: ImuNoise | None = None,
    ) -> None:
        """Read a table; without `noise`, what the table states as assumed counts.

        Raises DataError when the table cannot be used, UsageError when it is shorter than was asked for.
        """
        options = options or TrackOptions()
        self.problems: dict[str, int] = Problems()
        table = read_track_table(path, self.problems)
        self.name = path.stem
        self.rig = _rig(table, path)
        self.imu_noise: ImuNoise | None = noise or _assumed_noise(table, path)
        self._truth = truth
        first, last = _part(table.frame_t_ns, options, path)
        self._frame_t_ns, self._seen = table.frame_t_ns[first:last], table.seen[first:last]
        self.frame_count = last - first
        begin = max(int(np.searchsorted(table.imu_t_ns, self._frame_t_ns[0], "right")) - 1, 0)
        end = int(np.searchsorted(table.imu_t_ns, self._frame_t_ns[-1], "right")) + 1
        self._imu_t_ns, self._imu = table.imu_t_ns[begin:end], table.imu[begin:end]

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | Frame]:
        """Yield samples and frames in time order, samples first when stamps are equal; no frame before `from_ns`."""
        streams: list[Iterator[ImuSample | Frame]] = [self._samples(), self._frames(from_ns)]
        yield from heapq.merge(*streams, key=lambda event: event.t_ns)

    def truth(self) -> Trajectory | None:
        """Return the true poses of the IMU that were given, over the time of the frames; None without."""
        if self._truth is None:
            return None
        margin_ns = 1_000_000_000  # so that poses around the first and last frame can be interpolated
        t_ns = self._truth.t_ns
        near = (t_ns >= self._frame_t_ns[0] - margin_ns) & (t_ns <= self._frame_t_ns[-1] + margin_ns)
        return Trajectory(t_ns[near], self._truth.T_world_body[near])

    def _samples(self) -> Iterator[ImuSample]:
        for t_ns, row in zip(self._imu_t_ns.tolist(), self._imu, strict=True):
            yield ImuSample(t_ns, row[:3], row[3:])

    def _frames(self, from_ns: int | None) -> Iterator[Frame]:
        camera = self.rig.cameras[0]
        for index, (t_ns, (ids, seen)) in enumerate(zip(self._frame_t_ns.tolist(), self._seen, strict=True)):
            if from_ns is None or t_ns >= from_ns:
                pixels = seen * [camera.fx, camera.fy] + [camera.cx, camera.cy]
                yield Frame(t_ns, index, (), tracks=Observations(ids, pixels))


def read_track_table(path: Path, problems: dict[str, int]) -> TrackTable:
    """Read a table of samples and tracks; rows that cannot be used are counted in `problems`.

    Raises DataError when the file cannot be read, is no such table, or lacks samples or frames.
    """
    met = Problems()
    check_size(path, _MAX_FILE_BYTES)
    _check_head(path)
    meta: dict[str, str] = {}
    samples: list[Row[list[float]]] = []
    frames: dict[int, dict[int, tuple[float, float]]] = {}
    for t_ns, (kind, values) in read_rows(path, _parse, met, ",", needs_line_end=True):
        if kind == "meta":
            meta[values[0]] = values[1]
        elif kind == "imu":
            samples.append((t_ns, values))
        elif values[0] in (seen := frames.setdefault(t_ns, {})):
            met.count("a landmark twice in a frame", f"{t_ns} ns")
        else:
            seen[values[0]] = values[1]
    kept = list(in_time_order(samples, met, "imu"))
    problems.update(met)
    if len(kept) < 2 or not frames:
        raise DataError(f"{path} holds {len(kept)} inertial samples and {len(frames)} frames; both are needed")
    stamps = sorted(frames)
    return TrackTable(
        meta,
        np.array([t_ns for t_ns, _ in kept], dtype=np.int64),
        np.array([values for _, values in kept]),
        np.array(stamps, dtype=np.int64),
        tuple(_in_order(frames[t_ns]) for t_ns in stamps),
    )


def _check_head(path: Path) -> None:
    with opened(path) as file:
        head = file.readline(256)
    if not head.startswith(f"{_FIRST_COLUMN},".encode()):
        raise DataError(f"{path} is no table of tracks: its first line does not begin with '{_FIRST_COLUMN},'")


def _parse(fields: list[str]) -> Row[tuple[str, list[Any]]]:
    """Return stamp (0 for meta), kind, and what the row holds; raises ValueError or ArithmeticError."""
    if len(fields) < _COLUMNS:
        raise ValueError
    kind = fields[0]
    if kind == "meta":
        return 0, (kind, [fields[_KEY], fields[_KEY + 1].strip()])
    t_ns = parse_seconds(fields[_STAMP])
    if kind == "imu":
        return t_ns, (kind, _finite(fields[_IMU]))
    if kind != "vision_feature":
        raise ValueError
    landmark, (u, v) = int(fields[_LANDMARK]), _finite(fields[_SEEN])
    if not 0 <= landmark < _MAX_ID or max(abs(u), abs(v)) > _MAX_NORMALISED:
        raise ValueError
    return t_ns, (kind, [landmark, (u, v)])


def _finite(fields: list[str]) -> list[float]:
    values = [float(field) for field in fields]
    if not all(map(math.isfinite, values)):
        raise ArithmeticError
    return values


def _in_order(seen: dict[int, tuple[float, float]]) -> tuple[NDArray[np.int64], Array]:
    ids = sorted(seen)
    return np.array(ids, dtype=np.int64), np.array([seen[i] for i in ids])


def _numbers(table: TrackTable, names: tuple[str, ...], path: Path) -> list[float]:
    try:
        return _finite([table.meta[name] for name in names])
    except KeyError as error:
        raise DataError(f"{path} lacks the meta value {error.args[0]}; export it again") from error
    except (ValueError, ArithmeticError) as error:
        raise DataError(f"{path}: meta values {', '.join(names)} must be finite numbers") from error


def _rig(table: TrackTable, path: Path) -> Rig:
    """Return the one camera: principal point in the middle, as large as what was seen in it."""
    focal = np.array(_numbers(table, _CAMERA, path))
    if (focal <= 0.0).any() or (focal > _MAX_FOCAL_PX).any():
        raise DataError(f"{path}: focal lengths must be 0 to {_MAX_FOCAL_PX:g} px, got {focal.tolist()}")
    reach = np.max([np.abs(seen).max(axis=0) for _, seen in table.seen], axis=0)
    half = np.ceil(focal * reach) + 1.0
    camera = Camera(int(2 * half[0]) + 1, int(2 * half[1]) + 1, *focal.tolist(), *half.tolist())
    pose = np.array(_numbers(table, _POSE, path))
    if abs(np.linalg.norm(pose[3:]) - 1.0) > 1e-3:
        raise DataError(f"{path}: quaternion T_ci_q has norm {np.linalg.norm(pose[3:]):.4g} instead of 1")
    return Rig((camera,), (transform(rotation_from_quaternion_xyzw(pose[3:]), pose[:3]),))


def _assumed_noise(table: TrackTable, path: Path) -> ImuNoise:
    """Return the noise that the table states as assumed of the IMU."""
    squared = np.array(_numbers(table, tuple(f"eqf.{name}" for name in _NOISE), path))
    if (squared < 0.0).any() or (squared[:2] == 0.0).any():
        raise DataError(f"{path}: eqf.input_var_* must be positive, got {squared.tolist()}; give truth=RECORDING")
    rate_hz = 1e9 / float(np.median(np.diff(table.imu_t_ns)))
    gyro, accel, gyro_walk, accel_walk = np.sqrt(squared).tolist()
    return ImuNoise(gyro, accel, gyro_walk, accel_walk, rate_hz)


def _part(t_ns: Stamps, options: TrackOptions, path: Path) -> tuple[int, int]:
    """Return the first frame of the part that was asked for, and the one after its last."""
    since_s = (t_ns - t_ns[0]) * 1e-9
    end_s = np.inf if options.duration_s is None else options.start_s + options.duration_s
    first, last = np.searchsorted(since_s, [options.start_s - 1e-6, end_s + 1e-6])
    if last - first < 2 or (options.duration_s is not None and end_s > since_s[-1] + 0.1):
        raise UsageError(
            f"{path} lasts {since_s[-1]:.1f} s, asked for {options.duration_s or 0.0:g} s from {options.start_s:g} s "
            "on; choose another start_s or duration_s"
        )
    return int(first), int(last)
