"""The first state from rest: gravity and gyro bias are the means of what the IMU measures."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from vislam.config import InitConfig
from vislam.core.errors import DataError
from vislam.core.geometry import level_rotation, skew, transform
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import AS_MODELLED, Array, ImuSample, ImuSpan, NavState, NoiseScale
from vislam.imu.series import join

_REST_GYRO_STD_RAD_S = 0.03  # idling EuRoC drone 0.007 to 0.03, hovering above 0.065 (0.5 s windows)
# idling motors shake up to 0.35; the gyro and the image decide between the two
_REST_ACCEL_STD_M_S2 = 0.4
_REST_GYRO_MAX_RAD_S = 0.7  # mean rate: only the boot bias of a cheap gyro (ITG3205: 40 deg/s) may show
_SLOW_M_S = 0.1
_NOISE_SIGMAS = 3.0  # a sensor noisier than the thresholds assume must still be able to rest
_SET_OFF_M_S = 0.02  # gained since the force was that of rest: a filter takes rest's speed for zero to 5 mm/s
_MEMORY_S = 2.0  # of the force at rest: biases and tilt wander
# of the measured norm: accelerometer bias and scale of a calibrated sensor
GRAVITY_TOLERANCE_M_S2 = 0.5
_LEVEL_ACCEL_SIGMA_M_S2 = 1.5  # of a body that may move: a hand or a drone; 9 deg of tilt
_LEVEL_SPEED_SIGMA_M_S = 2.0  # of the same
_NS = 1_000_000_000
_CHOSEN = 1e-3  # sigma, rad and m, of heading and position where odom is defined to be zero
_REST_SIGMA_M_S = 0.02  # a body at rest still sways
_CORRELATED_S = 0.05  # vibration at rest averages out over samples this far apart


def is_still(gyro_rad_s: Array, accel_m_s2: Array, most: tuple[float, float, float]) -> bool:
    """Return whether samples [N, 3] look like rest: spread of rate and of force, and mean rate, below the `most`."""
    found = gyro_rad_s.std(axis=0), accel_m_s2.std(axis=0), gyro_rad_s.mean(axis=0)
    return all(float(np.linalg.norm(value)) < limit for value, limit in zip(found, most, strict=True))


def still_limits(noise: ImuNoise, scale: NoiseScale = AS_MODELLED) -> tuple[float, float, float]:
    """Return the `most` of `is_still`, widened where the sensor's own white noise needs it."""
    per_sample = np.sqrt(3.0 * noise.rate_hz) * _NOISE_SIGMAS
    gyro = max(_REST_GYRO_STD_RAD_S, per_sample * noise.gyroscope_noise_density * scale.gyro)
    accel = max(_REST_ACCEL_STD_M_S2, per_sample * noise.accelerometer_noise_density * scale.accel)
    return gyro, accel, _REST_GYRO_MAX_RAD_S


def is_slow(state: NavState) -> bool:
    """Return whether an estimator is sure that its body hardly moves.

    An IMU alone cannot distinguish rest from uniform motion: still samples are rest only where this holds.
    """
    sigma_m_s = float(np.sqrt(np.trace(state.covariance[6:9, 6:9])))
    return max(float(np.linalg.norm(state.velocity_world_m_s)), sigma_m_s) < _SLOW_M_S


class RestDetector:
    """Decides whether the sensor has been still for `config.rest_s`: low spread of rate and force, low mean rate.

    An IMU alone cannot distinguish rest from uniform straight motion; ask the image too (median disparity below
    `config.still_px`), as OpenVINS does for its zero-velocity update. A smooth start spreads force little and shifts
    far walls little for a second; the speed that it gains, integrated against the force of the rest before, shows it.
    """

    def __init__(self, config: InitConfig, noise: ImuNoise) -> None:
        """Set thresholds from the configuration, widened where the sensor's own white noise needs it."""
        self._config = config
        self._rest_ns = round(config.rest_s * _NS)
        self._spans: deque[ImuSpan] = deque()
        self._force: Array = np.zeros(3)  # mean [3] of this rest before the spans, fading; m/s^2 ...
        self._force_s = 0.0  # ... and over how long
        self._set_off = False  # the last rest ended by speed gained, so the next one has to show that force is steady
        self._accel_density = noise.accelerometer_noise_density
        self._noise = noise

    def clear(self) -> None:
        """Forget what was seen, as after a hole in the data."""
        self._spans.clear()
        self._force_s = 0.0

    def add(self, span: ImuSpan | None) -> bool:
        """Take the span since the last call (None: a hole) and return whether the sensor has been at rest.

        False until `rest_s` of consecutive data has been seen.
        """
        if span is None or (self._spans and self._spans[-1].t_ns[-1] != span.t_ns[0]):
            self.clear()
        if span is None:
            return False
        self._spans.append(span)
        while span.t_ns[-1] - self._spans[0].t_ns[-1] >= self._rest_ns:
            self._remember(self._spans.popleft())
        if span.t_ns[-1] - self._spans[0].t_ns[0] < self._rest_ns:
            return False
        joined = join(list(self._spans))
        if not self._is_still(joined):
            self._force_s, self._set_off = 0.0, False
            return False
        if self._sets_off(joined):
            self.clear()
            self._set_off = True
        elif self._force_s >= self._config.rest_s:
            self._set_off = False
        return not self._set_off

    def _remember(self, span: ImuSpan) -> None:
        dt_s = float(span.t_ns[-1] - span.t_ns[0]) / _NS
        self._force_s = min(self._force_s + dt_s, _MEMORY_S)
        self._force = self._force + dt_s / self._force_s * (span.accel_m_s2.mean(axis=0) - self._force)

    def _sets_off(self, span: ImuSpan) -> bool:
        """Return whether the speed gained over a span shows that the rest before it is over."""
        dt_s = float(span.t_ns[-1] - span.t_ns[0]) / _NS
        if self._force_s < self._config.rest_s:  # what was before is known less well than what came
            return False
        gained_m_s = float(np.linalg.norm(span.accel_m_s2.mean(axis=0) - self._force)) * dt_s
        density = self._accel_density * span.noise.accel
        sigma_m_s = density * np.sqrt(3.0 * dt_s * (1.0 + dt_s / self._force_s))
        return gained_m_s > max(_SET_OFF_M_S, _NOISE_SIGMAS * sigma_m_s)

    def _is_still(self, span: ImuSpan) -> bool:
        """Return whether one span looks like rest, whatever its length."""
        return is_still(span.gyro_rad_s, span.accel_m_s2, still_limits(self._noise, span.noise))


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
