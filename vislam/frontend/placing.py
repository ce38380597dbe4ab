"""Frames placed by the landmarks of their keyframe."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_log, transform
from vislam.core.messages import Array, Bools, Frame, Keyframe, no_observations
from vislam.core.quantiles import median
from vislam.frontend.attempt import Attempt, confirmed, failure
from vislam.frontend.keyframe_tracks import KeyframeTracks
from vislam.frontend.result import TrackResult, unscaled_motion
from vislam.frontend.view import DepthReading, View
from vislam.vision.landmarks import metric_points, move
from vislam.vision.locate import pnp_ransac, recognise
from vislam.vision.refine import CHI2_GATE, PoseEstimate, pose_covariance, refine_pose
from vislam.vision.two_view import TwoViewEstimate, moved_xy, turn_only

NO_DEPTH = "no depth has been seen yet"
_FITS = 2  # the second with a kernel as wide as what the first leaves
_HIDDEN = 3.0  # times the parallax that a turn leaves: depths have more in common than they differ by
_DEPTH_NOW_FACTOR = 2.0  # on the sigma of depth between keyframes, which is not averaged over time
# times what tracks scatter by: the noise of independent tracks that would move a pose as much. What neighbours have in
# common (patch, lens, registered depth) leaves no residual, since a pose can follow it; it is as if 16 of them were one
_ALIKE = 4.0
_USUAL_PX = 0.25  # scatter of tracks beside which depth errs as it is assumed: what blurs or bends images spoils both
_RANSAC_PX = 3.0
_RANSAC_BELOW = 0.6  # of the tracks agree: the prediction may have led astray
_WITH_THE_ROOM = 0.8  # of the tracks that agreed in the keyframe, at least, where a frame moves with it
_OTHERS, _OTHERS_AGREE = 0.1, 0.7  # least shares, of those that agree and of the others: they move as one rigid thing
_BLIND_SIGMA = 0.02  # of the inverse depth that the first keyframe is lent by a later frame


class BlindKeyframe:
    """Follows the turn of a camera whose depth sensor has not begun, frame by frame.

    Two views determine the direction of motion, too. In the first half second of fr1_desk, whose shutter rolls, they
    were 3 to 5 degrees off in every second frame, with small sigmas; a turn alone is 3 degrees off after 5 cm, and its
    residuals show that.
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
        """Return the camera's turn since the keyframe [4, 4] and its result; None where too few tracks are left.

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


class Placer:
    """Places frames by the landmarks of the keyframe: a guess, tracks around it, refinement, RANSAC where they differ.

    Poses are T_key_cam [4, 4] of the camera that is looked through.
    """

    def __init__(self, config: FrontEndConfig, tracks: KeyframeTracks) -> None:
        """Take the tracks of the keyframe, which change with each new one."""
        self._config, self._tracks = config, tracks

    def attempt(self, frame: Frame, T_guess: Array, dt_s: float) -> Attempt:
        """Follow the tracks from where a guess puts them, and place the frame `dt_s` after the one before."""
        by_most = self._place(frame, T_guess, dt_s, self._tracks.follow(frame, T_guess, dt_s))
        placed = self._with_the_room(by_most, frame, T_guess, dt_s)
        return replace(placed, others=self._others(by_most.xy, placed))

    def confirmed(self, attempt: Attempt, frame: Frame, T_expected: Array, dt_s: float) -> Attempt:
        """Return the attempt, or another without the tracks that are not where the filter's motion puts them."""
        tracks = self._tracks
        astray = self._astray(attempt.xy, T_expected, self._config.astray_px / tracks.camera.fx)
        return confirmed(
            attempt, astray, lambda pixels: self._place(frame, T_expected, dt_s, pixels), self._config
        )  # fmt: skip

    def recognised(self, attempt: Attempt, frame: Frame, keyframe: Keyframe, dt_s: float) -> Attempt:
        """Return a failed attempt, or another from where the keyframe's features are recognised in the frame."""
        view, config = self._tracks.view, self._config
        if not frame.images:
            return attempt
        T_found = recognise(
            keyframe, frame, view.camera, view.T_body_cam, config.described_features, config.min_inliers
        )
        return attempt if T_found is None else self.attempt(frame, T_found, dt_s)

    def from_blindness(self, blind: BlindKeyframe, frame: Frame, pixels: Array, twist_per_s: Array) -> Attempt | None:
        """Place the first frame with depth against a keyframe without, whose landmarks get theirs from it.

        None where the keyframe is out of sight. `pixels` [N, 2] are the tracks in the frame.
        """
        tracks = self._tracks
        xy = tracks.camera.normalise(pixels)
        reading = tracks.measure(frame, pixels, xy, np.full(len(xy), np.nan), twist_per_s, to_learn=False)
        placed = blind.placed(np.column_stack([xy, reading.rho]), self._ransac)
        if placed is None:
            return None
        T_key_cam, rho = placed
        tracks.landmarks.mean[:, 2] = rho
        tracks.landmarks.covariance[:, 2, 2] = (_BLIND_SIGMA * rho) ** 2
        estimate = self._search(T_key_cam, xy, None)
        estimate = self._polish(estimate, xy, None) if estimate.converged else estimate
        return Attempt(pixels, xy, xy, None, reading.rho, twist_per_s, estimate, self._failure(estimate, xy))

    def covariance(self, attempt: Attempt, measured_px: float, given: bool) -> Array:
        """Return the covariance [6, 6] of the camera's motion, by the noise that was measured instead of assumed.

        `given` is whether the tracks came with the frame: followed elsewhere, they are independent, and the noise of
        their depth is that of the settings.
        """
        tracks, config = self._tracks, self._config
        pixel_px, scale = (measured_px, 1.0) if given else (_ALIKE * _USUAL_PX, measured_px / _USUAL_PX)
        ratio = pixel_px / config.track_sigma_px
        by_pixel = np.array([ratio, ratio, 1.0])
        mean, covariance = tracks.landmarks.mean, tracks.landmarks.covariance * by_pixel[:, None] * by_pixel
        xy = np.where(attempt.estimate.inliers[:, None], attempt.xy, np.nan)
        exposures = tracks.exposures
        shear = exposures.shear(attempt, tracks.landmarks, tracks.tracker.pixels, xy)
        found = pose_covariance(
            attempt.estimate.T_key_cam, mean, covariance, xy, ratio * tracks.sigma_xy, config.cauchy,
            *self._weighed(attempt.depth_now), scale, shear, exposures.shutter.sigma_s,
        )  # fmt: skip
        return attempt.estimate.covariance if found is None else found

    def _with_the_room(self, attempt: Attempt, frame: Frame, T_guess: Array, dt_s: float) -> Attempt:
        """Return the attempt, or another by the tracks that agreed in the keyframe, where new ones outvote them.

        These went with the room, and something that moves by itself has come before the camera since.
        """
        proven = self._tracks.tracker.proven
        found = int((proven & np.isfinite(attempt.xy[:, 0])).sum())
        if (attempt.agreeing & proven).sum() >= _WITH_THE_ROOM * found:
            return attempt
        alone = self._place(frame, T_guess, dt_s, np.where(proven[:, None], attempt.pixels, np.nan))
        if alone.failure or (attempt.agreeing & alone.agreeing).sum() >= _WITH_THE_ROOM * alone.inliers:
            return attempt
        T_key_cam = alone.estimate.T_key_cam
        astray = self._astray(attempt.xy, T_key_cam, np.sqrt(CHI2_GATE) * self._tracks.sigma_xy)
        return self._place(frame, T_key_cam, dt_s, np.where(astray[:, None], np.nan, attempt.pixels))

    def _others(self, xy: Array, placed: Attempt) -> int:
        """Return how many tracks at `xy` [N, 2] agree on another motion than a frame's; 0 where that may be chance."""
        mean, inliers = self._tracks.landmarks.mean, placed.agreeing
        apart = self._tracks.landmarks.known & (mean[:, 2] > 0.0) & np.isfinite(xy[:, 0]) & ~inliers
        least = max(self._config.min_inliers, _OTHERS * inliers.sum(), _OTHERS_AGREE * apart.sum())
        T_other = None if apart.sum() < least else self._ransac(metric_points(mean[apart]), xy[apart])
        if T_other is None:
            return 0
        agree = int(self._refine(T_other, np.where(apart[:, None], xy, np.nan), None).inliers.sum())
        return agree if agree >= least else 0

    def _astray(self, xy: Array, T_expected: Array, gate_xy: float) -> Bools:
        """Return which tracks [N] are not where a motion puts them, by more than the gate and what landmarks err by."""
        landmarks = self._tracks.landmarks
        expected, covariance = move(landmarks.mean, landmarks.covariance, T_expected)
        gate = gate_xy + 3.0 * np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
        return np.asarray(np.linalg.norm(xy - expected[:, :2], axis=1) > gate)

    def _place(self, frame: Frame, T_guess: Array, dt_s: float, pixels: Array) -> Attempt:
        """Place the frame by tracks found at `pixels` [N, 2], from a guess."""
        tracks, T_before = self._tracks, self._tracks.T_key_cam
        shutter = tracks.exposures.shutter
        twist = se3_log(invert(T_before) @ T_guess) / dt_s
        predicted, _ = move(tracks.landmarks.mean, tracks.landmarks.covariance, T_guess)
        rho = predicted[:, 2]
        seen = tracks.camera.normalise(pixels)
        xy = shutter.to_instant(pixels, seen, rho, twist)
        depth_now = None
        if tracks.view.depth.every_frame and tracks.view.depth.available(frame):
            depth_now = tracks.measure(frame, pixels, seen, rho, twist, to_learn=False)
        estimate = self._search(T_guess, xy, depth_now)
        if estimate.converged:
            # once more with the velocity that was found instead of the predicted one, and without the outliers
            twist = se3_log(invert(T_before) @ estimate.T_key_cam) / dt_s
            xy = shutter.to_instant(pixels, seen, rho, twist)
            if depth_now is not None:
                depth_now = tracks.measure(frame, pixels, seen, rho, twist, to_learn=True)
            estimate = self._polish(estimate, xy, depth_now)
        return Attempt(pixels, seen, xy, depth_now, rho, twist, estimate, self._failure(estimate, xy))

    def _failure(self, estimate: PoseEstimate, xy: Array) -> str:
        followed, agree, least = int(np.isfinite(xy[:, 0]).sum()), int(estimate.inliers.sum()), self._config.min_inliers
        return failure(len(self._tracks), followed, agree, estimate.converged, least)

    def _search(self, T_guess: Array, xy: Array, depth_now: DepthReading | None) -> PoseEstimate:
        """Refine from the prediction; when few tracks agree with the result, look for a better start by RANSAC."""
        estimate = self._refine(T_guess, xy, depth_now)
        followed = int(np.isfinite(xy[:, 0]).sum())
        if estimate.inliers.sum() < _RANSAC_BELOW * followed:
            landmarks = self._tracks.landmarks
            known = landmarks.known & (landmarks.mean[:, 2] > 0.0)
            T_ransac = self._ransac(metric_points(landmarks.mean[known]), xy[known])
            if T_ransac is not None:
                other = self._refine(T_ransac, xy, depth_now)
                if other.inliers.sum() > estimate.inliers.sum():
                    estimate = other
        return estimate

    def _polish(self, estimate: PoseEstimate, xy: Array, depth_now: DepthReading | None) -> PoseEstimate:
        return self._refine(estimate.T_key_cam, np.where(estimate.inliers[:, None], xy, np.nan), depth_now)

    def _refine(self, T: Array, xy: Array, depth_now: DepthReading | None) -> PoseEstimate:
        tracks = self._tracks
        mean, covariance = tracks.landmarks.mean, tracks.landmarks.covariance
        return refine_pose(T, mean, covariance, xy, tracks.sigma_xy, self._config.cauchy, *self._weighed(depth_now))

    def _weighed(self, depth_now: DepthReading | None) -> tuple[Array | None, Array | None]:
        if depth_now is None:
            return None, None
        return depth_now.rho, _DEPTH_NOW_FACTOR * depth_now.sigma_rho

    def _ransac(self, points_m: Array, xy: Array) -> Array | None:
        return pnp_ransac(points_m, xy, _RANSAC_PX / self._tracks.camera.fx, self._config.min_inliers)
