"""One try to place a frame relative to its keyframe: where it is looked for, and whether its tracks agree on it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array, Bools, ImuSpan
from vislam.frontend.view import DepthReading
from vislam.imu.gyro_turns import gyro_rotation
from vislam.vision.refine import PoseEstimate

DEGRADED_INLIERS = 40  # fewer: degraded
_MIN_INLIER_RATIO = 0.3  # of the followed tracks; below, the agreement may be chance
DEGRADED_INLIER_RATIO = 0.5  # of the followed tracks
_CONTRADICTING_SHARE = 0.5  # of the tracks behind vision's motion are astray: it is not the camera's
_KNOWN_SHARE = 0.5  # of the tracks behind the filter's motion are behind vision's, too: there are not two that move
_MIN_EXPECTED_SHARE = 0.2  # of the tracks have to be where they are expected, or the expectation is wrong


class MotionPredictor:
    """Predicts the camera's motion over one frame interval from the last one and from the gyroscope."""

    def __init__(self, T_body_cam0: Array, longest_s: float) -> None:
        """Take the camera's pose on the body and the longest interval over which velocity is worth keeping."""
        self._R_body_cam = T_body_cam0[:3, :3].copy()
        self._longest_s = longest_s
        self._twist_per_s = np.zeros(6)

    def forget(self, twist_per_s: Array | None = None) -> None:
        """Assume a velocity [6] of the camera, rotation first, or a camera at rest, as after a loss."""
        self._twist_per_s = np.zeros(6) if twist_per_s is None else twist_per_s

    def look_through(self, T_body_cam: Array, T_cam_other: Array) -> None:
        """Go on predicting for another camera of the same body, at T_cam_other [4, 4] as the present one sees it."""
        self._R_body_cam = T_body_cam[:3, :3].copy()
        self._twist_per_s = se3_adjoint(np.asarray(invert(T_cam_other))) @ self._twist_per_s

    def observe(self, T_before_now: Array, dt_s: float) -> None:
        """Take note of the motion [4, 4] that was measured over `dt_s` seconds."""
        self._twist_per_s = se3_log(T_before_now) / dt_s

    def predict(self, dt_s: float, imu: ImuSpan | None) -> Array:
        """Return T_now_next [4, 4] of cam0 over the next `dt_s` seconds."""
        twist = self._twist_per_s * dt_s if dt_s <= self._longest_s else np.zeros(6)
        T = np.asarray(se3_exp(twist))
        if imu is not None and len(imu.t_ns) >= 2 and bool(np.isfinite(imu.gyro_rad_s).all()):
            T[:3, :3] = self._R_body_cam.T @ gyro_rotation(imu) @ self._R_body_cam
        return T


class Placing(Protocol):
    """One try to place a frame relative to the keyframe."""

    @property
    def pixels(self) -> Array:
        """Where all tracks are [N, 2], NaN where not found."""

    @property
    def failure(self) -> str:
        """Why it cannot be trusted; empty when it can."""

    @property
    def followed(self) -> int:
        """How many tracks were found."""

    @property
    def agreeing(self) -> NDArray[np.bool_]:
        """Which tracks [N] agree on the motion."""


T = TypeVar("T", bound=Placing)


def confirmed(placing: T, astray: NDArray[np.bool_], place: Callable[[Array], T], config: FrontEndConfig) -> T:
    """Return the placing, or another without the tracks that contradict the filter's motion, where most do.

    Where most do not, the filter has no say: vision drawn to what the filter believes would add nothing to it.

    Args:
        placing: by all tracks.
        astray: which tracks [N] are not where the filter's motion can put them.
        place: places the frame by tracks at pixels [N, 2], NaN where not to be used.
        config: the shares that decide.
    """
    agree = int(placing.agreeing.sum())
    if not placing.failure and (astray & placing.agreeing).sum() <= _CONTRADICTING_SHARE * agree:
        return placing
    other = place(np.where(astray[:, None], np.nan, placing.pixels))
    few = int(other.agreeing.sum()) < _MIN_EXPECTED_SHARE * placing.followed
    # of tracks that agree with both motions the filter's has gained none: misled, it would take what it just misses
    known = not placing.failure and (other.agreeing & placing.agreeing).sum() > _KNOWN_SHARE * other.agreeing.sum()
    return placing if few or known or other.failure else other


def failure(tracks: int, followed: int, agree: int, converged: bool, least: int) -> str:
    """Return why a motion on which tracks `agree` cannot be trusted, or an empty string; `least` have to be found."""
    if followed < least:
        return f"only {followed} of {tracks} tracks found"
    if not converged:
        return "the motion does not converge"
    if agree < max(least, _MIN_INLIER_RATIO * followed):
        return f"only {agree} of {followed} tracks agree on a motion"
    return ""


def weakness(followed: int, agree: int, enough: int) -> str:
    """Return why tracking is degraded, or an empty string; fewer than `enough` tracks that agree are a reason."""
    if agree < enough:
        return f"only {agree} inliers"
    if agree < DEGRADED_INLIER_RATIO * followed:
        return f"only {agree} of {followed} tracks agree"
    return ""


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One try to place a frame by landmarks."""

    pixels: Array  # [N, 2] of all tracks, NaN where not found
    seen: Array  # [N, 2] their directions on z = 1
    xy: Array  # [N, 2] the same as of the middle row's time
    depth_now: DepthReading | None  # what this frame measures, if that is used
    expected_rho: Array  # [N] in this frame
    twist_per_s: Array  # [6] velocity of the camera
    estimate: PoseEstimate
    failure: str  # empty when the pose can be trusted
    others: int = 0  # tracks that agree on another motion

    @property
    def followed(self) -> int:
        """Tracks that were found."""
        return int(np.isfinite(self.xy[:, 0]).sum())

    @property
    def agreeing(self) -> Bools:
        """Which tracks [N] agree on the pose."""
        return self.estimate.inliers

    @property
    def inliers(self) -> int:
        """Tracks that agree on the pose."""
        return int(self.estimate.inliers.sum())

    def parallax(self, key_xy: Array) -> float:
        """Return the median way of agreeing tracks from `key_xy` [N, 2] on z = 1, with rotation taken out."""
        good = self.estimate.inliers
        rays = np.column_stack([self.xy, np.ones(len(self.xy))])[good]
        turned = rays @ self.estimate.T_key_cam[:3, :3].T
        moved = turned[:, :2] / turned[:, 2:] - key_xy[good]
        return float(np.median(np.linalg.norm(moved, axis=1)))
