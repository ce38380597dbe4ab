"""Tilt and gyro bias by gyro and accelerometer: the force is low-passed where gravity stands still, not in the body.

Laidig and Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic disturbance
rejection", Information Fusion 91, 2023 (arXiv 2203.17024), sections 3.3 to 3.5. Other than there, steps may differ in
length, the time constant grows while the body keeps its tilt, what rests must keep its tilt too, and the error of the
tilt is reported.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.geometry import so3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array

_TAU_S = 3.0  # vqf: the force is averaged over it, at least
_TAU_MAX_S = 10.0  # at most, while the body keeps its tilt
_SPEED_CHANGE_M_S = 1.0  # a walk or a cart that starts; with the next it states what lies between the two
_GYRO_ERROR = 0.05  # share of the rate: scale is +-6 % and cross-axis 2 % of an ITG3205 as it comes
# a body that tilted is remembered for so long: each change of tau lets some motion through
_SWAY_S = 60.0
_BIAS_SIGMA_DEG_S = 0.5  # of the gyro's bias, when nothing is known
_BIAS_MOTION_SIGMA_DEG_S = 0.1  # what motion and gravity show of it in the long run
_BIAS_REST_SIGMA_DEG_S = 0.03  # and rest
_BIAS_VERTICAL_VARIANCE = 1e4  # times, about the vertical, where gravity shows nothing
_BIAS_FORGETTING_S = 100.0  # in which it may wander by 0.1 deg/s
_BIAS_INNOVATION_DEG_S = 2.0  # no bias changes by more at once
_REST_S = 1.5  # so long nothing may move
_REST_TAU_S = 0.5  # low-pass from which rate and force do not differ at rest
_REST_RATE_DEG_S = 2.0  # by more than this
_REST_FORCE_M_S2 = 0.5  # and this
# nor the low-passed force from the begin of rest: a cart that rolls tilts, 0.3 deg
_REST_TILT_M_S2 = 0.05
_FORGOTTEN_RAD_S = np.deg2rad(0.1)  # the bias wanders by so much in `bias_forgetting_s`
_UNSEEN = 2.5  # variance of white acceleration behind the filter, over tau^2 times that of its low-passed slope


@njit(cache=True, nogil=True)
def low_pass(state: Array, values: Array, dt_s: float, tau_s: float) -> None:
    """Move a Butterworth filter on by one sample: state [2, N] is what it lets through and its slope per second.

    `tau_s` is the time constant of its step response, the cutoff sqrt(2)/(2 pi tau_s). The differential equation is
    solved exactly for a value held over the step, so steps may differ and `tau_s` may change between them.
    """
    decay = np.exp(-dt_s / tau_s)
    c, s = decay * np.cos(dt_s / tau_s), decay * np.sin(dt_s / tau_s)
    for i in range(len(values)):
        off, drift = state[0, i] - values[i], tau_s * state[1, i]
        state[0, i] = values[i] + c * off + s * (off + drift)
        state[1, i] = (c * drift - s * (2.0 * off + drift)) / tau_s


class Level(NamedTuple):
    """What levelling remembers. `start` is the frame that the gyro alone carries on, level only in the beginning."""

    R_start_body: Array  # [3, 3]
    R_world_start: Array  # [3, 3]
    smooth: Array  # [2, 14] low-passed: force in start [3], R_world_body [9], bias in the world's x and y [2]
    calm: Array  # [2, 6] low-passed: rate and force in the body
    bias: Array  # [3] rad/s
    covariance: Array  # [3, 3] of it
    rest_force: Array  # [3] that rest began with
    rest_s: Array  # [1] since when it may be rest
    sway_rad_s: Array  # [1] how fast the tilt changed, its peaks slowly forgotten
    turning_rad_s: Array  # [3] low-passed rate of the smooth force in start, where gravity does not turn
    wander_rad2: Array  # [1] variance per axis that it shows


class Levelling(NamedTuple):
    """Settings of the kernel, in radians."""

    gravity_m_s2: float
    tau_s: float
    tau_max_s: float
    speed_change_m_s: float
    gyro_error: float
    sway_s: float
    bias_innovation_rad_s: float
    bias_forgetting_s: float
    bias_motion_sigma_rad_s: float
    bias_sigma_rad_s: float
    bias_vertical_variance: float
    bias_rest_sigma_rad_s: float
    rest_s: float
    rest_tau_s: float
    rest_rate_rad_s: float
    rest_force_m_s2: float
    rest_tilt_m_s2: float


def levelling(gravity_m_s2: float) -> Levelling:
    """Return the parameters of the kernel."""
    return Levelling(
        gravity_m_s2, _TAU_S, _TAU_MAX_S, _SPEED_CHANGE_M_S, _GYRO_ERROR, _SWAY_S,
        np.deg2rad(_BIAS_INNOVATION_DEG_S), _BIAS_FORGETTING_S, np.deg2rad(_BIAS_MOTION_SIGMA_DEG_S),
        np.deg2rad(_BIAS_SIGMA_DEG_S), _BIAS_VERTICAL_VARIANCE, np.deg2rad(_BIAS_REST_SIGMA_DEG_S),
        _REST_S, _REST_TAU_S, np.deg2rad(_REST_RATE_DEG_S), _REST_FORCE_M_S2,
        _REST_TILT_M_S2,
    )  # fmt: skip


def begin_level(R_world_body: Array, bias: Array, p: Levelling) -> Level:
    """Return the state of a body that has had this attitude and this bias for a while."""
    R, bias = np.array(R_world_body, dtype=np.float64), np.array(bias, dtype=np.float64)
    up = p.gravity_m_s2 * R[2]
    smooth, calm = np.zeros((2, 14)), np.zeros((2, 6))
    smooth[0] = np.hstack([[0.0, 0.0, p.gravity_m_s2], R.ravel(), (R @ bias)[:2]])
    calm[0] = np.hstack([bias, up])
    covariance = np.eye(3) * p.bias_sigma_rad_s**2
    return Level(R, np.eye(3), smooth, calm, bias, covariance, up, np.zeros(1), np.zeros(1), np.zeros(3), np.zeros(1))


@njit(cache=True, nogil=True)
def level(state: Level, gyro: Array, accel: Array, dt_s: float, p: Levelling) -> None:
    """Move the state on by one sample of rate [3] and force [3]."""
    _watch_rest(state, gyro, accel, dt_s, p)
    R = state.R_start_body
    R[:] = R @ so3_exp((gyro - state.bias) * dt_s)
    _orthonormalise(R)
    R_world_body = state.R_world_start @ R
    in_world = R_world_body @ state.bias
    tau_s = _time_constant(state, R_world_body[2], dt_s, p)
    low_pass(
        state.smooth, np.concatenate((R @ accel, R_world_body.copy().reshape(9), in_world[:2])), dt_s, tau_s
    )  # fmt: skip
    correction = _correct_tilt(state, dt_s, tau_s, p)
    _learn_bias(state, correction / dt_s, dt_s, p)


@njit(cache=True, nogil=True)
def _watch_rest(state: Level, gyro: Array, accel: Array, dt_s: float, p: Levelling) -> None:
    """Count the time for which nothing has moved: rate and force stay what they are, and so does the tilt."""
    calm = state.calm
    low_pass(calm, np.concatenate((gyro, accel)), dt_s, p.rest_tau_s)
    rate, force = gyro - calm[0, :3], accel - calm[0, 3:]
    moved = calm[0, 3:] - state.rest_force
    if (
        np.sum(rate * rate) < p.rest_rate_rad_s**2
        and np.max(np.abs(calm[0, :3] - state.bias)) < p.bias_innovation_rad_s
        and np.sum(force * force) < p.rest_force_m_s2**2
        and np.sum(moved * moved) < p.rest_tilt_m_s2**2
    ):
        state.rest_s[0] += dt_s
    else:
        state.rest_s[0] = 0.0
        state.rest_force[:] = calm[0, 3:]


@njit(cache=True, nogil=True)
def _time_constant(state: Level, up_body: Array, dt_s: float, p: Levelling) -> float:
    """Return over how long the force is averaged.

    Averaged over tau, a change of speed tilts by speed / (g tau), a gyro that is wrong by e by e tau: both are least
    where they are the same. How wrong it is grows with how fast the body tilts. At rest no speed changes.
    """
    rate = state.calm[0, :3] - state.bias
    sideways = rate - np.sum(rate * up_body) * up_body
    held = state.sway_rad_s[0] * np.exp(-dt_s / p.sway_s)
    state.sway_rad_s[0] = max(held, np.sqrt(np.sum(sideways * sideways)))
    if state.rest_s[0] >= p.rest_s:
        return p.tau_s
    P = state.covariance
    unknown = 0.5 * (P[0, 0] + P[1, 1] + P[2, 2] - np.sum(up_body * (P @ up_body)))  # mean over the horizontal axes
    wrong_rad_s = np.sqrt(unknown + (p.gyro_error * state.sway_rad_s[0]) ** 2)
    return min(max(np.sqrt(p.speed_change_m_s / (p.gravity_m_s2 * wrong_rad_s)), p.tau_s), p.tau_max_s)


@njit(cache=True, nogil=True)
def _correct_tilt(state: Level, dt_s: float, tau_s: float, p: Levelling) -> Array:
    """Turn the low-passed force upright by the shortest way; return that rotation vector [3] in the world."""
    force, slope = state.smooth[0, :3], state.smooth[1, :3]
    correction = np.zeros(3)
    norm = np.sqrt(np.sum(force * force))
    if norm < 1e-3 * p.gravity_m_s2:  # free fall has no direction
        return correction
    up = state.R_world_start @ (force / norm)
    sine = np.sqrt(up[0] * up[0] + up[1] * up[1])
    angle = np.arctan2(sine, up[2])
    if sine > 0.0:
        correction[0], correction[1] = angle * up[1] / sine, -angle * up[0] / sine
    else:
        correction[0] = angle
    state.R_world_start[:] = so3_exp(correction) @ state.R_world_start
    _orthonormalise(state.R_world_start)
    turning = state.turning_rad_s
    turning += (1.0 - np.exp(-dt_s / tau_s)) * (np.cross(force, slope) / (norm * norm) - turning)
    now_rad2 = 0.5 * _UNSEEN * tau_s * tau_s * np.sum(turning * turning)
    state.wander_rad2[0] += (1.0 - np.exp(-dt_s / p.tau_max_s)) * (now_rad2 - state.wander_rad2[0])
    return correction


@njit(cache=True, nogil=True)
def _learn_bias(state: Level, turning: Array, dt_s: float, p: Levelling) -> None:
    """Correct the bias by a Kalman filter: at rest by the rate, else by how fast [3] the tilt had to be corrected."""
    bias, P, smooth = state.bias, state.covariance, state.smooth[0]
    if state.rest_s[0] >= p.rest_s:
        H = np.eye(3)
        error = state.calm[0, :3] - bias
        turned_rad_s = p.rest_tilt_m_s2 / (p.gravity_m_s2 * state.rest_s[0])  # what rest so short does not rule out
        sigma = np.full(3, max(p.bias_rest_sigma_rad_s, turned_rad_s))
    else:
        H = smooth[3:12].copy().reshape(3, 3)
        error = -(H @ bias)
        error[:2] += smooth[12:14] - turning[:2]
        sigma = np.full(3, p.bias_motion_sigma_rad_s)
    walk = _FORGOTTEN_RAD_S**2 * dt_s / p.bias_forgetting_s
    begun = bias.copy()
    for i in range(3):
        P[i, i] = max(P[i, i], min(P[i, i] + walk, p.bias_sigma_rad_s**2))
    for i in range(3):
        variance = sigma[i] ** 4 / walk + sigma[i] ** 2  # a filter that settles at sigma
        if i == 2 and state.rest_s[0] < p.rest_s:
            variance *= p.bias_vertical_variance
        innovation = min(max(error[i], -p.bias_innovation_rad_s), p.bias_innovation_rad_s)
        innovation -= np.sum(H[i] * (bias - begun))
        PH = P @ H[i]
        gain = PH / (variance + np.sum(H[i] * PH))
        bias += gain * innovation
        P -= np.outer(gain, PH)


@njit(cache=True, nogil=True)
def _orthonormalise(R: Array) -> None:
    """Undo what rounding did to a rotation: one Gram-Schmidt step."""
    R[0] /= np.sqrt(np.sum(R[0] * R[0]))
    R[1] -= np.sum(R[1] * R[0]) * R[0]
    R[1] /= np.sqrt(np.sum(R[1] * R[1]))
    R[2] = np.cross(R[0], R[1])
