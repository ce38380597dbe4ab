"""The first state from rest: gravity and gyro bias are the means of what the IMU measures."""

from collections.abc import Sequence

import numpy as np

from vislam.config import InitConfig
from vislam.core.errors import DataError
from vislam.core.geometry import level_rotation, skew, transform
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import Array, ImuSample, ImuSpan, NavState
from vislam.imu.rest import is_still, still_limits

# of the measured norm: accelerometer bias and scale of a calibrated sensor
GRAVITY_TOLERANCE_M_S2 = 0.5
_LEVEL_ACCEL_SIGMA_M_S2 = 1.5  # of a body that may move: a hand or a drone; 9 deg of tilt
_LEVEL_SPEED_SIGMA_M_S = 2.0  # of the same
_NS = 1_000_000_000
_CHOSEN = 1e-3  # sigma, rad and m, of heading and position where odom is defined to be zero
_REST_SIGMA_M_S = 0.02  # a body at rest still sways
_CORRELATED_S = 0.05  # vibration at rest averages out over samples this far apart


def state_at_rest(
    samples: Sequence[ImuSample], noise: ImuNoise, gravity_m_s2: float = 9.81, config: InitConfig | None = None
) -> NavState:
    """Return the state at the last of the samples of a body at rest: level, heading and position zero.

    Raises DataError for samples that are too few or too short, that are not of rest, or whose force is not gravity.
    """
    config = config or InitConfig()
    length_s = (samples[-1].t_ns - samples[0].t_ns) / _NS if samples else 0.0
    if length_s < config.rest_s:
        raise DataError(
            f"a state from rest needs {config.rest_s:g} s of samples (init.rest_s), got {len(samples)} over "
            f"{length_s:.2f} s; give more, or a state by NavState.with_sigmas"
        )
    span = ImuSpan(
        np.array([sample.t_ns for sample in samples]),
        np.array([sample.gyro_rad_s for sample in samples]),
        np.array([sample.accel_m_s2 for sample in samples]),
    )
    gyro, force = span.gyro_rad_s.mean(axis=0), span.accel_m_s2.mean(axis=0)
    if not is_still(span.gyro_rad_s, span.accel_m_s2, still_limits(noise)):
        raise DataError(
            f"the {length_s:.2f} s of samples are not of rest: rate {np.linalg.norm(gyro):.2g} rad/s, its spread "
            f"{np.linalg.norm(span.gyro_rad_s.std(axis=0)):.2g} rad/s, that of the force "
            f"{np.linalg.norm(span.accel_m_s2.std(axis=0)):.2g} m/s^2; give a state by NavState.with_sigmas"
        )
    norm = float(np.linalg.norm(force))
    if abs(norm - gravity_m_s2) > GRAVITY_TOLERANCE_M_S2:
        raise DataError(
            f"the force at rest is {norm:.2f} m/s^2, gravity {gravity_m_s2:.2f}, allowed difference "
            f"{GRAVITY_TOLERANCE_M_S2:g} (init.gravity_tolerance_m_s2); calibrate the accelerometer"
        )
    R = level_rotation(force)
    covariance = rest_covariance(span, R, gravity_m_s2, config, noise)
    accel_bias = rest_accel_bias(span, gravity_m_s2, config)
    return NavState(samples[-1].t_ns, transform(R, np.zeros(3)), np.zeros(3), gyro, accel_bias, covariance)


def rest_variance(values: Array, rested_s: float) -> float:
    """Return the variance of the mean of one axis of `values` [N, 3]; vibration is correlated for a while."""
    return float(values.var(axis=0).max()) / max(rested_s / _CORRELATED_S, 1.0)


def rest_accel_bias(span: ImuSpan, gravity_m_s2: float, config: InitConfig) -> Array:
    """Return the accelerometer bias [3]: only its part along gravity shows at rest."""
    rested_s = (int(span.t_ns[-1]) - int(span.t_ns[0])) / _NS
    force = span.accel_m_s2.mean(axis=0)
    norm = float(np.linalg.norm(force))
    prior, measured = config.accel_bias_sigma_m_s2**2, rest_variance(span.accel_m_s2, rested_s)
    return np.asarray(force / norm * ((norm - gravity_m_s2) * prior / (prior + measured)))


def rest_covariance(span: ImuSpan, R: Array, gravity_m_s2: float, config: InitConfig, noise: ImuNoise) -> Array:
    """Return the covariance [15, 15] of a state at rest with attitude R [3, 3].

    Tilt and accelerometer bias cannot be separated, which their correlation expresses.
    """
    rested_s = (int(span.t_ns[-1]) - int(span.t_ns[0])) / _NS
    sigma_gyro = np.sqrt(rest_variance(span.gyro_rad_s, rested_s)) + noise.gyroscope_noise_density
    sigma_force = np.sqrt(rest_variance(span.accel_m_s2, rested_s)) + noise.accelerometer_noise_density
    information = np.zeros((6, 6))  # rotation, accel bias
    heading = R[2]  # rotation about the vertical, on the body side
    information[:3, :3] = np.outer(heading, heading) / _CHOSEN**2 + np.eye(3)  # and tilt within 1 rad
    information[3:, 3:] = np.eye(3) / config.accel_bias_sigma_m_s2**2
    J = np.hstack([skew(R.T @ np.array([0.0, 0.0, gravity_m_s2])), np.eye(3)])
    information += J.T @ J / sigma_force**2
    both = np.linalg.inv(information)
    covariance = np.diag(np.repeat([0.0, _CHOSEN**2, _REST_SIGMA_M_S**2, sigma_gyro**2, 0.0], 3))
    covariance[:3, :3], covariance[:3, 12:] = both[:3, :3], both[:3, 3:]
    covariance[12:, :3], covariance[12:, 12:] = both[3:, :3], both[3:, 3:]
    return covariance


def level_covariance(force_error_m_s2: float, R: Array, gravity_m_s2: float, config: InitConfig) -> Array:
    """Return the covariance [15, 15] of a body taken as level by a few samples, while it may move, with attitude R.

    `force_error_m_s2` is by how much the norm of the force differs from gravity: so much acceleration is certain.
    """
    acceleration = max(_LEVEL_ACCEL_SIGMA_M_S2, abs(force_error_m_s2))
    tilt = float(np.hypot(acceleration, config.accel_bias_sigma_m_s2)) / gravity_m_s2
    covariance = np.zeros((15, 15))
    heading = np.outer(R[2], R[2])  # about the vertical, on the body side
    covariance[:3, :3] = tilt**2 * (np.eye(3) - heading) + _CHOSEN**2 * heading
    sigmas = _CHOSEN, _LEVEL_SPEED_SIGMA_M_S, config.gyro_bias_sigma_rad_s, config.accel_bias_sigma_m_s2
    covariance[3:, 3:] = np.diag(np.repeat(np.square(sigmas), 3))
    return covariance
