"""Rest detection from inertial statistics; the caller combines it with what the image says."""

from __future__ import annotations

from collections import deque

import numpy as np

from vislam.config import InitConfig
from vislam.imu.noise import ImuNoise
from vislam.imu.series import join
from vislam.messages import ImuSpan

_NS = 1_000_000_000
_NOISE_SIGMAS = 3.0  # a sensor noisier than the thresholds assume must still be able to rest


class RestDetector:
    """Decides whether the sensor has been still for `config.rest_s`: low spread of rate and force, low mean rate.

    An IMU alone cannot tell rest from uniform straight motion; ask the image too (median disparity below
    `config.still_px`), as OpenVINS does for its zero-velocity update.
    """

    def __init__(self, config: InitConfig, noise: ImuNoise) -> None:
        """Set thresholds from the configuration, widened where the sensor's own white noise needs it."""
        self._config = config
        self._rest_ns = round(config.rest_s * _NS)
        self._gyro_max = config.rest_gyro_max_rad_s
        self._spans: deque[ImuSpan] = deque()
        per_sample = np.sqrt(3.0 * noise.rate_hz) * _NOISE_SIGMAS
        self._gyro_white_std = per_sample * noise.gyro_noise_density
        self._accel_white_std = per_sample * noise.accel_noise_density

    def clear(self) -> None:
        """Forget what was seen, as after a hole in the data."""
        self._spans.clear()

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
            self._spans.popleft()
        if span.t_ns[-1] - self._spans[0].t_ns[0] < self._rest_ns:
            return False
        return self.is_still(join(list(self._spans)))

    def is_still(self, span: ImuSpan) -> bool:
        """Return whether one span looks like rest, whatever its length."""
        gyro_std = float(np.linalg.norm(span.gyro_rad_s.std(axis=0)))
        accel_std = float(np.linalg.norm(span.accel_m_s2.std(axis=0)))
        rate = float(np.linalg.norm(span.gyro_rad_s.mean(axis=0)))
        gyro_limit = max(self._config.rest_gyro_std_rad_s, self._gyro_white_std * span.noise.gyro)
        accel_limit = max(self._config.rest_accel_std_m_s2, self._accel_white_std * span.noise.accel)
        return gyro_std < gyro_limit and accel_std < accel_limit and rate < self._gyro_max
