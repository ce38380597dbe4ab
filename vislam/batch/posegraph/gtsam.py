"""Pose graphs through gtsam: Levenberg-Marquardt as the route that always works, and iSAM2 fed edge by edge.

Positions of landmarks are Python factors: gtsam's Python has none with the error of `PositionEdges`.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from vislam.batch.posegraph.points import turned_by
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import Descent, Progress
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.factors.solvers import FAILURES

_ANCHOR_SIGMA = 1e-4  # rad and m: tight, yet far from where gtsam 4.3 calls a system indeterminate
_RELINEARISE = 0.1  # rad and m, of iSAM2, and every tenth update: what the field's replays use
_RELINEARISE_SKIP = 10
_FINAL_STEPS = 20


def gtsam_levenberg_marquardt(
    problem: PoseGraphProblem,
    poses: Array,
    weights: Array,
    *,
    iterations: int,
    tolerance: float,
    progress: Progress | None = None,
) -> Descent:
    """Lower the cost from `poses` by gtsam; edges of weight 0 are left out. Raises DataError when gtsam fails."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(len(problem.ids)):
        values.insert(i, _value(problem, i, poses[i]))
    for i in problem.anchors().tolist():
        graph.add(_anchor(problem, i, poses[i]))
    for e in np.flatnonzero(weights > 0.0).tolist():
        graph.add(_factor(problem, e, weights[e]))
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(tolerance)
    params.setlambdaUpperBound(1e9)
    costs = [problem.chi2(poses, weights)]
    try:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        while len(costs) <= iterations:
            optimizer.iterate()
            costs.append(2.0 * float(optimizer.error()))
            if progress is not None:
                progress(len(costs) - 1, costs[-1])
            if costs[-2] - costs[-1] <= tolerance * costs[-2]:
                break
        solved = _read(problem, optimizer.values())
        solved[problem.anchors()] = poses[problem.anchors()]
    except FAILURES as error:
        raise DataError(f"gtsam cannot optimise the graph ({str(error).splitlines()[0][:80]})") from error
    costs[-1] = problem.chi2(solved, weights)
    return Descent(solved, tuple(costs), len(costs) <= iterations)


def isam2_replay(
    problem: PoseGraphProblem, poses: Array, weights: Array, *, progress: Progress | None = None
) -> Descent:
    """Feed iSAM2 the poses in the order of their ids, each with its edges to earlier ones, as a run would.

    A pose starts from its first edge, or from `poses` where it has none. By Cholesky, and from the beginning by QR
    where that fails. Raises DataError when both fail.
    """
    for factorisation in ("CHOLESKY", "QR"):
        try:
            solved = _replayed(problem, poses, weights, factorisation, progress)
        except FAILURES:
            continue
        cost = problem.chi2(solved, weights)
        return Descent(solved, (problem.chi2(poses, weights), cost), True)
    raise DataError("iSAM2 cannot take the graph in the order of its ids; choose another method")


def _replayed(
    problem: PoseGraphProblem, poses: Array, weights: Array, factorisation: str, progress: Progress | None
) -> Array:
    params = gtsam.ISAM2Params()
    params.setFactorization(factorisation)
    params.setRelinearizeThreshold(_RELINEARISE)
    params.relinearizeSkip = _RELINEARISE_SKIP
    isam = gtsam.ISAM2(params)
    anchors = set(problem.anchors().tolist())
    used = np.flatnonzero(weights > 0.0)
    turn = np.arange(len(problem.ids))  # [N] when a pose comes; the world, of which priors are edges, comes first
    if problem.world >= 0:
        turn = (turn + 1) % len(turn)
    later = turn[problem.edges[used]].max(axis=1)
    order = used[np.argsort(later, kind="stable")]
    begins = np.searchsorted(np.sort(later), np.arange(len(problem.ids) + 1))
    step_back = max(1, len(problem.ids) // 100)
    for k, i in enumerate(np.argsort(turn).tolist()):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        edges = order[begins[k] : begins[k + 1]].tolist()
        start, known = poses[i], _from_edge(problem, isam, i, edges)
        if i in anchors:
            graph.add(_anchor(problem, i, poses[i]))
        elif known is not None:
            start = known
        else:
            # its edges all lead to later poses: a loose prior until they come
            graph.add(_anchor(problem, i, poses[i], sigma=1e3))
        for e in edges:
            graph.add(_factor(problem, e, weights[e]))
        values.insert(i, _value(problem, i, start))
        isam.update(graph, values)
        if progress is not None and k % step_back == 0:
            progress(k, float("nan"))
    for _ in range(_FINAL_STEPS):
        isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], None, None, None, True)
    return _read(problem, isam.calculateBestEstimate())


