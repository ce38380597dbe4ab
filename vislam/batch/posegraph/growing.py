"""A start that grows: poses join in the order of their ids, and what is there is settled before more comes.

A graph with landmarks that were seen again after a long way has deep minima far from the best one, and no linear start
knows where landmarks are that only drifted poses saw. As in incremental smoothing (Kaess, Ranganathan, Dellaert,
"iSAM", T-RO 2008), every stretch begins where the poses before it, already corrected, leave it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.solver import levenberg_marquardt
from vislam.batch.posegraph.starts import file_start
from vislam.batch.posegraph.structure import Structure
from vislam.core.messages import Array

_FIRST = 20  # poses of the first stretch
_SHARE = 10  # a stretch has one for each `_SHARE` that are there
_ITERATIONS, _TOLERANCE = 3, 1e-2  # of a stretch; the next one asks something else anyway

# of part of a problem, its poses, which edges [M] it has: better poses and weights [M]
Reweigh = Callable[[PoseGraphProblem, Array, Ids], tuple[Array, Array]]


def grown_start(problem: PoseGraphProblem, reweigh: Reweigh | None = None) -> Array:
    """Return poses [N, d + 1, d + 1] that grew from the first one, each stretch optimised with all before it.

    `reweigh` gives the weights of the edges before each round, 1 without it, and may place landmarks again. Poses of
    another part of the graph than the first come last.
    """
    poses = np.full_like(problem.poses, np.nan)
    rank = np.cumsum(problem.is_pose) - 1
    ends = np.where(problem.is_pose[problem.edges], rank[problem.edges], -1)
    arrives = ends.max(axis=1, initial=-1)  # [E] with which pose
    count, there = int(problem.is_pose.sum()), 0
    while there < count:
        there = min(count, there + max(_FIRST, there // _SHARE))
        poses = _with_more(problem, poses, there, (rank, arrives), reweigh)
    return poses


def _with_more(
    problem: PoseGraphProblem, poses: Array, there: int, when: tuple[Ids, Ids], reweigh: Reweigh | None
) -> Array:
    """Return the poses with those `there`, settled; those that nothing joins to them yet wait."""
    rank, arrives = when
    edges = np.flatnonzero(arrives < there)
    last = there == int(problem.is_pose.sum())
    is_in = problem.is_pose & (rank < there)
    is_in[problem.edges[edges]] = True
    is_in |= last
    joined = problem.with_edges(edges).components()
    if not last:
        is_in &= joined == joined[int(np.argmax(problem.is_pose))]
    edges = edges[is_in[problem.edges[edges]].all(axis=1)]
    part = part_of(problem, np.flatnonzero(is_in), edges)
    known = poses[is_in]
    start = file_start(part.with_poses(np.where(np.isnan(known), part.poses if last else np.nan, known)))
    start[part.is_point, :-1, :-1] = np.eye(problem.dimension)
    structure, rounds = Structure(part), 1 if reweigh is None else _ITERATIONS
    for _ in range(rounds):
        weights = np.ones(len(edges))
        if reweigh is not None:
            start, weights = reweigh(part, start, edges)
        descent = levenberg_marquardt(structure, start, weights, iterations=_ITERATIONS // rounds, tolerance=_TOLERANCE)
        start = descent.poses
    out = poses.copy()
    out[is_in] = start
    return out


def part_of(problem: PoseGraphProblem, poses: Ids, edges: Ids) -> PoseGraphProblem:
    """Return the problem of some poses and edges between them."""
    place = np.full(len(problem.ids), -1, dtype=np.int64)
    place[poses] = np.arange(len(poses))
    part = problem.with_edges(edges)
    return replace(
        part, ids=problem.ids[poses], poses=problem.poses[poses], fixed=problem.fixed[poses],
        is_point=problem.is_point[poses], edges=np.ascontiguousarray(place[part.edges]),
        world=int(place[problem.world]) if problem.world >= 0 else -1,
    )  # fmt: skip
