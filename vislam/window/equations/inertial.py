"""What ties keyframes to each other without a camera: preintegrated IMU, rest, and loose continuity without either.

Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", TRO 2017; biases walk between
keyframes, and derivatives of states held by the marginal prior are taken where it was linearised.
"""

from __future__ import annotations

import numpy as np

from vislam.core.geometry import skew, so3_exp, so3_log, so3_right_jacobian, so3_right_jacobian_inverse
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.core.small import product, product_back, product_transposed, put, put_back, rotated_back
from vislam.window.equations.layout import (
    AXES,
    CALIBRATION,
    Ints,
    Links,
    Normal,
    States,
    difference,
    rotation,
)


@njit(cache=True, nogil=True, error_model="numpy")
def imu_error(a: Array, b: Array, calibration: Array, links: Links, k: int, gravity_m_s2: float, J: Array) -> Array:
    """Return the error [9] (rotation, velocity, position) between states [21], and its derivative in J [9, 36].

    Columns of J: error of state a [15], of state b, relative errors of the axes [6].
    """
    Ra, Rb, by_imu, dt, moved = rotation(a), rotation(b), links.by_imu[k], links.dt[k], np.zeros(9)
    for i in range(9):
        for j in range(6):
            moved[i] += by_imu[i, j] * (a[15 + j] - links.bias[k, j]) + by_imu[i, 6 + j] * calibration[AXES + j]
    turn, velocity, position = moved[:3], np.empty(3), np.empty(3)
    for i in range(3):
        velocity[i] = b[12 + i] - a[12 + i]
        position[i] = b[9 + i] - a[9 + i] - dt * a[12 + i]
    velocity[2] += gravity_m_s2 * dt
    position[2] += 0.5 * gravity_m_s2 * dt * dt
    v, p, Rab = rotated_back(Ra, velocity), rotated_back(Ra, position), product_back(Ra, Rb)
    error = so3_log(product_back(product(links.dR[k], so3_exp(turn)), Rab))
    out = np.empty(9)
    for i in range(3):
        out[i] = error[i]
        out[3 + i] = v[i] - (links.dv[k, i] + moved[3 + i])
        out[6 + i] = p[i] - (links.dp[k, i] + moved[6 + i])
    inverse = so3_right_jacobian_inverse(error)
    turned = product(inverse, product_back(so3_exp(error), so3_right_jacobian(turn)))
    J[:] = 0.0
    put(J, 0, 0, -1.0, product_transposed(inverse, Rab))
    put(J, 0, 15, 1.0, inverse)
    put(J, 0, 9, -1.0, product(turned, by_imu))  # its first rows and columns
    put(J, 0, 30, -1.0, product(turned, by_imu[:, 6:]))
    put(J, 3, 0, 1.0, skew(v))
    put(J, 6, 0, 1.0, skew(p))
    put_back(J, 3, 6, -1.0, Ra)
    put_back(J, 3, 21, 1.0, Ra)
    put_back(J, 6, 3, -1.0, Ra)
    put_back(J, 6, 6, -dt, Ra)
    put_back(J, 6, 18, 1.0, Ra)
    for i in range(3, 9):
        for j in range(6):
            J[i, 9 + j], J[i, 30 + j] = -by_imu[i, j], -by_imu[i, 6 + j]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def guess_error(a: Array, b: Array, guess: Array, J: Array) -> Array:
    """Return the error [6] of the motion between two states against a guess [4, 4], and J [6, 12] by both poses."""
    Ra, Rb, apart = rotation(a), rotation(b), np.empty(3)
    for i in range(3):
        apart[i] = b[9 + i] - a[9 + i]
    moved, Rab = rotated_back(Ra, apart), product_back(Ra, Rb)
    error = so3_log(product_back(guess, Rab))
    out = np.empty(6)
    for i in range(3):
        out[i], out[3 + i] = error[i], moved[i] - guess[i, 3]
    inverse = so3_right_jacobian_inverse(error)
    J[:] = 0.0
    put(J, 0, 0, -1.0, product_transposed(inverse, Rab))
    put(J, 0, 6, 1.0, inverse)
    put(J, 3, 0, 1.0, skew(moved))
    put_back(J, 3, 3, -1.0, Ra)
    put_back(J, 3, 9, 1.0, Ra)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _extra_shift(a: Array, b: Array, at: Array) -> Array:
    """Return how far both poses are from where further sensors were linearised [12]."""
    out = np.empty(12)
    da, db = difference(a, at[0]), difference(b, at[1])
    for i in range(6):
        out[i], out[6 + i] = da[i], db[i]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _extra_cost(X: Array, links: Links) -> float:
    """Return the cost of all motions by further sensors, up to a constant."""
    total = 0.0
    for k in np.flatnonzero(links.extra):
        d = _extra_shift(X[k], X[k + 1], links.extra_at[k])
        for i in range(12):
            total += links.extra_b[k, i] * d[i]
            for j in range(12):
                total += 0.5 * d[i] * links.extra_H[k, i, j] * d[j]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _add_extra(d: Array, links: Links, where: Ints, k: int, A: Array, g: Array) -> None:
    """Add the motion of link k by further sensors, at a shift d [12], to the normal equations."""
    for i in range(12):
        at_i = where[k + i // 6, i % 6]
        total = links.extra_b[k, i]
        for j in range(12):
            at_j = where[k + j // 6, j % 6]
            total += links.extra_H[k, i, j] * d[j]
            if at_j >= at_i:
                A[at_i, at_j] += links.extra_H[k, i, j]
        g[at_i] += total


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(J: Array, information: Array, r: Array, at: Ints, A: Array, g: Array) -> None:
    """Add an error r [n] of the unknowns `at` to the normal equations; `information` [n, n] is symmetric."""
    rows, width = J.shape
    weighted, row = np.zeros((rows, width)), np.empty(width)
    for m in range(rows):
        for n in range(rows):
            factor = information[m, n]
            for j in range(width):
                weighted[m, j] += factor * J[n, j]
    for i in range(width):
        row[i:] = 0.0
        for m in range(rows):
            factor = weighted[m, i]
            g[at[i]] += factor * r[m]
            if factor != 0.0:
                for j in range(i, width):
                    row[j] += factor * J[m, j]
        for j in range(i, width):
            A[min(at[i], at[j]), max(at[i], at[j])] += row[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _diagonal(at_a: int, at_b: int, weight: float, error: float, A: Array, g: Array) -> None:
    """Add the square of `weight * (b - a)` whose value is `error`."""
    A[at_b, at_b] += weight
    g[at_b] += weight * error
    A[at_a, at_a] += weight
    A[min(at_a, at_b), max(at_a, at_b)] -= weight
    g[at_a] -= weight * error


@njit(cache=True, nogil=True, error_model="numpy")
def cost(X: Array, calibration: Array, links: Links, gravity_m_s2: float) -> float:
    """Return half the squared error of all links and of rest."""
    J9, J6 = np.empty((9, 36)), np.empty((6, 12))
    total = 0.0
    for k in range(len(X)):
        for i in range(12, 15):
            total += (links.rest_weight[k] * X[k, i]) ** 2
    for k in range(len(X) - 1):
        if links.inertial[k]:
            r = imu_error(X[k], X[k + 1], calibration, links, k, gravity_m_s2, J9)
            for i in range(9):
                for j in range(9):
                    total += r[i] * links.information[k, i, j] * r[j]
        for i in range(6):
            total += links.walk_information[k, i] * (X[k + 1, 15 + i] - X[k, 15 + i]) ** 2
        if links.guess_weight[k, 0] > 0.0:
            r = guess_error(X[k], X[k + 1], links.guess[k], J6)
            for i in range(6):
                total += (links.guess_weight[k, i // 3] * r[i]) ** 2
        for i in range(12, 15):
            total += (links.velocity_weight[k] * (X[k + 1, i] - X[k, i])) ** 2
    return 0.5 * total + _extra_cost(X, links)


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    states: States,
    calibration: Array,
    links: Links,
    gravity_m_s2: float,
    where: Ints,
    count: int,
    rests: int,
    normal: Normal,
) -> None:
    """Add the first `count` links and rest of the first `rests` keyframes to the normal equations.

    `where` [M, 15] (or [M, 6]) are the indices of each keyframe's error among the unknowns; with six there are no
    velocities. The calibration [16] comes after them.
    """
    X, X_first, held = states
    A, g = normal
    J9, J6, weights = np.empty((9, 36)), np.empty((6, 12)), np.zeros((6, 6))
    full = where.shape[1] == 15
    at = np.empty(36, dtype=np.int64)
    at[30:] = where.size + AXES + np.arange(6)
    for k in range(count):
        a = X_first[k] if held[k] else X[k]
        b = X_first[k + 1] if held[k + 1] else X[k + 1]
        if full:
            if links.inertial[k]:
                r = imu_error(X[k], X[k + 1], calibration, links, k, gravity_m_s2, J9)
                if held[k] or held[k + 1]:
                    imu_error(a, b, calibration, links, k, gravity_m_s2, J9)
                at[:15], at[15:30] = where[k], where[k + 1]
                _scatter(J9, links.information[k], r, at, A, g)
            for i in range(6, 15):  # velocity, biases
                weight = links.velocity_weight[k] ** 2 if i < 9 else links.walk_information[k, i - 9]
                _diagonal(where[k, i], where[k + 1, i], weight, X[k + 1, 6 + i] - X[k, 6 + i], A, g)
        if links.guess_weight[k, 0] > 0.0:
            r = guess_error(X[k], X[k + 1], links.guess[k], J6)
            if held[k] or held[k + 1]:
                guess_error(a, b, links.guess[k], J6)
            for i in range(6):
                weights[i, i] = links.guess_weight[k, i // 3] ** 2
            at[:6], at[6:12] = where[k, :6], where[k + 1, :6]
            _scatter(J6, weights, r, at[:12], A, g)
        if links.extra[k]:
            _add_extra(_extra_shift(X[k], X[k + 1], links.extra_at[k]), links, where, k, A, g)
    if full:
        for k in range(rests):
            weight = links.rest_weight[k] ** 2
            for i in range(6, 9):
                A[where[k, i], where[k, i]] += weight
                g[where[k, i]] += weight * X[k, 6 + i]


@njit(cache=True, nogil=True, error_model="numpy")
def prior_shift(X: Array, X_first: Array, calibration: Array, calibration_first: Array, held: int, size: int) -> Array:
    """Return how far [16 + held * size] the states are from where the prior was linearised."""
    out = np.empty(CALIBRATION + held * size)
    for i in range(CALIBRATION):
        out[i] = calibration[i] - calibration_first[i]
    for k in range(held):
        d = difference(X[k], X_first[k])
        for i in range(size):
            out[CALIBRATION + k * size + i] = d[i]
    return out
