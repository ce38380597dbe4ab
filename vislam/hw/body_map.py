"""From values in SI units to calibrated samples, for sources that bring units of their own."""

from collections.abc import Sequence

import numpy as np

from vislam.config import BoardConfig
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.affine import Affine
from vislam.hw.gyro_zero import GyroZero


class BodyMap:
    """Owns the calibration of a source in rad/s, m/s^2 and uT, and what is known of its temperature.

    Attributes:
        zero: the temperature at which biases were taken.
        temperature_c: smoothed; None where the source has none.
    """

    def __init__(self, config: BoardConfig) -> None:
        """Take the calibration; raises HardwareError for axes that name one twice."""
        c = config.calibration
        self._gyro = Affine.of(c.gyro_axes, c.gyro_matrix, c.gyro_bias_rad_s, 1.0)
        self._accel = Affine.of(c.accel_axes, c.accel_matrix, c.accel_bias_m_s2, 1.0)
        self._mag = Affine.of(c.mag_axes, c.mag_matrix, c.mag_bias_ut, 1.0)
        self._limit_c = config.max_temperature_change_c
        self.zero = GyroZero()
        self.temperature_c: float | None = None

    @property
    def is_far(self) -> bool:
        """Whether the chip is warmer or colder than where its biases were taken, by more than is allowed."""
        return self.zero.is_far(self.temperature_c, self._limit_c)

    def inertial(self, t_ns: int, rate: Array, force: Array) -> ImuSample:
        """Return the sample of rates [3] and specific forces [3] in axes of the chip."""
        rate = self._gyro.matrix @ rate + self._gyro.offset - self.zero.drift_rad_s(self.temperature_c)
        return ImuSample(t_ns, rate, self._accel.matrix @ force + self._accel.offset)

    def magnetic(self, t_ns: int, field_ut: Array) -> MagSample:
        """Return the sample of a field [3] in axes of the chip."""
        return MagSample(t_ns, self._mag.matrix @ field_ut + self._mag.offset)


def triple(values: Sequence[float]) -> Array:
    """Return three finite numbers [3]; raises ValueError for anything else."""
    found = np.array(values, dtype=np.float64)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"three finite numbers are needed, got {values!r}")
    return found
