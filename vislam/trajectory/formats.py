"""Trajectory files: TUM and KITTI, read strictly and written atomically.

A damaged line is an error with its file and line, never a pose that is quietly wrong.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.collector import paused
from vislam.core.errors import DataError
from vislam.core.files import write_lines
from vislam.core.geometry import quaternion_xyzw_from_rotation
from vislam.core.messages import Array
from vislam.core.reading import opened
from vislam.core.streams import Happening, StreamJudge
from vislam.core.trajectory import Trajectory

_LOG = logging.getLogger(__name__)
_MAX_BYTES = 512 * 2**20  # ten million poses; a larger file is not a trajectory
_MAX_LINE_BYTES = 16_384  # a state line with its covariance has about 3000
_MAX_STAMP_NS = 2**62
_QUATERNION_NORM_TOLERANCE = 0.02  # files round to as few as 4 decimals
_FARTHEST_M = 1e15  # beyond, a double knows no metre
_ROTATION_TOLERANCE = 1e-3  # KITTI files round to 7 digits


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file: `t tx ty tz qx qy qz qw` in seconds and metres, `#` starts a comment.

    Raises DataError with file and line on a damaged line, a zero quaternion, NaN or a backward stamp; of poses of one
    time the first is taken, as a run does.
    """
    stamps, numbers, lines = read_table(path, separator=None, columns=(8,))
    t_ns = np.array([stamp_ns(text, 1e9, path, n) for text, n in zip(stamps, lines, strict=True)], dtype=np.int64)
    return trajectory_of_rows(t_ns, (numbers[:, 0:3], numbers[:, 3:7]), path, lines)


