"""The values that leave the sliding window: numpy only.

`local` is the window's own frame: gravity-aligned with an IMU, drifting like odometry, never moved by loops.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, NavState


@dataclass(frozen=True, slots=True, eq=False)
class WindowEdge:
    """Relative pose of two consecutive keyframes by the window's posterior."""

    from_id: int
    to_id: int
    T_from_to: Array  # [4, 4] body to body
    covariance: Array  # [6, 6], perturbation on the body side of T_from_to
    settled: bool  # once, when `from_id` leaves the window; before that the edge is provisional


@dataclass(frozen=True, slots=True, eq=False)
class WindowGravity:
    """Which way is up for a keyframe that left the window."""

    id: int
    up_body: Array  # [3] unit, the world's up in body axes
    sigma_rad: float  # of the direction, the larger of its two axes
    covariance: Array  # [2, 2] in the columns of `geometry.tangent_basis(up_body)`, rad^2


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEstimate:
    """What the window believes about the calibration of cameras and IMU; what is not estimated has sigma 0.

    In their order: what is to be added to the camera's stamps to get the IMU's time, applied so far plus residual [s];
    rotation of cam0, a vector in its axes with R_body_cam0 = given @ so3_exp(vector) [3, rad]; readout of a rolling
    shutter, first to last row [s]; relative errors: the true focal length and the true baseline (or depth) are
    1 + error times what was given; rotation of cam1, as that of cam0, in cam0 [3, rad]; relative errors of the axes of
    gyroscope and accelerometer, which show 1 + error times the truth [6].
    """

    values: Array  # [16]
    sigmas: Array  # [16]

    @property
    def time_offset_s(self) -> float:
        """To add to the camera's own stamps to get the IMU's time."""
        return float(self.values[0])

    @property
    def R_cam_correction(self) -> Array:
        """Rotation vector [3] in cam0 axes, rad."""
        return self.values[1:4]

    @property
    def R_cam_sigma(self) -> Array:
        """Sigmas [3] of that, rad."""
        return self.sigmas[1:4]

    @property
    def metres_sigma(self) -> float:
        """How well the baseline or the unit of depth is known, relative; 0 where neither measures or is in doubt."""
        return float(self.sigmas[6])


@dataclass(frozen=True, slots=True, eq=False)
class WindowUpdate:
    """What one keyframe changed in the window."""

    ids: NDArray[np.int64]  # [M] keyframes in the window, ascending
    T_local_body: Array  # [M, 4, 4]
    newest: NavState | None  # None without an IMU
    odometry: tuple[WindowEdge, ...]  # settled edges first, then a provisional one for every pair in the window
    tilts: tuple[WindowGravity, ...]  # of keyframes that left; empty without an IMU
    states: tuple[tuple[int, NavState], ...]  # of keyframes that left; empty without an IMU
    calibration: CalibrationEstimate
    scale_sigma: float  # relative, 1 sigma: one camera with an IMU; 0 where scale is measured directly
    rejected_tracks: int  # taken out by the chi-square test in this update
    note: str = ""  # what happened when a plain update was not possible
