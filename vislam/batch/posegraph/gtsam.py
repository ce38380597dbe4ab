"""Pose graphs through gtsam: Levenberg-Marquardt as the route that always works, and iSAM2 fed edge by edge."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

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
        values.insert(i, _pose(problem, poses[i]))
    for i in problem.anchors().tolist():
        graph.add(_anchor(problem, i, poses[i]))
    for e in np.flatnonzero(weights > 0.0).tolist():
        graph.add(_between(problem, e, weights[e]))
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
    later = problem.edges[used].max(axis=1)
    order = used[np.argsort(later, kind="stable")]
    begins = np.searchsorted(np.sort(later), np.arange(len(problem.ids) + 1))
    step_back = max(1, len(problem.ids) // 100)
    for i in range(len(problem.ids)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        edges = order[begins[i] : begins[i + 1]].tolist()
        start = _pose(problem, poses[i])
        if i in anchors:
            graph.add(_anchor(problem, i, poses[i]))
        elif edges:
            a, b = problem.edges[edges[0]].tolist()
            Z = _pose(problem, problem.measurements[edges[0]])
            other = _current(problem, isam, a if b == i else b)
            start = other.compose(Z) if b == i else other.compose(Z.inverse())
        else:
            # its edges all lead to later poses: a loose prior until they come
            graph.add(_anchor(problem, i, poses[i], sigma=1e3))
        for e in edges:
            graph.add(_between(problem, e, weights[e]))
        values.insert(i, start)
        isam.update(graph, values)
        if progress is not None and i % step_back == 0:
            progress(i, float("nan"))
    for _ in range(_FINAL_STEPS):
        isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], None, None, None, True)
    return _read(problem, isam.calculateBestEstimate())


def _current(problem: PoseGraphProblem, isam: gtsam.ISAM2, i: int) -> Any:
    return isam.calculateEstimatePose2(i) if problem.dimension == 2 else isam.calculateEstimatePose3(i)


def _pose(problem: PoseGraphProblem, T: Array) -> Any:
    return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])) if problem.dimension == 2 else gtsam.Pose3(T)


def _anchor(problem: PoseGraphProblem, i: int, T: Array, sigma: float = _ANCHOR_SIGMA) -> Any:
    model = gtsam.noiseModel.Isotropic.Sigma(problem.tangent, sigma)
    kind = gtsam.PriorFactorPose2 if problem.dimension == 2 else gtsam.PriorFactorPose3
    return kind(i, _pose(problem, T), model)


def _between(problem: PoseGraphProblem, e: int, weight: float) -> Any:
    information = weight * problem.information[e]
    if problem.dimension == 2:
        information = np.roll(information, (-1, -1), axis=(0, 1))  # gtsam has the angle last
    kind = gtsam.BetweenFactorPose2 if problem.dimension == 2 else gtsam.BetweenFactorPose3
    a, b = problem.edges[e].tolist()
    model = gtsam.noiseModel.Gaussian.Information(information)
    return kind(a, b, _pose(problem, problem.measurements[e]), model)


def _read(problem: PoseGraphProblem, values: gtsam.Values) -> Array:
    at = values.atPose2 if problem.dimension == 2 else values.atPose3
    return np.ascontiguousarray([at(i).matrix() for i in range(len(problem.ids))])
