"""Noise model and calibration of an inertial sensor."""

from dataclasses import dataclass, field

import numpy as np

from vislam.core.errors import DataError
from vislam.core.messages import Array, ImuSample, MagSample

_SINGULAR = 1e-6  # determinant
_USUAL_PERIODS = 1.5  # a longer hole lacks a sample
_LONGEST_GAP_S = 0.5


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Continuous-time noise model of an IMU, by the names of Kalibr's files."""

    gyroscope_noise_density: float  # rad/s/sqrt(Hz)
    accelerometer_noise_density: float  # m/s^2/sqrt(Hz)
    gyroscope_random_walk: float  # rad/s^2/sqrt(Hz)
    accelerometer_random_walk: float  # m/s^3/sqrt(Hz)
    rate_hz: float
    # relative, of scale factors and misalignment that calibration left; None: not known, see `ImuConfig`
    gyroscope_scale_sigma: float | None = None
    accelerometer_scale_sigma: float | None = None

    def gap_s(self, stated_s: float) -> float:
        """Return how long a hole between samples is no outage: as given, and one and a half periods of a slow IMU.

        Not beyond half a second: what a body does between samples further apart is unmeasured.
        """
        usual_s = _USUAL_PERIODS / self.rate_hz if self.rate_hz > 0.0 else 0.0
        return max(stated_s, usual_s) if usual_s <= _LONGEST_GAP_S else stated_s


def _zero() -> Array:
    return np.zeros(3)


def _identity() -> Array:
    return np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class MagCalibration:
    """Hard and soft iron of a magnetometer: `calibrated = matrix @ (raw - bias)`, in the sensor's own axes.

    Raises:
        DataError: an entry is not finite, or the matrix cannot be inverted.
    """

    bias_ut: Array = field(default_factory=_zero)  # [3]
    matrix: Array = field(default_factory=_identity)  # [3, 3]

    def __post_init__(self) -> None:
        """Refuse a calibration that would turn every sample into nonsense."""
        _check_affine("magnetometer", self.bias_ut, self.matrix)

    def apply(self, sample: MagSample) -> MagSample:
        """Return the calibrated sample."""
        return MagSample(sample.t_ns, self.matrix @ (sample.field_ut - self.bias_ut))


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
        _check_affine("gyroscope", self.gyro_bias_rad_s, self.gyro_matrix)
        _check_affine("accelerometer", self.accel_bias_m_s2, self.accel_matrix)

    def apply_to(self, raw: Array) -> Array:
        """Return samples [N, 6], rates then forces, in calibrated body axes."""
        gyro = (raw[:, :3] - self.gyro_bias_rad_s) @ self.gyro_matrix.T
        return np.hstack([gyro, (raw[:, 3:] - self.accel_bias_m_s2) @ self.accel_matrix.T])

    def apply(self, sample: ImuSample) -> ImuSample:
        """Return the sample in calibrated body axes."""
        return ImuSample(
            t_ns=sample.t_ns,
            gyro_rad_s=self.gyro_matrix @ (sample.gyro_rad_s - self.gyro_bias_rad_s),
            accel_m_s2=self.accel_matrix @ (sample.accel_m_s2 - self.accel_bias_m_s2),
        )


def _check_affine(sensor: str, bias: Array, matrix: Array) -> None:
    for name, value, shape in (("bias", bias, (3,)), ("matrix", matrix, (3, 3))):
        if np.shape(value) != shape or not np.isfinite(value).all():
            got = np.asarray(value).tolist()
            raise DataError(f"{sensor} calibration: the {name} must be {shape} finite numbers, got {got}")
    if abs(np.linalg.det(matrix)) < _SINGULAR:
        raise DataError(f"{sensor} calibration: the matrix is singular, {np.asarray(matrix).tolist()}; calibrate again")
