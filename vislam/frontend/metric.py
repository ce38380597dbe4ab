"""Visual odometry with depth, stereo or RGB-D: the pose of every frame against the landmarks of the last keyframe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_adjoint, se3_log
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import FrontNews
from vislam.core.messages import (
    Array,
    Frame,
    ImuSpan,
    Keyframe,
    Observations,
    Tracking,
    VoMeasurement,
    no_observations,
)
from vislam.frontend.agreement import confirmed, failure, weakness
from vislam.frontend.attempt import Attempt
from vislam.frontend.blind_keyframe import NO_DEPTH, BlindKeyframe
from vislam.frontend.by_depth import ByDepth, Moved
from vislam.frontend.depth import DepthReading
from vislam.frontend.exposures import Exposures
from vislam.frontend.intake import Intake
from vislam.frontend.keyframes import KeyframeLife, keyframe_reason
from vislam.frontend.local_surfaces import LocalSurfaces
from vislam.frontend.pixel_noise import PixelNoise
from vislam.frontend.prediction import MotionPredictor
from vislam.frontend.result import TrackResult, metric_motion, too_few
from vislam.frontend.rgbd import ImageDepth
from vislam.frontend.tracker import Tracker, given_rows
from vislam.frontend.view import View, sees, spread, stereo_views
from vislam.vision.landmarks import Landmarks, metric_points, move
from vislam.vision.locate import pnp_ransac, recognise
from vislam.vision.refine import PoseEstimate, pose_covariance, refine_pose
from vislam.vision.two_view import epipolar_distances

_CORNER_SIGMA = 0.1  # of the track noise: the patch in the keyframe is the landmark, by definition
# times what tracks scatter by: the noise of independent tracks that would move a pose as much. What neighbours have in
# common (patch, lens, registered depth) leaves no residual, since a pose can follow it; it is as if 16 of them were one
_ALIKE = 4.0
_USUAL_PX = 0.25  # scatter of tracks beside which depth errs as it is told: what blurs or bends images spoils both
_RANSAC_PX = 3.0
_RANSAC_BELOW = 0.6  # of the tracks agree: the prediction may have led astray
_DEEP = 0.02  # of a keyframe's tracks are given depth at least, or its sensor is covered: wrong matches alone are fewer
_BLIND_SIGMA = 0.02  # of the inverse depth that the first keyframe is lent by a later frame


class MetricFrontEnd:
    """Frame-to-keyframe odometry on inverse-depth landmarks that are carried and improved from keyframe to keyframe."""

    mode: str
    knows_scale = True

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int, views: tuple[View, ...]) -> None:
        """Take the cameras to look through, the usual one first."""
        self.keyframe_spacing = 1.0
        self._config = config
        self._views = views
        self._view = views[0]
        self._camera, self._T_body_cam, self._depth = views[0].camera, views[0].T_body_cam, views[0].depth
        self._intake = Intake(rig, seed)
        self._tracker = Tracker(config)
        self._noise = PixelNoise(config.track_sigma_px)
        self._predictor = MotionPredictor(self._T_body_cam, config.patience_s)
        self._exposures = Exposures(self._camera, config)
        self._shutter, self._lag = self._exposures.shutter, self._exposures.lag
        self._sigma_xy = config.track_sigma_px / self._camera.fx
        self._landmarks = Landmarks()
        self._life = KeyframeLife(config, has_scale=True)
        self._T_key_cam: Array = np.eye(4)  # of the last frame, predicted while lost
        self._key_sees = True  # whether the usual camera sees anything in the keyframe
        self._now_sees = True  # and in this frame; only asked while another camera is looked through
        self._lost = False
        self._lacks_depth = False  # hardly a track of the keyframe was given depth when it began
        has_surfaces = rig.has_depth and self._depth.every_frame
        self._surfaces = LocalSurfaces(config, self._camera, self._T_body_cam) if has_surfaces else None
        self._by_depth = ByDepth(config, self._surfaces) if self._surfaces is not None and config.depth_alone else None
        self._blind: BlindKeyframe | None = None  # the keyframe is the first and has no depth

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """Place `frame` relative to the last keyframe; see FrontEnd.track."""
        result = self._track(frame, imu, T_last_now, gyro_sigma_rad_s)
        if self._by_depth is not None:
            self._by_depth.note(result.vo, result.keyframe is not None, result.by_depth, self._T_body_cam)
        return result.with_scatter(self._noise.sigma_px, 1.0 if frame.tracks is not None else self._noise.over_usual)

    def _track(
        self, frame: Frame, imu: ImuSpan | None, T_last_now: Array | None, gyro_sigma_rad_s: float
    ) -> TrackResult:
        whole, dt_s = self._intake.accept(frame)
        keyframe = self._life.keyframe
        if keyframe is None:
            return self._start(whole, "")
        self._look_back(whole, keyframe)
        frame = self._view.of(whole)
        T_before = self._T_key_cam
        T_guess = T_before @ self._predictor.predict(dt_s, imu)
        if self._blind is not None:
            return self._leave_blindness(self._blind, frame, keyframe, T_guess, dt_s, imu is not None)
        attempt = self._attempt(frame, T_before, T_guess, dt_s)
        other = self._by_other_camera(whole, keyframe, T_guess, dt_s) if attempt.failure else None
        if other is not None:
            frame, T_before, attempt = self._view.of(whole), self._T_key_cam, other
        if T_last_now is not None:
            T_expected = T_before @ invert(self._T_body_cam) @ T_last_now @ self._T_body_cam
            attempt = self._confirmed(attempt, frame, T_before, T_expected, dt_s)
        if attempt.failure:
            T_found = self._recognise(frame, keyframe)
            if T_found is not None:
                attempt = self._attempt(frame, T_before, T_found, dt_s)
        if attempt.failure:
            twist, bias = self._exposures.key_twist_per_s, None if imu is None else gyro_sigma_rad_s
            moved = Moved(T_before, T_guess, dt_s, twist, self._lag.delay_s, bias)
            return self._place_by_depth(frame, keyframe, attempt, moved) or self._lose(frame, attempt, T_guess)
        self._T_key_cam = attempt.estimate.T_key_cam
        if not self._lost:
            self._predictor.observe(invert(T_before) @ self._T_key_cam, dt_s)
        self._lost = False
        self._life.placed(frame.t_ns)
        if not self._weakness(attempt):
            self._exposures.learn(frame, attempt, self._landmarks, self._tracker.pixels, self._sigma_xy, dt_s)
        self._learn_noise(attempt, keyframe)
        return self._report(frame, keyframe, attempt, has_imu=imu is not None)

    @classmethod
    def lasting_scale_sigma(cls, config: FrontEndConfig, noise: ImuNoise | None) -> float:
        """Return 0: motions tell how well their metres are known."""
        return 0.0

    @classmethod
    def vo_inflation(cls, config: FrontEndConfig) -> float | None:
        """See FrontEnd.vo_inflation."""
        return None

    def begin_at(self, keyframe_id: int, news: FrontNews, seeks_place: bool = False) -> None:
        """See FrontEnd.begin_at."""
        self._life.begin_at(keyframe_id, seeks_place)
        self._tracker.next_id = news.next_track_id
        self._exposures.start_at(news)

    @property
    def news(self) -> FrontNews:
        """See FrontEnd.news."""
        readout_s = self._shutter.readout_s if self._shutter.learns else None
        lag = (self._lag.delay_estimate_s, self._lag.rows_estimate_s) if self._depth.every_frame else (None, None)
        return FrontNews(self._tracker.next_id, readout_s=readout_s, depth_delay_s=lag[0], depth_rows_s=lag[1])

    @property
    def calibration(self) -> dict[str, float]:
        """See FrontEnd.calibration."""
        return {}

    # -- placing one frame -------------------------------------------------------------------------------------------

    def _attempt(self, frame: Frame, T_before: Array, T_guess: Array, dt_s: float) -> Attempt:
        twist = se3_log(invert(T_before) @ T_guess) / dt_s
        predicted, _ = move(self._landmarks.mean, self._landmarks.covariance, T_guess)
        pixels = self._tracker.follow(frame, self._shutter.project(predicted, twist))
        return self._place(frame, T_before, T_guess, dt_s, pixels)

    def _confirmed(self, attempt: Attempt, frame: Frame, T_before: Array, T_expected: Array, dt_s: float) -> Attempt:
        """Return the attempt, or another without the tracks that are not where the filter's motion puts them."""
        expected, covariance = move(self._landmarks.mean, self._landmarks.covariance, T_expected)
        gate_xy = self._config.astray_px / self._camera.fx + 3.0 * np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
        astray = np.linalg.norm(attempt.xy - expected[:, :2], axis=1) > gate_xy
        return confirmed(
            attempt, astray, lambda pixels: self._place(frame, T_before, T_expected, dt_s, pixels), self._config
        )

    def _place(self, frame: Frame, T_before: Array, T_guess: Array, dt_s: float, pixels: Array) -> Attempt:
        """Place the frame by tracks found at `pixels` [N, 2], from a guess."""
        twist = se3_log(invert(T_before) @ T_guess) / dt_s
        predicted, _ = move(self._landmarks.mean, self._landmarks.covariance, T_guess)
        seen = self._camera.normalise(pixels)
        xy = self._shutter.to_instant(pixels, seen, predicted[:, 2], twist)
        depth_now = None
        if self._depth.every_frame and self._depth.available(frame):
            depth_now = self._measure(frame, pixels, seen, predicted[:, 2], twist, to_learn=False)
        estimate = self._search(T_guess, xy, depth_now)
        if estimate.converged:
            # once more with the velocity that was found instead of the predicted one, and without the outliers
            twist = se3_log(invert(T_before) @ estimate.T_key_cam) / dt_s
            xy = self._shutter.to_instant(pixels, seen, predicted[:, 2], twist)
            if depth_now is not None:
                depth_now = self._measure(frame, pixels, seen, predicted[:, 2], twist, to_learn=True)
            estimate = self._polish(estimate, xy, depth_now)
        why_not = self._failure(estimate, int(np.isfinite(xy[:, 0]).sum()))
        return Attempt(pixels, seen, xy, depth_now, predicted[:, 2], twist, estimate, why_not)

    def _measure(
        self, frame: Frame, pixels: Array, seen: Array, rho: Array, twist: Array, to_learn: bool
    ) -> DepthReading:
        return self._lag.measure(self._depth, frame, pixels, seen, rho, twist, self._tracker.ids, to_learn)

    def _failure(self, estimate: PoseEstimate, followed: int) -> str:
        agree, least = int(estimate.inliers.sum()), self._config.min_inliers
        return failure(len(self._tracker), followed, agree, estimate.converged, least, self._config)

    def _search(self, T_guess: Array, xy: Array, depth_now: DepthReading | None) -> PoseEstimate:
        """Refine from the prediction; when few tracks agree with the result, look for a better start by RANSAC."""
        estimate = self._refine(T_guess, xy, depth_now)
        followed = int(np.isfinite(xy[:, 0]).sum())
        if estimate.inliers.sum() < _RANSAC_BELOW * followed:
            known = self._landmarks.known & (self._landmarks.mean[:, 2] > 0.0)
            T_ransac = self._ransac(metric_points(self._landmarks.mean[known]), xy[known])
            if T_ransac is not None:
                other = self._refine(T_ransac, xy, depth_now)
                if other.inliers.sum() > estimate.inliers.sum():
                    estimate = other
        return estimate

    def _polish(self, estimate: PoseEstimate, xy: Array, depth_now: DepthReading | None) -> PoseEstimate:
        return self._refine(estimate.T_key_cam, np.where(estimate.inliers[:, None], xy, np.nan), depth_now)

    def _refine(self, T: Array, xy: Array, depth_now: DepthReading | None) -> PoseEstimate:
        mean, covariance = self._landmarks.mean, self._landmarks.covariance
        return refine_pose(T, mean, covariance, xy, self._sigma_xy, self._config.cauchy, *self._weighed(depth_now))

    def _weighed(self, depth_now: DepthReading | None) -> tuple[Array | None, Array | None]:
        if depth_now is None:
            return None, None
        return depth_now.rho, self._config.depth_now_factor * depth_now.sigma_rho

    def _ransac(self, points_m: Array, xy: Array) -> Array | None:
        return pnp_ransac(points_m, xy, _RANSAC_PX / self._camera.fx, self._config.min_inliers)

    def _recognise(self, frame: Frame, keyframe: Keyframe) -> Array | None:
        config = self._config
        if not frame.images:
            return None
        return recognise(
            keyframe, frame.images[0], self._camera, self._T_body_cam, config.described_features, config.min_inliers
        )

    def _learn_noise(self, attempt: Attempt, keyframe: Keyframe) -> None:
        """Take note of the distances from epipolar lines."""
        key_xy, ends = self._landmarks.mean[:, :2], 1.0
        if keyframe.frame.tracks is not None:  # as it was seen there, not as it was improved: its noise is then known
            given = keyframe.frame.tracks
            key_xy, ends = self._camera.normalise(given_rows(given, given.pixels_px, self._tracker.ids)), 2.0
        self._noise.learn(epipolar_distances(self._T_key_cam, key_xy, attempt.xy), self._camera, attempt.xy, ends)

    # -- looking through another camera ------------------------------------------------------------------------------

    def _look_through(self, view: View) -> None:
        """Let another camera of the rig be the one that is followed; what is known of the keyframe stays behind."""
        if view is self._view:
            return
        T_cam_other = invert(self._T_body_cam) @ view.T_body_cam
        back = se3_adjoint(np.asarray(invert(T_cam_other)))
        self._T_key_cam = invert(T_cam_other) @ self._T_key_cam @ T_cam_other
        self._exposures.key_twist_per_s = back @ self._exposures.key_twist_per_s
        self._predictor.look_through(view.T_body_cam, np.asarray(T_cam_other))
        self._shutter.look_through(view.camera)
        self._sigma_xy = self._config.track_sigma_px / view.camera.fx
        self._now_sees = not view.is_swapped
        self._view, self._camera, self._T_body_cam, self._depth = view, view.camera, view.T_body_cam, view.depth

    def _carry_keyframe(self, view: View, keyframe: Keyframe) -> None:
        """Look through another camera at the same keyframe; landmarks that it does not see to the pixel get NaN."""
        landmarks = Landmarks()
        landmarks.mean, landmarks.covariance = self._view.carry(self._landmarks.mean, self._landmarks.covariance, view)
        self._look_through(view)
        vague = view.camera.fx * spread(landmarks.covariance) > self._config.epipolar_gate_px
        landmarks.mean[vague] = np.nan
        # from here on the landmark is the patch at this place, and no longer the one that the other camera saw
        landmarks.pin(_CORNER_SIGMA * self._sigma_xy)
        landmarks.by_delay = self._landmarks.by_delay
        self._landmarks = landmarks
        pixels = self._shutter.project(landmarks.mean, self._exposures.key_twist_per_s)
        pixels[~view.camera.contains(pixels)] = np.nan
        self._tracker.look_through(view.of(keyframe.frame).images[0], pixels)

    def _by_other_camera(self, whole: Frame, keyframe: Keyframe, T_guess: Array, dt_s: float) -> Attempt | None:
        """Place the frame by the other camera and go on looking through it; None, and nothing changed, if that fails.

        Which camera is covered is not asked of its image: what counts is which one can be followed.
        """
        before = self._view
        if min(len(self._views), len(whole.images), len(keyframe.frame.images)) < 2:
            return None
        if before.is_swapped and not self._key_sees:
            return None
        other = self._views[not before.is_swapped]
        T_key_cam, landmarks, pixels = self._T_key_cam, self._landmarks, self._tracker.pixels
        T_cam_other = invert(before.T_body_cam) @ other.T_body_cam
        self._carry_keyframe(other, keyframe)
        T_guess = np.asarray(invert(T_cam_other) @ T_guess @ T_cam_other)
        attempt = self._attempt(other.of(whole), self._T_key_cam, T_guess, dt_s)
        if not attempt.failure:
            return attempt
        self._look_through(before)
        self._T_key_cam, self._landmarks = T_key_cam, landmarks
        self._tracker.look_through(before.of(keyframe.frame).images[0], pixels)
        return None

    def _look_back(self, whole: Frame, keyframe: Keyframe) -> None:
        """Go back to the usual camera as soon as it sees again, if the keyframe has anything in its image."""
        if not self._view.is_swapped:
            return
        self._now_sees = sees(whole.images[0], self._config)
        if self._now_sees and self._key_sees:
            self._carry_keyframe(self._views[0], keyframe)

    def _sees_again(self, frame: Frame) -> str:
        """Return which camera was covered in the keyframe and sees again, or an empty string: a reason for another."""
        if self._view.is_swapped:
            return "cam0 sees again" if self._now_sees else ""
        lost_depth = self._lacks_depth and min(len(self._views), len(frame.images)) > 1
        return "cam1 sees again" if lost_depth and sees(frame.images[1], self._config) else ""

    def _as_cam0_would(self, ids: NDArray[np.int64], xy: Array, means: Array, covariances: Array) -> Observations:
        gate_px = self._config.epipolar_gate_px
        return self._view.as_other_would(self._views[0], ids, xy, means, covariances, gate_px)

    # -- what comes of it --------------------------------------------------------------------------------------------

    def _report(self, frame: Frame, keyframe: Keyframe, attempt: Attempt, has_imu: bool) -> TrackResult:
        vo = self._measurement(frame, keyframe.id, attempt)
        departure = self._life.departure(
            frame.t_ns,
            self._T_key_cam[:3, :3],
            self._camera.fx * attempt.parallax(self._landmarks.mean[:, :2]),
            attempt.followed,
            attempt.inliers,
            self._depth.available(frame),
        )
        reason = keyframe_reason(departure, self._config, self.keyframe_spacing)
        reason = self._sees_again(frame) or reason
        if reason:
            if self._surfaces is not None and not has_imu:  # a window does without, and its filter was no better
                vo, self._T_key_cam = self._surfaces.fitted(frame, vo, self._T_key_cam, self._lag, attempt.twist_per_s)
            new, observations = self._continue_from(frame, attempt)
            return TrackResult(vo, observations, new, departure.parallax_px, reason)
        good = attempt.estimate.inliers
        at_instant = self._shutter.instant_px(attempt.xy[good])
        observations = Observations(self._tracker.ids[good].copy(), attempt.pixels[good], instant_px=at_instant)
        if self._view.is_swapped:
            means, covariances = move(self._landmarks.mean[good], self._landmarks.covariance[good], self._T_key_cam)
            observations = self._as_cam0_would(observations.track_ids, attempt.xy[good], means, covariances)
        self._landmarks.keep(self._tracker.judge(good))
        return TrackResult(vo, observations, None, departure.parallax_px, self._weakness(attempt))

    def _weakness(self, attempt: Attempt) -> str:
        """Return why the tracking is degraded, or an empty string."""
        if self._view.is_swapped:
            return "cam0 sees nothing; cam1 is followed"
        if self._lacks_depth:
            return "the keyframe has no depth of its own"
        return weakness(attempt.followed, attempt.inliers, self._config.degraded_inliers, self._config)

    def _measurement(self, frame: Frame, keyframe_id: int, attempt: Attempt) -> VoMeasurement:
        covariance = self._covariance(attempt, frame.tracks is not None)
        return metric_motion(
            frame.t_ns, keyframe_id, attempt.estimate.T_key_cam, covariance, self._T_body_cam, attempt.inliers,
            is_weak=bool(self._weakness(attempt)),
        )  # fmt: skip

    def _covariance(self, attempt: Attempt, given: bool) -> Array:
        """Return the covariance [6, 6] of the camera's motion, by the noise that was measured instead of told."""
        measured_px = self._noise.frame_px
        # tracks that were followed elsewhere are independent, and the noise of their depth is told
        pixel_px, scale = (measured_px, 1.0) if given else (_ALIKE * _USUAL_PX, measured_px / _USUAL_PX)
        ratio = pixel_px / self._config.track_sigma_px
        by_pixel = np.array([ratio, ratio, 1.0])
        mean, covariance = self._landmarks.mean, self._landmarks.covariance * by_pixel[:, None] * by_pixel
        xy = np.where(attempt.estimate.inliers[:, None], attempt.xy, np.nan)
        shear = self._exposures.shear(attempt, self._landmarks, self._tracker.pixels, xy)
        found = pose_covariance(
            attempt.estimate.T_key_cam, mean, covariance, xy, ratio * self._sigma_xy, self._config.cauchy,
            *self._weighed(attempt.depth_now), scale, shear, self._shutter.sigma_s,
        )  # fmt: skip
        return attempt.estimate.covariance if found is None else found

    def _lose(self, frame: Frame, attempt: Attempt, T_guess: Array) -> TrackResult:
        self._T_key_cam = T_guess
        self._lost = True
        if self._life.is_given_up(frame.t_ns) and self._depth.available(frame):
            return self._start(frame, attempt.failure)
        return self._life.lost(frame.t_ns, attempt.failure, attempt.inliers)

    def _place_by_depth(self, frame: Frame, keyframe: Keyframe, attempt: Attempt, moved: Moved) -> TrackResult | None:
        """Return the result of a frame that only its depth image places; None where that does not either."""
        placed = None if self._by_depth is None else self._by_depth.place(frame, keyframe, moved, len(self._tracker))
        if placed is None:
            return None
        self._T_key_cam = placed.T_key_cam
        T_before_now = invert(moved.T_before) @ placed.T_key_cam
        if not self._lost:
            self._predictor.observe(T_before_now, moved.dt_s)
        self._lost = False
        self._life.placed_without_vision(frame.t_ns)
        vo = placed.motion(frame.t_ns, keyframe.id, self._T_body_cam)
        reason = f"{placed.reason or 'placed by depth alone'}: {attempt.failure}"
        if not placed.reason:
            return TrackResult(vo, no_observations(), None, 0.0, reason, by_depth=True)
        none = replace(attempt.estimate, inliers=np.zeros(len(attempt.xy), dtype=np.bool_))
        attempt = replace(attempt, estimate=none, twist_per_s=se3_log(T_before_now) / moved.dt_s)
        new, observations = self._continue_from(frame, attempt)
        return TrackResult(vo, observations, new, 0.0, reason, by_depth=True)

    # -- a first keyframe without depth ------------------------------------------------------------------------------

    def _leave_blindness(
        self, blind: BlindKeyframe, frame: Frame, keyframe: Keyframe, T_guess: Array, dt_s: float, has_imu: bool
    ) -> TrackResult:
        """Follow a first keyframe that has no depth until a frame comes that has: then place it by its own depth."""
        T_before = self._T_key_cam
        T_step = invert(T_before) @ T_guess
        pixels = self._tracker.follow(frame, blind.expected(T_step))
        if not self._depth.available(frame):
            turned = blind.turn(frame, keyframe, pixels, T_guess)
            self._T_key_cam = T_guess if turned is None else turned[0]
            # with an IMU, filter and graph begin with what has scale, and know the turn
            if turned is None or has_imu:
                return self._life.lost(frame.t_ns, NO_DEPTH)
            self._predictor.observe(invert(T_before) @ self._T_key_cam, dt_s)
            return turned[1]
        xy, twist = self._camera.normalise(pixels), se3_log(T_step) / dt_s
        reading = self._measure(frame, pixels, xy, np.full(len(xy), np.nan), twist, to_learn=False)
        placed = blind.placed(np.column_stack([xy, reading.rho]), self._ransac)
        if placed is None:
            return self._start(frame, "the first keyframe, which had no depth, is out of sight")
        T_key_cam, rho = placed
        self._landmarks.mean[:, 2] = rho
        self._landmarks.covariance[:, 2, 2] = (_BLIND_SIGMA * rho) ** 2
        estimate = self._search(T_key_cam, xy, None)
        estimate = self._polish(estimate, xy, None) if estimate.converged else estimate
        why_not = self._failure(estimate, int(np.isfinite(xy[:, 0]).sum()))
        if why_not:
            return self._start(frame, why_not)
        attempt = Attempt(pixels, xy, xy, None, reading.rho, twist, estimate, "")
        self._T_key_cam = estimate.T_key_cam
        # followed for long, through a rolling shutter of which nothing was known: true, but not to the millimetre
        vo = replace(self._measurement(frame, keyframe.id, attempt), tracking=Tracking.DEGRADED)
        parallax_px = self._camera.fx * attempt.parallax(self._landmarks.mean[:, :2])
        new, observations = self._continue_from(frame, attempt)
        self._blind = None
        return TrackResult(vo, observations, new, parallax_px, "the first depth")

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def _start(self, frame: Frame, why: str) -> TrackResult:
        """Begin anew with this frame as keyframe, if there is enough to see in it."""
        self._tracker.forget()
        self._landmarks = Landmarks()
        frame = self._view.of(frame)
        self._look_through(self._views[0])
        count = self._tracker.begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
        reading = self._add_landmarks(frame, count, np.zeros(6))
        lack = self._lack(frame)
        if lack:
            self._tracker.forget()
            self._landmarks = Landmarks()
            return self._life.refused(frame.t_ns, why, lack)
        self._predictor.forget()
        self._lost = self._lacks_depth = False
        has_depth = self._depth.available(frame)
        self._blind = None if has_depth else BlindKeyframe(self._config, self._view, self._tracker.pixels)
        self._install(frame, np.zeros(6), None)
        observations = self._observations(self._tracker.pixels, reading, self._landmarks.mean[:, :2])
        return self._life.started(observations, count, why)

    def _lack(self, frame: Frame) -> str:
        """Return what a frame lacks to start from, or an empty string; only the very first may be without depth."""
        corners, deep = len(self._tracker), int(self._landmarks.known.sum())
        if corners < self._config.min_start_corners:
            return too_few(frame, corners)
        if deep < self._config.min_inliers and (self._life.keyframe is not None or self._depth.available(frame)):
            return f"only {deep} of {corners} corners have depth"
        return ""

    def _continue_from(self, frame: Frame, attempt: Attempt) -> tuple[Keyframe, Observations]:
        """Carry the agreeing landmarks into this frame, improve them by what it measures, fill the gaps."""
        kept = attempt.estimate.inliers
        reading = self._lag.measure(
            self._depth, frame, attempt.pixels[kept], attempt.seen[kept], attempt.expected_rho[kept],
            attempt.twist_per_s, self._tracker.ids[kept],
        )  # fmt: skip
        landmarks = self._landmarks.carried(
            kept, self._T_key_cam, attempt.xy[kept], self._sigma_xy, reading.rho, reading.sigma_rho, reading.slope
        )
        self._landmarks = landmarks
        # the patch that is followed from now on is the one where the landmark is believed to be
        pixels = attempt.pixels.copy()
        pixels[kept] = self._shutter.project(landmarks.mean, attempt.twist_per_s)
        count = self._tracker.begin(frame, kept, pixels)
        fresh = self._add_landmarks(frame, count, attempt.twist_per_s)
        seen_at = np.vstack([attempt.pixels[kept], self._tracker.pixels[len(self._tracker) - count :]])
        instant = np.vstack([attempt.xy[kept], landmarks.mean[len(landmarks.mean) - count :, :2]])
        measured = reading.joined(fresh)
        self._lacks_depth = len(measured.rho) > np.isfinite(measured.rho).sum() / _DEEP
        observations = self._observations(seen_at, measured, instant)
        return self._install(frame, attempt.twist_per_s, self._T_key_cam), observations

    def _add_landmarks(self, frame: Frame, count: int, twist_per_s: Array) -> DepthReading:
        """Give the tracker's last `count` corners landmarks; return their depth reading."""
        first = len(self._tracker) - count
        pixels = self._tracker.pixels[first:]
        seen = self._camera.normalise(pixels)
        expected_rho = self._landmarks.expected_rho(seen)
        reading = self._lag.measure(
            self._depth, frame, pixels, seen, expected_rho, twist_per_s, self._tracker.ids[first:]
        )
        xy = self._shutter.to_instant(pixels, seen, np.nan_to_num(reading.rho), twist_per_s)
        # a corner is its patch in the keyframe; a point that was followed elsewhere is as noisy here as anywhere
        sigma_xy = self._sigma_xy if frame.tracks is not None else _CORNER_SIGMA * self._sigma_xy
        self._landmarks.append(xy, reading.rho, sigma_xy, reading.sigma_rho, reading.slope)
        return reading

    def _observations(self, pixels: Array, reading: DepthReading, xy: Array) -> Observations:
        """Return what a keyframe sees: raw pixels [N, 2] and directions [N, 2] of the middle row's time."""
        ids = self._tracker.ids.copy()
        if self._view.is_swapped:
            return self._as_cam0_would(ids, xy, self._landmarks.mean, self._landmarks.covariance)
        return Observations(
            ids, pixels.copy(), reading.right_px, reading.depth_m, instant_px=self._shutter.instant_px(xy)
        )

    def _install(self, frame: Frame, twist_per_s: Array, T_key_new: Array | None) -> Keyframe:
        whole, usual = self._view.of(frame), self._views[0]
        usual_twist = np.zeros(6) if self._view.is_swapped else twist_per_s
        exposed = self._exposures.of_keyframe(usual.depth, whole, usual_twist, self._landmarks.expected_rho)
        keyframe = self._life.install(whole, usual.camera, usual.T_body_cam, len(self._tracker), exposed)
        if self._surfaces is not None:
            self._surfaces.add(keyframe, T_key_new)
        self._exposures.key_twist_per_s = twist_per_s
        self._key_sees = self._now_sees
        self._T_key_cam = np.eye(4)
        return keyframe


class StereoFrontEnd(MetricFrontEnd):
    """Metric by a second camera; goes on with that one while the first is covered."""

    mode = "stereo"

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take the rig's first two cameras; raises UsageError where it has one."""
        if not rig.is_stereo:
            raise UsageError("front end 'stereo' needs two cameras, this recording has one; use --frontend.mode auto")
        super().__init__(config, rig, seed, stereo_views(rig, config))


class RgbdFrontEnd(MetricFrontEnd):
    """Metric by depth images; goes on with these alone while the camera is covered."""

    mode = "rgbd"

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take the rig's first camera; raises UsageError where it has no depth."""
        if not rig.has_depth:
            raise UsageError("front end 'rgbd' needs depth images, this recording has none; use --frontend.mode auto")
        view = View(rig.cameras[0], rig.T_body_cams[0], ImageDepth(config))
        super().__init__(config, rig, seed, (view,))