def _from_edge(problem: PoseGraphProblem, isam: gtsam.ISAM2, i: int, edges: list[int]) -> Array | None:
    """Return where the first of the edges that has it puts a pose or landmark, None where none does."""
    for e in edges:
        a, b = problem.edges[e].tolist()
        if problem.is_position[e] and not problem.is_point[i]:
            continue
        Z, other = problem.measurements[e], _matrix(problem, a if b == i else b, isam, "calculateEstimate")
        return np.asarray(other @ Z if b == i else other @ np.linalg.inv(Z))
    return None


def _pose(problem: PoseGraphProblem, T: Array) -> Any:
    return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])) if problem.dimension == 2 else gtsam.Pose3(T)


def _value(problem: PoseGraphProblem, i: int, T: Array) -> Any:
    """Return a pose, or the position of a landmark, as gtsam has it."""
    return T[:-1, -1].copy() if problem.is_point[i] else _pose(problem, T)


def _anchor(problem: PoseGraphProblem, i: int, T: Array, sigma: float = _ANCHOR_SIGMA) -> Any:
    point = bool(problem.is_point[i])
    model = gtsam.noiseModel.Isotropic.Sigma(problem.dimension if point else problem.tangent, sigma)
    prior = getattr(gtsam, f"PriorFactor{'Point' if point else 'Pose'}{problem.dimension}")
    return prior(i, _value(problem, i, T), model)


def _factor(problem: PoseGraphProblem, e: int, weight: float) -> Any:
    return (_position if problem.is_position[e] else _between)(problem, e, weight)


def _position(problem: PoseGraphProblem, e: int, weight: float) -> Any:
    """Return an edge that measures a position alone, with the error of `PositionEdges`."""
    d = problem.dimension
    i, j = problem.edges[e].tolist()
    Z, to_point = problem.measurements[e], bool(problem.is_point[j])
    R_back = Z[:d, :d].T

    def error(_factor: Any, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        Ti, Tj = _matrix(problem, i, values), _matrix(problem, j, values)
        to_from = Ti[:d, :d].T
        seen = to_from @ (Tj[:d, d] - Ti[:d, d])
        if jacobians is not None:
            turned = turned_by(seen[None])[0]
            parts = (R_back @ turned, -R_back)
            jacobians[0] = np.concatenate(parts[::-1] if d == 2 else parts, axis=1)  # in the plane the angle is last
            moved = R_back @ to_from
            still, moved_body = np.zeros((d, problem.tangent - d)), moved @ Tj[:d, :d]
            whole = (moved_body, still) if d == 2 else (still, moved_body)
            jacobians[1] = moved if to_point else np.concatenate(whole, axis=1)
        return np.asarray(R_back @ (seen - Z[:d, d]))

    information = weight * problem.information[e][-d:, -d:]
    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Information(information), [i, j], error)


def _between(problem: PoseGraphProblem, e: int, weight: float) -> Any:
    information = weight * problem.information[e]
    if problem.dimension == 2:
        information = np.roll(information, (-1, -1), axis=(0, 1))  # gtsam has the angle last
    kind = gtsam.BetweenFactorPose2 if problem.dimension == 2 else gtsam.BetweenFactorPose3
    a, b = problem.edges[e].tolist()
    model = gtsam.noiseModel.Gaussian.Information(information)
    return kind(a, b, _pose(problem, problem.measurements[e]), model)


def _matrix(problem: PoseGraphProblem, i: int, solved: Any, ask: str = "at") -> Array:
    """Return a pose, or the position of a landmark, of values, or of an iSAM2 where that is asked otherwise."""
    point = bool(problem.is_point[i])
    value = getattr(solved, f"{ask}{'Point' if point else 'Pose'}{problem.dimension}")(i)
    if not point:
        return np.asarray(value.matrix())
    out = np.eye(problem.dimension + 1)
    out[:-1, -1] = value
    return out


def _read(problem: PoseGraphProblem, values: gtsam.Values) -> Array:
    return np.ascontiguousarray([_matrix(problem, i, values) for i in range(len(problem.ids))])
