"""Visual odometry of a single camera: rotation and direction of motion since the keyframe, without scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert, transform
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import Learned
from vislam.core.messages import Array, Frame, ImuSpan, Keyframe, Observations
from vislam.core.quantiles import median
from vislam.frontend.attempt import DEGRADED_INLIERS, MotionPredictor, confirmed, failure, weakness
from vislam.frontend.intake import Intake
from vislam.frontend.keyframes import PATIENCE_S, KeyframeLife, keyframe_reason
from vislam.frontend.pixel_noise import PixelNoise
from vislam.frontend.result import CommonErrors, TrackResult, too_few, unscaled_motion
from vislam.frontend.tracker import MIN_START_CORNERS, Tracker
from vislam.frontend.turning_rows import TurningRows
from vislam.vision.refine import refine_pose
from vislam.vision.two_view import (
    RotationPrior,
    TwoViewEstimate,
    direction_given_rotation,
    epipolar_distances,
    essential_ransac,
    from_epipolar_segment,
    moved_xy,
    refine_two_view,
    turn_only,
)

# of rotation by the gyro since a keyframe, beside its bias: scale, time offset
_MONO_GYRO_SIGMA_RAD = 0.002
_MONO_MIN_PARALLAX_PX = 3.0  # less, and the direction of motion drowns in noise: only rotation is measured
_MIN_GIVEN = 8  # in place of both numbers for tracks given from elsewhere: few, but selected by their source
_RANSAC_PX = 1.5
_RANSAC_BELOW = 0.9  # of the tracks agree: the start may have led to the second solution that a flat scene has
_TURN_EXPLAINS = 0.9  # of the tracks agree with a rotation: no need for a translation
_VAGUE_RAD = 0.35  # sigma of a direction that a linear model of its error no longer describes
_GYRO_KNOWN_ALREADY = 3.0  # on its sigma, since filter and graph use the same gyroscope
_LEAN = 2.0  # rad, over the square of noise over parallax: 0.2 across and along the axis, 3.5 between, in simulation
_BOTH_ENDS = 2.0**0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Where a frame is relative to the keyframe; direction zero when there is no parallax."""

    view: TwoViewEstimate
    pixels: Array  # [N, 2], NaN where not found
    xy: Array  # [N, 2] the same on z = 1
    parallax_px: float
    failure: str

    @property
    def followed(self) -> int:
        return int(np.isfinite(self.pixels[:, 0]).sum())

    @property
    def agreeing(self) -> NDArray[np.bool_]:
        return self.view.inliers

    @property
    def inliers(self) -> int:
        return int(self.view.inliers.sum())


@dataclass(frozen=True, slots=True)
class _Limits:
    """What is asked of tracks, which depends on who followed them."""

    min_inliers: int
    sigma_xy: float  # of a pixel relative to the keyframe's
    min_parallax_px: float

    @classmethod
    def of(cls, config: FrontEndConfig, fx: float, is_given: bool) -> _Limits:
        """Return those of a camera; given tracks are as noisy in the keyframe as here, where a corner is its patch."""
        ends = _BOTH_ENDS if is_given else 1.0
        least = _MIN_GIVEN if is_given else config.min_inliers
        return cls(least, ends * config.track_sigma_px / fx, ends * _MONO_MIN_PARALLAX_PX)


