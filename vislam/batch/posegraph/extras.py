"""Landmarks and priors in g2o files, in the order in which g2o's types write their fields.

A landmark is a pose without a rotation, a prior an edge from a pose at the origin of the world (`PoseGraphProblem`). An
offset P of a sensor on a body, which PARAMS_SE3OFFSET gives, is taken into what was measured: with the error
P^-1 T_i^-1 l - z of a landmark l, Z has the identity and t_P + R_P z; a prior with the error Log(Z^-1 T_i P) has the
measurement Z P^-1, and its information is carried over by the adjoint of P^-1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.parts import EdgeLines, PoseLines, poses_from_angles, poses_from_quaternions, symmetric
from vislam.batch.posegraph.problem import Ids, Mask, PoseGraphProblem
from vislam.batch.posegraph.structure import adjoints
from vislam.batch.posegraph.tagged_lines import Rows
from vislam.core.errors import DataError
from vislam.core.geometry import invert_many, quaternion_xyzw_from_rotation
from vislam.core.messages import Array

EXTRA_2D = {  # tag: ids and numbers
    "VERTEX_XY": (1, 2),
    "EDGE_SE2_XY": (2, 5),
    "LANDMARK2": (2, 5),  # an older name of it
    "EDGE_PRIOR_SE2": (1, 9),
    "EDGE_PRIOR_SE2_XY": (1, 5),
    "EDGE_PRIOR_XY": (1, 5),
}
EXTRA_3D = {  # the last of the ids of an edge is that of its offset
    "VERTEX_TRACKXYZ": (1, 3),
    "EDGE_SE3_TRACKXYZ": (3, 9),
    "EDGE_SE3_TRACKXYZ:QUAT": (3, 9),
    "EDGE_SE3_PRIOR": (2, 28),
    "EDGE_SE3_XYZ_PRIOR": (2, 9),
    "EDGE_POINTXYZ_PRIOR": (1, 9),
}
_OFFSETS = "PARAMS_SE3OFFSET"
EXTRA_COLUMNS = EXTRA_2D | EXTRA_3D | {_OFFSETS: (1, 7)}
_ORDER_2D, _ORDER_3D = (2, 0, 1), (3, 4, 5, 0, 1, 2)  # files have translation first


@dataclass(frozen=True, slots=True, eq=False)
class Extras:
    """Landmarks, and edges to and between what is no pose, as a file's lines gave them."""

    points: PoseLines
    to: Ids  # [E] what an edge ends at
    observer: Ids  # [E] from which pose; -1: from the world
    wants_point: Mask  # [E] whether it has to end at a landmark
    measurements: Array  # [E, d + 1, d + 1]
    information: Array  # [E, k, k] rotation, then translation
    is_position: Mask  # [E]
    lines: Ids  # [E]

    def __len__(self) -> int:
        """Number of lines."""
        return len(self.points.ids) + len(self.lines)

    @property
    def has_priors(self) -> bool:
        """Whether something is measured in the world."""
        return bool((self.observer < 0).any())

    def joined(self, path: Path, poses: PoseLines, edges: EdgeLines) -> tuple[PoseLines, EdgeLines]:
        """Return poses, then landmarks and, for priors, the world, and edges, then those of here.

        Raises DataError where an id is that of a pose and of a landmark, and where none is left for the world.
        """
        at_points, lines = np.concatenate([self.points.ids, self.to[self.wants_point]]), self.lines
        point_lines = np.concatenate([self.points.lines, lines[self.wants_point]])
        at_poses = np.concatenate(
            [poses.ids, edges.ids.ravel(), self.observer[self.observer >= 0], self.to[~self.wants_point]]
        )
        both = np.isin(at_points, at_poses)
        if both.any():
            i = int(np.argmax(both))
            raise DataError(f"{path}:{point_lines[i]}: {at_points[i]} is the id of a landmark and that of a pose")
        world = int(max(at_points.max(initial=0), at_poses.max(initial=0))) + 1
        if world > _MAX_ID and self.has_priors:
            raise DataError(f"{path} names the id {world - 1}; ids must be below it for priors to find a place")
        d, origin = poses.poses.shape[1] - 1, 1 if self.has_priors else 0
        pose = PoseLines(
            np.concatenate([poses.ids, self.points.ids, np.full(origin, min(world, _MAX_ID))]),
            np.concatenate([poses.poses, self.points.poses, np.eye(d + 1)[None][:origin]]),
            np.concatenate([poses.lines, self.points.lines, np.zeros(origin, dtype=np.int64)]),
        )
        ends = np.column_stack([np.where(self.observer < 0, world, self.observer), self.to])
        return pose, EdgeLines(
            np.concatenate([edges.ids, ends]),
            np.concatenate([edges.measurements, self.measurements]),
            np.concatenate([edges.information, self.information]),
            np.concatenate([edges.lines, lines]),
        )

    def marked(self, problem: PoseGraphProblem) -> PoseGraphProblem:
        """Return a problem of what `joined` gave, with its landmarks, positions and world frame as given."""
        own = len(problem.edges) - len(self.lines)
        is_position = np.concatenate([np.zeros(own, dtype=np.bool_), self.is_position])
        information, turn = problem.information.copy(), problem.tangent - problem.dimension
        information[is_position, :turn] = information[is_position, :, :turn] = 0.0
        points = np.concatenate([self.points.ids, self.to[self.wants_point]])
        priors = int(np.count_nonzero(self.observer < 0))
        note = f"{len(np.unique(points))} landmarks, seen {len(self.lines) - priors} times, and {priors} priors"
        return replace(
            problem, information=information, is_position=is_position, is_point=np.isin(problem.ids, points),
            world=len(problem.ids) - 1 if self.has_priors else -1, notes=(*problem.notes, note),
        )  # fmt: skip


