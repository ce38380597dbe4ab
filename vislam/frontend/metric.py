"""Visual odometry with depth, stereo or RGB-D: the pose of every frame against the landmarks of the last keyframe."""

from dataclasses import replace

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.geometry import invert, se3_log
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import Learned
from vislam.core.messages import Array, Frame, ImuSpan, Keyframe, Observations, Tracking, VoMeasurement, no_observations
from vislam.frontend.attempt import DEGRADED_INLIERS, Attempt, weakness
from vislam.frontend.by_depth import ByDepth, Moved
from vislam.frontend.intake import Intake
from vislam.frontend.keyframe_tracks import KeyframeTracks
from vislam.frontend.keyframes import KeyframeLife, keyframe_reason
from vislam.frontend.local_surfaces import LocalSurfaces
from vislam.frontend.pixel_noise import PixelNoise
from vislam.frontend.placing import NO_DEPTH, BlindKeyframe, Placer
from vislam.frontend.result import CommonErrors, TrackResult, metric_motion, too_few
from vislam.frontend.tracker import MIN_START_CORNERS
from vislam.frontend.view import ImageDepth, View, sees, stereo_views
from vislam.vision.two_view import epipolar_distances


class SecondCamera:
    """Decides which camera of a rig is looked through; with one, it is always that."""

    def __init__(self, config: FrontEndConfig, views: tuple[View, ...], tracks: KeyframeTracks, placer: Placer) -> None:
        """Take the cameras, the usual one first, and what follows tracks through one of them."""
        self._config, self._views, self._tracks, self._placer = config, views, tracks, placer
        self._key_sees = True  # whether the usual camera sees anything in the keyframe
        self._now_sees = True  # and in this frame; only asked while the other camera is looked through

    def take_keyframe(self) -> None:
        """Take note that the frame became the keyframe."""
        self._now_sees = self._now_sees or not self._tracks.view.is_swapped
        self._key_sees = self._now_sees

    def look_back(self, whole: Frame, keyframe: Keyframe) -> None:
        """Go back to the usual camera as soon as it sees again, if the keyframe has anything in its image."""
        if not self._tracks.view.is_swapped:
            return
        self._now_sees = sees(whole, 0, self._config)
        if self._now_sees and self._key_sees:
            self._tracks.carry_keyframe(self._views[0], keyframe)

    def placed(self, failed: Attempt, whole: Frame, keyframe: Keyframe, T_guess: Array, dt_s: float) -> Attempt:
        """Place a frame by the other camera and go on looking through it; where that fails, nothing has changed.

        Which camera is covered is not asked of its image: what counts is which one can be followed.
        """
        tracks, before = self._tracks, self._tracks.view
        if min(len(self._views), len(whole.images), len(keyframe.frame.images)) < 2:
            return failed
        if before.is_swapped and not self._key_sees:
            return failed
        other = self._views[not before.is_swapped]
        T_key_cam, landmarks, pixels = tracks.T_key_cam, tracks.landmarks, tracks.tracker.pixels
        T_cam_other = invert(before.T_body_cam) @ other.T_body_cam
        tracks.carry_keyframe(other, keyframe)
        self._now_sees = not other.is_swapped
        T_guess = np.asarray(invert(T_cam_other) @ T_guess @ T_cam_other)
        attempt = self._placer.attempt(other.of(whole), T_guess, dt_s)
        if not attempt.failure:
            return attempt
        tracks.look_through(before)
        self._now_sees = not before.is_swapped
        tracks.T_key_cam, tracks.landmarks = T_key_cam, landmarks
        tracks.tracker.look_through(before.of(keyframe.frame).images[0], pixels)
        return failed

    def sees_again(self, frame: Frame) -> str:
        """Return which camera was covered in the keyframe and sees again, or an empty string: a reason for another."""
        if self._tracks.view.is_swapped:
            return "cam0 sees again" if self._now_sees else ""
        lost_depth = self._tracks.lacks_depth and min(len(self._views), len(frame.images)) > 1
        return "cam1 sees again" if lost_depth and sees(frame, 1, self._config) else ""


