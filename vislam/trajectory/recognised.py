"""Trajectory files of other tools, recognised by their content; what each was taken for is stated.

Read are TUM (ORB-SLAM3 with nanoseconds, evo), EuRoC, VINS-Mono and VINS-Fusion, KITTI, tables whose header names their
columns, and positions only; separated by blanks, commas or semicolons. What is ambiguous is settled by the numbers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.core.reading import open_file, opened
from vislam.core.trajectory import Trajectory
from vislam.trajectory.formats import (
    data_lines,
    is_number,
    kitti_poses,
    read_kitti_times,
    stamp_ns,
    trajectory_of_rows,
    why_columns,
)
from vislam.trajectory.named_columns import NamedColumns, named_columns, whole_names

_OTHERS = {
    b"PK\x03\x04": "a zip archive, as evo saves results; unzip it and give the trajectory in it, if it holds one",
    b"\x1f\x8b": "packed by gzip; unpack it first",
    b"\x93NUMPY": "an array of NumPy; save it as text: t x y z qx qy qz qw",
    b"\xff\xfe": "UTF-16 or not text; save it as UTF-8",
    b"#ROSBAG": "a bag; give its topic: --topic or --reference-topic",
    b"\x89MCAP": "a bag; give its topic: --topic or --reference-topic",
    b"{": "JSON; save its poses as text: t x y z qx qy qz qw",
    b"<": "a web page or XML, perhaps in place of the file; download it again",
    b"SQLite format 3": "a database; of a bag give the topic: --topic or --reference-topic",
}
_SAMPLE = 100  # rows by which a file is recognised
_UNITS = {1.0: "nanoseconds", 1e3: "microseconds", 1e6: "milliseconds", 1e9: "seconds"}
_EPOCH = ((1e17, 1.0), (1e14, 1e3), (1e11, 1e6))  # stamps since 1970 from 1973 to 5138 show their unit
_SINCE_1970_S = 1e8  # of a stamp, and more in smaller units
_NS_STEP = 1e4  # poses are neither three hours apart nor 10 us
_KITTI_HZ = 10


@dataclass(frozen=True, slots=True)
class Recognised:
    """A trajectory, what its file was taken for, and whether it has times; without them it is numbered at 10 Hz."""

    trajectory: Trajectory
    taken_for: str
    timed: bool = True


@dataclass(frozen=True, slots=True)
class _Layout:
    name: str
    separator: str | None
    width: int  # fields of each line, without an empty last one
    stamp: int | None  # column
    position: tuple[int, ...] = ()  # columns of x y z
    turn: tuple[int, ...] = ()  # columns of a quaternion x y z w, or of roll pitch yaw
    matrix: int | None = None  # first of 12 columns
    unit_ns: float = 1e9
    header: bool = False  # whether the first line is names
    named: NamedColumns | None = None  # where the header states the columns


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory file of any kind that `recognise` knows. Raises DataError, for one without times too."""
    found = recognise(path)
    if not found.timed:
        raise DataError(f"{path} is {found.taken_for}; put times.txt beside it")
    return found.trajectory


def recognise(path: Path, times: Path | None = None, or_times: Path | None = None) -> Recognised:
    """Read a trajectory file by what it holds.

    A file without times (KITTI) takes `times`, times.txt beside it or where KITTI keeps it, else `or_times`.

    Raises:
        DataError: with file and line, for what is no trajectory, is damaged, or is another kind of file.
    """
    _refuse_others(path)
    layout = _layout(path)
    stamps, numbers, lines, lost, is_cut = _rows(path, layout)
    if not len(numbers):
        raise DataError(f"{path} holds no poses" + (f", only {lost} rows of NaN" if lost else ""))
    left_out = f"; {lost} rows of NaN left out" if lost else ""
    left_out += "; last line cut short, left out" if is_cut else ""
    if layout.stamp is None:
        return _without_stamps(path, times or _times_of(path) or or_times, layout, numbers, lines)
    if times is not None:
        raise DataError(f"{path} has times of its own ({layout.name}); leave out the option for {times}")
    t_ns = np.array([stamp_ns(s, layout.unit_ns, path, n) for s, n in zip(stamps, lines, strict=True)], dtype=np.int64)
    if backward := int(np.count_nonzero(np.diff(t_ns) < 0)):
        order = np.argsort(t_ns, kind="stable")
        t_ns, numbers, lines = t_ns[order], numbers[order], [lines[k] for k in order]
        left_out += f"; time goes back {backward} times: sorted"
    if layout.matrix is not None:
        poses = kitti_poses(numbers, path, lines)
        found = trajectory_of_rows(t_ns, poses, path, lines)
    else:
        found = trajectory_of_rows(t_ns, _pose_parts(layout, numbers), path, lines, identity_is_none=True)
    kind = f"{layout.name}, {_UNITS[layout.unit_ns]}" + ("" if found.has_rotation else ", positions only")
    return Recognised(found, f"{kind}; {len(found)} poses over {found.duration_s:.1f} s{left_out}")


