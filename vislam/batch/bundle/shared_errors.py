"""What all pixels and distances of a run are off by together: errors of the focal length and of the unit of metres.

gtsam has no projection factor that knows a camera's place in the body and its calibration, too. So the cost of a
solution is taken as a function of these two errors alone: at each the states follow by Gauss-Newton steps (profile
likelihood; variable projection, Golub and Pereyra 1973). Its curvature gives their covariance, how the states follow
what they add to that of the states (consider states: Schmidt 1966).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from vislam.batch.bundle.rays import Tracks
from vislam.core.geometry import so3_log
from vislam.core.messages import Array
from vislam.factors.keys import B, V, X
from vislam.factors.solvers import FAILURES

GraphAt = Callable[[Array], gtsam.NonlinearFactorGraph]

_STEP = 1e-3  # relative, of finite differences; well above rounding, and a tenth of a pixel at the edge of an image
_FOLLOWING = 3  # steps of the states: under a robust kernel each goes 70 % of the way


class Seen:
    """What a run saw, without what solutions show of its cameras: errors of calibration, motion while rows are read."""

    def __init__(self, tracks: Tracks) -> None:
        """Begin with what the given calibration makes of pixels and distances."""
        self._given = tracks
        self.errors: Array = np.zeros(2)  # true focal length and true metres are 1 + errors times those given
        self.moved_xy: Array = np.zeros((len(tracks), 2))  # from the middle row's instant to that of the own row

    def tracks(self, errors: Array | None = None) -> Tracks:
        """Return the tracks, at other errors [2] if they are given."""
        given = self._given
        focal, metres = (self.errors if errors is None else errors).tolist()
        rho = (given.rho + focal * given.by_focal[:, 2]) / (1.0 + metres)
        of_pair = 1.0 + focal if given.by_focal[:, 2].any() else 1.0
        return replace(
            given,
            xy=given.xy + focal * given.by_focal[:, :2] - self.moved_xy,
            rho=rho,
            focal=1.0 + focal,
            disparity=of_pair * (1.0 + metres),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SharedErrors:
    """Relative errors of focal length and metres as a solution shows them."""

    values: Array  # [2]
    covariance: Array  # [2, 2]; of an error that the calibration excludes 0
    by_error: Array  # [K, 15, 2] how states, in NavState's order and axes, follow; NaN in what was not estimated

    @property
    def sigmas(self) -> Array:
        """Sigmas [2]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def added(self) -> Array:
        """Return the covariance [K, 15, 15] that they add to the states."""
        return self.by_error @ self.covariance @ self.by_error.transpose(0, 2, 1)


def profiled(
    graph_at: GraphAt, values: gtsam.Values, count: int, at: Array, sigmas: Array, moves: bool
) -> SharedErrors | None:
    """Return the errors after a Newton step from `at` [2]; None where the linear system cannot be solved.

    `graph_at` gives the factors at errors [2], `values` are the solution of `count` keyframes at `at`, `sigmas` [2] of
    the prior. Unless it `moves`, the prior is all that is known of them.
    """
    which = np.flatnonzero(sigmas > 0.0).tolist()
    H, gradient, by_error = np.zeros((2, 2)), np.zeros(2), np.zeros((count, 15, 2))
    if not which:
        return SharedErrors(at, H, by_error)
    shifts = np.eye(2) * _STEP
    try:
        here, there = _followed(graph_at(at), values)
        for i in which:
            ahead, to = _followed(graph_at(at + shifts[i]), values)
            by_error[:, :, i] = _difference(there, to, count) / _STEP
            if moves:
                back, _ = _followed(graph_at(at - shifts[i]), values)
                H[i, i], gradient[i] = max(ahead + back - 2.0 * here, 0.0), (ahead - back) / (2.0 * _STEP)
                H[0, 1] -= ahead
        if moves and len(which) == 2:
            H[0, 1] += here + _followed(graph_at(at + shifts.sum(axis=0)), values)[0]
    except FAILURES:
        return None
    most = 0.99 * np.sqrt(H[0, 0] * H[1, 1])
    H[0, 1] = H[1, 0] = np.clip(H[0, 1], -most, most)
    known = np.ix_(which, which)
    prior, covariance, errors = np.diag(sigmas[which] ** -2.0), np.zeros((2, 2)), at.copy()
    covariance[known] = np.linalg.inv(H[known] / _STEP**2 + prior)
    if moves:
        errors[which] -= covariance[known] @ (gradient[which] + prior @ at[which])
    return SharedErrors(errors, covariance, by_error)


def _followed(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[float, gtsam.Values]:
    """Return the cost of the factors after some Gauss-Newton steps, and where they led."""
    for _ in range(_FOLLOWING):
        values = values.retract(graph.linearize(values).optimize())
    return float(graph.error(values)), values


def _difference(a: gtsam.Values, b: gtsam.Values, count: int) -> Array:
    """Return b minus a [K, 15] of poses, velocities and biases, rotation on the body side."""
    out = np.full((count, 15), np.nan)
    for k in range(count):
        A, C = a.atPose3(X(k)), b.atPose3(X(k))
        out[k, :3] = so3_log(A.rotation().matrix().T @ C.rotation().matrix())
        out[k, 3:6] = C.translation() - A.translation()
        if a.exists(V(k)):
            out[k, 6:9] = b.atVector(V(k)) - a.atVector(V(k))
            before, after = a.atConstantBias(B(k)), b.atConstantBias(B(k))
            out[k, 9:12] = after.gyroscope() - before.gyroscope()
            out[k, 12:] = after.accelerometer() - before.accelerometer()
    return out
