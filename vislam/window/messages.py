"""The values that leave the sliding window: numpy only.

`local` is the window's own frame: gravity-aligned with an IMU, drifting like odometry, never moved by loops.
"""

from __future__ import annotations

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
    """What the window believes about the sensor's calibration; a quantity that is not estimated has sigma 0."""

    time_offset_s: float  # to add to the camera's own stamps to get the IMU's time: applied so far plus residual
    time_offset_sigma_s: float
    R_cam_correction: Array  # [3] rotation vector in cam0 axes, rad: R_body_cam0 = given @ so3_exp(correction)
    R_cam_sigma: Array  # [3] rad
    readout_s: float  # rolling shutter, first to last row
    readout_sigma_s: float


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
