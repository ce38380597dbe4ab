"""What the filter can measure, and that as linear systems, compiled: it corrects between two inertial samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.geometry import skew, so3_left_jacobian_inverse, so3_log
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.ekf.loose.kernels import ERRORS, pose
from vislam.vision.relative_motion import metric_residual


class NewKeyframe(NamedTuple):
    """Visual motions at later times may refer to the pose at this one."""

    keyframe_id: int


class OnWheels(NamedTuple):
    """A cart's axle goes neither sideways nor up."""


class LinearMeasurement(NamedTuple):
    """A measurement at the present state, without own variables: `residual ~ H @ error + noise`."""

    residual: Array  # [m]
    H: Array  # [m, 21]
    noise: Array  # [m, m]


def absolute_pose(x: Array, T_odom_vo: Array, sigma_rad: float, sigma_m: float) -> LinearMeasurement:
    """Return orientation and position of the body as a visual chain has them: z = [p_vo, theta_vo], R fixed.

    The measurement of Karpov et al. 2026, section 4. Its true error grows and repeats itself from frame to frame, which
    a fixed R of independent errors does not say.
    """
    residual, H = np.empty(6), np.zeros((6, ERRORS))
    T_body = pose(x, 0, 6)
    residual[:3] = so3_log(T_body[:3, :3].T @ T_odom_vo[:3, :3])
    residual[3:] = T_odom_vo[:3, 3] - T_body[:3, 3]
    H[:3, :3] = so3_left_jacobian_inverse(residual[:3])
    H[3:, 3:6] = np.eye(3)
    return LinearMeasurement(residual, H, np.diag(np.repeat([sigma_rad**2, sigma_m**2], 3)))


@njit(cache=True, nogil=True)
def zero_velocity(x: Array, gyro_rad_s: Array, sigma_m_s: float, sigma_rad_s: float) -> LinearMeasurement:
    """Return "at rest": velocity is zero, and the gyro [3] shows its bias."""
    H, residual, noise = np.zeros((6, ERRORS)), np.empty(6), np.zeros((6, 6))
    for i in range(3):
        H[i, 6 + i] = H[3 + i, 9 + i] = 1.0
        residual[i], residual[3 + i] = -x[3 + i], gyro_rad_s[i] - x[13 + i]
        noise[i, i], noise[3 + i, 3 + i] = sigma_m_s * sigma_m_s, sigma_rad_s * sigma_rad_s
    return LinearMeasurement(residual, H, noise)


@njit(cache=True, nogil=True)
def on_wheels(
    x: Array, gyro_rad_s: Array, axle_m: Array, sigma_m_s: float, floor_z_m: float, floor_sigma_m: float
) -> LinearMeasurement:
    """Return "on wheels": the axle, at `axle_m` [3] in the body frame, goes neither sideways nor up (NHC).

    Args:
        x: nominal state [23].
        gyro_rad_s: rate [3] as measured.
        axle_m: where the wheels cannot slip.
        sigma_m_s: how much they do all the same.
        floor_z_m: height of the body in `odom`.
        floor_sigma_m: of the height; 0: it is not known.
    """
    rows = 3 if floor_sigma_m > 0.0 else 2
    R_T = np.ascontiguousarray(pose(x, 0, 6)[:3, :3].T)
    forward = R_T @ x[3:6]
    velocity = forward + skew(gyro_rad_s - x[13:16]) @ axle_m
    H, residual, noise = np.zeros((rows, ERRORS)), np.empty(rows), np.zeros((rows, rows))
    H[:2, :3], H[:2, 6:9], H[:2, 9:12] = skew(forward)[1:], R_T[1:], skew(axle_m)[1:]
    for i in range(2):
        residual[i] = -velocity[1 + i]
        noise[i, i] = sigma_m_s * sigma_m_s
    if rows == 3:
        H[2, 5] = 1.0
        residual[2] = floor_z_m - x[2]
        noise[2, 2] = floor_sigma_m * floor_sigma_m
    return LinearMeasurement(residual, H, noise)


@njit(cache=True, nogil=True)
def where_rest_began(x: Array, at_rest: LinearMeasurement, sigma_rad: float, sigma_m: float) -> LinearMeasurement:
    """Return "at rest" with six more rows: the body is where the clone is, but for its sway."""
    residual, J_clone, J_body = metric_residual(pose(x, 16, 19), pose(x, 0, 6), np.eye(4))
    noise = np.zeros((12, 12))
    noise[:6, :6] = at_rest.noise
    for i in range(3):
        noise[6 + i, 6 + i], noise[9 + i, 9 + i] = sigma_rad * sigma_rad, sigma_m * sigma_m
    H = np.concatenate((at_rest.H, spread(J_clone, J_body)))
    return LinearMeasurement(np.concatenate((at_rest.residual, residual)), H, noise)


def biases(x: Array, gyro_bias_rad_s: Array, accel_bias_m_s2: Array, sigmas: Array) -> LinearMeasurement:
    """Return biases [3], [3] known from elsewhere with `sigmas` [6]."""
    H = np.zeros((6, ERRORS))
    H[:, 9:15] = np.eye(6)
    residual = np.concatenate([gyro_bias_rad_s - x[13:16], accel_bias_m_s2 - x[10:13]])
    return LinearMeasurement(residual, H, np.diag(sigmas**2))


@njit(cache=True, nogil=True)
def spread(J_clone: Array, J_body: Array) -> Array:
    """Return H [m, 21] of what depends on the poses of clone and body only, from its Jacobians [m, 6]."""
    H = np.zeros((len(J_body), ERRORS))
    H[:, :6] = J_body
    H[:, 15:] = J_clone
    return H
