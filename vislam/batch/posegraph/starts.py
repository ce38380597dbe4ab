"""Where the optimisation of a pose graph starts: the file's poses, odometry, a spanning tree, chordal relaxation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.clusters import ClusteredSolver
from vislam.batch.posegraph.ordering import Ints
from vislam.batch.posegraph.parts import poses_from_angles
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.structure import Structure
from vislam.core.jit import njit
from vislam.core.messages import Array

Mask = NDArray[np.bool_]

_TOLERANCE = 1e-4  # of the relaxations' solutions, where these are found by conjugate gradients


def file_start(problem: PoseGraphProblem) -> Array:
    """Return the poses [N, d + 1, d + 1] that the problem has, with those missing chained to them by edges."""
    known = problem.has_pose
    if known.all():
        return problem.poses.copy()
    labels = problem.components()
    without = np.setdiff1d(np.arange(labels.max() + 1), labels[known])
    known[np.unique(labels, return_index=True)[1][without]] = True
    return _chained(problem, known, np.zeros(len(problem.edges), dtype=np.bool_))


def odometry_start(problem: PoseGraphProblem, anchors: Ints) -> Array:
    """Return poses chained from the anchors by edges between successive ids, other edges only where these end."""
    rank = np.cumsum(problem.is_pose)  # landmarks may have ids between those of poses
    successive = (np.abs(rank[problem.edges[:, 1]] - rank[problem.edges[:, 0]]) == 1) & problem.is_pose[
        problem.edges
    ].all(axis=1)
    return _chained(problem, np.isin(np.arange(len(problem.ids)), anchors), successive)


def tree_start(problem: PoseGraphProblem, anchors: Ints) -> Array:
    """Return poses chained from the anchors by as few edges as possible."""
    known = np.isin(np.arange(len(problem.ids)), anchors)
    return _chained(problem, known, np.zeros(len(problem.edges), dtype=np.bool_))


def chordal_start(structure: Structure, weights: Array) -> Array:
    """Return poses by the chordal relaxation: rotations as free matrices, made rotations, then positions.

    Two linear least-squares problems that know no local minimum, weighted by the isotropic parts of the information as
    in SE-Sync. Martinec and Pajdla, CVPR 2007; Carlone, Tron, Daniilidis, Dellaert, ICRA 2015.
    """
    problem = structure.problem
    d = problem.dimension
    rotation_weight, translation_weight = _isotropic(problem, weights)
    poses = _placed_anchors(problem)
    R, Z = poses[:, :d, :d], problem.measurements[:, :d, :d]
    if d == 3:
        relaxed = _relax(structure, rotation_weight, Z.transpose(0, 2, 1), R.transpose(0, 2, 1))
        U, _, Vt = np.linalg.svd(relaxed.transpose(0, 2, 1))
        U[:, :, 2] *= np.copysign(1.0, np.linalg.det(U) * np.linalg.det(Vt))[:, None]
        poses[structure.free, :3, :3] = U @ Vt
    else:
        heading = _relax(structure, rotation_weight, Z, R[:, :, :1])[:, :, 0]
        length = np.linalg.norm(heading, axis=1)
        c, s = np.where(length > 1e-12, heading.T / np.maximum(length, 1e-300), [[1.0], [0.0]])
        poses[structure.free, :2, :2] = np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1)
    _place(structure, translation_weight, poses)
    return poses


def angles_start(structure: Structure, weights: Array) -> Array:
    """Return poses in the plane by linear angles, made unique along a spanning tree of few edges, then positions.

    In large graphs the chordal relaxation fades: matrices far from the anchor shrink as their measurements contradict
    each other. Angles do not; they need cycles whose errors are below half a turn. Carlone, Aragues, Castellanos, Bona,
    "A fast and accurate approximation for planar pose graph optimization", IJRR 2014.
    """
    problem, ends, n = structure.problem, structure.ends, len(structure.free)
    rotation_weight, translation_weight = _isotropic(problem, weights)
    poses = tree_start(problem, structure.anchors)
    R, Z = poses[:, :2, :2], problem.measurements[:, :2, :2]
    missed = Z.transpose(0, 2, 1) @ R[problem.edges[:, 0]].transpose(0, 2, 1) @ R[problem.edges[:, 1]]
    pull = rotation_weight * np.arctan2(missed[:, 1, 0], missed[:, 0, 0])
    rhs = _gathered(ends[:, 0], pull, n) - _gathered(ends[:, 1], pull, n)
    total = _per_pose(ends, rotation_weight, n)
    turn = _solve(structure, 1, total, -rotation_weight[:, None, None], rhs[:, None, None], lambda: np.ones((n, 1, 1)))
    poses[structure.free] = poses_from_angles(np.zeros((n, 2)), turn[:, 0, 0]) @ poses[structure.free]
    _place(structure, translation_weight, poses)
    return poses


def _relax(structure: Structure, weights: Array, motions: Array, known: Array) -> Array:
    """Return X [n, d, C] of the free poses that minimises the sum of weight |X_to - motion @ X_from|^2."""
    problem, ends = structure.problem, structure.ends
    d, n = motions.shape[1], len(structure.free)
    total = _per_pose(ends, weights, n)
    rhs = np.zeros((n, *known.shape[1:]))
    scaled = weights[:, None, None] * motions
    from_held = np.flatnonzero((ends[:, 0] < 0) & (ends[:, 1] >= 0))
    np.add.at(rhs, ends[from_held, 1], scaled[from_held] @ known[problem.edges[from_held, 0]])
    to_held = np.flatnonzero((ends[:, 1] < 0) & (ends[:, 0] >= 0))
    np.add.at(rhs, ends[to_held, 0], scaled[to_held].transpose(0, 2, 1) @ known[problem.edges[to_held, 1]])
    return _solve(structure, d, total, -scaled, rhs, lambda: _carried(structure, motions))


def _place(structure: Structure, weights: Array, poses: Array) -> None:
    """Fill the positions of the free poses, given their rotations."""
    problem, ends = structure.problem, structure.ends
    d, n = problem.dimension, len(structure.free)
    total = _per_pose(ends, weights, n)
    R_from = poses[problem.edges[:, 0], :d, :d]
    moved = weights[:, None] * np.einsum("eij,ej->ei", R_from, problem.measurements[:, :d, d])
    anchored = weights[:, None, None] * poses[:, :d, d][problem.edges]  # [E, 2, d]
    rhs = np.zeros((n, d))
    for end, sign in ((1, 1.0), (0, -1.0)):
        terms = sign * moved
        held = ends[:, 1 - end] < 0
        terms[held] += anchored[held, 1 - end]
        for c in range(d):
            rhs[:, c] += _gathered(ends[:, end], terms[:, c], n)
    solved = _solve(structure, 1, total, -weights[:, None, None], rhs[:, None, :], lambda: np.ones((n, 1, 1)))
    poses[structure.free, :d, d] = solved[:, 0]


def _per_pose(ends: Ints, weights: Array, n: int) -> Array:
    """Return the sum [n] of the weights of the edges at each free pose."""
    return _gathered(ends[:, 0], weights, n) + _gathered(ends[:, 1], weights, n)


def _gathered(at: Ints, terms: Array, n: int) -> Array:
    """Return the sums [n] of terms [E] at free poses; -1 stands for one that is not free."""
    here = at >= 0
    return np.bincount(at[here], terms[here], n).astype(np.float64)


def _carried(structure: Structure, motions: Array) -> Array:
    """Return products [n, d, d] of motions [E, d, d], chained to each pose from the first one of its cluster."""
    problem, clusters, d = structure.problem, structure.clusters, motions.shape[1]
    cluster = np.full(len(problem.ids), -1, dtype=np.int64)
    cluster[structure.free] = clusters.of
    inside = (structure.ends >= 0).all(axis=1) & (cluster[problem.edges[:, 0]] == cluster[problem.edges[:, 1]])
    back = np.tile(np.eye(d + 1), (int(inside.sum()), 1, 1))  # products grow on the left: of the transposed ones
    back[:, :d, :d] = motions[inside].transpose(0, 2, 1)
    poses = np.tile(np.eye(d + 1), (len(cluster), 1, 1))
    reached = np.isin(np.arange(len(cluster)), structure.free[clusters.first])
    _chain(problem.edges[inside], back, np.zeros(len(back), dtype=np.bool_), reached, poses)
    return np.ascontiguousarray(poses[structure.free, :d, :d].transpose(0, 2, 1))


def _solve(
    structure: Structure, d: int, total: Array, blocks: Array, rhs: Array, motions: Callable[[], Array]
) -> Array:
    """Return the solution [n, d, C] of equations with `total` [n] on the diagonal, `blocks` [E, d, d] (to, from).

    `motions` gives what a motion of a pose's cluster is as one of the pose [n, d, d].
    """
    solver = structure.solver(d, _TOLERANCE)
    # the block of the later pose's columns: where that is `from`, the transposed one
    off = np.ascontiguousarray(np.where(solver.later_is_to[:, None, None], blocks.transpose(0, 2, 1), blocks))
    floor = 1e-9 * total.max(initial=1e-300)  # poses without information stay where they are put
    diagonal = np.maximum(total, floor)[:, None, None] * ((1.0 + 1e-12) * np.eye(d))
    if isinstance(solver, ClusteredSolver):
        solver.factorise(diagonal * (1.0 + 1e-9), off, motions())
    elif not solver.factorise(diagonal, off):
        solver.factorise(diagonal * (1.0 + 1e-6), off)
    return np.stack([solver.solve(np.ascontiguousarray(rhs[:, :, c])) for c in range(rhs.shape[2])], axis=2)


def _isotropic(problem: PoseGraphProblem, weights: Array) -> tuple[Array, Array]:
    """Return isotropic weights [E] of rotations and translations, at least a millionth of the mean eigenvalue."""
    turn = problem.tangent - problem.dimension
    rotation, translation = problem.information[:, :turn, :turn], problem.information[:, turn:, turn:]
    return tuple(
        weights * np.maximum(harmonic_means(W), 1e-6 * np.einsum("eii->e", W) / W.shape[1])
        for W in (rotation, translation)
    )


def harmonic_means(W: Array) -> Array:
    """Return the harmonic means [E] of the eigenvalues of matrices [E, m, m], 0 where one of them is."""
    eigenvalues = np.linalg.eigvalsh(W)
    singular = eigenvalues[:, 0] <= 1e-12 * eigenvalues[:, -1]
    eigenvalues[singular] = 1.0
    return np.where(singular, 0.0, W.shape[1] / np.sum(1.0 / eigenvalues, axis=1))


def _placed_anchors(problem: PoseGraphProblem) -> Array:
    """Return the problem's poses, identity where there is none."""
    return np.where(problem.has_pose[:, None, None], problem.poses, np.eye(problem.dimension + 1))