class MonoFrontEnd:
    """Frame-to-keyframe odometry from epipolar geometry; below a few pixels of parallax it measures only rotation.

    The translation column of its measurements is the unit direction in which cam0 (not the body's origin) moved, in
    body axes of the keyframe: without scale, the lever arm between the two cannot be taken out here.
    """

    mode = "mono"
    knows_scale = False

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take the rig's first camera."""
        self.keyframe_spacing = 1.0
        self.calibration: dict[str, float] = {}
        self._config = config
        self._camera = rig.cameras[0]
        self._T_body_cam = rig.T_body_cams[0]
        self._R_body_cam = np.ascontiguousarray(self._T_body_cam[:3, :3])
        self._intake = Intake(rig, seed)
        self._tracker = Tracker(config)
        self._noise = PixelNoise(config.track_sigma_px)
        self._rows = TurningRows(self._camera, self._R_body_cam, config)
        self._predictor = MotionPredictor(self._T_body_cam, PATIENCE_S)
        self._limits = _Limits.of(config, self._camera.fx, is_given=False)
        self._life = KeyframeLife(config, has_scale=False)
        self._last_px: Array = np.empty((0, 2))  # of every track in the last frame, guessed where it was not found
        self._R_key_cam: Array = np.eye(3)  # of the last frame, predicted while lost
        self._R_key_gyro: Array = np.eye(3)  # of the last frame, by the gyroscope alone
        self._gyro_sigma_rad = 0.0
        self._T_key_filter: Array | None = np.eye(4)  # of the last frame's camera, by the filter; None: not all known
        self._direction_key: Array = np.zeros(3)  # to the last frame, or where it will probably go; zero: not known
        self._lost = False

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """Place `frame` relative to the last keyframe; see FrontEnd.track."""
        result = self._track(frame, imu, gyro_sigma_rad_s, T_last_now)
        return result.with_scatter(self._noise.sigma_px, 1.0 if frame.tracks is not None else self._noise.over_usual)

    def _track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float, T_last_now: Array | None
    ) -> TrackResult:
        frame, dt_s = self._intake.accept(frame)
        self._rows.take(imu)
        given = _BOTH_ENDS if frame.tracks is not None else 1.0
        self._limits = _Limits.of(self._config, self._camera.fx, frame.tracks is not None)
        if self._life.keyframe is None:
            return self._start(frame, "")
        R_now_next = np.ascontiguousarray(self._predictor.predict(dt_s, imu)[:3, :3])
        R_before = self._R_key_cam
        R_guess = R_before @ R_now_next
        prior = self._gyro_prior(R_now_next, dt_s, gyro_sigma_rad_s if imu is not None else np.inf)
        last = np.column_stack([self._camera.normalise(self._last_px), np.ones(len(self._last_px))])
        guess = self._camera.project(last @ R_now_next)
        pixels = self._tracker.follow(frame, guess)
        self._rows.look(self._tracker.pixels)
        found = np.isfinite(pixels[:, 0])
        self._last_px = np.where(found[:, None], pixels, guess)
        located = self._locate(R_guess, prior, pixels)
        motion = self._confirmed(located, R_guess, prior, T_last_now)
        if motion.failure:
            self._R_key_cam = R_guess
            return self._lose(frame, motion)
        self._R_key_cam = motion.view.R_key_cam
        if motion.view.direction_key.any():
            self._direction_key = motion.view.direction_key
        if not self._lost:
            self._predictor.observe(transform(R_before.T @ self._R_key_cam, np.zeros(3)), dt_s)
        self._lost = False
        self._life.placed(frame.t_ns)
        self._learn_noise(motion, given**2)
        self._rows.learn(motion.view, motion.pixels, self._limits.sigma_xy, prior)
        outliers = 1.0 - int(located.agreeing.sum()) / max(located.followed, 1)
        return replace(self._report(frame, motion), outliers=outliers)

    @classmethod
    def errors(cls, config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> CommonErrors:
        """Return that of the accelerometer's scale, by which all metres come."""
        return CommonErrors(0.0 if noise is None else noise.accelerometer_scale_sigma or 0.0)

    def begin_at(self, keyframe_id: int, learned: Learned, seeks_place: bool = False) -> None:
        """See FrontEnd.begin_at."""
        self._life.begin_at(keyframe_id, seeks_place)
        self._tracker.next_id = learned.next_track_id
        self._rows.start_at(learned.readout_s)

    @property
    def learned(self) -> Learned:
        """See FrontEnd.learned."""
        return Learned(self._tracker.next_id, readout_s=self._rows.learned_s)

    # -- placing one frame -------------------------------------------------------------------------------------------

    def _gyro_prior(self, R_now_next: Array, dt_s: float, sigma_rad_s: float) -> RotationPrior | None:
        """Return the rotation since the keyframe by gyroscope alone; None where a span of unknown bias is in it."""
        self._R_key_gyro = self._R_key_gyro @ R_now_next
        self._gyro_sigma_rad += sigma_rad_s * dt_s
        if not np.isfinite(self._gyro_sigma_rad):
            return None
        return RotationPrior(self._R_key_gyro, _MONO_GYRO_SIGMA_RAD + self._gyro_sigma_rad)

    def _confirmed(
        self, motion: _Motion, R_guess: Array, prior: RotationPrior | None, T_last_now: Array | None
    ) -> _Motion:
        """Return the motion, or another without the tracks that no depth explains by the filter's motion."""
        if T_last_now is None or self._T_key_filter is None:
            self._T_key_filter = None
            return motion
        self._T_key_filter = self._T_key_filter @ invert(self._T_body_cam) @ T_last_now @ self._T_body_cam
        nearest = 1.0 / self._config.min_depth_m
        off_px = self._camera.fx * from_epipolar_segment(self._T_key_filter, self._rows.key_xy, motion.xy, nearest)
        astray = off_px > self._config.astray_px
        return confirmed(motion, astray, lambda pixels: self._locate(R_guess, prior, pixels), self._config)

    def _locate(self, R_guess: Array, prior: RotationPrior | None, pixels: Array) -> _Motion:
        key_xy, xy = self._rows.key_xy, self._rows.now_xy(pixels)
        still = self._turn(R_guess, key_xy, xy) if prior is None else self._turn_by(prior, key_xy, xy)
        parallax_px = self._camera.fx * _parallax(still.R_key_cam if still.converged else R_guess, key_xy, xy)
        view = still
        followed = int(np.isfinite(xy[:, 0]).sum())
        explained = still.converged and still.inliers.sum() >= _TURN_EXPLAINS * followed
        if not explained or parallax_px > self._limits.min_parallax_px:
            both = self._two_view(R_guess, prior, key_xy, xy)
            # a direction that does not settle is no reason to give up a rotation that does
            if both.converged or not still.converged:
                parallax = _parallax(both.R_key_cam, key_xy, xy)
                view = _without_vague_direction(_with_lean(both, self._limits.sigma_xy, parallax))
                parallax_px = self._camera.fx * parallax
        agree, least = int(view.inliers.sum()), self._limits.min_inliers
        why = failure(len(self._tracker), followed, agree, view.converged, least)
        return _Motion(view, pixels, xy, parallax_px, why)

    def _turn(self, R_guess: Array, key_xy: Array, xy: Array) -> TwoViewEstimate:
        """Explain the image by rotation alone: all points at infinity."""
        points = np.column_stack([key_xy, np.zeros(len(key_xy))])
        no_noise: Array = np.zeros((len(points), 3, 3))
        start = transform(np.ascontiguousarray(R_guess), np.zeros(3))
        pose = refine_pose(start, points, no_noise, xy, self._limits.sigma_xy, self._config.cauchy, rotation_only=True)
        R = np.ascontiguousarray(pose.T_key_cam[:3, :3])
        return turn_only(TwoViewEstimate(R, np.zeros(3), pose.covariance, pose.inliers, pose.converged))

    def _turn_by(self, prior: RotationPrior, key_xy: Array, xy: Array) -> TwoViewEstimate:
        """Take the gyroscope's rotation: what vision finds alone swallows small translations before a flat scene."""
        moved_px = moved_xy(prior.R_key_cam, key_xy, xy) * self._camera.fx
        with np.errstate(invalid="ignore"):
            inliers = np.asarray(moved_px < self._limits.min_parallax_px, dtype=np.bool_)
        covariance = np.eye(6) * (_GYRO_KNOWN_ALREADY * prior.sigma_rad) ** 2
        return turn_only(TwoViewEstimate(prior.R_key_cam, np.zeros(3), covariance, inliers, True))

    def _two_view(self, R_guess: Array, prior: RotationPrior | None, key_xy: Array, xy: Array) -> TwoViewEstimate:
        """Refine from the prediction, for a new keyframe going on as before; search by RANSAC if not all agree."""
        if prior is not None:
            return self._two_view_by(prior, key_xy, xy)
        config = self._config
        best: TwoViewEstimate | None = None
        if self._direction_key.any():
            best = refine_two_view(R_guess, self._direction_key, key_xy, xy, self._limits.sigma_xy, config.cauchy)
        if best is None or not best.converged or best.inliers.sum() < _RANSAC_BELOW * np.isfinite(xy[:, 0]).sum():
            start = essential_ransac(R_guess, key_xy, xy, _RANSAC_PX / self._camera.fx, self._limits.min_inliers)
            if start is not None:
                other = refine_two_view(*start[:2], key_xy, xy, self._limits.sigma_xy, config.cauchy)
                if best is None or other.inliers.sum() > best.inliers.sum():
                    best = other
        if best is None:
            nothing = np.zeros(len(xy), dtype=np.bool_)
            return TwoViewEstimate(R_guess, np.zeros(3), np.full((6, 6), np.nan), nothing, False)
        return best

    def _two_view_by(self, prior: RotationPrior, key_xy: Array, xy: Array) -> TwoViewEstimate:
        """Refine around the gyroscope's rotation from the direction that fits it, and from the last one."""
        config = self._config
        nothing = np.zeros(len(xy), dtype=np.bool_)
        best = TwoViewEstimate(prior.R_key_cam, np.zeros(3), np.full((6, 6), np.nan), nothing, False)
        starts = [self._direction_key] if self._direction_key.any() else []
        fitting = direction_given_rotation(prior.R_key_cam, key_xy, xy)
        for start in [*starts, *([] if fitting is None else [fitting])]:
            found = refine_two_view(prior.R_key_cam, start, key_xy, xy, self._limits.sigma_xy, config.cauchy, prior)
            if found.converged >= best.converged and found.inliers.sum() > best.inliers.sum():
                best = found
        return best

    def _learn_noise(self, motion: _Motion, ends: float) -> None:
        """Take note of the distances from epipolar lines; without a direction there are none."""
        T_key_cam = np.asarray(transform(motion.view.R_key_cam, motion.view.direction_key))
        distances = epipolar_distances(T_key_cam, self._rows.key_xy, motion.xy)
        self._noise.learn(distances, self._camera, motion.xy, ends)

    # -- what comes of it --------------------------------------------------------------------------------------------

    def _report(self, frame: Frame, motion: _Motion) -> TrackResult:
        weak = self._weakness(motion)
        vo = unscaled_motion(
            frame.t_ns, self._life.newest_id, motion.view, self._R_body_cam, motion.inliers, is_weak=bool(weak)
        )
        good = motion.view.inliers
        departure = self._life.departure(
            frame.t_ns, self._R_key_cam, motion.parallax_px, motion.followed, motion.inliers
        )
        reason = keyframe_reason(departure, self._config, self.keyframe_spacing)
        if reason:
            pixels = motion.pixels.copy()
            self._tracker.begin(frame, good, pixels)
            new = self._install(frame)
            return TrackResult(vo, self._observations(), new, motion.parallax_px, reason)
        observations = Observations(self._tracker.ids[good].copy(), motion.pixels[good], readout_s=self._rows.learned_s)
        self._last_px = self._last_px[self._tracker.judge(good)]
        return TrackResult(vo, observations, None, motion.parallax_px, weak)

    def _weakness(self, motion: _Motion) -> str:
        # of given tracks, as many times the least as of our own
        enough = DEGRADED_INLIERS * self._limits.min_inliers // self._config.min_inliers
        return weakness(motion.followed, motion.inliers, enough)

    def _lose(self, frame: Frame, motion: _Motion) -> TrackResult:
        self._lost = True
        if self._life.is_given_up(frame.t_ns):
            return self._start(frame, motion.failure)
        return self._life.lost(frame.t_ns, motion.failure, motion.inliers)

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def _start(self, frame: Frame, why: str) -> TrackResult:
        """Begin again with this frame as keyframe, if there is enough to see in it."""
        self._tracker.forget()
        count = self._tracker.begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
        self._last_px = self._tracker.pixels.copy()
        least = MIN_START_CORNERS if frame.tracks is None else _MIN_GIVEN
        if count < least:
            self._tracker.forget()
            self._last_px = np.empty((0, 2))
            return self._life.refused(frame.t_ns, why, too_few(frame, count))
        self._predictor.forget()
        self._direction_key = np.zeros(3)
        self._lost = False
        self._install(frame)
        return self._life.started(self._observations(), count, why)

    def _observations(self) -> Observations:
        return Observations(self._tracker.ids.copy(), self._tracker.pixels.copy(), readout_s=self._rows.learned_s)

    def _install(self, frame: Frame) -> Keyframe:
        keyframe = self._life.install(frame, self._camera, self._T_body_cam, len(self._tracker))
        self._last_px = self._tracker.pixels.copy()
        self._direction_key = self._R_key_cam.T @ self._direction_key
        self._R_key_cam = np.eye(3)
        self._R_key_gyro, self._gyro_sigma_rad = np.eye(3), 0.0
        self._T_key_filter = np.eye(4)
        self._rows.begin()
        return keyframe


def _without_vague_direction(view: TwoViewEstimate) -> TwoViewEstimate:
    """Return the estimate without its direction if that is hardly known."""
    vague = view.converged and float(np.trace(view.covariance[3:, 3:])) > _VAGUE_RAD**2
    return turn_only(view) if vague else view


def _with_lean(view: TwoViewEstimate, sigma_xy: float, parallax: float) -> TwoViewEstimate:
    """Return the estimate with what its direction may be off however many tracks there are, by their parallax.

    Each track brings a depth of its own, so that noise does not average out (Neyman and Scott, 1948): the direction
    leans towards the optical axis by about the square of noise over parallax.
    """
    if not view.converged or parallax <= 0.0:
        return view
    lean_rad = _LEAN * view.variance * (sigma_xy / parallax) ** 2
    covariance, d = view.covariance.copy(), view.direction_key
    covariance[3:, 3:] += lean_rad**2 * (np.eye(3) - np.outer(d, d))
    return replace(view, covariance=covariance)


def _parallax(R_key_cam: Array, key_xy: Array, xy: Array) -> float:
    """Return the median way on z = 1 that a turn leaves; 0 where nothing was followed."""
    moved = moved_xy(R_key_cam, key_xy, xy)
    seen = np.isfinite(moved)
    return median(moved[seen]) if seen.any() else 0.0
