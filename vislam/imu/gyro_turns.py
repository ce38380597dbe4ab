"""Turns by the gyroscope against those that a camera saw: how camera, its clock and gyroscope sit to each other.

`R_key_frame = R_cam_body R_gyro(t_key + d, t_frame + d) R_body_cam`: the rotation part of Kalibr (Furgale et al., IROS
2013) without its splines. What is done with errors and derivatives is the users' matter: the clock of a run follows a
sliding window (`frontend/time_offset.py`), a calibration solves over a whole recording.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.geometry import so3_exp, so3_log
from vislam.core.jit import njit
from vislam.core.messages import Array, ImuSpan
from vislam.core.small import product, product_back, product_transposed

UNKNOWNS = 8  # of `turn_errors`: offset, gyro bias, rotation of the camera, drift


class GyroTurns(NamedTuple):
    """Samples, and what they integrate to from the first one on."""

    t_s: Array  # [N]
    gyro: Array  # [N, 3] rad/s
    bias: Array  # [3] that is taken off
    R: Array  # [N, 3, 3] attitude
    total: Array  # [N, 3, 3] its integral over time


class SeenTurns(NamedTuple):
    """How a camera turned from keyframes to later frames, at times of its own clock, in order."""

    key_s: Array  # [M]
    frame_s: Array  # [M]
    R_key_frame: Array  # [M, 3, 3]


@njit(cache=True, nogil=True)
def integrate_gyro(t_s: Array, gyro: Array) -> Array:
    """Return rotations [N, 3, 3] from the first sample on; the mean rate of two samples turns between them."""
    out = np.empty((len(t_s), 3, 3))
    out[0] = np.eye(3)
    for i in range(1, len(t_s)):
        step = so3_exp(0.5 * (gyro[i - 1] + gyro[i]) * (t_s[i] - t_s[i - 1]))
        out[i] = out[i - 1] @ step
    return out


def gyro_rotation(span: ImuSpan) -> Array:
    """Return R_first_last [3, 3] of the body over a span, by trapezoidal integration of the angular rate."""
    t_s = (span.t_ns - span.t_ns[0]).astype(np.float64) * 1e-9
    return np.asarray(integrate_gyro(t_s, np.ascontiguousarray(span.gyro_rad_s))[-1])


@njit(cache=True, nogil=True)
def _turned(R: Array, rate_a: Array, rate_b: Array, bias: Array, dt: float, out: Array) -> None:
    """Write R after `dt` at the mean of two rates into `out` [3, 3]."""
    w = np.empty(3)
    for i in range(3):
        w[i] = (0.5 * (rate_a[i] + rate_b[i]) - bias[i]) * dt
    out[:] = product(R, so3_exp(w))


@njit(cache=True, nogil=True)
def integrated(t_s: Array, gyro: Array, bias: Array) -> GyroTurns:
    """Return what rates [N, 3] at times [N] turn by; the mean rate of two samples turns between them."""
    R, total = np.zeros((len(t_s), 3, 3)), np.zeros((len(t_s), 3, 3))
    for i in range(3):
        R[0, i, i] = 1.0
    for k in range(len(t_s) - 1):
        dt = t_s[k + 1] - t_s[k]
        _turned(R[k], gyro[k], gyro[k + 1], bias, dt, R[k + 1])
        for i in range(3):
            for j in range(3):
                total[k + 1, i, j] = total[k, i, j] + (0.5 * dt) * (R[k, i, j] + R[k + 1, i, j])
    return GyroTurns(t_s, gyro, bias, R, total)


@njit(cache=True, nogil=True)
def _at(t: float, turns: GyroTurns) -> tuple[Array, Array, Array]:
    """Return attitude, its integral and rate at a time inside the samples."""
    t_s, gyro, bias, R, total = turns
    k = int(np.searchsorted(t_s, t)) - 1
    k = min(max(k, 0), len(t_s) - 2)
    h, share = t - t_s[k], (t - t_s[k]) / (t_s[k + 1] - t_s[k])
    rate, turned, integral = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        rate[i] = gyro[k, i] + (gyro[k + 1, i] - gyro[k, i]) * share
    _turned(R[k], gyro[k], rate, bias, h, turned)
    for i in range(3):
        rate[i] -= bias[i]
        for j in range(3):
            integral[i, j] = total[k, i, j] + (0.5 * h) * (R[k, i, j] + turned[i, j])
    return turned, integral, rate


@njit(cache=True, nogil=True)
def turns_between(turns: GyroTurns, begin_s: Array, end_s: Array) -> Array:
    """Return the body's rotations R_begin_end [M, 3, 3] between times [M] inside the samples."""
    out = np.empty((len(begin_s), 3, 3))
    for k in range(len(begin_s)):
        out[k] = product_back(_at(begin_s[k], turns)[0], _at(end_s[k], turns)[0])
    return out


@njit(cache=True, nogil=True)
def turn_errors(
    turns: GyroTurns, seen: SeenTurns, R_cam_body: Array, offset_s: float, drift: float
) -> tuple[Array, Array]:
    """Return by what the camera's turns differ from the gyroscope's, in the key's camera axes.

    Args:
        turns: of the gyroscope.
        seen: of the camera.
        R_cam_body: [3, 3].
        offset_s: to be added to the camera's time at its newest frame.
        drift: by which that grows in a second.

    Returns:
        Rotation vectors [M, 3], NaN where the samples do not cover both frames, and what a small change of the unknowns
        takes off them [M, 3, 8]; R_cam_body is turned on its left side.
    """
    errors, J = np.full((len(seen.frame_s), 3), np.nan), np.zeros((len(seen.frame_s), 3, UNKNOWNS))
    for k in range(len(errors)):
        since_key, since_frame = seen.key_s[k] - seen.frame_s[-1], seen.frame_s[k] - seen.frame_s[-1]
        begin, end = seen.key_s[k] + offset_s + drift * since_key, seen.frame_s[k] + offset_s + drift * since_frame
        if begin < turns.t_s[0] or end > turns.t_s[-1]:
            continue
        R_a, total_a, rate_a = _at(begin, turns)
        R_b, total_b, rate_b = _at(end, turns)
        to_camera = product(R_cam_body, product_back(R_a, R_b))
        predicted = product_transposed(to_camera, R_cam_body)
        by_bias = product(product_transposed(R_cam_body, R_a), total_b - total_a)
        for i in range(3):
            for j in range(3):
                by_begin, by_end = -R_cam_body[i, j] * rate_a[j], to_camera[i, j] * rate_b[j]
                J[k, i, 0] += by_end + by_begin
                J[k, i, 7] += by_end * since_frame + by_begin * since_key
                J[k, i, 1 + j] = -by_bias[i, j]
                J[k, i, 4 + j] = (1.0 if i == j else 0.0) - predicted[i, j]
        errors[k] = so3_log(product_transposed(seen.R_key_frame[k], predicted))
    return errors, J
