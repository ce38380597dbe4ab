"""True trajectories of the supported formats.

`vislam.trajectory` reads trajectory files strictly, since an evaluation must not rest on a damaged file. The truth of a
recording is read here with the tolerance of its other tables: a recording that was cut short keeps what it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from vislam.core.errors import DataError
from vislam.core.geometry import rotation_from_quaternion_xyzw
from vislam.core.messages import Array
from vislam.core.recording import Problems
from vislam.datasets.images import Stamps
from vislam.datasets.tables import MAX_FILE_BYTES, Row, check_size, header, in_time_order, parse_seconds, read_numbers
from vislam.trajectory import Trajectory, read_kitti
from vislam.trajectory.formats import gives_rotation
from vislam.trajectory.named_columns import named_columns

Truth = Callable[[Problems], Trajectory | None]


def asl_truth(path: Path, T_sensor_body: Array) -> Truth:
    """Return a reader of ASL truth: t [ns], position, quaternion w x y z of a sensor, whose pose gives the body's."""

    def read(problems: Problems) -> Trajectory | None:
        check_size(path, MAX_FILE_BYTES)
        _check_names(path, ",", (5, 6, 7, 4), 1.0)
        rows = ((t, [*v[:3], *v[4:7], v[3]]) for t, v in read_numbers(path, 7, problems))
        return trajectory_of(rows, problems, T_sensor_body)

    return read


def tum_truth(path: Path) -> Truth:
    """Return a reader of TUM truth: t [s], position, quaternion x y z w of cam0, which is the body."""

    def read(problems: Problems) -> Trajectory | None:
        check_size(path, MAX_FILE_BYTES)
        _check_names(path, None, (4, 5, 6, 7), 1e9)
        return trajectory_of(read_numbers(path, 7, problems, parse_seconds, None), problems, np.eye(4))

    return read


def _check_names(path: Path, separator: str | None, turn: tuple[int, ...], unit_ns: float) -> None:
    """Raise DataError where a header names another order or unit than the format has."""
    named = named_columns(path, [*header(path, separator)])
    wanted = ((1, 2, 3), turn, unit_ns, 1.0)
    if named and (named.position, named.turn or turn, named.unit_ns or unit_ns, named.unit_m) != wanted:
        order = "qw, qx, qy, qz in ns" if turn[0] == 5 else "qx, qy, qz, qw in s"
        raise DataError(f"{path}: its header names another order or unit than t, x, y, z, {order} and m; convert it")


def kitti_truth(path: Path, t_ns: Stamps) -> Truth:
    """Return a reader of KITTI truth: the nth row holds the 3x4 pose of cam0 at the nth stamp."""
    return lambda _problems: read_kitti(path, t_ns)


def trajectory_of(rows: Iterable[Row[list[float]]], problems: Problems, T_sensor_body: Array) -> Trajectory | None:
    """Return the body's trajectory of rows t, x, y, z, qx, qy, qz, qw of a sensor; None without usable rows.

    Rows that all have the same empty rotation give positions only.
    """
    kept = list(in_time_order(rows, problems, "truth"))
    values = np.array([row[1] for row in kept]).reshape(-1, 7)
    t_ns = np.array([row[0] for row in kept], dtype=np.int64)
    has_rotation = gives_rotation(values[:, 3:], identity_is_none=True)
    if not has_rotation:
        values[:, 3:] = [0.0, 0.0, 0.0, 1.0]
    usable = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) < 0.1
    problems.count("truth: quaternion that is not of unit norm", times=int(np.count_nonzero(~usable)))
    if not usable.any():
        return None
    T = np.tile(np.eye(4), (int(usable.sum()), 1, 1))
    T[:, :3, :3] = rotation_from_quaternion_xyzw(values[usable, 3:])
    T[:, :3, 3] = values[usable, :3]
    return Trajectory(t_ns[usable], T @ T_sensor_body, has_rotation)
