"""iSAM's text files: edges with the square root of their information, poses only in space, landmarks in the plane.

iSAM's residual is the difference of the numbers x y angle, or x y z yaw pitch roll, of the predicted and the measured
motion (`Pose2d_Pose2d_Factor`, `Pose3d_Pose3d_Factor`): of translations in the first pose's frame, and of Euler angles.
Information is carried into our tangent at the measurement and back, so that both costs agree to second order; at a
pitch of 90 degrees Euler angles have no rates, and such an edge is refused.

Files go about in this format whose numbers are covariances (Victoria Park as gtsam brings it). Taken for square roots,
their headings would be off by more than half a turn, which is meaningless: that identifies them.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Literal

import numpy as np

from vislam.batch.posegraph.angles import (
    choose_dimension,
    edge_lines,
    numbers_of,
    planar_tangent,
    pose_lines,
    poses_of,
    refuse_other_tags,
    refuse_what_is_lost,
)
from vislam.batch.posegraph.extras import Extras
from vislam.batch.posegraph.landmark_lines import (
    BEARING_RANGE_COLUMNS,
    LANDMARK_COLUMNS,
    Noise,
    information_of,
    landmark_lines,
    read_sightings,
    with_sightings,
)
from vislam.batch.posegraph.parts import EdgeLines, PoseLines, problem_from_lines
from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.tagged_lines import Rows, read_tagged_lines
from vislam.core.errors import DataError, UsageError
from vislam.core.files import write_lines
from vislam.core.messages import Array

_EDGES_2D = ("ODOMETRY", "EDGE2", "Constraint2")
_SEEN = LANDMARK_COLUMNS | BEARING_RANGE_COLUMNS
_COLUMNS = dict.fromkeys(_EDGES_2D, (2, 9)) | {"EDGE3": (2, 27), "POSE3D_INIT": (1, 6)} | _SEEN
_MAX_ID = 2**63 - 1
_UPRIGHT = 1e-6  # cosine of the pitch
_NO_PIVOT = 1e-7  # of the largest of a square root: below, information is singular


def read_isam(path: Path, repair: bool = False, noise: Noise | Literal["auto"] = "auto") -> PoseGraphProblem:
    """Read ODOMETRY, EDGE2, Constraint2, LANDMARK and BR, or EDGE3 and POSE3D_INIT.

    There are no poses of the plane to start from. Edges are in the order of the file, landmarks behind them. `noise`
    is what stands for it in the plane: the square root of information, as in iSAM, or covariances; "auto" decides.
    Raises DataError with the line number on damage of any kind, on both dimensions in one file, and on other tags;
    landmarks whose ids are poses', too, are numbered behind these; see `problem_from_lines` for the rest.
    """
    found, passed_over = read_tagged_lines(path, _COLUMNS).without_data()
    refuse_other_tags(path, found, _COLUMNS)
    plane, space = _joined([found.rows[tag] for tag in _EDGES_2D]), (found.rows["POSE3D_INIT"], found.rows["EDGE3"])
    seen = [found.rows[tag] for tag in _SEEN if len(found.rows[tag].lines)]
    first_seen = min((int(rows.lines[0]) for rows in seen), default=0)
    vertices, edges, two = choose_dimension(path, (_joined([]), plane), space)
    if first_seen and not two:
        raise DataError(f"{path}:{first_seen}: landmarks are known in the plane alone here, beside edges of the plane")
    measured = poses_of(edges.numbers, two)
    form, notes = _form(edges, noise) if two else ("root", ())
    J = _file_tangent(path, measured, edges.lines)
    information = J.transpose(0, 2, 1) @ information_of(path, edges.numbers[:, J.shape[1] :], edges.lines, form) @ J
    information = 0.5 * (information + information.transpose(0, 2, 1))
    poses = PoseLines(vertices.ids.reshape(-1), poses_of(vertices.numbers, two), vertices.lines)
    found_edges = EdgeLines(edges.ids, measured, information, edges.lines)
    if not first_seen:
        problem = problem_from_lines(path, 2 if two else 3, poses, found_edges, repair=repair)
    else:
        sightings, renumbered = _numbered_apart(read_sightings(path, found.rows, form), found_edges)
        problem = with_sightings(path, poses, found_edges, sightings, repair)
        notes += renumbered
    return problem.noted(notes + passed_over)


def _numbered_apart(seen: Extras, edges: EdgeLines) -> tuple[Extras, tuple[str, ...]]:
    """Return sightings whose landmarks have ids of their own, and a note where that changed them.

    iSAM counts poses and landmarks apart, so the same number may stand for one of each.
    """
    of_poses = np.concatenate([edges.ids.ravel(), seen.observer])
    landmarks, at = np.unique(seen.to, return_inverse=True)
    first = int(of_poses.max()) + 1
    if not np.isin(landmarks, of_poses).any() or first + len(landmarks) > _MAX_ID:
        return seen, ()
    note = f"landmarks {landmarks[0]} to {landmarks[-1]} have ids of poses; they are numbered from {first} on"
    return replace(seen, to=first + at), (note,)


def _form(edges: Rows, noise: Noise | Literal["auto"]) -> tuple[Noise, tuple[str, ...]]:
    """Return what the noise of edges of the plane is stated as, and a note where that was found out."""
    if noise != "auto":
        return noise, ()
    root = float(np.median(edges.numbers[:, -1])) if len(edges.lines) else 0.0
    if not 0.0 < root < 1.0 / np.pi:
        return "root", ()
    note = (
        f"the noise was read as covariances (headings to {np.sqrt(root):.2g} rad): as square roots of information, "
        f"headings would be off by {1.0 / root:.2g} rad, which is meaningless; --isam-noise root reads them so"
    )
    return "covariance", (note,)


def write_isam(problem: PoseGraphProblem, path: Path, poses: Array | None = None) -> None:
    """Write a problem with 17 digits; in space with poses, `poses` [N, d + 1, d + 1] in the place of its own.

    Raises UsageError for what the format cannot hold (fixed poses, priors, landmarks in space, information without a
    square root, a measured pitch of 90 degrees), StorageError.
    """
    seen = problem.is_position if problem.dimension == 2 and problem.world < 0 else np.zeros(0, dtype=np.bool_)
    refuse_what_is_lost(problem, path, "iSAM", with_landmarks=bool(seen.any()))
    whole, problem = problem, problem.with_edges(~seen) if seen.any() else problem
    J = _file_tangent(path, problem.measurements, np.arange(1, len(problem.edges) + 1), UsageError)
    inverse = np.linalg.inv(J)
    try:
        R = np.linalg.cholesky(inverse.transpose(0, 2, 1) @ problem.information @ inverse).transpose(0, 2, 1)
        pivots = np.diagonal(R, axis1=1, axis2=2)
        if np.any(pivots.min(axis=1) <= _NO_PIVOT * pivots.max(axis=1)):  # by rounding above zero
            raise np.linalg.LinAlgError
        places = list(landmark_lines(whole)) if seen.any() else []
    except np.linalg.LinAlgError as error:
        raise UsageError(
            f"{path}: an edge's information is singular and has no square root; write a g2o file"
        ) from error
    a, b = np.triu_indices(problem.tangent)
    two = problem.dimension == 2
    starts = () if two else pose_lines(problem, poses, "POSE3D_INIT")
    write_lines(path, chain(starts, edge_lines(problem, R[:, a, b], "EDGE2" if two else "EDGE3"), places))


def _joined(parts: list[Rows]) -> Rows:
    """Return rows in the order of their lines."""
    if not parts:
        return Rows(np.empty((0, 1), dtype=np.int64), np.empty((0, 3)), np.empty(0, dtype=np.int64))
    ids, numbers, lines = (np.concatenate([getattr(p, name) for p in parts]) for name in ("ids", "numbers", "lines"))
    order = np.argsort(lines)
    return Rows(ids[order], numbers[order], lines[order])


def _file_tangent(path: Path, measured: Array, lines: Ids, error: type[DataError | UsageError] = DataError) -> Array:
    """Return the derivatives [E, k, k] of the file's numbers by our tangent (rotation first) at measurements."""
    if measured.shape[1] == 3:
        return planar_tangent(measured)
    J = np.zeros((len(measured), 6, 6))
    J[:, :3, 3:] = measured[:, :3, :3]
    roll, pitch = numbers_of(measured)[:, 3:5].T
    cos_pitch = np.cos(pitch)
    upright = np.abs(cos_pitch) < _UPRIGHT
    if upright.any():
        where = f"{path}:{lines[int(np.argmax(upright))]}"
        raise error(f"{where}: at a pitch of 90 degrees Euler angles say nothing of small rotations; write a g2o file")
    s, c, t = np.sin(roll), np.cos(roll), np.tan(pitch)
    J[:, 3, 0] = 1.0
    J[:, 3, 1], J[:, 3, 2] = s * t, c * t
    J[:, 4, 1], J[:, 4, 2] = c, -s
    J[:, 5, 1], J[:, 5, 2] = s / cos_pitch, c / cos_pitch
    return J
