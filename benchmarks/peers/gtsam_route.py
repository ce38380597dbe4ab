"""Pose graphs with landmarks and priors through gtsam's Levenberg-Marquardt: what ours is held against.

Positions of landmarks are Python factors: gtsam's Python has none with the error of `PositionEdges`.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from vislam.batch import PoseGraphProblem
from vislam.batch.posegraph.solver import Descent
from vislam.batch.posegraph.structure import turned_by
from vislam.core import Array

_ANCHOR_SIGMA = 1e-4  # rad and m: tight, yet far from where gtsam 4.3 calls a system indeterminate


def gtsam_levenberg_marquardt(
    problem: PoseGraphProblem, poses: Array, iterations: int = 100, tolerance: float = 1e-9
) -> Descent:
    """Lower the cost from `poses` [N, d + 1, d + 1] by gtsam, all edges believed; it raises where gtsam fails."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i in range(len(problem.ids)):
        values.insert(i, _value(problem, i, poses[i]))
    for i in problem.anchors().tolist():
        graph.add(_anchor(problem, i, poses[i]))
    for e in range(len(problem.edges)):
        graph.add(_factor(problem, e))
    params = gtsam.LevenbergMarquardtParams()
    params.setlambdaUpperBound(1e9)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    costs = [problem.chi2(poses)]
    while len(costs) <= iterations:
        optimizer.iterate()
        costs.append(2.0 * float(optimizer.error()))
        if costs[-2] - costs[-1] <= tolerance * costs[-2]:
            break
    solved = _read(problem, optimizer.values())
    solved[problem.anchors()] = poses[problem.anchors()]
    costs[-1] = problem.chi2(solved)
    return Descent(solved, tuple(costs), len(costs) <= iterations)


def _pose(problem: PoseGraphProblem, T: Array) -> Any:
    return gtsam.Pose2(T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])) if problem.dimension == 2 else gtsam.Pose3(T)


def _value(problem: PoseGraphProblem, i: int, T: Array) -> Any:
    """Return a pose, or the position of a landmark, as gtsam has it."""
    return T[:-1, -1].copy() if problem.is_point[i] else _pose(problem, T)


def _anchor(problem: PoseGraphProblem, i: int, T: Array) -> Any:
    point = bool(problem.is_point[i])
    model = gtsam.noiseModel.Isotropic.Sigma(problem.dimension if point else problem.tangent, _ANCHOR_SIGMA)
    prior = getattr(gtsam, f"PriorFactor{'Point' if point else 'Pose'}{problem.dimension}")
    return prior(i, _value(problem, i, T), model)


def _factor(problem: PoseGraphProblem, e: int) -> Any:
    return (_position if problem.is_position[e] else _between)(problem, e)


def _position(problem: PoseGraphProblem, e: int) -> Any:
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

    information = problem.information[e][-d:, -d:]
    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Information(information), [i, j], error)


def _between(problem: PoseGraphProblem, e: int) -> Any:
    information = problem.information[e]
    if problem.dimension == 2:
        information = np.roll(information, (-1, -1), axis=(0, 1))  # gtsam has the angle last
    kind = gtsam.BetweenFactorPose2 if problem.dimension == 2 else gtsam.BetweenFactorPose3
    a, b = problem.edges[e].tolist()
    model = gtsam.noiseModel.Gaussian.Information(information)
    return kind(a, b, _pose(problem, problem.measurements[e]), model)


def _matrix(problem: PoseGraphProblem, i: int, values: gtsam.Values) -> Array:
    """Return a pose, or the position of a landmark, as a pose that is turned by nothing."""
    point = bool(problem.is_point[i])
    value = getattr(values, f"at{'Point' if point else 'Pose'}{problem.dimension}")(i)
    if not point:
        return np.asarray(value.matrix())
    out = np.eye(problem.dimension + 1)
    out[:-1, -1] = value
    return out


def _read(problem: PoseGraphProblem, values: gtsam.Values) -> Array:
    return np.ascontiguousarray([_matrix(problem, i, values) for i in range(len(problem.ids))])
