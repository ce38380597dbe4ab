"""g2o files: poses, landmarks, edges and priors in the plane and in space, and what is fixed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from vislam.batch.posegraph.extras import (
    EXTRA_2D,
    EXTRA_3D,
    EXTRA_COLUMNS,
    extra_edges,
    extra_vertices,
    pose_numbers,
    read_extras,
)
from vislam.batch.posegraph.parts import (
    EdgeLines,
    PoseLines,
    poses_from_angles,
    poses_from_quaternions,
    problem_from_lines,
    symmetric,
)
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.tagged_lines import Rows, TaggedLines, read_tagged_lines
from vislam.core.collector import paused
from vislam.core.errors import DataError
from vislam.core.files import write_lines
from vislam.core.messages import Array

_POSE_2D, _POSE_3D, _EDGE_2D, _EDGE_3D = "VERTEX_SE2", "VERTEX_SE3:QUAT", "EDGE_SE2", "EDGE_SE3:QUAT"
_COLUMNS = {_POSE_2D: (1, 3), _POSE_3D: (1, 7), _EDGE_2D: (2, 9), _EDGE_3D: (2, 28)}
_PASSED = {"PARAMS_SE2OFFSET": 4}  # tag: fields behind it
_POSE_DIGITS = {True: " ".join(["%.15g"] * 3), False: " ".join(["%.15g"] * 7)}
_EDGES_AT_ONCE = 4096
_ORDER_2D, _ORDER_3D = (2, 0, 1), (3, 4, 5, 0, 1, 2)  # files have translation first


def read_g2o(path: Path, repair: bool = False) -> PoseGraphProblem:
    """Read VERTEX_SE2 and EDGE_SE2, or VERTEX_SE3:QUAT and EDGE_SE3:QUAT, with FIX, landmarks and priors.

    The information of rotations is taken as of rotation vectors, as gtsam and SE-Sync read these files (g2o itself has
    it of the vector part of the quaternion, half of that). Raises DataError with the line number on damage of any kind,
    on both dimensions in one file and on tags that it does not know; see `problem_from_lines` for the rest.
    """
    found, passed_over = read_tagged_lines(path, _COLUMNS | EXTRA_COLUMNS).without_data()
    rows = found.rows
    in_plane, in_space = (
        [rows[tag].lines for tag in (pose, edge, *extra)]
        for pose, edge, extra in ((_POSE_2D, _EDGE_2D, EXTRA_2D), (_POSE_3D, _EDGE_3D, EXTRA_3D))
    )
    first_2d, first_3d = (min((int(n[0]) for n in lines if len(n)), default=0) for lines in (in_plane, in_space))
    if first_2d and first_3d:
        raise DataError(f"{path}:{max(first_2d, first_3d)}: poses in the plane and in space in one file; give one kind")
    fixed_ids, passed = _others(path, found)
    if first_2d:
        vertices, edges = rows[_POSE_2D], rows[_EDGE_2D]
        poses = poses_from_angles(vertices.numbers[:, :2], vertices.numbers[:, 2])
        measured = poses_from_angles(edges.numbers[:, :2], edges.numbers[:, 2])
        information = symmetric(edges.numbers[:, 3:], _ORDER_2D)
    else:
        vertices, edges = rows[_POSE_3D], rows[_EDGE_3D]
        poses, measured = _poses_3d(path, vertices), _poses_3d(path, edges)
        information = symmetric(edges.numbers[:, 7:], _ORDER_3D)
    d = 2 if first_2d else 3
    pose_lines = PoseLines(vertices.ids[:, 0], poses, vertices.lines)
    edge_lines = EdgeLines(edges.ids, measured, information, edges.lines)
    extras = read_extras(path, rows, d)
    if not len(extras):
        return problem_from_lines(path, d, pose_lines, edge_lines, fixed_ids, passed, repair).noted(passed_over)
    pose_lines, edge_lines = extras.joined(path, pose_lines, edge_lines)
    world = ((0, int(pose_lines.ids[-1])),) if extras.has_priors else ()
    problem = problem_from_lines(path, d, pose_lines, edge_lines, fixed_ids + world, passed, repair)
    return extras.marked(problem).noted(passed_over)


@paused()
def write_g2o(problem: PoseGraphProblem, path: Path, poses: Array | None = None) -> None:
    """Write a problem with 15 digits, with `poses` [N, d + 1, d + 1] in the place of its own.

    Poses without a value are left out. The file appears whole or not at all. Raises StorageError.
    """
    values = problem.poses if poses is None else poses
    fixed = problem.fixed & (problem.is_pose | problem.is_point)
    lines = (
        problem.passed_lines, _pose_lines(problem, values), extra_vertices(problem, values),
        (f"FIX {i}" for i in problem.ids[fixed].tolist()), extra_edges(problem), _edge_lines(problem),
    )  # fmt: skip
    write_lines(path, chain.from_iterable(lines))


def _pose_lines(problem: PoseGraphProblem, values: Array) -> Iterator[str]:
    two, known = problem.dimension == 2, ~np.isnan(values[:, 0, 0]) & problem.is_pose
    row = f"{_POSE_2D if two else _POSE_3D} %d {_POSE_DIGITS[two]}"
    for i, numbers in zip(problem.ids[known].tolist(), pose_numbers(values[known]).tolist(), strict=True):
        yield row % (i, *numbers)


def _edge_lines(problem: PoseGraphProblem) -> Iterator[str]:
    two = problem.dimension == 2
    row, back = (
        f"{_EDGE_2D if two else _EDGE_3D} %d %d {_POSE_DIGITS[two]} %s",
        np.argsort(_ORDER_2D if two else _ORDER_3D),
    )
    a, b = np.triu_indices(problem.tangent)
    digits = " ".join(["%.15g"] * len(a))
    texts: dict[bytes, str] = {}  # most files repeat a few matrices
    own = np.flatnonzero(~problem.is_position & (problem.edges[:, 0] != problem.world))
    for at in np.split(own, range(_EDGES_AT_ONCE, len(own), _EDGES_AT_ONCE)):
        ends, measured = problem.ids[problem.edges[at]].tolist(), pose_numbers(problem.measurements[at]).tolist()
        for (i, j), numbers, upper in zip(ends, measured, problem.information[at][:, back[a], back[b]], strict=True):
            matrix = upper.tobytes()
            if matrix not in texts:
                texts[matrix] = digits % tuple(upper.tolist())
            yield row % (i, j, *numbers, texts[matrix])


def _poses_3d(path: Path, rows: Rows) -> Array:
    return poses_from_quaternions(path, rows.numbers[:, :3], rows.numbers[:, 3:7], rows.lines)


def _others(path: Path, found: TaggedLines) -> tuple[tuple[tuple[int, int], ...], tuple[str, ...]]:
    """Return (line, id) of what is fixed, and the lines to keep: those of parameters that nothing uses."""
    fixed: list[tuple[int, int]] = []
    passed: list[str] = []
    for line, text in found.others:
        tag, *fields = text.split()
        if tag == "FIX":
            if not fields or not all(f.isascii() and f.isdigit() and len(f) < 20 for f in fields):
                raise DataError(f"{path}:{line}: FIX needs ids, got '{text[:40]}'")
            fixed += [(line, int(f)) for f in fields]
            continue
        if tag not in _PASSED:
            known = ", ".join([*_COLUMNS, "FIX", *EXTRA_COLUMNS, *_PASSED])
            raise DataError(f"{path}:{line}: '{tag[:40]}' is no tag that is known here: {known}")
        _check_fields(path, line, tag, fields)
        passed.append(text)
    return tuple(fixed), tuple(passed)


def _check_fields(path: Path, line: int, tag: str, fields: list[str]) -> None:
    try:
        good = len(fields) == _PASSED[tag] and all(math.isfinite(float(f)) and "_" not in f for f in fields)
    except ValueError:
        good = False
    if not good:
        raise DataError(f"{path}:{line}: {tag} needs {_PASSED[tag]} finite numbers; is the line cut short?")
