"""Rest detection from inertial statistics; the caller combines it with what the image shows."""

from collections import deque

import numpy as np

from vislam.config import InitConfig
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import AS_MODELLED, Array, ImuSpan, NavState, NoiseScale
from vislam.imu.series import join

_REST_GYRO_STD_RAD_S = 0.03  # idling EuRoC drone 0.007 to 0.03, hovering above 0.065 (0.5 s windows)
# idling motors shake up to 0.35; the gyro and the image decide between the two
_REST_ACCEL_STD_M_S2 = 0.4
_REST_GYRO_MAX_RAD_S = 0.7  # mean rate: only the boot bias of a cheap gyro (ITG3205: 40 deg/s) may show
_NS = 1_000_000_000
_SLOW_M_S = 0.1
_NOISE_SIGMAS = 3.0  # a sensor noisier than the thresholds assume must still be able to rest
_SET_OFF_M_S = 0.02  # gained since the force was that of rest: a filter takes rest's speed for zero to 5 mm/s
_MEMORY_S = 2.0  # of the force at rest: biases and tilt wander


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