def read_extras(path: Path, rows: Mapping[str, Rows], d: int) -> Extras:
    """Return landmarks and priors. Raises DataError with the line of an offset that is not there."""
    if d == 2:
        points = rows["VERTEX_XY"]
        parts = [
            _positions(rows["EDGE_SE2_XY"], True, True),
            _positions(rows["LANDMARK2"], True, True),
            _priors_2d(rows["EDGE_PRIOR_SE2"]),
            _positions(rows["EDGE_PRIOR_SE2_XY"], False, False),
            _positions(rows["EDGE_PRIOR_XY"], False, True),
        ]
    else:
        points = rows["VERTEX_TRACKXYZ"]
        offsets = _read_offsets(path, rows[_OFFSETS])
        seen = [rows["EDGE_SE3_TRACKXYZ"], rows["EDGE_SE3_TRACKXYZ:QUAT"]]
        parts = [
            *(_shifted(path, _positions(r, True, True), offsets, r.ids[:, 2]) for r in seen),
            _priors_3d(path, rows["EDGE_SE3_PRIOR"], offsets),
            _positions(rows["EDGE_SE3_XYZ_PRIOR"], False, False),  # g2o reads the id of an offset, and leaves it aside
            _positions(rows["EDGE_POINTXYZ_PRIOR"], False, True),
        ]
    at = PoseLines(points.ids[:, 0], places(points.numbers), points.lines)
    fields = [np.concatenate([part[name] for part in parts]) for name in _FIELDS]
    return Extras(at, *fields)


def extra_vertices(problem: PoseGraphProblem, values: Array) -> Iterator[str]:
    """Yield the lines of landmarks at `values` [N, d + 1, d + 1]."""
    d = problem.dimension
    row = f"{'VERTEX_XY' if d == 2 else 'VERTEX_TRACKXYZ'} %d" + " %.15g" * d
    known = problem.is_point & ~np.isnan(values[:, 0, 0])
    for i, t in zip(problem.ids[known].tolist(), values[known, :d, d].tolist(), strict=True):
        yield row % (i, *t)


def extra_edges(problem: PoseGraphProblem) -> Iterator[str]:
    """Yield the lines of observations of landmarks and of priors."""
    d, order = problem.dimension, _ORDER_2D if problem.dimension == 2 else _ORDER_3D
    turn, back = problem.tangent - d, np.argsort(order)
    extra = np.flatnonzero(problem.is_position | (problem.edges[:, 0] == problem.world))
    offset = f" {_UNMOVED}" if d == 3 else ""
    if len(extra) and d == 3:
        yield f"{_OFFSETS} {_UNMOVED} 0 0 0 0 0 0 1"
    for e in extra.tolist():
        i, j = problem.edges[e].tolist()
        W, Z = problem.information[e], problem.measurements[e]
        ends = f"{problem.ids[j]}" if i == problem.world else f"{problem.ids[i]} {problem.ids[j]}"
        to_point = bool(problem.is_point[j])
        if problem.is_position[e] and (i != problem.world or np.array_equal(Z[:d, :d], np.eye(d))):
            numbers, upper = Z[:d, d], W[turn:, turn:][np.triu_indices(d)]
            kind = ("EDGE_SE2_XY", "EDGE_SE3_TRACKXYZ") if i != problem.world else _PRIORS[to_point]
            with_offset = offset if i != problem.world or not to_point else ""
        else:
            numbers, upper = pose_numbers(Z[None])[0], W[np.ix_(back, back)][np.triu_indices(problem.tangent)]
            kind, with_offset = ("EDGE_PRIOR_SE2", "EDGE_SE3_PRIOR"), offset
        text = " ".join(f"{v:.15g}" for v in (*numbers.tolist(), *upper.tolist()))
        yield f"{kind[d - 2]} {ends}{with_offset} {text}"