def _pose_parts(layout: _Layout, numbers: Array) -> tuple[Array, Array]:
    """Return positions [N, 3] in metres and quaternions x y z w [N, 4], zero where none is stated."""
    positions, turns = numbers[:, :3], numbers[:, 3:] if layout.turn else np.zeros((len(numbers), 4))
    if layout.named is not None:
        positions = positions * layout.named.unit_m
    if len(layout.turn) == 3:
        turns = Rotation.from_euler(
            "ZYX", turns[:, ::-1], layout.named is not None and layout.named.in_degrees
        ).as_quat()
    return positions, turns


def _times_of(path: Path) -> Path | None:
    sequence = path.parent.parent / "sequences" / path.stem / "times.txt"  # as KITTI's own poses/00.txt
    return next((file for file in (path.with_name("times.txt"), sequence) if file.is_file()), None)


def _without_stamps(path: Path, times: Path | None, layout: _Layout, numbers: Array, lines: list[int]) -> Recognised:
    poses = kitti_poses(numbers, path, lines)
    if times is None:
        t_ns = np.arange(len(poses)) * (10**9 // _KITTI_HZ)
        return Recognised(
            Trajectory(t_ns, poses),
            f"{layout.name} without times, {len(poses)} poses, taken for 10 a second",
            timed=False,
        )
    t_ns = read_kitti_times(times, len(poses), path)
    return Recognised(Trajectory(t_ns, poses), f"{layout.name}, times in {times}; {len(poses)} poses")


def _refuse_others(path: Path) -> None:
    with opened(path) as file:
        head = file.read(32)
    for begin, what in _OTHERS.items():
        if head.startswith(begin):
            raise DataError(f"{path} is {what}")


def _layout(path: Path) -> _Layout:
    """Return what the first rows of a file show."""
    comments: list[str] = []
    sample = list(islice(data_lines(path, comments), _SAMPLE))
    if not sample:
        raise DataError(f"{path} holds no poses")
    separator = next((sign for sign in (",", ";") if sign in sample[0][1]), None)
    rows = [_fields(line, separator) for _, line in sample]
    headers = [_fields(text, separator) for text in reversed(comments)]
    width = len(rows[0])
    names = next((whole for n in headers if (whole := whole_names(n, width))), [])
    names = names or next((n for n in headers if len(n) == width), [])
    has_header = not any(is_number(field) for field in rows[0])
    if has_header:
        names, rows = rows[0], rows[1:]
    named = named_columns(path, names)
    if not rows:
        raise DataError(f"{path} holds names of columns, but no poses")
    if named is None:
        return _by_numbers(path, sample[has_header], separator, rows, has_header)
    what = "TUM" if separator is None and width == 8 and named.turn == (4, 5, 6, 7) else "columns by their names"
    if separator and (width, named.turn[3:]) in {(8, (4,)), (17, (4,))}:
        what = "EuRoC"
    if len(named.turn) == 3:
        what += f", roll pitch yaw in {'degrees' if named.in_degrees else 'radians'}"
    if named.unit_m != 1.0:
        what += f", positions times {named.unit_m:g}"
    unit_ns = _unit_ns(rows, named.stamp) if named.unit_ns is None else named.unit_ns
    return _Layout(what, separator, width, named.stamp, named.position, named.turn, None, unit_ns, has_header, named)


def _by_numbers(
    path: Path, first_line: tuple[int, str], separator: str | None, rows: list[list[str]], header: bool
) -> _Layout:
    """Return what rows without names hold, by how many numbers there are and what they are."""
    line, text = first_line
    width, kind = len(rows[0]), "separated by blanks" if separator is None else f"separated by '{separator}'"
    try:
        first = np.array([float(field) for field in rows[0]])
    except ValueError as error:
        why = "no row of numbers, and no names of columns before it"
        if re.fullmatch(r"(-?\d+,\d+[\s;]*)+", text):
            why = "commas stand for decimal points; save it with points"
        raise DataError(f"{path}:{line}: {error}; {why}") from error
    if width == 12 and _is_pose(first):
        return _Layout("KITTI", separator, width, None, matrix=0, header=header)
    if width == 16 and _is_pose(first[:12]):
        return _Layout("4x4 matrices", separator, width, None, matrix=0, header=header)
    unit_ns = _unit_ns(rows, 0)
    if width in (13, 17) and _is_pose(first[1:13]):
        return _Layout("stamp and matrix", separator, width, 0, matrix=1, unit_ns=unit_ns, header=header)
    if width == 4:
        return _Layout(f"stamp and position {kind}", separator, width, 0, (1, 2, 3), (), None, unit_ns, header)
    if width == 7 and abs(first[0]) > _SINCE_1970_S and not _has_quaternion([["", *row] for row in rows]):
        why = (
            "7 numbers whose last four are no quaternion; if they are t x y z and angles, name them above: "
            "# t x y z roll_deg pitch_deg yaw_deg"
        )
        raise DataError(f"{path}:{line}: {why}, or _rad")
    if width < 8 or not _has_quaternion(rows):
        raise DataError(f"{path}:{line}: {why_columns(width)}")
    w_first = separator is not None and (unit_ns != 1e9 or width == 17 or abs(first[4]) > 0.99)
    known = {8: "EuRoC", 17: "EuRoC", 11: "VINS-Mono or VINS-Fusion"}
    if separator is None:
        name = "TUM" if unit_ns == 1e9 else "TUM columns as of ORB-SLAM3"
    else:
        name = known.get(width, f"a table {kind}") if w_first else f"TUM columns {kind}"
    name += ", quaternion w first" if w_first else ", quaternion w last"
    if width > 8 and (separator is None or width not in known):
        name += f", {width - 8} further columns ignored"
    return _Layout(
        name, separator, width, 0, (1, 2, 3), (5, 6, 7, 4) if w_first else (4, 5, 6, 7), None, unit_ns, header
    )


def _has_quaternion(rows: list[list[str]]) -> bool:
    """Return whether columns 5 to 8 of most rows have norm 1, or are zero or NaN as where no rotation is given."""
    turns = np.array([[float(f) if is_number(f) else np.inf for f in row[4:8]] for row in rows if len(row) >= 8])
    norms = np.linalg.norm(turns, axis=1)
    return bool(np.mean((np.abs(norms - 1.0) < 0.1) | (norms == 0.0) | np.isnan(norms)) > 0.5)


def _is_pose(twelve: Array) -> bool:
    R = twelve.reshape(3, 4)[:, :3]
    return bool(np.isfinite(R).all() and np.abs(R @ R.T - np.eye(3)).max() < 0.05 and np.linalg.det(R) > 0.0)


def _unit_ns(rows: list[list[str]], column: int) -> float:
    """Return the unit of stamps by how large they are and how far apart."""
    stamps = np.array([float(row[column]) for row in rows if len(row) > column and is_number(row[column])])
    stamps = stamps[np.isfinite(stamps)]
    if not len(stamps):
        return 1e9
    largest = float(np.abs(stamps).max())
    for least, unit_ns in _EPOCH:
        if largest >= least:
            return unit_ns
    steps = np.abs(np.diff(stamps))
    return 1.0 if len(steps) and np.median(steps) >= _NS_STEP else 1e9


def _fields(line: str, separator: str | None) -> list[str]:
    """Return the fields of a line, without an empty one behind the last separator."""
    fields = [field.strip(' \t"') for field in line.split(separator)]
    return fields[:-1] if separator is not None and fields and not fields[-1] else fields


def _rows(path: Path, layout: _Layout) -> tuple[list[str], Array, list[int], int, bool]:
    """Return stamps, the numbers of poses [N, 3, 7 or 12], lines [N], how many rows were NaN, if the last is cut."""
    used: Sequence[int] = (*layout.position, *layout.turn)
    if layout.matrix is not None:
        used = range(layout.matrix, layout.matrix + 12)
    stamps: list[str] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    skip, cut = layout.header, None
    for number, line in data_lines(path):
        if skip:
            skip = False
            continue
        if cut is not None:
            raise cut
        fields = _fields(line, layout.separator)
        if len(fields) != layout.width:
            first = "header" if layout.header else "first row"
            cut = DataError(f"{path}:{number}: {len(fields)} columns, where the {first} has {layout.width}")
            if len(fields) > layout.width or _ends(path):
                raise cut
            continue
        try:
            if "_" in line and any("_" in fields[k] for k in used):  # Python would read 1_0 as ten
                raise ValueError("'_' is not part of a number")
            rows.append([float(fields[k]) for k in used])
        except ValueError as error:
            raise DataError(f"{path}:{number}: {error}") from error
        stamps.append("" if layout.stamp is None else fields[layout.stamp])
        if layout.named is not None and layout.named.nanos is not None:
            stamps[-1] += f".{fields[layout.named.nanos]:0>9}"
        lines.append(number)
    numbers = np.array(rows).reshape(-1, len(used))
    kept = ~np.isnan(numbers).all(axis=1) if layout.stamp is not None else np.ones(len(numbers), dtype=bool)
    if layout.turn and np.isnan(numbers[:, 3:]).all():
        numbers[:, 3:] = 0.0
    index = np.flatnonzero(kept)
    stamps, lines, numbers = [stamps[k] for k in index], [lines[k] for k in index], numbers[kept]
    finite = np.isfinite(numbers).all(axis=1)
    if not finite.all():
        raise DataError(f"{path}:{lines[int(np.argmin(finite))]}: NaN or infinity; remove or repair the line")
    return stamps, numbers, lines, int(len(kept) - len(index)), cut is not None


def _ends(path: Path) -> bool:
    """Return whether the last line of a file has an end."""
    with open_file(path) as file:
        file.seek(-1, 2)
        return file.read() == b"\n"
