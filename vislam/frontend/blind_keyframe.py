"""A first keyframe without depth: where its tracks went since, and how the camera turned."""

from __future__ import annotations

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import transform
from vislam.core.messages import Array
from vislam.core.quantiles import median
from vislam.vision.refine import refine_pose
from vislam.vision.two_view import TwoViewEstimate, turn_only

_FITS = 2  # the second with a kernel as wide as what the first leaves
_HIDDEN = 3.0  # times the parallax that a turn leaves: depths have more in common than they differ by


class BlindKeyframe:
    """Follows the turn of a camera whose depth sensor has not begun, frame by frame.

    Two views could tell the direction of motion, too. In the first half second of fr1_desk, whose shutter rolls, they
    were 3 to 5 degrees off in every second frame and sure of it; a turn alone is 3 degrees off after 5 cm, and what it
    leaves unexplained says so.
    """

    def __init__(self, config: FrontEndConfig, camera: Camera, pixels: Array) -> None:
        """Take where the keyframe's tracks are in it, [N, 2]."""
        self._config, self._camera = config, camera
        self._key_xy = camera.normalise(pixels)
        self._last_px = pixels.copy()

    def expected(self, T_last_now: Array) -> Array:
        """Return where the tracks should be [N, 2] after a motion [4, 4] since the last frame, as far as it turns."""
        rays = np.column_stack([self._camera.normalise(self._last_px), np.ones(len(self._last_px))])
        return self._camera.project(rays @ T_last_now[:3, :3])

    def turn(self, pixels: Array, T_guess: Array) -> TwoViewEstimate | None:
        """Return how a frame is turned; None where too few tracks are left.

        The covariance has what parallax hides behind a turn.

        Args:
            pixels: of the tracks in the frame [N, 2]; NaN: not found.
            T_guess: motion [4, 4] of the camera since the keyframe, of which only the turn counts.
        """
        self._last_px = np.where(np.isfinite(pixels), pixels, self._last_px)
        xy = self._camera.normalise(pixels)
        if np.isfinite(xy[:, 0]).sum() < self._config.min_inliers:
            return None
        at_infinity = np.column_stack([self._key_xy, np.zeros(len(xy))])
        no_noise: Array = np.zeros((len(xy), 3, 3))
        T = np.asarray(transform(np.ascontiguousarray(T_guess[:3, :3]), np.zeros(3)))
        for _ in range(_FITS):
            sigma_xy = max(self._config.track_sigma_px / self._camera.fx, self._left(T[:3, :3], xy))
            pose = refine_pose(T, at_infinity, no_noise, xy, sigma_xy, self._config.cauchy, rotation_only=True)
            T = pose.T_key_cam
        if not pose.converged or pose.inliers.sum() < self._config.min_inliers:
            return None
        covariance = pose.covariance + (_HIDDEN * self._left(T[:3, :3], xy)) ** 2 * np.eye(6)
        return turn_only(TwoViewEstimate(np.ascontiguousarray(T[:3, :3]), np.zeros(3), covariance, pose.inliers, True))

    def _left(self, R_key_cam: Array, xy: Array) -> float:
        """Return the median way on z = 1 that a turn leaves unexplained."""
        turned = np.column_stack([xy, np.ones(len(xy))]) @ R_key_cam.T
        left = np.linalg.norm(turned[:, :2] / turned[:, 2:] - self._key_xy, axis=1)
        return median(left[np.isfinite(left)])