@paused()
def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a TUM file with exact nanoseconds; the file appears whole or not at all. Raises StorageError."""
    write_lines(path, _tum_lines(trajectory))


def _tum_lines(trajectory: Trajectory) -> Iterator[str]:
    q, row = _quaternions_xyzw(trajectory), "%s%d.%09d" + " %.9f" * 7
    yield "# t_s tx ty tz qx qy qz qw"
    for t_ns, p, o in zip(trajectory.t_ns.tolist(), trajectory.positions_m.tolist(), q.tolist(), strict=True):
        sign, (seconds, fraction) = "-" if t_ns < 0 else "", divmod(abs(t_ns), 10**9)
        yield row % (sign, seconds, fraction, *p, *o)


def read_kitti(path: Path, t_ns: NDArray[np.int64]) -> Trajectory:
    """Read a KITTI pose file (12 numbers of a row-major 3x4 matrix per line) whose poses have times in ns [N]."""
    _, numbers, lines = read_table(path, separator=None, columns=(12,), with_stamp=False)
    _check_count(len(t_ns), len(numbers), path)
    _check_increasing(t_ns, path, lines)
    return Trajectory(t_ns, kitti_poses(numbers, path, lines))


def kitti_poses(numbers: Array, path: Path, lines: list[int]) -> Array:
    """Return poses [N, 4, 4] of rows [N, 12] of 3x4 matrices; raises DataError for what is no rotation or too far."""
    _check_reach(numbers, path, lines)
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :4] = numbers.reshape(-1, 3, 4)
    U, _, Vt = np.linalg.svd(poses[:, :3, :3])
    R = U @ Vt  # the nearest rotation: repairs the rounding of the file
    wrong = (np.abs(R - poses[:, :3, :3]).max(axis=(1, 2)) > _ROTATION_TOLERANCE) | (np.linalg.det(R) < 0.0)
    if wrong.any():
        raise DataError(f"{path}:{lines[int(np.argmax(wrong))]}: the 3x3 part is not a rotation")
    poses[:, :3, :3] = R
    return poses


@paused()
def write_kitti(trajectory: Trajectory, path: Path) -> None:
    """Write a KITTI pose file; the format holds no times. Raises StorageError."""
    rows = trajectory.T_world_body[:, :3, :].reshape(-1, 12).tolist()
    row = " ".join(["%.12g"] * 12)
    write_lines(path, (row % tuple(numbers) for numbers in rows))


def data_lines(path: Path, comments: list[str] | None = None) -> Iterator[tuple[int, str]]:
    """Yield (line number, stripped line) of what is neither empty nor a comment (# or %); these go to `comments`."""
    try:
        with opened(path) as file:
            size = path.stat().st_size
            if size > _MAX_BYTES:
                raise DataError(
                    f"{path} has {size / 2**20:.0f} MiB; a trajectory file has at most {_MAX_BYTES >> 20} MiB"
                )
            number = 0
            while raw := file.readline(_MAX_LINE_BYTES):
                number += 1
                if len(raw) == _MAX_LINE_BYTES:
                    raise DataError(f"{path}:{number}: line longer than {_MAX_LINE_BYTES} bytes; not a trajectory file")
                is_comment = raw.startswith((b"#", b"%"))  # which may be in any encoding
                line = (
                    raw.decode("utf-8", "replace" if is_comment else "strict").strip().removeprefix("\ufeff")
                )  # the mark of bytes' order
                if line and not line.startswith(("#", "%")):
                    yield number, line
                elif line and comments is not None:
                    comments.append(line.lstrip("#% "))
    except UnicodeDecodeError as error:
        raise DataError(f"{path}:{number}: not text ({error.reason}); is this a trajectory file?") from error


def read_table(
    path: Path,
    separator: str | None,
    columns: tuple[int, ...],
    with_stamp: bool = True,
    header: list[str] | None = None,
    optional_from: int | None = None,
) -> tuple[list[str], Array, list[int]]:
    """Return the text of the first column, the finite numbers of the others [N, C] and the line numbers [N].

    With `header`, the first line must be exactly these names. Numbers from column `optional_from` on may be NaN (not
    estimated), but not infinite.
    """
    stamps: list[str] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    width = 0
    for number, line in data_lines(path):
        fields = line.split(separator)
        if header is not None:
            if fields != header:
                raise DataError(f"{path}:{number}: the header is not that of this kind of file: {line[:60]}...")
            header = None
            continue
        width = width or len(fields)
        if len(fields) not in columns or len(fields) != width:
            wanted = width if width in columns else " or ".join(str(count) for count in columns)
            why = "" if width in columns else f"; {why_columns(len(fields))}"
            raise DataError(f"{path}:{number}: expected {wanted} columns, got {len(fields)}{why}")
        try:
            if "_" in line:  # Python would read 1_0 as ten
                raise ValueError("'_' is not part of a number")
            rows.append([float(field) for field in (fields[1:] if with_stamp else fields)])
        except ValueError as error:
            raise DataError(f"{path}:{number}: {error}") from error
        stamps.append(fields[0])
        lines.append(number)
    if not rows:
        raise DataError(f"{path} holds no poses")
    numbers = np.array(rows)
    finite = np.isfinite(numbers[:, :optional_from]).all(axis=1) & ~np.isinf(numbers).any(axis=1)
    if not finite.all():
        raise DataError(f"{path}:{lines[int(np.argmin(finite))]}: NaN or infinity; remove or repair the line")
    return stamps, numbers, lines


def stamp_ns(text: str, unit_ns: float, path: Path, line: int) -> int:
    """Return a stamp in ns without going through a float, which cannot hold today's nanoseconds. Raises DataError."""
    try:
        value = Decimal(text.strip())
    except InvalidOperation as error:
        raise DataError(f"{path}:{line}: '{text[:40]}' is not a time stamp") from error
    limit = Decimal(_MAX_STAMP_NS / unit_ns)
    if not value.is_finite() or not -limit <= value <= limit:  # comparing never overflows, abs() may
        raise DataError(f"{path}:{line}: time stamp {text[:40]} is out of range")
    return int((value * int(unit_ns)).to_integral_value())


def is_number(text: str) -> bool:
    """Return whether a field is a number; Python would read 1_0 as one."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def why_columns(count: int) -> str:
    """Return in words what rows of `count` numbers are, for a reader that does not take them."""
    known = {
        7: "7 numbers, perhaps a pose without a time: put the time before each",
        12: "12 numbers, a 3x4 matrix as of KITTI if its left part is a rotation, which wants times beside it",
        13: "13 numbers, a stamp and a 3x4 matrix if its left part is a rotation",
    }
    wanted = (
        "read are t x y z qx qy qz qw, the same with a header that names further columns or another order, EuRoC's "
    )
    return f"{known.get(count, f'{count} numbers in which no pose is found')}; {wanted}and KITTI's 12"


def read_kitti_times(times: Path, poses: int, path: Path) -> NDArray[np.int64]:
    """Return the times [poses] in ns, a row in seconds each, for the poses in `path`; raises DataError."""
    stamps, _, lines = read_table(times, separator=None, columns=(1,))
    t_ns = np.array([stamp_ns(text, 1e9, times, n) for text, n in zip(stamps, lines, strict=True)], dtype=np.int64)
    _check_count(len(t_ns), poses, path)
    _check_increasing(t_ns, times, lines)
    return t_ns


def _check_count(times: int, poses: int, path: Path) -> None:
    if times != poses:
        raise DataError(f"{path} has {poses} poses but there are {times} times; give the times of this file")


def gives_rotation(q_xyzw: Array, identity_is_none: bool) -> bool:
    """Return whether quaternions [N, 4] say anything: they do not if all are zero.

    With `identity_is_none`, neither if all are the identity, with w at either end: so positions are written as poses.
    """
    is_same = bool((q_xyzw == q_xyzw[:1]).all())
    none = [np.zeros(4), *([np.eye(4)[0], np.eye(4)[3]] if identity_is_none else [])]
    return not (is_same and len(q_xyzw) and any((np.abs(q_xyzw[0]) == quaternion).all() for quaternion in none))


def trajectory_of_rows(
    t_ns: NDArray[np.int64], given: Array | tuple[Array, Array], path: Path, lines: list[int], *,
    identity_is_none: bool = False,
) -> Trajectory:  # fmt: skip
    """Return the trajectory of rows: poses [N, 4, 4], or positions [N, 3] and quaternions x y z w [N, 4].

    Of poses of one time the first is taken, which is stated. Raises DataError with file and line for times that go
    back, for what is too far, and for quaternions that are none; if none gives a rotation, it has positions only.
    """
    kept = np.ones(len(t_ns), dtype=bool)
    if (np.diff(t_ns) == 0).any() and (np.diff(t_ns) >= 0).all():
        judge = StreamJudge(path.name)
        kept = np.array([judge.takes(t) for t in t_ns.tolist()], dtype=bool)
        _LOG.warning("%s", "; ".join(e.words(int(t_ns[0])) for e in judge.events if e.happening is Happening.DUPLICATE))
        t_ns, lines = t_ns[kept], list(compress(lines, kept))
    _check_increasing(t_ns, path, lines)
    if not isinstance(given, tuple):
        return Trajectory(t_ns, given[kept])
    positions, q_xyzw = given[0][kept], given[1][kept]
    _check_reach(positions, path, lines)
    poses = np.tile(np.eye(4), (len(t_ns), 1, 1))
    poses[:, :3, 3] = positions
    if not gives_rotation(q_xyzw, identity_is_none):
        return Trajectory(t_ns, poses, has_rotation=False)
    norms = np.linalg.norm(q_xyzw, axis=1)
    wrong = np.abs(norms - 1.0) > _QUATERNION_NORM_TOLERANCE
    if wrong.any():
        i = int(np.argmax(wrong))
        raise DataError(f"{path}:{lines[i]}: quaternion has norm {norms[i]:.4g} instead of 1")
    poses[:, :3, :3] = Rotation.from_quat(q_xyzw).as_matrix()
    return Trajectory(t_ns, poses)


def _check_reach(numbers: Array, path: Path, lines: list[int]) -> None:
    near = (np.abs(numbers) <= _FARTHEST_M).all(axis=1)
    if not near.all():
        i = int(np.argmin(near))
        raise DataError(f"{path}:{lines[i]}: {np.abs(numbers[i]).max():.3g} m are too far, {_FARTHEST_M:g} m at most")


def _check_increasing(t_ns: NDArray[np.int64], path: Path, lines: list[int]) -> None:
    backward = np.flatnonzero(np.diff(t_ns) <= 0)
    if len(backward):
        i = int(backward[0]) + 1
        raise DataError(f"{path}:{lines[i]}: time stamp {t_ns[i]} ns does not follow {t_ns[i - 1]} ns; sort the file")


def _quaternions_xyzw(trajectory: Trajectory) -> Array:
    if not len(trajectory) or not trajectory.has_rotation:
        return np.zeros((len(trajectory), 4))
    return quaternion_xyzw_from_rotation(trajectory.T_world_body[:, :3, :3])
