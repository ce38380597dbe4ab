"""Time offset, rotation of the camera and readout: what a window believes of them, and which of them it may move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import WindowConfig
from vislam.core.messages import Array
from vislam.window.messages import CalibrationEstimate

_MAX_OFFSET_S = 0.1  # a residual time offset beyond this is a wrong clock, not a late camera


class Calibration:
    """Owns the estimate [5] of a window whose states are `full` (with velocities and biases) or poses alone."""

    def __init__(self, config: WindowConfig, full: bool, time_offset_s: float) -> None:
        """Start at the time offset that the first keyframe's stamp contains."""
        self.wanted: NDArray[np.bool_] = full & np.array(
            [config.estimate_time_offset, *[config.estimate_rotation] * 3, config.estimate_readout]
        )
        self.values: Array = np.array([time_offset_s, 0.0, 0.0, 0.0, config.readout_s or 0.0])
        self.start_sigmas: Array = self.wanted * np.array(
            [config.time_offset_sigma_s, *[np.deg2rad(config.rotation_sigma_deg)] * 3, config.readout_sigma_s]
        )

    def take(self, values: Array, applied_s: float) -> None:
        """Take a solution [5], with the time offset near to what is applied."""
        self.values = values.copy()
        self.values[0] = applied_s + np.clip(values[0] - applied_s, -_MAX_OFFSET_S, _MAX_OFFSET_S)

    def estimate(self, covariance: Array | None, applied_s: float) -> CalibrationEstimate:
        """Return the estimate; its covariance [5, 5] is None while nothing is moved."""
        values = self.values
        sigmas = self.start_sigmas if covariance is None else np.sqrt(np.diag(covariance)) * self.wanted
        offset_s = float(values[0]) if self.wanted[0] else applied_s
        return CalibrationEstimate(
            offset_s, float(sigmas[0]), values[1:4].copy(), sigmas[1:4], float(values[4]), float(sigmas[4])
        )  # fmt: skip