class MetricFrontEnd:
    """Frame-to-keyframe odometry on inverse-depth landmarks that are carried and improved from keyframe to keyframe."""

    mode: str
    knows_scale = True

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int, views: tuple[View, ...]) -> None:
        """Take the cameras to look through, the usual one first."""
        self.keyframe_spacing = 1.0
        self.calibration: dict[str, float] = {}
        self._config = config
        self._usual = usual = views[0]
        self._intake = Intake(rig, seed)
        self._life = KeyframeLife(config, has_scale=True)
        self._tracks = KeyframeTracks(config, views)
        self._placer = Placer(config, self._tracks)
        self._second = SecondCamera(config, views, self._tracks, self._placer)
        self._noise = PixelNoise(config.track_sigma_px)
        self._lost = False
        self._twist_per_s = np.zeros(6)  # at the frame that it begins with, see `Learned.habits`
        self._blind: BlindKeyframe | None = None  # the keyframe is the first and has no depth
        has_surfaces = rig.has_depth and usual.depth.every_frame
        self._surfaces = LocalSurfaces(config, usual.camera, usual.T_body_cam) if has_surfaces else None
        self._by_depth = ByDepth(config, self._surfaces) if self._surfaces is not None and config.depth_alone else None

    # -- the algorithm -----------------------------------------------------------------------------------------------

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """Place `frame` relative to the last keyframe; see FrontEnd.track."""
        whole, dt_s = self._intake.accept(frame)
        keyframe, outliers = self._life.keyframe, 0.0
        if keyframe is None:
            result = self._start(whole, "")
        else:
            self._second.look_back(whole, keyframe)
            T_guess = self._tracks.predicted(dt_s, imu)
            if self._blind is not None:
                result = self._leave_blindness(self._blind, whole, keyframe, T_guess, dt_s, imu is not None)
            else:
                attempt = self._placer.attempt(self._tracks.view.of(whole), T_guess, dt_s)
                outliers = 1.0 - attempt.inliers / max(attempt.followed, 1)
                attempt = self._place(attempt, whole, keyframe, T_guess, dt_s, T_last_now)
                bias = None if imu is None else gyro_sigma_rad_s
                result = self._settle(self._tracks.view.of(whole), keyframe, attempt, T_guess, dt_s, bias)
        if self._by_depth is not None:
            self._by_depth.note(result.vo, result.keyframe is not None, result.by_depth, self._tracks.view.T_body_cam)
        noise = 1.0 if frame.tracks is not None else self._noise.over_usual
        return replace(result.with_scatter(self._noise.sigma_px, noise), outliers=outliers)

    def _place(
        self, attempt: Attempt, whole: Frame, keyframe: Keyframe, T_guess: Array, dt_s: float, T_last_now: Array | None
    ) -> Attempt:
        """Return where the landmarks have a frame: by an attempt from the guess, the second camera, or recognised."""
        if attempt.failure:
            attempt = self._second.placed(attempt, whole, keyframe, T_guess, dt_s)
        view = self._tracks.view
        frame = view.of(whole)
        if T_last_now is not None:
            T_expected = self._tracks.T_key_cam @ invert(view.T_body_cam) @ T_last_now @ view.T_body_cam
            attempt = self._placer.confirmed(attempt, frame, T_expected, dt_s)
        return self._placer.recognised(attempt, frame, keyframe, dt_s) if attempt.failure else attempt

    def _settle(
        self, frame: Frame, keyframe: Keyframe, attempt: Attempt, T_guess: Array, dt_s: float, bias: float | None
    ) -> TrackResult:
        """Take the motion over, or use depth alone, or lose the keyframe; `bias` as `Moved.gyro_sigma_rad_s`."""
        tracks = self._tracks
        if attempt.failure:
            exposures = tracks.exposures
            moved = Moved(tracks.T_key_cam, T_guess, dt_s, exposures.key_twist_per_s, exposures.lag.delay_s, bias)
            return self._place_by_depth(frame, keyframe, attempt, moved) or self._lose(frame, attempt, T_guess)
        tracks.moved(attempt.estimate.T_key_cam, dt_s, self._lost)
        self._lost = False
        self._life.placed(frame.t_ns)
        if not self._weakness(attempt):
            tracks.exposures.learn(
                frame, attempt, tracks.landmarks, tracks.tracker.pixels, tracks.sigma_xy, dt_s
            )  # fmt: skip
        key_xy, ends = tracks.key_xy(keyframe)
        self._noise.learn(epipolar_distances(tracks.T_key_cam, key_xy, attempt.xy), tracks.camera, attempt.xy, ends)
        return self._decide(frame, keyframe, attempt, has_imu=bias is not None)

    def _decide(self, frame: Frame, keyframe: Keyframe, attempt: Attempt, has_imu: bool) -> TrackResult:
        """Return the motion of a placed frame, and make it a keyframe where it has come far enough."""
        tracks = self._tracks
        vo = self._measurement(frame, keyframe.id, attempt)
        departure = self._life.departure(
            frame.t_ns,
            tracks.T_key_cam[:3, :3],
            tracks.camera.fx * attempt.parallax(tracks.landmarks.mean[:, :2]),
            attempt.followed,
            attempt.inliers,
            tracks.view.depth.available(frame),
        )
        reason = keyframe_reason(departure, self._config, self.keyframe_spacing)
        reason = self._second.sees_again(frame) or reason
        if reason:
            if self._surfaces is not None and not has_imu:  # a window does without, and its filter was no better
                vo, tracks.T_key_cam = self._surfaces.fitted(
                    frame, vo, tracks.T_key_cam, tracks.exposures.lag, attempt.twist_per_s
                )
            new, observations = self._continue_from(frame, attempt)
            return TrackResult(vo, observations, new, departure.parallax_px, reason, others=attempt.others)
        good = attempt.estimate.inliers
        observations = tracks.observations(good, attempt.pixels, attempt.xy)
        tracks.judge(good)
        weakness = self._weakness(attempt)
        return TrackResult(vo, observations, None, departure.parallax_px, weakness, others=attempt.others)

    # -- what it is made of ------------------------------------------------------------------------------------------

    def _weakness(self, attempt: Attempt) -> str:
        """Return why the tracking is degraded, or an empty string."""
        if self._tracks.view.is_swapped:
            return "cam0 sees nothing; cam1 is followed"
        if self._tracks.lacks_depth:
            return "the keyframe has no depth of its own"
        return weakness(attempt.followed, attempt.inliers, DEGRADED_INLIERS)

    def _measurement(self, frame: Frame, keyframe_id: int, attempt: Attempt) -> VoMeasurement:
        covariance = self._placer.covariance(attempt, self._noise.frame_px, frame.tracks is not None)
        return metric_motion(
            frame.t_ns, keyframe_id, attempt.estimate.T_key_cam, covariance, self._tracks.view.T_body_cam,
            attempt.inliers, is_weak=bool(self._weakness(attempt)),
        )  # fmt: skip

    def _lose(self, frame: Frame, attempt: Attempt, T_guess: Array) -> TrackResult:
        self._tracks.T_key_cam = T_guess
        self._lost = True
        view = self._tracks.view
        if self._life.is_given_up(frame.t_ns) and view.depth.available(frame):
            return self._start(view.of(frame), attempt.failure)
        return self._life.lost(frame.t_ns, attempt.failure, attempt.inliers)

    def _place_by_depth(self, frame: Frame, keyframe: Keyframe, attempt: Attempt, moved: Moved) -> TrackResult | None:
        """Return the result of a frame that only its depth image places; None where that does not either."""
        tracks = self._tracks
        placed = None if self._by_depth is None else self._by_depth.place(frame, keyframe, moved, len(tracks))
        if placed is None:
            return None
        tracks.moved(placed.T_key_cam, moved.dt_s, self._lost)
        self._lost = False
        self._life.placed_without_vision(frame.t_ns)
        vo = placed.motion(frame.t_ns, keyframe.id, tracks.view.T_body_cam)
        reason = f"{placed.reason or 'placed by depth alone'}: {attempt.failure}"
        if not placed.reason:
            return TrackResult(vo, no_observations(), None, 0.0, reason, by_depth=True)
        none = replace(attempt.estimate, inliers=np.zeros(len(attempt.xy), dtype=np.bool_))
        twist_per_s = se3_log(invert(moved.T_before) @ placed.T_key_cam) / moved.dt_s
        new, observations = self._continue_from(frame, replace(attempt, estimate=none, twist_per_s=twist_per_s))
        return TrackResult(vo, observations, new, 0.0, reason, by_depth=True)

    def _leave_blindness(
        self, blind: BlindKeyframe, frame: Frame, keyframe: Keyframe, T_guess: Array, dt_s: float, has_imu: bool
    ) -> TrackResult:
        """Follow a first keyframe that has no depth until a frame comes that has: then place it by its own depth."""
        tracks = self._tracks
        T_step = invert(tracks.T_key_cam) @ T_guess
        pixels = tracks.tracker.follow(frame, blind.expected(T_step))
        if not tracks.view.depth.available(frame):
            turned = blind.turn(frame, keyframe, pixels, T_guess)
            # with an IMU, filter and graph begin with what has scale, and know the turn
            is_lost = turned is None or has_imu
            tracks.moved(T_guess if turned is None else turned[0], dt_s, is_lost)
            return self._life.lost(frame.t_ns, NO_DEPTH) if turned is None or has_imu else turned[1]
        attempt = self._placer.from_blindness(blind, frame, pixels, se3_log(T_step) / dt_s)
        if attempt is None:
            return self._start(frame, "the first keyframe, which had no depth, is out of sight")
        if attempt.failure:
            return self._start(frame, attempt.failure)
        tracks.T_key_cam = attempt.estimate.T_key_cam
        # followed for long, through a rolling shutter of which nothing was known: true, but not to the millimetre
        vo = replace(self._measurement(frame, keyframe.id, attempt), tracking=Tracking.DEGRADED)
        parallax_px = tracks.camera.fx * attempt.parallax(tracks.landmarks.mean[:, :2])
        new, observations = self._continue_from(frame, attempt)
        self._blind = None
        return TrackResult(vo, observations, new, parallax_px, "the first depth")

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def _start(self, whole: Frame, why: str) -> TrackResult:
        """Begin again with this frame as keyframe, if there is enough to see in it."""
        tracks = self._tracks
        tracks.look_through(self._usual)
        twist_per_s, self._twist_per_s = self._twist_per_s, np.zeros(6)
        observations = tracks.begin(whole, twist_per_s)
        has_depth, count = self._usual.depth.available(whole), len(tracks)
        lack = self._lack(whole, has_depth)
        if lack:
            tracks.forget()
            return self._life.refused(whole.t_ns, why, lack)
        tracks.predictor.forget(twist_per_s)
        self._lost = tracks.lacks_depth = False
        self._blind = None if has_depth else BlindKeyframe(self._config, self._usual, tracks.tracker.pixels)
        self._install(whole, twist_per_s, None)
        return self._life.started(observations, count, why)

    def _lack(self, frame: Frame, has_depth: bool) -> str:
        """Return what a frame lacks to start from, or an empty string; only the very first may be without depth."""
        corners, deep = len(self._tracks), int(self._tracks.landmarks.known.sum())
        if corners < MIN_START_CORNERS:
            return too_few(frame, corners)
        if deep < self._config.min_inliers and (self._life.keyframe is not None or has_depth):
            return f"only {deep} of {corners} corners have depth"
        return ""

    def _continue_from(self, frame: Frame, attempt: Attempt) -> tuple[Keyframe, Observations]:
        """Make a frame the keyframe, with the tracks that agree and new ones."""
        observations = self._tracks.carry_on(frame, attempt)
        return self._install(frame, attempt.twist_per_s, self._tracks.T_key_cam), observations

    def _install(self, frame: Frame, twist_per_s: Array, T_key_new: Array | None) -> Keyframe:
        whole, usual, tracks = self._tracks.view.of(frame), self._usual, self._tracks
        exposed = tracks.exposed(whole, twist_per_s)
        keyframe = self._life.install(whole, usual.camera, usual.T_body_cam, len(tracks), exposed)
        if self._surfaces is not None:
            self._surfaces.add(keyframe, T_key_new)
        tracks.anchor(twist_per_s)
        self._second.take_keyframe()
        return keyframe

    # -- what is known -----------------------------------------------------------------------------------------------

    def begin_at(self, keyframe_id: int, learned: Learned, seeks_place: bool = False) -> None:
        """See FrontEnd.begin_at."""
        self._life.begin_at(keyframe_id, seeks_place)
        self._tracks.tracker.next_id = learned.next_track_id
        self._tracks.exposures.start_at(learned)
        if learned.habits is not None:
            self._twist_per_s = learned.habits[:6]
            self._noise.start_at(learned.habits[6:8])

    @property
    def learned(self) -> Learned:
        """See FrontEnd.learned."""
        learned = self._tracks.exposures.learned(self._tracks.tracker.next_id, self._usual.depth.every_frame)
        exposures = self._tracks.exposures
        twist_per_s = np.zeros(6) if self._tracks.view.is_swapped else exposures.key_twist_per_s
        known = [*self._noise.memory, exposures.shutter.information, *exposures.lag.information]
        return replace(learned, habits=np.array([*twist_per_s, *known]))

    @classmethod
    def errors(cls, config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> CommonErrors:
        """Return that of the baseline or of the unit of depth; covariances have the others."""
        return CommonErrors(rig.metres_sigma)


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
