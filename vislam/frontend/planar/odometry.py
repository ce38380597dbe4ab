"""Visual odometry of a cart by the floor: one camera at a known height gives motion in metres.

Corners are followed from the keyframe; those that lie on the floor fit a motion in the plane (`fit`), with a
tilt from gyroscope and floor (`floor`). The rest, on walls and furniture, is triangulated along the way and
kept for those who want tracks (`tracks`). It never fails silently: too little texture, points of the floor in
too few parts of the image, residuals that nothing explains, or a yaw that the gyroscope contradicts make a frame
degraded or lost (`place`).

Method `split` is that of Karpov 2026: Harris corners in regions, rotation from above the horizon, translation from
below it at the calibrated tilt, a base frame a few frames old, and new corners as soon as a region runs dry.
"""

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import Learned
from vislam.core.messages import Array, Bools, Frame, ImuSpan, Keyframe, Observations
from vislam.frontend.intake import Intake
from vislam.frontend.keyframes import PATIENCE_S, Exposed, KeyframeLife, keyframe_reason
from vislam.frontend.planar.fit import Fit, FloorPair, camera_motion, joint_fit, no_fit, split_fit
from vislam.frontend.planar.floor import Mount, Regions, Tilt, make_mount
from vislam.frontend.planar.floor_tracks import FloorTracks, Steps
from vislam.frontend.planar.place import (
    MIN_CELLS,
    MIN_POINTS,
    STAMP_JITTER_S,
    Course,
    Place,
    by_jitter,
    by_tilt,
    failure,
    weakness,
    yaw_prior,
)
from vislam.frontend.result import CommonErrors, TrackResult, metric_motion, too_few
from vislam.frontend.tracker import MAX_BACK_PX, MIN_START_CORNERS
from vislam.vision.landmarks import move
from vislam.vision.two_view import from_epipolar_segment

_HISTORY_FRAMES = 8  # method split: a base frame is at most so old
_EPIPOLAR_PX = 3.0  # of a track off the floor that agrees with the motion
_FEW = 6  # points in a region, method split: below, it has run dry


