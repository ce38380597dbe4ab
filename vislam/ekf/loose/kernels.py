"""Compiled arithmetic of the filter.

Nominal state x [23]: position 0:3, velocity 3:6, quaternion wxyz 6:10, accel bias 10:13, gyro bias 13:16 (the 16 of
Karpov et al. 2026), then the cloned keyframe: position 16:19, quaternion 19:23.
Error state [21]: rotation 0:3 (body side), position 3:6, velocity 6:9, gyro bias 9:12, accel bias 12:15 (the order of
`NavState`), then the clone: rotation 15:18, position 18:21. Sola, "Quaternion kinematics for the error-state Kalman
filter", 2017; the clone after Roumeliotis and Burdick, "Stochastic cloning", ICRA 2002.
The K own variables of sensors (`vislam.sensors`) end both: x [23 + K] and errors [21 + K] that are simply added.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.core.small import write_cross, write_left_jacobian, write_right_jacobian, write_rotation

NOMINAL = 23
ERRORS = 21
_MOVING = 9  # the first of them: rotation, position and velocity; biases and clone stay as they are in a prediction
_HOLE_STEP_S = 0.01
_HOLE_STEPS = 2000  # at most: a clock that leaps by a year must not stop the filter for as long


class Step(NamedTuple):
    """From one sample to the next."""

    before: Array  # [6] gyro, accel
    after: Array  # [6]
    dt_s: float
    gap_s: float  # length of the hole in the data that it lies in, else 0


@njit(cache=True, nogil=True)
def turn(x: Array, at: int, rx: float, ry: float, rz: float) -> None:
    """Multiply the quaternion in `x[at:at+4]` by a rotation vector on its body side, in place."""
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    c = math.cos(0.5 * angle)
    s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    ex, ey, ez = s * rx, s * ry, s * rz
    w, a, b, d = x[at], x[at + 1], x[at + 2], x[at + 3]
    w1 = w * c - a * ex - b * ey - d * ez
    a1 = w * ex + a * c + b * ez - d * ey
    b1 = w * ey - a * ez + b * c + d * ex
    d1 = w * ez + a * ey - b * ex + d * c
    norm = 1.0 / math.sqrt(w1 * w1 + a1 * a1 + b1 * b1 + d1 * d1)
    x[at] = w1 * norm
    x[at + 1] = a1 * norm
    x[at + 2] = b1 * norm
    x[at + 3] = d1 * norm


@njit(cache=True, nogil=True)
def pose(x: Array, at_p: int, at_q: int) -> Array:
    """Return the pose [4, 4] whose position and quaternion start at these places of x."""
    T = np.eye(4)
    write_rotation(x[at_q], x[at_q + 1], x[at_q + 2], x[at_q + 3], T)
    T[0, 3], T[1, 3], T[2, 3] = x[at_p], x[at_p + 1], x[at_p + 2]
    return T


@njit(cache=True, nogil=True)
def predict(
    x: Array,
    P: Array,
    rate0: Array,
    rate1: Array,
    dt: float,
    gap_s: float,
    sigmas: Array,
    gravity: float,
) -> None:
    """Move x [23 + K] and P [21 + K, 21 + K] by one step, in place.

    Mid-point: both samples [6] (gyro, accel) are averaged, and the force acts along the attitude half way. The same
    arithmetic as `vislam.imu.preintegrate`.

    Args:
        x: nominal state.
        P: covariance.
        rate0: sample [6] at the start of the step, gyro then accel.
        rate1: sample [6] at its end.
        dt: length of the step in s.
        gap_s: length of the hole in the data that the step lies in, else 0.
        sigmas: [6] gyro and accel noise densities, gyro and accel bias walks, then what mean rate and force may have
            done unseen inside a hole (rad/s and m/s^2).
        gravity: m/s^2.
    """
    _step(x, P, Step(rate0, rate1, dt, gap_s), sigmas, gravity, np.zeros((2, _MOVING, len(P))))


@njit(cache=True, nogil=True)
def _step(x: Array, P: Array, step: Step, sigmas: Array, gravity: float, work: Array) -> None:
    """Predict, as `predict` documents. `work` [2, 9, 21 + K]: scratch, all zero at first, for many steps."""
    rate0, rate1, dt, gap_s = step
    wx = (0.5 * (rate0[0] + rate1[0]) - x[13]) * dt
    wy = (0.5 * (rate0[1] + rate1[1]) - x[14]) * dt
    wz = (0.5 * (rate0[2] + rate1[2]) - x[15]) * dt
    ax = 0.5 * (rate0[3] + rate1[3]) - x[10]
    ay = 0.5 * (rate0[4] + rate1[4]) - x[11]
    az = 0.5 * (rate0[5] + rate1[5]) - x[12]
    R, M = np.empty((3, 3)), np.empty((3, 3))  # attitude at the start and half way
    write_rotation(x[6], x[7], x[8], x[9], R)
    turn(x, 6, 0.5 * wx, 0.5 * wy, 0.5 * wz)
    write_rotation(x[6], x[7], x[8], x[9], M)
    turn(x, 6, 0.5 * wx, 0.5 * wy, 0.5 * wz)
    fx = M[0, 0] * ax + M[0, 1] * ay + M[0, 2] * az
    fy = M[1, 0] * ax + M[1, 1] * ay + M[1, 2] * az
    fz = M[2, 0] * ax + M[2, 1] * ay + M[2, 2] * az

    F = work[0]  # the rows of the transition that are not those of the identity
    angle = math.sqrt(wx * wx + wy * wy + wz * wz)
    s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    write_rotation(math.cos(0.5 * angle), -s * wx, -s * wy, -s * wz, F)  # Exp(-w dt)
    write_right_jacobian(wx, wy, wz, -dt, F[:3, 9:12])
    write_cross(fx, fy, fz, R, -dt, F[6:9, :3])
    write_cross(fx, fy, fz, M, 0.5 * dt * dt, F[6:9, 9:12])
    F[6:9, 12:15] = -dt * M
    F[3:6] = 0.5 * dt * F[6:9]
    for i in range(3):
        F[3 + i, 3 + i] = F[6 + i, 6 + i] = 1.0
        F[3 + i, 6 + i] = dt
    _propagate(P, F, work[1], dt, gap_s, sigmas)

    fz -= gravity
    x[0] += dt * x[3] + 0.5 * dt * dt * fx
    x[1] += dt * x[4] + 0.5 * dt * dt * fy
    x[2] += dt * x[5] + 0.5 * dt * dt * fz
    x[3] += dt * fx
    x[4] += dt * fy
    x[5] += dt * fz


@njit(cache=True, nogil=True)
def _propagate(P: Array, F: Array, rows: Array, dt: float, gap_s: float, sigmas: Array) -> None:
    """P = F P F^T + Q, in place; the result is exactly symmetric."""
    # Inside a hole the unseen error is constant, so it grows with the square of time; spread over steps as white noise.
    gyro = (sigmas[0] * sigmas[0] + sigmas[4] * sigmas[4] * gap_s) * dt
    accel = (sigmas[1] * sigmas[1] + sigmas[5] * sigmas[5] * gap_s) * dt
    np.dot(F, P, rows)
    columns = np.ascontiguousarray(rows.T)  # BLAS takes twice as long for a small matrix that is transposed
    block = F @ columns
    symmetrise(block)
    P[:_MOVING] = rows
    P[:, :_MOVING] = columns
    P[:_MOVING, :_MOVING] = block
    for i in range(3):
        P[i, i] += gyro
        P[3 + i, 3 + i] += accel * dt * dt / 3.0
        P[6 + i, 6 + i] += accel
        P[3 + i, 6 + i] += 0.5 * dt * accel
        P[6 + i, 3 + i] += 0.5 * dt * accel
        P[9 + i, 9 + i] += sigmas[2] * sigmas[2] * dt
        P[12 + i, 12 + i] += sigmas[3] * sigmas[3] * dt


@njit(cache=True, nogil=True)
def symmetrise(P: Array) -> None:
    """Replace P by the mean of itself and its transpose, in place: rounding alone would make it indefinite."""
    for i in range(len(P)):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean


@njit(cache=True, nogil=True)
def pieces_of(dt: float, gap_s: float) -> int:
    """Return in how many pieces to take a step of `dt` s; in a hole what is unseen turns the force, too."""
    return min(max(math.ceil(dt / _HOLE_STEP_S), 1), _HOLE_STEPS) if gap_s > 0.0 else 1


@njit(cache=True, nogil=True)
def between(a: Array, b: Array, share: float, out: Array) -> None:
    """Write the sample at a share of the way from a [6] to b [6] into `out`."""
    for i in range(6):
        out[i] = a[i] + share * (b[i] - a[i])


@njit(cache=True, nogil=True)
def store(x: Array, out: Array) -> None:
    """Write position, velocity and quaternion into `out` [10]."""
    for i in range(10):
        out[i] = x[i]


@njit(cache=True, nogil=True)
def predict_run(
    x: Array,
    P: Array,
    t_ns: NDArray[np.int64],
    samples: Array,
    gaps_s: Array,
    track: Array,
    sigmas: Array,
    gravity: float,
) -> None:
    """Predict through samples [N, 6] at `t_ns` [N], the state being at the first; store x[:10] of each in `track`.

    `gaps_s` [N] is, for the step that ends at each sample, the length of the hole it lies in, else 0.
    """
    before, after = np.empty(6), np.empty(6)
    work = np.zeros((2, _MOVING, len(P)))
    store(x, track[0])
    for k in range(1, len(t_ns)):
        dt = (t_ns[k] - t_ns[k - 1]) * 1e-9
        pieces = pieces_of(dt, gaps_s[k])
        for j in range(pieces):
            if pieces == 1:  # not even rounding may distinguish this from a single `predict`
                _step(x, P, Step(samples[k - 1], samples[k], dt, gaps_s[k]), sigmas, gravity, work)
                break
            between(samples[k - 1], samples[k], j / pieces, before)
            between(samples[k - 1], samples[k], (j + 1) / pieces, after)
            _step(x, P, Step(before, after, dt / pieces, gaps_s[k]), sigmas, gravity, work)
        store(x, track[k])


@njit(cache=True, nogil=True)
def correct(x: Array, P: Array, K: Array, H: Array, noise: Array, residual: Array) -> None:
    """Apply a gain K [n, m] in place: x by K @ residual, P by Joseph's form, which is valid for any gain.

    The correction is that of the right-invariant error (Barrau and Bonnabel, "The invariant extended Kalman filter as a
    stable observer", IEEE TAC 2017): rotation, position and velocity move along the group SE_2(3), and P, though kept
    in the error of `NavState`, is carried to the new state so that the invariant error keeps its covariance. What
    vision and gravity cannot show, heading and position, then stays unknown however often the state is corrected.
    """
    G = np.eye(len(P))  # from the error about the old state to that about the new
    _move_all(x, K @ residual, G)
    GK = G @ K
    A = GK @ H
    np.subtract(G, A, A)
    np.dot(A, P, G)
    np.dot(G, np.ascontiguousarray(A.T), P)
    np.dot(GK @ noise, np.ascontiguousarray(GK.T), A)
    P += A
    symmetrise(P)


@njit(cache=True, nogil=True)
def _move_all(x: Array, d: Array, G: Array) -> None:
    """Correct the nominal state by the error d, and write the derivative of the move into G, both in place."""
    R, J = np.empty((3, 3)), np.empty((3, 3))
    for clone in range(2):  # in a loop, for numba would compile the moves again for each constant
        row = 15 * clone
        _begin_move(x, d, G, 6 + 13 * clone, row, R, J)
        for vector in range(2 - clone):  # position and velocity; the clone has a position
            _move(x, d, G, 16 * clone + 3 * vector, row + 3 + 3 * vector, row, R, J)
    for i in range(3):
        x[10 + i] += d[12 + i]
        x[13 + i] += d[9 + i]
    for i in range(len(x) - NOMINAL):
        x[NOMINAL + i] += d[ERRORS + i]


@njit(cache=True, nogil=True)
def _begin_move(x: Array, d: Array, G: Array, at_q: int, row: int, R: Array, J: Array) -> None:
    """Correct the rotation at `at_q` by the error at `row`; give R as it was, and the left Jacobian in world axes."""
    write_rotation(x[at_q], x[at_q + 1], x[at_q + 2], x[at_q + 3], R)
    rx, ry, rz = d[row], d[row + 1], d[row + 2]
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    write_rotation(math.cos(0.5 * angle), -s * rx, -s * ry, -s * rz, J)
    for i in range(3):
        for j in range(3):
            G[row + i, row + j] = J[i, j]
    wx = R[0, 0] * rx + R[0, 1] * ry + R[0, 2] * rz
    wy = R[1, 0] * rx + R[1, 1] * ry + R[1, 2] * rz
    wz = R[2, 0] * rx + R[2, 1] * ry + R[2, 2] * rz
    write_left_jacobian(wx, wy, wz, J)
    if angle > 0.0:  # not even rounding may move what the gain leaves alone
        turn(x, at_q, rx, ry, rz)


@njit(cache=True, nogil=True)
def _move(x: Array, d: Array, G: Array, at: int, error: int, row: int, R: Array, J: Array) -> None:
    """Correct the vector at `at` by its error, along the turn that the rotation at `row` just made."""
    mx = J[0, 0] * d[error] + J[0, 1] * d[error + 1] + J[0, 2] * d[error + 2]
    my = J[1, 0] * d[error] + J[1, 1] * d[error + 1] + J[1, 2] * d[error + 2]
    mz = J[2, 0] * d[error] + J[2, 1] * d[error + 1] + J[2, 2] * d[error + 2]
    x[at] += mx
    x[at + 1] += my
    x[at + 2] += mz
    for j in range(3):
        G[error, row + j] = mz * R[1, j] - my * R[2, j]
        G[error + 1, row + j] = mx * R[2, j] - mz * R[0, j]
        G[error + 2, row + j] = my * R[0, j] - mx * R[1, j]


@njit(cache=True, nogil=True)
def innovation(P: Array, H: Array, noise: Array, residual: Array) -> tuple[float, Array]:
    """Return the normalised innovation squared and the optimal gain [n, m]."""
    m = len(residual)
    HP = H @ P
    S = HP @ np.ascontiguousarray(H.T) + noise
    symmetrise(S)
    whiten = np.zeros((m, m))  # inverse of L, where S = L L^T with L in the lower half
    for i in range(m):
        for j in range(i + 1):
            for k in range(j):
                S[i, j] -= S[i, k] * S[j, k]
            S[i, j] = math.sqrt(S[i, j]) if i == j else S[i, j] / S[j, j]
        whiten[i, i] = 1.0 / S[i, i]
        for j in range(i):
            for k in range(j, i):
                whiten[i, j] -= S[i, k] * whiten[k, j]
            whiten[i, j] *= whiten[i, i]
    whitened = whiten @ residual
    KT = np.ascontiguousarray(whiten.T) @ (whiten @ HP)
    return np.sum(whitened * whitened), np.ascontiguousarray(KT.T)


@njit(cache=True, nogil=True)
def update(x: Array, P: Array, H: Array, noise: Array, residual: Array, limit: float, moves: Array) -> float:
    """Correct x and P in place, unless the normalised innovation squared is above the limit; return that.

    Args:
        x: nominal state [23 + K].
        P: covariance [n, n], n = 21 + K.
        H: Jacobian [m, n], or [m, 21] of what does not depend on own variables.
        noise: [m, m].
        residual: [m].
        limit: of the gate; negative: change nothing.
        moves: [n, n] what becomes of the optimal gain; the identity leaves it as it is.
    """
    wide = H
    if H.shape[1] < len(P):
        wide = np.zeros((len(H), len(P)))
        wide[:, : H.shape[1]] = H
    nis, K = innovation(P, wide, noise, residual)
    if nis <= limit:
        correct(x, P, moves @ K, wide, noise, residual)
    return nis


def clone(x: Array, P: Array) -> None:
    """Make the clone a copy of the present pose, fully correlated with it, in place."""
    x[16:19] = x[0:3]
    x[19:23] = x[6:10]
    P[15:21, :15] = P[0:6, :15]
    P[:15, 15:21] = P[:15, 0:6]
    P[15:21, 15:21] = P[0:6, 0:6]
    if len(P) > ERRORS:
        P[15:21, 21:] = P[0:6, 21:]
        P[21:, 15:21] = P[21:, 0:6]
