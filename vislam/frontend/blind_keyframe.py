"""A first keyframe without depth: where its tracks went since, and how the camera turned."""

from collections.abc import Callable

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, transform
from vislam.core.messages import Array, Frame, Keyframe, no_observations
from vislam.core.quantiles import median
from vislam.frontend.result import TrackResult, unscaled_motion
from vislam.frontend.view import View
from vislam.vision.landmarks import metric_points, move
from vislam.vision.refine import refine_pose
from vislam.vision.two_view import TwoViewEstimate, moved_xy, turn_only

NO_DEPTH = "no depth has been seen yet"
_FITS = 2  # the second with a kernel as wide as what the first leaves
_HIDDEN = 3.0  # times the parallax that a turn leaves: depths have more in common than they differ by


class BlindKeyframe:
    """Follows the turn of a camera whose depth sensor has not begun, frame by frame.

    Two views could tell the direction of motion, too. In the first half second of fr1_desk, whose shutter rolls, they
    were 3 to 5 degrees off in every second frame and sure of it; a turn alone is 3 degrees off after 5 cm, and what it
    leaves unexplained says so.
    """

    def __init__(self, config: FrontEndConfig, view: View, pixels: Array) -> None:
        """Take where the keyframe's tracks are in it, [N, 2]."""
        self._config, self._camera = config, view.camera
        self._R_body_cam = view.T_body_cam[:3, :3]
        self._key_xy = self._camera.normalise(pixels)
        self._last_px = pixels.copy()

    def expected(self, T_last_now: Array) -> Array:
        """Return where the tracks should be [N, 2] after a motion [4, 4] since the last frame, as far as it turns."""
        rays = np.column_stack([self._camera.normalise(self._last_px), np.ones(len(self._last_px))])
        return self._camera.project(rays @ T_last_now[:3, :3])

    def turn(self, frame: Frame, keyframe: Keyframe, pixels: Array, T_guess: Array) -> tuple[Array, TrackResult] | None:
        """Return the camera's turn since the keyframe [4, 4] and what it tells; None where too few tracks are left.

        The covariance has what parallax hides behind a turn.

        Args:
            frame: without depth.
            keyframe: of which this is the state.
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
        turn = turn_only(TwoViewEstimate(T[:3, :3], np.zeros(3), covariance, pose.inliers, True))
        agree = int(pose.inliers.sum())
        vo = unscaled_motion(frame.t_ns, keyframe.id, turn, self._R_body_cam, agree, is_weak=True)
        return T, TrackResult(vo, no_observations(), None, 0.0, NO_DEPTH)

    def placed(self, points: Array, ransac: Callable[[Array, Array], Array | None]) -> tuple[Array, Array] | None:
        """Return T_key_cam [4, 4] of a frame with depth and the keyframe's inverse depths [N] by it, NaN: unknown.

        Args:
            points: inverse-depth points [N, 3] of the tracks in the frame, NaN where unknown.
            ransac: returns T_b_a of points [M, 3] in a, metres, that b saw in directions [M, 2]; None where it cannot.
        """
        usable = np.isfinite(points).all(axis=1) & (points[:, 2] > 0.0)
        T_cam_key = ransac(metric_points(points[usable]), self._key_xy[usable])
        if T_cam_key is None:
            return None
        rho: Array = np.full(len(points), np.nan)
        rho[usable] = move(points[usable], np.zeros((int(usable.sum()), 3, 3)), T_cam_key)[0][:, 2]
        return np.asarray(invert(T_cam_key)), rho

    def _left(self, R_key_cam: Array, xy: Array) -> float:
        """Return the median way on z = 1 that a turn leaves unexplained."""
        left = moved_xy(R_key_cam, self._key_xy, xy)
        return median(left[np.isfinite(left)])
