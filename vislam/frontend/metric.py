"""Visual odometry with depth, stereo or RGB-D: the pose of every frame against the landmarks of the last keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.camera import Rig
from vislam.config import FrontEndConfig
from vislam.errors import DataError
from vislam.features import describe, match
from vislam.frontend.depth import DepthReading, DepthSensor
from vislam.frontend.keyframes import Departure, keyframe_reason
from vislam.frontend.landmarks import UNKNOWN_RHO, UNKNOWN_RHO_SIGMA, fuse, move
from vislam.frontend.prediction import MotionPredictor, body_motion
from vislam.frontend.refine import PoseEstimate, refine_pose
from vislam.frontend.result import TrackResult, identity_motion, lost_motion, no_observations
from vislam.frontend.tracker import Tracker
from vislam.geometry import invert, se3_adjoint, so3_log, transform, transform_points
from vislam.messages import Array, Frame, ImuSpan, Keyframe, Observations, Tracking, VoMeasurement

Bools = NDArray[np.bool_]

# squared Mahalanobis distances that one good residual in a thousand exceeds, by degrees of freedom
_CHI2_GATE = np.array([0.0, 10.8, 13.8, 16.3])


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    """One try to place a frame relative to the keyframe."""

    pixels: Array  # [N, 2] of all tracks, NaN where not found
    xy: Array  # [N, 2] on z = 1
    reading: DepthReading
    estimate: PoseEstimate
    inliers: Bools  # [N]
    failure: str  # empty when the pose can be trusted

    @property
    def ratio(self) -> float:
        followed = int(np.isfinite(self.pixels[:, 0]).sum())
        return float(self.inliers.sum()) / max(followed, 1)


class MetricFrontEnd:
    """Frame-to-keyframe odometry on inverse-depth landmarks that are carried and improved from keyframe to keyframe."""

    def __init__(self, mode: str, config: FrontEndConfig, rig: Rig, depth: DepthSensor, seed: int) -> None:
        """Take the sensor that measures depth; `mode` is only the name."""
        self.mode = mode
        self._config = config
        self._camera = rig.cameras[0]
        self._T_body_cam = rig.T_body_cams[0]
        self._depth = depth
        self._seed = seed
        self._tracker = Tracker(config)
        self._predictor = MotionPredictor(self._T_body_cam, config.patience_s)
        self._sigma_xy = config.track_sigma_px / self._camera.fx
        self._landmarks: Array = np.empty((0, 3))
        self._covariances: Array = np.empty((0, 3, 3))
        self._keyframe: Keyframe | None = None
        self._next_id = 0
        self._T_key_cam: Array = np.eye(4)  # of the last frame, predicted while lost
        self._t_ns = -1  # of the last frame
        self._t_good_ns = -1  # of the last frame that was placed

    def track(self, frame: Frame, imu: ImuSpan | None) -> TrackResult:
        """Place `frame` relative to the last keyframe; see FrontEnd.track."""
        self._camera.check_image(frame.images[0])
        if frame.t_ns <= self._t_ns:
            raise DataError(f"frame {frame.index} at {frame.t_ns} ns does not come after {self._t_ns} ns; skip it")
        cv2.setRNGSeed(self._seed + frame.index)
        dt_s = (frame.t_ns - self._t_ns) * 1e-9
        self._t_ns = frame.t_ns
        if self._keyframe is None:
            return self._start(frame, "")
        T_now_next = self._predictor.predict(dt_s, imu)
        T_before = self._T_key_cam
        self._T_key_cam = T_before @ T_now_next
        attempt = self._attempt(frame, self._T_key_cam)
        if attempt.failure:
            T_found = self._relocalise(frame)
            if T_found is not None:
                attempt = self._attempt(frame, T_found)
        if attempt.failure:
            return self._lose(frame, attempt)
        self._T_key_cam = attempt.estimate.T_key_cam
        if self._t_good_ns == frame.t_ns - round(dt_s * 1e9):
            self._predictor.observe(invert(T_before) @ self._T_key_cam, dt_s)
        self._t_good_ns = frame.t_ns
        return self._report(frame, attempt)

    # -- one frame ---------------------------------------------------------------------------------------------------

    def _attempt(self, frame: Frame, T_guess: Array) -> _Attempt:
        predicted, _ = move(self._landmarks, self._covariances, T_guess)
        rays = np.column_stack([predicted[:, :2], np.ones(len(predicted))])
        pixels = self._tracker.follow(frame.images[0], self._camera.project(rays))
        xy = self._camera.normalise(pixels)
        reading = self._depth.measure(frame, pixels, xy, predicted[:, 2])
        estimate = self._solve(T_guess, xy, reading)
        inliers = _inliers(estimate)
        followed = int(np.isfinite(xy[:, 0]).sum())
        count = int(inliers.sum())
        failure = ""
        if followed < self._config.min_inliers:
            failure = f"only {followed} of {len(self._tracker)} tracks found"
        elif not estimate.converged:
            failure = "the motion does not converge"
        elif count < self._config.min_inliers or count < self._config.min_inlier_ratio * followed:
            failure = f"only {count} of {followed} tracks agree on a motion"
        return _Attempt(pixels, xy, reading, estimate, inliers, failure)

    def _solve(self, T_guess: Array, xy: Array, reading: DepthReading) -> PoseEstimate:
        """Refine from the prediction; when few tracks agree with the result, look for a better start by RANSAC."""
        estimate = self._refine(T_guess, xy, reading, None)
        followed = np.isfinite(xy[:, 0])
        if _inliers(estimate).sum() < 0.6 * followed.sum():
            T_ransac = self._ransac(xy, followed)
            if T_ransac is not None:
                other = self._refine(T_ransac, xy, reading, None)
                if _inliers(other).sum() > _inliers(estimate).sum():
                    estimate = other
        return self._refine(estimate.T_key_cam, xy, reading, _inliers(estimate)) if estimate.converged else estimate

    def _refine(self, T: Array, xy: Array, reading: DepthReading, only: Bools | None) -> PoseEstimate:
        used = xy if only is None else np.where(only[:, None], xy, np.nan)
        import os
        rr = reading.rho if int(os.environ.get("CURD","1")) else np.full(len(used), np.nan)
        return refine_pose(
            T, self._landmarks, self._covariances, used, rr, self._sigma_xy, reading.sigma_rho, self._config.cauchy
        )

    def _ransac(self, xy: Array, followed: Bools) -> Array | None:
        """Return T_key_cam [4, 4] by P3P RANSAC over the landmarks of known depth, or None."""
        known = followed & (np.sqrt(self._covariances[:, 2, 2]) < 0.2 * self._landmarks[:, 2])
        landmarks = self._landmarks[known]
        points = np.column_stack([landmarks[:, :2], np.ones(len(landmarks))]) / landmarks[:, 2:]
        return pnp_ransac(points, xy[known], 3.0 / self._camera.fx, self._config.min_inliers)

    def _relocalise(self, frame: Frame) -> Array | None:
        """Return T_key_cam [4, 4] found by matching ORB descriptors with the keyframe, or None."""
        keyframe = self._keyframe
        if keyframe is None or keyframe.points_body_m is None:
            return None
        pixels, descriptors = describe(frame.images[0], self._config.described_features)
        pairs = match(keyframe.descriptors, descriptors)
        pairs = pairs[np.isfinite(keyframe.points_body_m[pairs[:, 0], 0])]
        xy = self._camera.normalise(pixels[pairs[:, 1]])
        seen = np.isfinite(xy[:, 0])
        points = transform_points(invert(self._T_body_cam), keyframe.points_body_m[pairs[seen, 0]])
        return pnp_ransac(points, xy[seen], 4.0 / self._camera.fx, self._config.min_inliers)

    # -- what comes of it --------------------------------------------------------------------------------------------

    def _report(self, frame: Frame, attempt: _Attempt) -> TrackResult:
        keyframe = self._keyframe
        assert keyframe is not None
        vo = self._measurement(frame, keyframe.id, attempt)
        parallax_px = self._parallax_px(attempt)
        observations = self._observations(attempt)
        departure = Departure(
            dt_s=(frame.t_ns - keyframe.t_ns) * 1e-9,
            rotation_rad=float(np.linalg.norm(so3_log(np.ascontiguousarray(self._T_key_cam[:3, :3])))),
            parallax_px=parallax_px,
            alive=float(np.isfinite(attempt.xy[:,0]).sum()) / max(self._keyframe_tracks, 1),
        )
        reason = keyframe_reason(departure, self._config)
        if reason:
            new = self._make_keyframe(frame, attempt)
            return TrackResult(vo, observations, new, parallax_px, reason)
        alive = self._tracker.judge(attempt.inliers)
        self._landmarks, self._covariances = self._landmarks[alive], self._covariances[alive]
        why = "" if vo.tracking is Tracking.OK else f"{vo.inliers} inliers, {attempt.ratio:.0%} of the tracks"
        return TrackResult(vo, observations, None, parallax_px, why)

    def _measurement(self, frame: Frame, keyframe_id: int, attempt: _Attempt) -> VoMeasurement:
        config = self._config
        inliers = int(attempt.inliers.sum())
        weak = inliers < config.degraded_inliers or attempt.ratio < config.degraded_inlier_ratio
        adjoint = se3_adjoint(self._T_body_cam)
        covariance = adjoint @ attempt.estimate.covariance @ adjoint.T
        return VoMeasurement(
            t_ns=frame.t_ns,
            keyframe_id=keyframe_id,
            T_keyframe_body=body_motion(attempt.estimate.T_key_cam, self._T_body_cam),
            covariance=0.5 * (covariance + covariance.T),
            has_scale=True,
            tracking=Tracking.DEGRADED if weak else Tracking.OK,
            inliers=inliers,
        )

    def _parallax_px(self, attempt: _Attempt) -> float:
        rays = np.column_stack([attempt.xy, np.ones(len(attempt.xy))])[attempt.inliers]
        turned = rays @ self._T_key_cam[:3, :3].T
        moved = turned[:, :2] / turned[:, 2:] - self._landmarks[attempt.inliers, :2]
        return float(np.median(np.linalg.norm(moved, axis=1)) * self._camera.fx) if len(moved) else 0.0

    def _observations(self, attempt: _Attempt) -> Observations:
        good = attempt.inliers
        right = attempt.reading.right_px
        return Observations(
            track_ids=self._tracker.ids[good].copy(),
            pixels_px=attempt.pixels[good],
            right_px=None if right is None else right[good],
            depth_m=attempt.reading.depth_m[good],
        )

    def _lose(self, frame: Frame, attempt: _Attempt) -> TrackResult:
        assert self._keyframe is not None
        if (frame.t_ns - self._t_good_ns) * 1e-9 >= self._config.patience_s:
            return self._start(frame, attempt.failure)
        vo = lost_motion(frame.t_ns, self._keyframe.id, True, int(attempt.inliers.sum()))
        return TrackResult(vo, no_observations(), None, 0.0, attempt.failure)

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def _start(self, frame: Frame, failure: str) -> TrackResult:
        """Begin anew with this frame as keyframe, if there is enough to see in it."""
        self._tracker.begin(frame.images[0], np.zeros(len(self._tracker), dtype=np.bool_), self._tracker.pixels)
        last_id = self._next_id - 1
        if len(self._tracker) < self._config.min_start_corners:
            reason = f"{failure + '; ' if failure else ''}only {len(self._tracker)} corners, mean grey {frame.images[0].mean():.0f}"
            return TrackResult(lost_motion(frame.t_ns, last_id, True), no_observations(), None, 0.0, reason)
        self._landmarks, self._covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        self._predictor.forget()
        reading = self._add_landmarks(frame, len(self._tracker))
        keyframe = self._install(frame)
        observations = Observations(
            self._tracker.ids.copy(), self._tracker.pixels.copy(), reading.right_px, reading.depth_m
        )
        if last_id < 0:
            return TrackResult(identity_motion(frame.t_ns, 0, True, len(self._tracker)), observations, keyframe, 0.0, "first")
        return TrackResult(lost_motion(frame.t_ns, last_id, True), observations, keyframe, 0.0, f"restarted: {failure}")

    def _make_keyframe(self, frame: Frame, attempt: _Attempt) -> Keyframe:
        """Carry the agreeing landmarks into this frame, improve them by what it measures, fill the gaps."""
        kept = attempt.inliers
        landmarks, covariances = move(self._landmarks[kept], self._covariances[kept], self._T_key_cam)
        reading = attempt.reading
        self._landmarks, self._covariances = fuse(
            landmarks, covariances, attempt.xy[kept], reading.rho[kept], self._sigma_xy, reading.sigma_rho[kept]
        )
        # the patch that is followed from now on is the one where the landmark is believed to be
        pixels = attempt.pixels.copy()
        pixels[kept] = self._camera.project(np.column_stack([self._landmarks[:, :2], np.ones(len(self._landmarks))]))
        self._add_landmarks(frame, self._tracker.begin(frame.images[0], kept, pixels))
        return self._install(frame)

    def _add_landmarks(self, frame: Frame, count: int) -> DepthReading:
        """Give the tracker's last `count` corners landmarks; return their depth reading."""
        pixels = self._tracker.pixels[len(self._tracker) - count :]
        reading = self._measure(frame, pixels)
        landmarks = np.column_stack([self._camera.normalise(pixels), reading.rho])
        covariances = np.zeros((count, 3, 3))
        covariances[:, 0, 0] = covariances[:, 1, 1] = (0.1 * self._sigma_xy) ** 2
        known = np.isfinite(reading.rho)
        covariances[:, 2, 2] = np.where(known, reading.sigma_rho, UNKNOWN_RHO_SIGMA) ** 2
        landmarks[~known, 2] = UNKNOWN_RHO
        self._landmarks = np.vstack([self._landmarks, landmarks])
        self._covariances = np.concatenate([self._covariances, covariances])
        return reading

    def _measure(self, frame: Frame, pixels: Array) -> DepthReading:
        """Measure depth where none is expected yet; the nearest landmarks' depth is the first guess."""
        xy = self._camera.normalise(pixels)
        expected: Array = np.full(len(pixels), UNKNOWN_RHO)
        known = np.sqrt(self._covariances[:, 2, 2]) < 0.2 * self._landmarks[:, 2]
        if known.any() and len(pixels):
            distance = np.linalg.norm(xy[:, None] - self._landmarks[None, known, :2], axis=2)
            expected = self._landmarks[known, 2][np.argmin(distance, axis=1)]
        return self._depth.measure(frame, pixels, xy, expected)

    def _install(self, frame: Frame) -> Keyframe:
        keypoints, descriptors = describe(frame.images[0], self._config.described_features)
        depth_m = self._measure(frame, keypoints).depth_m
        points = self._camera.unproject(keypoints) * depth_m[:, None]
        keyframe = Keyframe(
            self._next_id, frame.t_ns, frame, keypoints, descriptors, transform_points(self._T_body_cam, points)
        )
        self._keyframe = keyframe
        self._keyframe_tracks = len(self._tracker)
        self._next_id += 1
        self._T_key_cam = np.eye(4)
        self._t_good_ns = frame.t_ns
        return keyframe


def _inliers(estimate: PoseEstimate) -> Bools:
    with np.errstate(invalid="ignore"):
        return np.asarray(estimate.chi2 < _CHI2_GATE[estimate.dof], dtype=np.bool_)


def pnp_ransac(points_key: Array, xy: Array, threshold: float, min_inliers: int) -> Array | None:
    """Return T_key_cam [4, 4] of a camera that sees points [N, 3] of the keyframe's camera at `xy` [N, 2], or None.

    P3P in RANSAC on the plane z = 1; `threshold` is a distance there.
    """
    if len(points_key) < max(min_inliers, 4):
        return None
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points_key, xy, np.eye(3), None, iterationsCount=200, reprojectionError=threshold, confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < min_inliers:
        return None
    return np.asarray(invert(transform(cv2.Rodrigues(rotation)[0], translation[:, 0])))
