"""What a window believes of its sensors' calibration, which of it may move, and how far it may be off at first."""

import numpy as np
from numpy.typing import NDArray

from vislam.config import WindowConfig
from vislam.core.camera import Rig
from vislam.core.lens import Lenses
from vislam.core.messages import Array, Observations
from vislam.imu import ImuNoise
from vislam.window.equations import CALIBRATION
from vislam.window.messages import CalibrationEstimate

_MAX_OFFSET_S = 0.1  # a residual time offset beyond this is a wrong clock, not a late camera
_READOUT_SIGMA_S = 0.0  # stated, or what the front end found: a window alone needs brisk rotation for it


def optics_of(rig: Rig) -> tuple[Array, Lenses, int]:
    """Return the cameras of a rig as `equations.Camera` has them: places in the first, lenses, and which is the right.

    -1 where none is.
    """
    return rig.T_cam0_cams, rig.lenses, 1 if rig.is_stereo else -1


class Calibration:
    """Owns the estimate [16], see `equations.layout`, of a window with an IMU, or with poses alone, which moves none.

    Without inertial data scale and turns have no other source, and vision alone constrains its lens too weakly.
    """

    def __init__(self, config: WindowConfig, rig: Rig, noise: ImuNoise | None, time_offset_s: float) -> None:
        """Start at the time offset that the first keyframe's stamp contains; `noise` None: of poses alone."""
        first, second = rig.cameras[0].sigmas, rig.cameras[1].sigmas if rig.is_stereo else None
        axes = (0.0, 0.0) if noise is None else (noise.gyroscope_scale_sigma, noise.accelerometer_scale_sigma)
        sigmas = np.array([
            config.time_offset_sigma_s, *[np.deg2rad(config.rotation_sigma_deg)] * 3, _READOUT_SIGMA_S,
            first.focal, rig.metres_sigma, *[0.0 if second is None else second.turn_rad] * 3,
            *np.repeat([axis or 0.0 for axis in axes], 3),
        ])  # fmt: skip
        self.wanted: NDArray[np.bool_] = (sigmas > 0.0) & (noise is not None)
        self.start_sigmas: Array = self.wanted * sigmas
        self.values: Array = np.zeros(CALIBRATION)
        self.values[0], self.values[4] = time_offset_s, config.readout_s or 0.0
        self._learns_readout = config.readout_s is None

    def see(self, seen: Observations) -> None:
        """Take the readout that was learned with a keyframe's tracks, unless one is stated."""
        if self._learns_readout and seen.readout_s is not None:
            self.values[4] = seen.readout_s

    def take(self, values: Array, applied_s: float) -> None:
        """Take a solution [16], with the time offset near to what is applied."""
        self.values = values.copy()
        self.values[0] = applied_s + np.clip(values[0] - applied_s, -_MAX_OFFSET_S, _MAX_OFFSET_S)

    def estimate(self, covariance: Array | None, applied_s: float) -> CalibrationEstimate:
        """Return the estimate; its covariance [16, 16] is None while nothing is moved."""
        values = self.values.copy()
        values[0] = values[0] if self.wanted[0] else applied_s
        sigmas = self.start_sigmas if covariance is None else np.sqrt(np.diag(covariance)) * self.wanted
        return CalibrationEstimate(values, sigmas)
