"""Compiled inertial arithmetic of the tight filter: nominal motion, error transition and its noise, step by step.

Nominal x [16]: position 0:3, velocity 3:6, quaternion wxyz 6:10, accel bias 10:13, gyro bias 13:16.
Error [15]: rotation 0:3, position 3:6, velocity 6:9, gyro bias 9:12, accel bias 12:15, where the first three are
right-invariant, in world axes: `R = Exp(e) R^`, `p = Exp(e) p^ + e_p`, `v = Exp(e) v^ + e_v`. In these coordinates
what cannot be observed (yaw and position) is the same direction for every estimate, so the filter cannot gain
information on it by moving its linearisation point: no first-estimates Jacobians are needed. Barrau and Bonnabel,
"An EKF-SLAM algorithm with consistency properties", 2015; Wu et al., "An invariant-EKF VINS algorithm for improving
consistency", IROS 2017. The bias of the accelerometer is given in body axes, which breaks this for the tilt of a body
at rest, whose other half that bias is: see `state.Rest`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.geometry import skew, so3_right_jacobian
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.ekf.loose.kernels import Step, between, pieces_of, pose, store, turn
from vislam.ekf.stretch import Stretch

INERTIAL = 15


class Inertial(NamedTuple):
    """What moves from sample to sample, changed in place."""

    x: Array  # [16] nominal state
    Phi: Array  # [15, 15] error transition since the last measurement
    Q: Array  # [15, 15] noise gathered since then


class _Turned(NamedTuple):
    """What one step does."""

    turning: Array  # [3] rad
    force: Array  # [3] mean, in world axes
    middle: Array  # [4, 4] pose after half of the turn
    end: Array  # [4, 4] after all of it


@njit(cache=True, nogil=True)
def step(moving: Inertial, sample: Step, sigmas: Array, gravity: float, to_first: Array) -> None:
    """Move x by one step and chain its error transition onto Phi and Q, all in place.

    Mid-point rule, as in `vislam.imu.preintegrate`; the transition is the exact derivative of that rule.

    Args:
        moving: the state.
        sample: from one sample to the next.
        sigmas: [6] gyro and accel noise densities, gyro and accel bias walks, then what mean rate and force may have
            done unseen inside a hole (rad/s and m/s^2).
        gravity: m/s^2.
        to_first: [3, 3] from the world by x to that by the attitude at which the bias of the accelerometer is
            linearised, see `Rest`.
    """
    x = moving.x
    rate0, rate1, dt, _ = sample
    turning = np.empty(3)
    force = np.empty(3)
    for i in range(3):
        turning[i] = (0.5 * (rate0[i] + rate1[i]) - x[13 + i]) * dt
        force[i] = 0.5 * (rate0[3 + i] + rate1[3 + i]) - x[10 + i]
    turn(x, 6, 0.5 * turning[0], 0.5 * turning[1], 0.5 * turning[2])
    middle = pose(x, 0, 6)
    turn(x, 6, 0.5 * turning[0], 0.5 * turning[1], 0.5 * turning[2])
    end = pose(x, 0, 6)
    f = np.zeros(3)
    for i in range(3):
        for j in range(3):
            f[i] += middle[i, j] * force[j]
    for i in range(3):
        acceleration = f[i] - (gravity if i == 2 else 0.0)
        x[i] += dt * x[3 + i] + 0.5 * dt * dt * acceleration
        x[3 + i] += dt * acceleration
    _chain(moving, _Turned(turning, f, middle, end), sample, sigmas, gravity, to_first)


@njit(cache=True, nogil=True)
def _chain(moving: Inertial, turned: _Turned, sample: Step, sigmas: Array, gravity: float, to_first: Array) -> None:
    """Phi = F Phi and Q = F Q F^T + noise; x is that at the end of the step."""
    x, Phi, Q = moving
    turning, f, middle, end = turned
    dt, gap_s = sample.dt_s, sample.gap_s
    J_end = so3_right_jacobian(turning)
    J_middle = so3_right_jacobian(np.array([0.5 * turning[0], 0.5 * turning[1], 0.5 * turning[2]]))
    B = np.zeros((9, 3))  # rotation, position, velocity by gyro bias
    M = np.zeros((3, 3))  # rotation at mid-step by gyro bias
    push = np.zeros((3, 3))  # acceleration by accel bias, less its sign
    for i in range(3):
        for j in range(3):
            for k in range(3):
                B[i, j] -= dt * end[i, k] * J_end[k, j]
                M[i, j] -= 0.5 * dt * middle[i, k] * J_middle[k, j]
                push[i, j] += to_first[i, k] * middle[k, j]
    S_f = skew(f)
    S_p = skew(x[0:3])
    S_v = skew(x[3:6])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                B[3 + i, j] += S_p[i, k] * B[k, j] - 0.5 * dt * dt * S_f[i, k] * M[k, j]
                B[6 + i, j] += S_v[i, k] * B[k, j] - dt * S_f[i, k] * M[k, j]
    for j in range(INERTIAL):
        _advance(Phi[:, j], B, push, dt, gravity)
    for j in range(INERTIAL):
        _advance(Q[:, j], B, push, dt, gravity)
    for j in range(INERTIAL):
        _advance(Q[j], B, push, dt, gravity)
    gyro = (sigmas[0] * sigmas[0] + sigmas[4] * sigmas[4] * gap_s) / dt
    accel = (sigmas[1] * sigmas[1] + sigmas[5] * sigmas[5] * gap_s) * dt
    for i in range(9):
        for j in range(9):
            Q[i, j] += gyro * (B[i, 0] * B[j, 0] + B[i, 1] * B[j, 1] + B[i, 2] * B[j, 2])
    for i in range(3):
        Q[3 + i, 3 + i] += 0.25 * dt * dt * accel
        Q[3 + i, 6 + i] += 0.5 * dt * accel
        Q[6 + i, 3 + i] += 0.5 * dt * accel
        Q[6 + i, 6 + i] += accel
        Q[9 + i, 9 + i] += sigmas[2] * sigmas[2] * dt
        Q[12 + i, 12 + i] += sigmas[3] * sigmas[3] * dt


@njit(cache=True, nogil=True)
def _advance(e: Array, B: Array, push: Array, dt: float, gravity: float) -> None:
    """Replace e by F e, in place: position first, since it needs the others as they were."""
    down_x = gravity * e[1]
    down_y = -gravity * e[0]
    for i in range(3):
        gained = 0.0
        for k in range(3):
            gained -= dt * push[i, k] * e[12 + k]
        e[3 + i] += dt * e[6 + i] + 0.5 * dt * gained
        e[6 + i] += gained
        for k in range(3):
            e[3 + i] += B[3 + i, k] * e[9 + k]
            e[6 + i] += B[6 + i, k] * e[9 + k]
    e[3] += 0.5 * dt * dt * down_x
    e[4] += 0.5 * dt * dt * down_y
    e[6] += dt * down_x
    e[7] += dt * down_y
    for i in range(3):
        for k in range(3):
            e[i] += B[i, k] * e[9 + k]


@njit(cache=True, nogil=True)
def run(moving: Inertial, piece: Stretch, track: Array, sigmas: Array, gravity: float, to_first: Array) -> None:
    """Step through samples, the state being at the first; store x[:10] at each in `track` [N, 10].

    For the last three see `step`.
    """
    x, t_ns, samples, gaps_s = moving.x, piece.t_ns, piece.samples, piece.gaps_s
    before, after = np.empty(6), np.empty(6)
    store(x, track[0])
    for k in range(1, len(t_ns)):
        dt = (t_ns[k] - t_ns[k - 1]) * 1e-9
        pieces = pieces_of(dt, gaps_s[k])
        for j in range(pieces):
            if pieces == 1:  # not even rounding may distinguish this from a single `step`
                step(moving, Step(samples[k - 1], samples[k], dt, gaps_s[k]), sigmas, gravity, to_first)
                break
            between(samples[k - 1], samples[k], j / pieces, before)
            between(samples[k - 1], samples[k], (j + 1) / pieces, after)
            step(moving, Step(before, after, dt / pieces, gaps_s[k]), sigmas, gravity, to_first)
        store(x, track[k])


def to_nav_error(x: Array) -> Array:
    """Return M [15, 15] that turns the invariant error into that of `NavState`; to first order."""
    T = pose(x, 0, 6)
    M = np.eye(INERTIAL)
    M[0:3, 0:3] = T[:3, :3].T
    M[3:6, 0:3] = -skew(x[0:3])
    M[6:9, 0:3] = -skew(x[3:6])
    return M


def from_nav_error(x: Array) -> Array:
    """Return the inverse of `to_nav_error`."""
    T = pose(x, 0, 6)
    M = np.eye(INERTIAL)
    M[0:3, 0:3] = T[:3, :3]
    M[3:6, 0:3] = skew(x[0:3]) @ T[:3, :3]
    M[6:9, 0:3] = skew(x[3:6]) @ T[:3, :3]
    return M
