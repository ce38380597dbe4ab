"""The plain answer to a pose graph: from which start, and how the cost descends from there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.solver import Descent, Progress, levenberg_marquardt
from vislam.batch.posegraph.starts import angles_start, chordal_start, file_start, odometry_start, tree_start
from vislam.batch.posegraph.structure import Structure
from vislam.config import PoseGraphConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array

_FIRST = 20  # poses of the first stretch
_SHARE = 10  # a stretch has one for each `_SHARE` that are there
_ITERATIONS, _TOLERANCE = 3, 1e-2  # of a stretch; the next one asks something else anyway

# of part of a problem, its poses, which edges [M] it has: better poses and weights [M]
Reweigh = Callable[[PoseGraphProblem, Array, Ids], tuple[Array, Array]]
_NOISE_ALLOWS = 0.999  # chance of a cost below what is not doubted
_SAME_COST = 1e-4  # relative: descents that end this near each other agree


def grown_start(problem: PoseGraphProblem, reweigh: Reweigh | None = None) -> Array:
    """Return poses [N, d + 1, d + 1] that grew from the first one, each stretch optimised with all before it.

    A graph with landmarks that were seen again after a long way has deep minima far from the best one, and no linear
    start knows where landmarks are that only drifted poses saw; so it grows as in incremental smoothing (Kaess,
    Ranganathan, Dellaert, "iSAM", T-RO 2008).

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


def onto_priors(problem: PoseGraphProblem, poses: Array) -> Array:
    """Return poses [N, d + 1, d + 1], each part that only priors hold turned and shifted onto them as a whole.

    Positions and rotations are fitted together, weighted by the traces of their information: the rotation is the polar
    factor of the sum of both (Umeyama, PAMI 1991, with rotations as further vectors).
    """
    d, of_world = problem.dimension, problem.edges[:, 0] == problem.world
    labels = problem.with_edges(~of_world).components()
    held = np.unique(labels[problem.fixed])
    out, at = poses.copy(), np.flatnonzero(of_world & ~np.isin(labels[problem.edges[:, 1]], held))
    to = problem.edges[at, 1]
    for part in np.unique(labels[to]):
        edges = at[labels[to] == part]
        T, Z, W = poses[problem.edges[edges, 1]], problem.measurements[edges], problem.information[edges]
        weight = np.einsum("eii->e", W[:, -d:, -d:])
        turn = np.where(problem.is_position[edges], 0.0, np.einsum("eii->e", W[:, :-d, :-d]))
        total = max(float(weight.sum()), 1e-300)
        ours, theirs = weight @ T[:, :d, d] / total, weight @ Z[:, :d, d] / total
        M = np.einsum("e,ei,ej->ij", weight, Z[:, :d, d] - theirs, T[:, :d, d] - ours)
        M += np.einsum("e,eik,ejk->ij", turn, Z[:, :d, :d], T[:, :d, :d])
        U, values, Vt = np.linalg.svd(M)
        if not values[0] > 0.0:
            continue
        U[:, -1] *= np.copysign(1.0, np.linalg.det(U) * np.linalg.det(Vt))
        moved = np.eye(d + 1)
        moved[:d, :d] = U @ Vt
        moved[:d, d] = theirs - moved[:d, :d] @ ours if weight.any() else 0.0
        here = labels == part
        out[here] = moved @ poses[here]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Plain:
    """The answer that believes all edges."""

    start_name: str
    start: Array  # [N, d + 1, d + 1]
    start_costs: dict[str, float]  # of each start that was tried
    descent: Descent
    note: str  # how many starts led here, where several were solved


def solve(structure: Structure, config: PoseGraphConfig, progress: Progress | None = None) -> Plain:
    """Return the lowest cost found from the start asked for, or from the cheapest of all.

    A start of low cost may lie in a wrong valley. So where the cost that it leads to is more than noise allows, the
    other starts are solved too.
    """
    starts, costs = _starts(structure, config)
    order = sorted(starts, key=costs.__getitem__)
    descents = {order[0]: descend(structure, starts[order[0]], config, progress)}
    if len(order) > 1 and _is_doubtful(structure, descents[order[0]].costs[-1]):
        descents |= {name: descend(structure, starts[name], config, progress) for name in order[1:]}
    best = min(descents, key=lambda name: descents[name].costs[-1])
    lowest, note = descents[best].costs[-1], ""
    if len(descents) > 1:
        agree = sum(d.costs[-1] <= lowest * (1.0 + _SAME_COST) for d in descents.values())
        note = f"the cost is more than noise allows: {len(descents)} starts were solved, {agree} end with this cost"
    return Plain(best, starts[best], costs, descents[best], note)


def _is_doubtful(structure: Structure, cost: float) -> bool:
    """Return whether a cost is more than the noise stated allows, of a graph with anything redundant."""
    problem, free = structure.problem, structure.free
    measured = np.where(problem.is_position, problem.dimension, problem.tangent).sum()
    unknown = np.where(problem.is_point[free], problem.dimension, problem.tangent).sum()
    redundant = int(measured - unknown)
    return redundant > 0 and cost > chi_square_limit(_NOISE_ALLOWS, redundant)


def _starts(structure: Structure, config: PoseGraphConfig) -> tuple[dict[str, Array], dict[str, float]]:
    """Return the poses [N, d + 1, d + 1] of the starts asked for that have a finite cost, and the costs of all."""
    problem = structure.problem
    names = ["chordal", "angles", "tree", "odometry", "file", "grown"]
    if problem.dimension == 3:
        names.remove("angles")
    if config.start != "auto" and config.start not in names:
        raise UsageError(f"start '{config.start}' is for graphs in the plane; for this one: {', '.join(names)}")
    if config.start != "auto":
        names = [config.start]
    elif not problem.has_pose.any():
        names.remove("file")
    if config.start == "auto" and not problem.is_point.any():
        names.remove("grown")  # as dear as solving, and among poses alone the linear starts are good
    relative = structure
    if problem.world >= 0:
        relative = Structure(problem.with_edges(problem.edges[:, 0] != problem.world), config.equations)
    starts: dict[str, Array] = {}
    costs: dict[str, float] = {}
    for name in names:
        made = [_make(name, structure)]
        if relative is not structure:
            made.append(onto_priors(problem, _make(name, relative) if name != "grown" else made[0]))
        for poses in made:
            poses[problem.is_point, :-1, :-1] = np.eye(problem.dimension)
            cost = problem.chi2(poses)
            if name not in costs or cost < costs[name]:
                costs[name], starts[name] = cost, poses
    starts = {name: poses for name, poses in starts.items() if np.isfinite(costs[name])}
    if not starts:
        raise DataError("the graph has no finite cost at any start; are its measurements too large?")
    return starts, costs


def _make(name: str, structure: Structure) -> Array:
    """Return the poses [N, d + 1, d + 1] of one start."""
    problem, ones = structure.problem, np.ones(len(structure.problem.edges))
    if name == "chordal":
        return chordal_start(structure, ones)
    if name == "angles":
        return angles_start(structure, ones)
    if name == "tree":
        return tree_start(problem, structure.anchors)
    if name == "odometry":
        return odometry_start(problem, structure.anchors)
    return file_start(problem) if name == "file" else grown_start(problem)


def descend(structure: Structure, start: Array, config: PoseGraphConfig, progress: Progress | None) -> Descent:
    """Return where the descent from `start` [N, d + 1, d + 1] leads, all edges believed."""
    return levenberg_marquardt(
        structure, start, np.ones(len(structure.problem.edges)), iterations=config.iterations,
        tolerance=config.tolerance, progress=progress,
    )  # fmt: skip
