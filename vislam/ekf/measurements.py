"""What the filter can measure, as linear systems: residual, Jacobian, noise, and which states the gain may move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import gammaincinv

from vislam.ekf.kernels import ERRORS, pose
from vislam.geometry import skew, so3_left_jacobian_inverse, so3_log
from vislam.messages import Array, VoMeasurement
from vislam.relative_motion import direction_noise, direction_residual, metric_residual

_FLOOR = 1e-10  # variance, rad^2 and m^2: keeps an identity motion with zero covariance from making S singular
_OPPOSITE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LinearMeasurement:
    """A measurement at the present state: `residual ~ H @ error + noise`."""

    residual: Array  # [m]
    H: Array  # [m, 21]
    noise: Array  # [m, m]
    impossible: str = ""  # why it cannot be right whatever the gate says


def chi_square_limit(probability: float, dof: int) -> float:
    """Return the value that a chi-square variable of `dof` degrees stays below with this probability."""
    return float(2.0 * gammaincinv(0.5 * dof, probability))


def why_unusable(vo: VoMeasurement) -> str:
    """Return what is wrong with the numbers of a motion that is not lost, "" if nothing is."""
    T = vo.T_keyframe_body
    if T is None:
        return "no motion given"
    if T.shape != (4, 4) or not np.isfinite(T).all() or abs(np.linalg.det(T[:3, :3]) - 1.0) > 1e-3:
        return "the motion is not a finite rigid transform"
    if vo.covariance.shape != (6, 6) or not np.isfinite(vo.covariance).all():
        return "the covariance is not 6x6 finite numbers"
    if np.linalg.eigvalsh(0.5 * (vo.covariance + vo.covariance.T))[0] < -1e-9 * (1.0 + np.trace(vo.covariance)):
        return "the covariance is not positive semidefinite"
    return ""


def relative_motion(x: Array, P: Array, vo: VoMeasurement, lever_m: Array, inflation: float) -> LinearMeasurement:
    """Return visual odometry against the clone: 6 rows, 5 without scale, 3 (rotation) without parallax.

    Args:
        x: nominal state [23].
        P: covariance [21, 21]; how far the camera moved is only as well known as this says.
        vo: usable, and relative to the keyframe that is cloned.
        lever_m: camera in the body frame [3]; only matters without scale.
        inflation: factor on the sigmas of `vo`.
    """
    T = vo.T_keyframe_body
    assert T is not None
    T_clone, T_body = pose(x, 16, 19), pose(x, 0, 6)
    covariance = inflation * inflation * vo.covariance
    impossible = ""
    if vo.has_scale:
        residual, J_clone, J_body = metric_residual(T_clone, T_body, T)
        noise = covariance
    elif np.linalg.norm(T[:3, 3]) < 0.5:  # a unit direction or zero, nothing between
        residual, J_clone, J_body = metric_residual(T_clone, T_body, T)
        residual, J_clone, J_body, noise = residual[:3], J_clone[:3], J_body[:3], covariance[:3, :3]
    else:
        residual, J_clone, J_body, axes, along = direction_residual(T_clone, T_body, T, lever_m)
        variance = _displacement_variance(P, T_clone, T[:3, 3])
        if along < -_OPPOSITE_SIGMAS * np.sqrt(variance):
            impossible = f"moved {-along:.2f} m against the direction seen"
        noise = direction_noise(T, covariance, axes, float(np.sqrt(along * along + variance)))
    noise = noise + _FLOOR * np.eye(len(noise))
    return LinearMeasurement(residual, _spread(J_clone, J_body), noise, impossible)


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


def with_shared_error(
    measurement: LinearMeasurement, fraction: float, already: Array
) -> tuple[LinearMeasurement, Array, Array]:
    """Move the part of the noise that all motions from one keyframe share into the clone's own uncertainty.

    Motions relative to one keyframe are built on the same landmarks: their errors have a common part, which repeated
    measuring does not average out. It acts like an error of the keyframe's pose, so it is added to the clone once, and
    only the rest is white noise.

    Args:
        measurement: relative motion.
        fraction: of its noise variance that is shared.
        already: [6, 6] what earlier motions from this keyframe have added to the clone.

    Returns:
        The measurement with the white part of its noise, what to add to the clone's covariance [6, 6], and the new
        total of what was added.
    """
    J_clone = measurement.H[:, 15:]
    inverse = np.linalg.pinv(J_clone)
    wanted = inverse @ (fraction * measurement.noise) @ inverse.T - already
    values, vectors = np.linalg.eigh(0.5 * (wanted + wanted.T))
    more = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(measurement, noise=(1.0 - fraction) * measurement.noise), more, already + more


def zero_velocity(x: Array, gyro_rad_s: Array, sigma_m_s: float, sigma_rad_s: float) -> LinearMeasurement:
    """Return "at rest": velocity is zero, and the gyro [3] shows its bias."""
    H = np.zeros((6, ERRORS))
    H[:3, 6:9] = np.eye(3)
    H[3:, 9:12] = np.eye(3)
    residual = np.concatenate([-x[3:6], gyro_rad_s - x[13:16]])
    return LinearMeasurement(residual, H, np.diag(np.repeat([sigma_m_s**2, sigma_rad_s**2], 3)))


def on_wheels(
    x: Array, gyro_rad_s: Array, axle_m: Array, sigma_m_s: float, floor: tuple[float, float] | None
) -> LinearMeasurement:
    """Return "on wheels": the axle, at `axle_m` [3] in the body frame, goes neither sideways nor up (NHC).

    Args:
        x: nominal state [23].
        gyro_rad_s: rate [3] as measured.
        axle_m: where the wheels cannot slip.
        sigma_m_s: how much they do all the same.
        floor: height of the body in `odom` and its sigma, in metres; None: not known.
    """
    R = pose(x, 0, 6)[:3, :3]
    forward = R.T @ x[3:6]
    velocity = forward + np.cross(gyro_rad_s - x[13:16], axle_m)
    H = np.zeros((3, ERRORS))
    H[:2, :3], H[:2, 6:9], H[:2, 9:12] = skew(forward)[1:], R.T[1:], skew(axle_m)[1:]
    if floor is None:
        return LinearMeasurement(-velocity[1:], H[:2], np.eye(2) * sigma_m_s**2)
    H[2, 5] = 1.0
    residual = np.array([-velocity[1], -velocity[2], floor[0] - x[2]])
    return LinearMeasurement(residual, H, np.diag([sigma_m_s**2, sigma_m_s**2, floor[1] ** 2]))


def where_rest_began(x: Array, at_rest: LinearMeasurement, sigma_rad: float, sigma_m: float) -> LinearMeasurement:
    """Return "at rest" with six more rows: the body is where the clone is, but for its sway."""
    residual, J_clone, J_body = metric_residual(pose(x, 16, 19), pose(x, 0, 6), np.eye(4))
    noise = np.diag(np.repeat([sigma_rad**2, sigma_m**2], 3))
    return LinearMeasurement(
        np.concatenate([at_rest.residual, residual]),
        np.vstack([at_rest.H, _spread(J_clone, J_body)]),
        block_diag(at_rest.noise, noise),
    )


def biases(x: Array, gyro_bias_rad_s: Array, accel_bias_m_s2: Array, sigmas: Array) -> LinearMeasurement:
    """Return biases [3], [3] known from elsewhere with `sigmas` [6]."""
    H = np.zeros((6, ERRORS))
    H[:, 9:15] = np.eye(6)
    residual = np.concatenate([gyro_bias_rad_s - x[13:16], accel_bias_m_s2 - x[10:13]])
    return LinearMeasurement(residual, H, np.diag(sigmas**2))


def _displacement_variance(P: Array, T_clone: Array, direction: Array) -> float:
    """Return how well the motion since the clone is known along a direction [3] of the clone's axes, in m^2."""
    row = np.zeros(ERRORS)
    row[3:6] = T_clone[:3, :3] @ direction
    row[18:21] = -row[3:6]
    return max(float(row @ P @ row), 0.0)


def _spread(J_clone: Array, J_body: Array) -> Array:
    H = np.zeros((len(J_body), ERRORS))
    H[:, :6] = J_body
    H[:, 15:] = J_clone
    return H