def pose_numbers(T: Array) -> Array:
    """Return x, y, angle [M, 3] or x, y, z, quaternion [M, 7]."""
    if T.shape[1] == 3:
        return np.column_stack([T[:, :2, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    if not len(T):
        return np.empty((0, 7))
    return np.column_stack([T[:, :3, 3], quaternion_xyzw_from_rotation(T[:, :3, :3])])


_Columns = dict[str, NDArray[Any]]
_FIELDS = ("to", "observer", "wants_point", "measurements", "information", "is_position", "lines")
_PRIORS = (("EDGE_PRIOR_SE2_XY", "EDGE_SE3_XYZ_PRIOR"), ("EDGE_PRIOR_XY", "EDGE_POINTXYZ_PRIOR"))  # of pose, landmark
_MAX_ID = 2**63 - 1
_UNMOVED = 0  # id of the offset that is none; all others were taken into the measurements


def _positions(rows: Rows, observed: bool, wants_point: bool) -> _Columns:
    """Return edges to positions, seen from a pose or from the world."""
    d = 2 if rows.numbers.shape[1] == 5 else 3
    k, count = 3 * (d - 1), len(rows.lines)
    information = np.zeros((count, k, k))
    information[:, k - d :, k - d :] = symmetric(rows.numbers[:, d:], tuple(range(d)))
    return {
        "to": rows.ids[:, 1 if observed else 0], "wants_point": np.full(count, wants_point),
        "observer": rows.ids[:, 0] if observed else np.full(count, -1), "measurements": places(rows.numbers[:, :d]),
        "information": information, "is_position": np.full(count, True), "lines": rows.lines,
    }  # fmt: skip


def _priors_2d(rows: Rows) -> _Columns:
    Z = poses_from_angles(rows.numbers[:, :2], rows.numbers[:, 2])
    W = symmetric(rows.numbers[:, 3:], _ORDER_2D)
    return _priors(rows, Z, W, np.abs(W[:, :1]).sum(axis=(1, 2)) == 0.0)


def _priors_3d(path: Path, rows: Rows, offsets: dict[int, Array]) -> _Columns:
    Z = poses_from_quaternions(path, rows.numbers[:, :3], rows.numbers[:, 3:7], rows.lines)
    W = symmetric(rows.numbers[:, 7:], _ORDER_3D)
    back = invert_many(_offsets_of(path, offsets, rows.ids[:, 1], rows.lines))
    A = adjoints(back)
    priors = _priors(rows, Z @ back, A.transpose(0, 2, 1) @ W @ A, np.abs(W[:, :3]).sum(axis=(1, 2)) == 0.0)
    levers = priors["is_position"]
    moved = levers & back[:, :3, 3].any(axis=1)
    if moved.any():
        line = rows.lines[int(np.argmax(moved))]
        raise DataError(
            f"{path}:{line}: a prior of a position alone, with an offset away from the body, is not known here; give "
            "it information on the rotation, or an offset at the body's origin"
        )
    priors["information"][levers, :3] = priors["information"][levers, :, :3] = 0.0
    return priors


def _priors(rows: Rows, Z: Array, W: Array, is_position: Mask) -> _Columns:
    """Return edges from the world; to a position where nothing is said of the rotation."""
    count = len(rows.lines)
    return {
        "to": rows.ids[:, 0], "observer": np.full(count, -1), "wants_point": np.full(count, False), "measurements": Z,
        "information": W, "is_position": is_position, "lines": rows.lines,
    }  # fmt: skip


def _shifted(path: Path, edges: _Columns, offsets: dict[int, Array], ids: Ids) -> _Columns:
    """Return observations by a sensor as those by its body."""
    P = _offsets_of(path, offsets, ids, edges["lines"])
    Z, W = edges["measurements"].copy(), edges["information"].copy()
    Z[:, :3, 3] = np.einsum("eab,eb->ea", P[:, :3, :3], Z[:, :3, 3]) + P[:, :3, 3]
    W[:, 3:, 3:] = P[:, :3, :3] @ W[:, 3:, 3:] @ P[:, :3, :3].transpose(0, 2, 1)
    return edges | {"measurements": Z, "information": W}


def _read_offsets(path: Path, rows: Rows) -> dict[int, Array]:
    P = poses_from_quaternions(path, rows.numbers[:, :3], rows.numbers[:, 3:], rows.lines)
    return dict(zip(rows.ids[:, 0].tolist(), P, strict=True))


def _offsets_of(path: Path, offsets: dict[int, Array], ids: Ids, lines: Ids) -> Array:
    for i, line in zip(ids.tolist(), lines.tolist(), strict=True):
        if i not in offsets:
            raise DataError(f"{path}:{line}: there is no {_OFFSETS} {i}; add its line")
    return np.array([offsets[i] for i in ids.tolist()]).reshape(-1, 4, 4)


def places(positions: Array) -> Array:
    """Return transforms [M, d + 1, d + 1] without a rotation."""
    d = positions.shape[1]
    T = np.tile(np.eye(d + 1), (len(positions), 1, 1))
    T[:, :d, d] = positions
    return T
