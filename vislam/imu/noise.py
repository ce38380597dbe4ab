"""Noise model and calibration of an inertial sensor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vislam.errors import DataError
from vislam.messages import Array, ImuSample


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Continuous-time noise model of an IMU, as in EuRoC's and Kalibr's files."""

    gyro_noise_density: float  # rad/s/sqrt(Hz)
    accel_noise_density: float  # m/s^2/sqrt(Hz)
    gyro_bias_walk: float  # rad/s^2/sqrt(Hz)
    accel_bias_walk: float  # m/s^3/sqrt(Hz)
    rate_hz: float


def _zero() -> Array:
    return np.zeros(3)


def _identity() -> Array:
    return np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class ImuCalibration:
    """Affine calibration from raw sensor axes to the body frame: `calibrated = matrix @ (raw - bias)`.

    The matrices hold scale, misalignment and the chip's mounting; they need not be orthogonal (Tedaldi et al.,
    ICRA 2014, write the same as T K (raw - b)).

    Raises:
        DataError: an entry is not finite, or a matrix [3, 3] cannot be inverted.
    """

    gyro_bias_rad_s: Array = field(default_factory=_zero)  # [3], raw axes
    accel_bias_m_s2: Array = field(default_factory=_zero)  # [3], raw axes
    gyro_matrix: Array = field(default_factory=_identity)  # [3, 3]
    accel_matrix: Array = field(default_factory=_identity)  # [3, 3]

    def __post_init__(self) -> None:
        """Refuse a calibration that would turn every sample into nonsense."""
        for name in ("gyro_bias_rad_s", "accel_bias_m_s2", "gyro_matrix", "accel_matrix"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            expected = (3, 3) if name.endswith("matrix") else (3,)
            if value.shape != expected or not np.isfinite(value).all():
                raise DataError(f"IMU calibration: {name} must be {expected} finite numbers, got {value.tolist()}")
            if name.endswith("matrix") and abs(np.linalg.det(value)) < 1e-6:
                raise DataError(f"IMU calibration: {name} is singular, got {value.tolist()}; calibrate again")

    def apply(self, sample: ImuSample) -> ImuSample:
        """Return the sample in calibrated body axes."""
        return ImuSample(
            t_ns=sample.t_ns,
            gyro_rad_s=self.gyro_matrix @ (sample.gyro_rad_s - self.gyro_bias_rad_s),
            accel_m_s2=self.accel_matrix @ (sample.accel_m_s2 - self.accel_bias_m_s2),
        )
