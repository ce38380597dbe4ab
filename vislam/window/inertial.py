"""What ties keyframes to each other without a camera: preintegrated IMU, rest, and loose continuity without either.

Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", TRO 2017; biases walk between
keyframes, and derivatives of states held by the marginal prior are taken where it was linearised.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.geometry import skew, so3_exp, so3_log, so3_right_jacobian, so3_right_jacobian_inverse
from vislam.messages import Array
from vislam.window.layout import Ints, Links, difference


@njit(cache=True, nogil=True, error_model="numpy")
def imu_error(a: Array, b: Array, links: Links, k: int, gravity_m_s2: float, J: Array) -> Array:
    """Return the error [9] (rotation, velocity, position) between states [21], and its derivative in J [9, 30].

    Columns of J: error of state a [15], then of state b.
    """
    Ra, Rb = a[:9].copy().reshape(3, 3), b[:9].copy().reshape(3, 3)
    dt = links.dt[k]
    change = np.empty(6)
    change[:3] = a[15:18] - links.bias[k, :3]
    change[3:] = a[18:21] - links.bias[k, 3:]
    by_bias = links.by_bias[k]
    moved = by_bias @ change
    turn = moved[:3].copy()
    dR = links.dR[k] @ so3_exp(turn)
    dv, dp = links.dv[k] + moved[3:6], links.dp[k] + moved[6:]
    velocity = b[12:15] - a[12:15]
    velocity[2] += gravity_m_s2 * dt
    position = b[9:12] - a[9:12] - dt * a[12:15]
    position[2] += 0.5 * gravity_m_s2 * dt * dt
    Rt = Ra.T.copy()
    v, p = Rt @ velocity, Rt @ position
    out = np.empty(9)
    out[:3] = so3_log(dR.T.copy() @ (Rt @ Rb))
    out[3:6] = v - dv
    out[6:] = p - dp
    rotation = out[:3].copy()
    inverse = so3_right_jacobian_inverse(rotation)
    J[:] = 0.0
    J[:3, :3] = -(inverse @ (Rb.T.copy() @ Ra))
    J[:3, 15:18] = inverse
    J[:3, 9:12] = -(inverse @ so3_exp(-rotation) @ so3_right_jacobian(turn) @ by_bias[:3, :3].copy())
    J[3:6, :3] = skew(v)
    J[6:, :3] = skew(p)
    J[3:6, 6:9] = -Rt
    J[3:6, 21:24] = Rt
    J[6:, 3:6] = -Rt
    J[6:, 6:9] = -dt * Rt
    J[6:, 18:21] = Rt
    J[3:6, 9:15] = -by_bias[3:6]
    J[6:, 9:15] = -by_bias[6:]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def guess_error(a: Array, b: Array, guess: Array, J: Array) -> Array:
    """Return the error [6] of the motion between two states against a guess [4, 4], and J [6, 12] by both poses."""
    Ra, Rb = a[:9].copy().reshape(3, 3), b[:9].copy().reshape(3, 3)
    Rt = Ra.T.copy()
    out = np.empty(6)
    out[:3] = so3_log(guess[:3, :3].copy().T @ (Rt @ Rb))
    moved = Rt @ (b[9:12] - a[9:12])
    out[3:] = moved - guess[:3, 3]
    inverse = so3_right_jacobian_inverse(out[:3].copy())
    J[:] = 0.0
    J[:3, :3] = -(inverse @ (Rb.T.copy() @ Ra))
    J[:3, 6:9] = inverse
    J[3:, :3] = skew(moved)
    J[3:, 3:6] = -Rt
    J[3:, 9:] = Rt
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(J: Array, information: Array, r: Array, at: Ints, A: Array, g: Array) -> None:
    weighted = J.T.copy() @ information
    H, b = weighted @ J, weighted @ r
    for i in range(len(at)):
        g[at[i]] += b[i]
        for j in range(len(at)):
            if at[j] >= at[i]:
                A[at[i], at[j]] += H[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _diagonal(at_a: int, at_b: int, weight: float, error: float, A: Array, g: Array) -> None:
    """Add the square of `weight * (b - a)` whose value is `error`; at_a < 0: of b alone."""
    A[at_b, at_b] += weight
    g[at_b] += weight * error
    if at_a >= 0:
        A[at_a, at_a] += weight
        A[min(at_a, at_b), max(at_a, at_b)] -= weight
        g[at_a] -= weight * error


@njit(cache=True, nogil=True, error_model="numpy")
def cost(X: Array, links: Links, gravity_m_s2: float) -> float:
    """Return half the squared error of all links and of rest."""
    J9, J6 = np.empty((9, 30)), np.empty((6, 12))
    total = 0.0
    for k in range(len(X) - 1):
        if links.inertial[k]:
            r = imu_error(X[k], X[k + 1], links, k, gravity_m_s2, J9)
            total += r @ (links.information[k] @ r)
        change = X[k + 1, 15:21] - X[k, 15:21]
        total += np.sum(links.walk_information[k] * change * change)
        if links.guess_weight[k, 0] > 0.0:
            r = guess_error(X[k], X[k + 1], links.guess[k], J6)
            total += links.guess_weight[k, 0] ** 2 * np.sum(r[:3] ** 2)
            total += links.guess_weight[k, 1] ** 2 * np.sum(r[3:] ** 2)
        total += links.velocity_weight[k] ** 2 * np.sum((X[k + 1, 12:15] - X[k, 12:15]) ** 2)
    for k in range(len(X)):
        total += links.rest_weight[k] ** 2 * np.sum(X[k, 12:15] ** 2)
    return 0.5 * total


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    X: Array,
    X_first: Array,
    held: Array,
    links: Links,
    gravity_m_s2: float,
    where: Ints,
    count: int,
    rests: int,
    A: Array,
    g: Array,
) -> None:
    """Add the first `count` links and rest of the first `rests` keyframes to the normal equations.

    They are the upper triangle of A [D, D] and g [D]. `where` [M, 15] (or [M, 6]) says at which unknown each
    keyframe's error lies; with six there are no velocities.
    """
    J9, J6, waste = np.empty((9, 30)), np.empty((6, 12)), np.empty((9, 30))
    full = where.shape[1] == 15
    for k in range(count):
        a = X_first[k] if held[k] else X[k]
        b = X_first[k + 1] if held[k + 1] else X[k + 1]
        if full:
            both = np.concatenate((where[k], where[k + 1]))
            if links.inertial[k]:
                imu_error(a, b, links, k, gravity_m_s2, J9)
                r = imu_error(X[k], X[k + 1], links, k, gravity_m_s2, waste)
                _scatter(J9, links.information[k], r, both, A, g)
            for i in range(6):
                error = X[k + 1, 15 + i] - X[k, 15 + i]
                _diagonal(where[k, 9 + i], where[k + 1, 9 + i], links.walk_information[k, i], error, A, g)
            for i in range(3):
                error = X[k + 1, 12 + i] - X[k, 12 + i]
                _diagonal(where[k, 6 + i], where[k + 1, 6 + i], links.velocity_weight[k] ** 2, error, A, g)
        if links.guess_weight[k, 0] > 0.0:
            guess_error(a, b, links.guess[k], J6)
            r6 = guess_error(X[k], X[k + 1], links.guess[k], np.empty((6, 12)))
            information = np.zeros((6, 6))
            for i in range(6):
                information[i, i] = links.guess_weight[k, 0 if i < 3 else 1] ** 2
            _scatter(J6, information, r6, np.concatenate((where[k, :6], where[k + 1, :6])), A, g)
    if full:
        for k in range(rests):
            for i in range(3):
                _diagonal(-1, where[k, 6 + i], links.rest_weight[k] ** 2, X[k, 12 + i], A, g)


@njit(cache=True, nogil=True, error_model="numpy")
def prior_shift(X: Array, X_first: Array, calibration: Array, calibration_first: Array, held: int, size: int) -> Array:
    """Return how far [5 + held * size] the states are from where the prior was linearised."""
    out = np.empty(5 + held * size)
    out[:5] = calibration - calibration_first
    for k in range(held):
        out[5 + k * size : 5 + (k + 1) * size] = difference(X[k], X_first[k])[:size]
    return out
