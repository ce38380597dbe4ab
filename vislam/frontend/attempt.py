"""One try to place a frame relative to its keyframe, and whether its tracks agree on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.messages import Array, Bools
from vislam.frontend.depth import DepthReading
from vislam.vision.refine import PoseEstimate


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
    if not placing.failure and (astray & placing.agreeing).sum() <= config.contradicting_share * agree:
        return placing
    other = place(np.where(astray[:, None], np.nan, placing.pixels))
    few = int(other.agreeing.sum()) < config.min_expected_share * placing.followed
    return placing if few or other.failure else other


def failure(tracks: int, followed: int, agree: int, converged: bool, least: int, config: FrontEndConfig) -> str:
    """Return why a motion on which tracks `agree` cannot be trusted, or an empty string; `least` have to be found."""
    if followed < least:
        return f"only {followed} of {tracks} tracks found"
    if not converged:
        return "the motion does not converge"
    if agree < max(least, config.min_inlier_ratio * followed):
        return f"only {agree} of {followed} tracks agree on a motion"
    return ""


def weakness(followed: int, agree: int, enough: int, config: FrontEndConfig) -> str:
    """Return why tracking is degraded, or an empty string; fewer than `enough` tracks that agree are a reason."""
    if agree < enough:
        return f"only {agree} inliers"
    if agree < config.degraded_inlier_ratio * followed:
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
