"""TORO files.

In the plane the cost is TORO's own (`TreeOptimizer2::error`; see `graph_angles`). In space information is taken as of
the measured second pose's frame and of rotation vectors, as everybody who reads these files does; TORO's own residual
there is of the world's frame, so it is no function of relative motion.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from vislam.batch.posegraph.angles import (
    choose_dimension,
    edge_lines,
    planar_tangent,
    pose_lines,
    poses_of,
    refuse_other_tags,
    refuse_what_is_lost,
)
from vislam.batch.posegraph.landmark_lines import BEARING_RANGE_COLUMNS, read_sightings, with_sightings
from vislam.batch.posegraph.parts import EdgeLines, PoseLines, problem_from_lines, symmetric
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.tagged_lines import read_tagged_lines
from vislam.core.errors import DataError
from vislam.core.files import write_lines
from vislam.core.messages import Array

_COLUMNS = BEARING_RANGE_COLUMNS | {
    "VERTEX2": (1, 3), "EDGE2": (2, 9), "VERTEX3": (1, 6), "EDGE3": (2, 27), "EQUIV": (2, 0)
}  # fmt: skip
_ROWS_OF_TORO = [0, 1, 4, 2, 5, 3]  # its ff fs ss rr fr sr as an upper triangle in rows
_SAME = 1e12  # 1/m^2 and 1/rad^2, of what EQUIV joins: a micrometre, and little enough for the solver
_ORDER_3D = (3, 4, 5, 0, 1, 2)  # files have translation first


def read_toro(path: Path, repair: bool = False) -> PoseGraphProblem:
    """Read VERTEX2, EDGE2 and BR (bearing and range of a landmark, as gtsam writes it), or VERTEX3 and EDGE3.

    Raises DataError with the line number on damage of any kind, on both dimensions in one file and on other tags; see
    `problem_from_lines` for the rest. EQUIV, two names of one pose, is an edge without motion.
    """
    found, passed_over = read_tagged_lines(path, _COLUMNS).without_data()
    refuse_other_tags(path, found, _COLUMNS)
    rows = found.rows
    vertices, edges, two = choose_dimension(path, (rows["VERTEX2"], rows["EDGE2"]), (rows["VERTEX3"], rows["EDGE3"]))
    measured = poses_of(edges.numbers, two)
    if two:
        J = planar_tangent(measured)
        information = J.transpose(0, 2, 1) @ symmetric(edges.numbers[:, 3:][:, _ROWS_OF_TORO], (0, 1, 2)) @ J
    else:
        information = symmetric(edges.numbers[:, 6:], _ORDER_3D)
    poses = PoseLines(vertices.ids[:, 0], poses_of(vertices.numbers, two), vertices.lines)
    same, (k, size) = rows["EQUIV"], (information.shape[1], measured.shape[1])
    found_edges = EdgeLines(
        np.concatenate([edges.ids, same.ids]),
        np.concatenate([measured, np.tile(np.eye(size), (len(same.ids), 1, 1))]),
        np.concatenate([information, np.tile(_SAME * np.eye(k), (len(same.ids), 1, 1))]),
        np.concatenate([edges.lines, same.lines]),
    )
    if not len(rows["BR"].lines):
        return problem_from_lines(path, 2 if two else 3, poses, found_edges, repair=repair).noted(passed_over)
    if not two:
        raise DataError(f"{path}:{rows['BR'].lines[0]}: BR is of the plane, the poses are not; give one kind")
    seen = read_sightings(path, {"BR": rows["BR"]}, "root")
    return with_sightings(path, poses, found_edges, seen, repair).noted(passed_over)


def write_toro(problem: PoseGraphProblem, path: Path, poses: Array | None = None) -> None:
    """Write a problem with 17 digits, with `poses` [N, d + 1, d + 1] in the place of its own.

    Raises UsageError for what the format cannot hold (fixed poses, landmarks), StorageError.
    """
    refuse_what_is_lost(problem, path, "TORO")
    a, b = np.triu_indices(problem.tangent)
    if problem.dimension == 2:
        J = np.linalg.inv(planar_tangent(problem.measurements))
        upper = (J.transpose(0, 2, 1) @ problem.information @ J)[:, a, b][:, np.argsort(_ROWS_OF_TORO)]
        tags = "VERTEX2", "EDGE2"
    else:
        back = np.argsort(_ORDER_3D)
        upper, tags = problem.information[:, back[a], back[b]], ("VERTEX3", "EDGE3")
    write_lines(path, chain(pose_lines(problem, poses, tags[0]), edge_lines(problem, upper, tags[1])))