def _chained(problem: PoseGraphProblem, known: Mask, free_of_charge: Mask) -> Array:
    poses = _placed_anchors(problem)
    reached = known.copy()
    if not problem.of_poses:  # what knows a rotation first
        full = ~problem.is_position
        _chain(problem.edges[full], problem.measurements[full], free_of_charge[full], reached, poses)
    _chain(problem.edges, problem.measurements, free_of_charge, reached, poses)
    return poses


@njit(cache=True, nogil=True)
def _chain(  # noqa: PLR0912
    edges: Ints, measurements: Array, free_of_charge: Mask, reached: Mask, poses: Array
) -> None:
    """Fill the poses not reached along paths with as few edges as possible, those free of charge not counted."""
    n, m = len(reached), len(edges)
    begins = np.zeros(n + 2, dtype=np.int64)
    for e in range(m):
        begins[edges[e, 0] + 2] += 1
        begins[edges[e, 1] + 2] += 1
    for i in range(2, n + 2):
        begins[i] += begins[i - 1]
    out_of = np.empty(2 * m, dtype=np.int64)
    for e in range(m):
        for end in range(2):
            out_of[begins[edges[e, end] + 1]] = e
            begins[edges[e, end] + 1] += 1
    size = poses.shape[1]
    members, following = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    count = 0
    for i in range(n):
        if reached[i]:
            members[count] = i
            count += 1
    while count > 0:
        # all that successive edges reach belongs to the same layer
        at = 0
        while at < count:
            i = members[at]
            at += 1
            for p in range(begins[i], begins[i + 1]):
                e = out_of[p]
                j = edges[e, 0] + edges[e, 1] - i
                if free_of_charge[e] and not reached[j]:
                    _compose(poses, i, j, measurements[e], edges[e, 0] == i, size)
                    reached[j] = True
                    members[count] = j
                    count += 1
        found = 0
        for k in range(count):
            i = members[k]
            for p in range(begins[i], begins[i + 1]):
                e = out_of[p]
                j = edges[e, 0] + edges[e, 1] - i
                if not reached[j]:
                    _compose(poses, i, j, measurements[e], edges[e, 0] == i, size)
                    reached[j] = True
                    following[found] = j
                    found += 1
        members, following = following, members
        count = found


@njit(cache=True, nogil=True)
def _compose(poses: Array, i: int, j: int, Z: Array, forward: bool, size: int) -> None:
    """Write poses[i] @ Z, or @ Z^-1, into poses[j]."""
    d = size - 1
    T, G = poses[i], poses[j]
    for a in range(d):
        for b in range(d):
            s = 0.0
            for k in range(d):
                s += T[a, k] * (Z[k, b] if forward else Z[b, k])
            G[a, b] = s
    for a in range(d):
        s = T[a, d]
        for k in range(d):
            s += T[a, k] * Z[k, d] if forward else -G[a, k] * Z[k, d]
        G[a, d] = s