class PlanarFrontEnd:
    """Frame-to-keyframe odometry on a plane, metric by the height of the camera above it."""

    mode = "planar"
    knows_scale = True

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take the rig's first camera; raises UsageError where its height above the floor is not known."""
        self.keyframe_spacing = 1.0
        self._config, self._planar = config, config.planar
        self._camera = rig.cameras[0]
        self._T_body_cam = rig.T_body_cams[0]
        mount = make_mount(self._planar, np.ascontiguousarray(self._T_body_cam[:3, :3]))
        self._height_m = mount.height_m
        self._tilt = Tilt(self._planar, mount)
        self._regions = Regions(self._planar, self._camera, mount)
        self._tracks = FloorTracks(config, self._camera, self._regions, mount.height_m)
        self._course = Course(PATIENCE_S)
        self._steps = Steps(MAX_BACK_PX)  # method split
        self._is_split = self._planar.method == "split"
        self._intake = Intake(rig, seed)
        self._seed = seed
        self._life = KeyframeLife(config, has_scale=True)  # its tracks are points on the floor
        self._frames_since_keyframe = 0
        self._R_key: Array = np.eye(3)  # level frame from cam0, in the keyframe

    @classmethod
    def errors(cls, config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> CommonErrors:
        """Return that of the camera's height, by which all metres come, and the inflation over a floor."""
        floor = config.planar
        return CommonErrors(
            0.0 if floor.height_m is None else floor.height_sigma_m / floor.height_m, floor.vo_inflation
        )

    @property
    def mount(self) -> Mount:
        """The camera's height and tilt, as the floor has corrected them."""
        return self._tilt.mount

    @property
    def calibration(self) -> dict[str, float]:
        """What is believed of the mount, with standard deviations; the height is as it was given."""
        mount, sigma_deg = self.mount, np.rad2deg(np.sqrt(np.diag(self._tilt.covariance)))
        return {
            "height_m": mount.height_m,
            "height_sigma_m": self._planar.height_sigma_m,
            "tilt_deg": mount.tilt_deg,
            "tilt_sigma_deg": float(sigma_deg[1]),
            "roll_deg": mount.roll_deg,
            "roll_sigma_deg": float(sigma_deg[0]),
        }

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """Place `frame` relative to the last keyframe; see FrontEnd.track."""
        frame, dt_s = self._intake.accept(frame)
        turn = self._tilt.advance(dt_s, None if self._is_split else imu, gyro_sigma_rad_s)
        if self._life.keyframe is None:
            return self._start(frame, "")
        self._frames_since_keyframe += 1
        guess = self._course.predicted(turn, dt_s, gyro_sigma_rad_s)
        place = self._locate(frame, guess)
        if place.failure:
            self._course.lose(guess)
            return self._lose(frame, place)
        self._course.follow(place.fit.motion, dt_s)
        self._life.placed(frame.t_ns)
        return self._report(frame, place)

    def begin_at(self, keyframe_id: int, learned: Learned, seeks_place: bool = False) -> None:
        """See FrontEnd.begin_at."""
        self._life.begin_at(keyframe_id, seeks_place)
        self._tracks.tracker.next_id = learned.next_track_id
        if learned.tilt is not None:
            self._tilt.start_at(learned.tilt[:2], learned.tilt[2:].reshape(2, 2))

    @property
    def learned(self) -> Learned:
        """See FrontEnd.learned."""
        tilt = np.concatenate([self._tilt.mean, self._tilt.covariance.ravel()])
        return Learned(self._tracks.tracker.next_id, tilt=None if self._is_split else tilt)

    # -- placing one frame -------------------------------------------------------------------------------------------

    def _locate(self, frame: Frame, guess: Array) -> Place:
        tracks, R_now = self._tracks, self._tilt.R_level_cam
        T_guess = _camera_pose(guess, self._R_key, R_now)
        expected, _ = move(tracks.landmarks.mean, tracks.landmarks.covariance, T_guess)
        where = self._camera.project(np.column_stack([expected[:, :2], np.ones(len(expected))]))
        pixels = self._steps.follow(frame) if self._is_split else self._warped(frame, where, T_guess)
        xy = self._camera.normalise(pixels)
        pair = FloorPair(tracks.rays, xy, self._R_key, R_now, self._height_m, tracks.px)
        use = tracks.usable(pair)
        fit = self._split(pair, use, frame) if self._is_split else self._joint(pair, use, guess, frame)
        return self._placed(pixels, xy, fit, use, pair)

    def _warped(self, frame: Frame, where: Array, T_guess: Array) -> Array:
        """Follow from the keyframe, the floor as it should look from here."""
        up = self._R_key[2]
        over_floor = T_guess[:3, :3].T @ (np.eye(3) + np.outer(T_guess[:3, 3], up) / self._height_m)
        K = self._camera.K
        H = K @ over_floor @ np.linalg.inv(K)
        return self._tracks.tracker.follow_warped(frame, where, self._tracks.candidates, H)

    def _split(self, pair: FloorPair, use: Bools, frame: Frame) -> Fit:
        with np.errstate(invalid="ignore"):
            above = (self._tracks.pixels[:, 1] < self._regions.horizon_px) & np.isfinite(pair.seen[:, 0])
        prior = self._tilt_prior()
        return split_fit(
            pair, use, above, self._planar.sigma_px, prior, self._planar.heave_m, _FEW, self._frame_seed(frame)
        )

    def _joint(self, pair: FloorPair, use: Bools, guess: Array, frame: Frame) -> Fit:
        """Fit from the motion that most points agree on; the gyroscope's yaw counts as far as it is known."""
        if np.count_nonzero(use) < MIN_POINTS:
            reason = f"only {np.count_nonzero(use)} points on the floor found"
            return no_fit(guess, len(use), reason)
        course, planar = self._course, self._planar
        start = pair.searched(use, course.yaw_rad if course.knows_yaw else None, self._frame_seed(frame))
        yaw = yaw_prior(course)
        return joint_fit(
            pair, use, start, planar.sigma_px, self._config.cauchy, self._tilt_prior(), planar.heave_m, yaw
        )

    def _tilt_prior(self) -> Array:
        """Return the covariance [4, 4] of the tilt error that both images share and of what the newer has beside it."""
        sway = self._tilt.sway_sigma_rad**2
        prior = np.zeros((4, 4))
        prior[:2, :2] = self._tilt.covariance + sway * np.eye(2)
        prior[2:, 2:] = 2.0 * sway * np.eye(2)
        return prior

    def _placed(self, pixels: Array, xy: Array, fit: Fit, use: Bools, pair: FloorPair) -> Place:
        candidates = int(np.count_nonzero(use))
        T, covariance = camera_motion(fit, pair.R_key, pair.R_now)
        why_not = failure(fit, candidates, self._course, self._planar)
        good, weak = fit.inliers.copy(), ""
        if not why_not:
            covariance = covariance + by_tilt(fit, T, self._tilt.covariance, self._planar)
            covariance += by_jitter(self._course.rate, pair.R_now, STAMP_JITTER_S)
            off_px = from_epipolar_segment(T, pair.rays, xy, 1.0 / self._config.min_depth_m) / pair.px
            with np.errstate(invalid="ignore"):
                good |= off_px < _EPIPOLAR_PX
            cells = int(np.count_nonzero(self._regions.counts(pixels[fit.inliers])))
            weak = weakness(fit, candidates, cells)
        return Place(T, covariance, fit, pixels, xy, candidates, good, why_not, weak)

    def _frame_seed(self, frame: Frame) -> int:
        return (self._seed * 1_000_003 + frame.index) % 2**31

    # -- what comes of it --------------------------------------------------------------------------------------------

    def _report(self, frame: Frame, place: Place) -> TrackResult:
        self._tracks.judge_floor(place.fit.inliers, place.xy)
        parallax_px = self._parallax_px(place)
        departure = self._life.departure(
            frame.t_ns, place.T_key_cam[:3, :3], parallax_px, place.agreeing, place.agreeing
        )
        reason = (
            self._ran_dry(place) if self._is_split else keyframe_reason(departure, self._config, self.keyframe_spacing)
        )
        vo = metric_motion(
            frame.t_ns, self._life.newest_id, place.T_key_cam, place.covariance, self._T_body_cam, place.agreeing,
            is_weak=bool(place.weakness),
        )  # fmt: skip
        if reason:
            new, observations = self._continue_from(frame, place)
            return TrackResult(vo, observations, new, parallax_px, reason)
        observations = self._tracks.observed(place.good, place.pixels, self._tilt.R_level_cam)
        self._steps.keep(self._tracks.judge(place.good))
        return TrackResult(vo, observations, None, parallax_px, place.weakness)

    def _ran_dry(self, place: Place) -> str:
        """Return why method split needs new corners, or an empty string."""
        if self._frames_since_keyframe >= _HISTORY_FRAMES:
            return f"{self._frames_since_keyframe} frames since the last base"
        found = place.pixels[place.good]
        if np.count_nonzero(self._regions.counts(found) < _FEW) > len(self._regions.floor) - MIN_CELLS:
            return "regions of the floor have run dry"
        if np.count_nonzero(self._regions.counts_above(found) < _FEW) > len(self._regions.above) // 2:
            return "regions above the horizon have run dry"
        return ""

    def _parallax_px(self, place: Place) -> float:
        on = place.fit.inliers
        turned = np.column_stack([place.xy[on], np.ones(int(on.sum()))]) @ place.T_key_cam[:3, :3].T
        moved = turned[:, :2] / turned[:, 2:] - self._tracks.rays[on]
        return float(np.median(np.linalg.norm(moved, axis=1)) / self._tracks.px)

    def _lose(self, frame: Frame, place: Place) -> TrackResult:
        if self._life.is_given_up(frame.t_ns):
            return self._start(frame, place.failure)
        return self._life.lost(frame.t_ns, place.failure, place.agreeing)

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def _start(self, frame: Frame, why: str) -> TrackResult:
        """Begin again with this frame as keyframe, if there is enough of the floor to see in it."""
        count = self._tracks.begin(frame, self._tilt.R_level_cam)
        lack = self._lack(frame)
        if lack:
            self._tracks.forget()
            return self._life.refused(frame.t_ns, why, lack)
        self._install(frame)
        self._course.begin(at_rest=True)
        return self._life.started(self._seen(), count, why)

    def _lack(self, frame: Frame) -> str:
        """Return what a frame lacks to start from, or an empty string."""
        if not frame.images:
            return "planar odometry needs images"
        if len(self._tracks) < MIN_START_CORNERS:
            return too_few(frame, len(self._tracks))
        floor = self._tracks.on_floor(self._tilt.R_level_cam)
        cells = int(np.count_nonzero(self._regions.counts(self._tracks.pixels[floor])))
        if np.count_nonzero(floor) < MIN_POINTS or cells < MIN_CELLS:
            return f"too little texture on the floor: {np.count_nonzero(floor)} corners in {cells} of 8 parts of it"
        return ""

    def _continue_from(self, frame: Frame, place: Place) -> tuple[Keyframe, Observations]:
        """Make the frame a keyframe: learn the tilt, carry tracks on, fill the gaps."""
        if not self._is_split:
            prior = self._tilt_prior()[:2, :2]
            self._tilt.learn(place.fit.tilt[:2], place.fit.covariance[3:5, 3:5], prior)
        R = self._tilt.R_level_cam
        self._tracks.continue_in(frame, place.good, place.pixels, place.xy, place.T_key_cam, R)
        keyframe = self._install(frame)
        self._course.begin()
        return keyframe, self._seen()

    def _seen(self) -> Observations:
        """Return all tracks as the new keyframe sees them."""
        every = np.ones(len(self._tracks), dtype=np.bool_)
        return self._tracks.observed(every, self._tracks.pixels, self._R_key)

    def _install(self, frame: Frame) -> Keyframe:
        self._R_key = self._tilt.R_level_cam
        self._tracks.install(self._R_key)
        on_floor = int(np.count_nonzero(self._tracks.candidates))
        keyframe = self._life.install(frame, self._camera, self._T_body_cam, on_floor, Exposed(self._measure_depth))
        self._steps.begin(frame, self._tracks.pixels)
        self._frames_since_keyframe = 0
        return keyframe

    def _measure_depth(self, pixels: Array, ids: NDArray[np.int64] | None) -> Array:
        """Return the z-depth [N] of features of the newest keyframe, NaN where unknown."""
        return self._tracks.depth_m(pixels, self._tilt.R_level_cam)


def _camera_pose(motion: Array, R_key: Array, R_now: Array) -> Array:
    """Return T_key_now [4, 4] of cam0 for a motion [3] of the level frame."""
    c, s = np.cos(motion[0]), np.sin(motion[0])
    T = np.eye(4)
    T[:3, :3] = R_key.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R_now
    T[:3, 3] = R_key.T @ np.array([motion[1], motion[2], 0.0])
    return T
