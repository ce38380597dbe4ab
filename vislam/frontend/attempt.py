"""One try to place a frame relative to its keyframe by landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.core.messages import Array, Bools
from vislam.frontend.depth import DepthReading
from vislam.vision.refine import PoseEstimate


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One try to place a frame relative to the keyframe."""

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
