"""What TORO's and iSAM's files share: poses as x y angle, or x y z roll pitch yaw, and lines of them.

Both programs take the error of a translation in the frame of the first pose, R_i^T (t_j - t_i) - z, where ours is in
that of the measured second pose: information has to be turned on the way in and on the way out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.batch.posegraph.parts import poses_from_angles
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.tagged_lines import Rows, TaggedLines
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array


def choose_dimension(path: Path, plane: tuple[Rows, Rows], space: tuple[Rows, Rows]) -> tuple[Rows, Rows, bool]:
    """Return rows of poses, rows of edges and whether they are of the plane. Raises DataError where there are both."""
    first_2d, first_3d = (min((int(r.lines[0]) for r in rows if len(r.lines)), default=0) for rows in (plane, space))
    if first_2d and first_3d:
        raise DataError(f"{path}:{max(first_2d, first_3d)}: poses in the plane and in space in one file; give one kind")
    return (*plane, True) if first_2d else (*space, False)


def poses_of(numbers: Array, two: bool) -> Array:
    """Return transforms [M, d + 1, d + 1] of rows that begin with x y angle, or with x y z roll pitch yaw."""
    if two:
        return poses_from_angles(numbers[:, :2], numbers[:, 2])
    out = np.tile(np.eye(4), (len(numbers), 1, 1))
    if len(numbers):
        out[:, :3, :3] = Rotation.from_euler("ZYX", numbers[:, 5:2:-1]).as_matrix()
        out[:, :3, 3] = numbers[:, :3]
    return out


def numbers_of(poses: Array) -> Array:
    """Return the rows [M, 3] x y angle or [M, 6] x y z roll pitch yaw of transforms."""
    d = poses.shape[1] - 1
    if d == 2:
        return np.column_stack([poses[:, :2, 2], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])
    if not len(poses):
        return np.empty((0, 6))
    # at a pitch of 90 degrees only roll - yaw counts, and yaw is made zero
    R = poses[:, :3, :3]
    level = np.hypot(R[:, 2, 1], R[:, 2, 2])
    upright = level < 1e-9
    yaw = np.where(upright, 0.0, np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    roll = np.where(upright, np.arctan2(-R[:, 1, 2], R[:, 1, 1]), np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    return np.column_stack([poses[:, :3, 3], roll, np.arctan2(-R[:, 2, 0], level), yaw])


def planar_tangent(measured: Array) -> Array:
    """Return the derivatives [E, 3, 3] of x y angle in the first pose's frame by our tangent, at measurements."""
    J = np.zeros((len(measured), 3, 3))
    J[:, :2, 1:] = measured[:, :2, :2]
    J[:, 2, 0] = 1.0
    return J


def pose_lines(problem: PoseGraphProblem, poses: Array | None, tag: str) -> Iterator[str]:
    """Yield a line per pose that has a value."""
    values = problem.poses if poses is None else poses
    known = ~np.isnan(values[:, 0, 0])
    numbers = numbers_of(values[known])
    row = f"{tag} %d " + " ".join(["%.17g"] * numbers.shape[1])
    for i, fields in zip(problem.ids[known].tolist(), numbers.tolist(), strict=True):
        yield row % (i, *fields)


def edge_lines(problem: PoseGraphProblem, upper: Array, tag: str) -> Iterator[str]:
    """Yield a line per edge: ids, measurement and the numbers [E, C] of its information."""
    numbers = np.column_stack([numbers_of(problem.measurements), upper])
    row = f"{tag} %d %d " + " ".join(["%.17g"] * numbers.shape[1])
    for (i, j), fields in zip(problem.ids[problem.edges].tolist(), numbers.tolist(), strict=True):
        yield row % (i, j, *fields)


def refuse_other_tags(path: Path, found: TaggedLines, known: Mapping[str, tuple[int, int]]) -> None:
    """Raise DataError at the first line with a tag that is not known."""
    for line, text in found.others:
        raise DataError(f"{path}:{line}: '{text.split()[0][:40]}' is no tag that is known here: {', '.join(known)}")


def refuse_what_is_lost(problem: PoseGraphProblem, path: Path, name: str, with_landmarks: bool = False) -> None:
    """Raise UsageError for a problem with fixed poses or landmarks, which the format has no lines for."""
    if problem.fixed.any() or problem.passed_lines or not (problem.of_poses or with_landmarks):
        raise UsageError(f"{path}: {name} files have no lines for fixed poses, landmarks, priors; write a g2o file")
