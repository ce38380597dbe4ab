"""Visual odometry of a cart by the floor: one camera at a known height gives motion in metres.

Corners are followed from the keyframe; those that lie on the floor fit a motion in the plane (`planar_fit`), with a
tilt that gyroscope and floor tell (`planar_floor`). The rest, on walls and furniture, is triangulated along the way and
kept for those who want tracks. It never fails silently: too little texture, points of the floor in too few parts of the
image, residuals that nothing explains, or a yaw that the gyroscope contradicts make a frame degraded or lost.

Method `split` is that of Karpov 2026: Harris corners in regions, rotation from above the horizon, translation from
below it at the calibrated tilt, a base frame a few frames old, and new corners as soon as a region runs dry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.camera import Rig
from vislam.config import FrontEndConfig
from vislam.features import FlowSettings, follow
from vislam.frontend.epipolar import from_epipolar_segment
from vislam.frontend.intake import Intake
from vislam.frontend.keyframes import Departure, keyframe_reason, make_keyframe
from vislam.frontend.landmarks import UNKNOWN_RHO, Landmarks, fuse, move
from vislam.frontend.planar_fit import Fit, FloorPair, camera_motion, joint_fit, no_fit, scale_sigma, split_fit
from vislam.frontend.planar_floor import Mount, Regions, Tilt, Turn, make_mount
from vislam.frontend.prediction import body_motion
from vislam.frontend.result import TrackResult, identity_motion, lost_motion, no_observations, too_few
from vislam.frontend.tracker import Tracker
from vislam.geometry import se3_adjoint, so3_log
from vislam.memory import FrontNews
from vislam.messages import Array, Frame, ImageU8, ImuSpan, Keyframe, Observations, Tracking, VoMeasurement

Bools = NDArray[np.bool_]

_GUESSED_RHO_SIGMA = 0.15  # 1/m, of a corner under the horizon, which is on the floor or on what stands there
_FUSE_GATE = 3.0  # standard deviations
_EPIPOLAR_PX = 3.0  # of a track off the floor that agrees with the motion
_GYRO_KNOWN_ALREADY = 3.0  # on its sigma, since filter and graph use the same gyroscope
_LENS_YAW_RAD = 0.001  # of a yaw between keyframe and frame by the gyroscope: scale, axes, time
_DEGRADED_VARIANCE = 25.0  # of residuals over what is expected: five times as noisy as a sharp floor
_FEW = 6  # points in a region, method split: below, it has run dry
_NEAR_PX = 12.0  # of a track, within which a feature lies on the same surface
_SCALE_BY_TILT = 2.9  # per rad: half a degree of tilt is 2.5 % of the way
_UNEXPLAINED_RATIO = 0.3  # of the points that should be on the floor; fewer agree, and something else moves


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Where a frame is relative to the keyframe."""

    T_key_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of the camera's motion
    fit: Fit
    pixels: Array  # [N, 2] of all tracks, NaN where not found
    xy: Array  # [N, 2] on z = 1
    candidates: int  # tracks that should be on the floor
    good: Bools  # [N] tracks that agree with the motion, on the floor or off it
    failure: str
    weakness: str


class PlanarFrontEnd:
    """Frame-to-keyframe odometry on a plane, metric by the height of the camera above it."""

    mode = "planar"

    def __init__(self, config: FrontEndConfig, rig: Rig, seed: int) -> None:
        """Take the rig's first camera; raises UsageError where its height above the floor is not known."""
        self.keyframe_spacing = 1.0
        self._config, self._planar = config, config.planar
        self._camera = rig.cameras[0]
        self._T_body_cam = rig.T_body_cams[0]
        self._px = 2.0 / (self._camera.fx + self._camera.fy)
        mount = make_mount(self._planar, np.ascontiguousarray(self._T_body_cam[:3, :3]))
        self._height_m = mount.height_m
        self._max_distance_m = self._planar.max_distance_heights * mount.height_m
        self._tilt = Tilt(self._planar, mount)
        self._regions = Regions(self._planar, self._camera, mount)
        self._intake = Intake(rig, seed)
        self._seed = seed
        self._is_split = self._planar.method == "split"
        self._tracker = Tracker(replace(config, max_tracks=self._planar.max_tracks), self._find)
        self._landmarks = Landmarks()
        self._off_floor: Bools = np.zeros(0, dtype=np.bool_)  # tracks that are seen not to lie on the floor
        self._confirmed: Bools = np.zeros(0, dtype=np.bool_)  # tracks that moved as the floor does
        self._floor_candidates: Bools = np.zeros(0, dtype=np.bool_)  # tracks that lie where the floor should be
        self._last_image: ImageU8 | None = None  # method split: of the frame before ...
        self._last_px: Array = np.empty((0, 2))  # ... and where its tracks were
        self._keyframe: Keyframe | None = None
        self._since_restart = config.restart_keyframes  # keyframes; that many: long ago
        self._first_id = 0
        self._keyframe_floor = 0  # points on the floor with which the keyframe began
        self._frames_since_keyframe = 0
        self._R_key: Array = np.eye(3)  # level frame from cam0, in the keyframe
        self._motion: Array = np.zeros(3)  # of the last frame since the keyframe, predicted while lost
        self._rate: Array = np.zeros(3)  # per second, in the level frame of the frame it leads to
        self._yaw_rad, self._yaw_sigma_rad = 0.0, 0.0  # since the keyframe by the gyroscope; sigma infinite: not known
        self._t_placed_ns = -1
        self._lost = False

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
        if self._keyframe is None:
            return self._start(frame, "")
        self._frames_since_keyframe += 1
        guess = self._predicted(turn, dt_s, gyro_sigma_rad_s)
        place = self._locate(frame, guess)
        if place.failure:
            self._motion = guess
            return self._lose(frame, self._keyframe, place)
        self._follow(guess, place.fit.motion, dt_s)
        self._t_placed_ns = frame.t_ns
        return self._report(frame, self._keyframe, place)

    def begin_at(self, keyframe_id: int, news: FrontNews, seeks_place: bool = False) -> None:
        """See FrontEnd.begin_at."""
        self._first_id, self._tracker.next_id = keyframe_id, news.next_track_id
        if seeks_place:
            self._since_restart = 0
        if news.tilt is not None:
            self._tilt.start_at(news.tilt[:2], news.tilt[2:].reshape(2, 2))

    @property
    def news(self) -> FrontNews:
        """See FrontEnd.news."""
        tilt = np.concatenate([self._tilt.mean, self._tilt.covariance.ravel()])
        return FrontNews(self._tracker.next_id, tilt=None if self._is_split else tilt)

    # -- placing one frame -------------------------------------------------------------------------------------------

    def _predicted(self, turn: Turn, dt_s: float, gyro_sigma_rad_s: float) -> Array:
        """Return the motion [3] since the keyframe that is expected, and add up what the gyroscope says of the yaw."""
        if turn.known:
            self._yaw_rad += turn.yaw_rad
            self._yaw_sigma_rad += gyro_sigma_rad_s * dt_s
        else:
            self._yaw_sigma_rad = np.inf
        rate = self._rate if dt_s <= self._config.patience_s else np.zeros(3)
        yaw = turn.yaw_rad if turn.known else float(rate[0] * dt_s)
        return _composed(self._motion, np.array([yaw, rate[1] * dt_s, rate[2] * dt_s]))

    def _follow(self, guess: Array, found: Array, dt_s: float) -> None:
        """Take note of the velocity that leads to the motion found."""
        step = _between(self._motion, found)
        self._rate = step / dt_s if not self._lost else np.zeros(3)
        self._motion, self._lost = found.copy(), False

    def _locate(self, frame: Frame, guess: Array) -> _Place:
        R_now = self._tilt.R_level_cam
        T_guess = _camera_pose(guess, self._R_key, R_now)
        expected, _ = move(self._landmarks.mean, self._landmarks.covariance, T_guess)
        where = self._camera.project(np.column_stack([expected[:, :2], np.ones(len(expected))]))
        pixels = self._step(frame) if self._is_split else self._warped(frame, where, T_guess)
        xy = self._camera.normalise(pixels)
        pair = FloorPair(self._landmarks.mean[:, :2], xy, self._R_key, R_now, self._height_m, self._px)
        use = pair.usable(self._max_distance_m) & ~self._off_floor
        if self._is_split:
            return self._placed(pixels, xy, self._split(pair, use, frame), use, pair)
        return self._placed(pixels, xy, self._joint(pair, use, guess, frame), use, pair)

    def _warped(self, frame: Frame, where: Array, T_guess: Array) -> Array:
        """Follow from the keyframe, the floor as it should look from here."""
        up = self._R_key[2]
        over_floor = T_guess[:3, :3].T @ (np.eye(3) + np.outer(T_guess[:3, 3], up) / self._height_m)
        K = self._camera.K
        return self._tracker.follow_warped(frame, where, self._floor_candidates, K @ over_floor @ np.linalg.inv(K))

    def _step(self, frame: Frame) -> Array:
        """Follow from the frame before, as the paper does; what is lost stays lost until the next base."""
        if self._last_image is None or not frame.images:
            return np.full((len(self._tracker), 2), np.nan)
        flow = FlowSettings(max_back_px=self._config.max_back_px)
        pixels = follow(self._last_image, frame.images[0], self._last_px, self._last_px, flow)[0]
        self._last_image, self._last_px = frame.images[0], pixels
        return pixels

    def _split(self, pair: FloorPair, use: Bools, frame: Frame) -> Fit:
        with np.errstate(invalid="ignore"):
            above = (self._tracker.pixels[:, 1] < self._regions.horizon_px) & np.isfinite(pair.seen[:, 0])
        prior = self._tilt_prior()
        return split_fit(
            pair, use, above, self._planar.sigma_px, prior, self._planar.heave_m, _FEW, self._frame_seed(frame)
        )

    def _joint(self, pair: FloorPair, use: Bools, guess: Array, frame: Frame) -> Fit:
        """Fit from the motion that most points agree on; the gyroscope's yaw counts as far as it is known."""
        if np.count_nonzero(use) < self._planar.min_points:
            reason = f"only {np.count_nonzero(use)} points on the floor found"
            return no_fit(guess, len(use), reason)
        known = bool(np.isfinite(self._yaw_sigma_rad))
        start = pair.searched(use, self._yaw_rad if known else None, self._frame_seed(frame))
        planar = self._planar
        return joint_fit(
            pair, use, start, planar.sigma_px, self._config.cauchy, self._tilt_prior(), planar.heave_m, self._yaw()
        )

    def _yaw(self) -> tuple[float, float] | None:
        if not np.isfinite(self._yaw_sigma_rad):
            return None
        return self._yaw_rad, _GYRO_KNOWN_ALREADY * (_LENS_YAW_RAD + self._yaw_sigma_rad)

    def _tilt_prior(self) -> Array:
        """Return the covariance [4, 4] of the tilt error that both images share and of what the newer has beside it."""
        sway = self._tilt.sway_sigma_rad**2
        prior = np.zeros((4, 4))
        prior[:2, :2] = self._tilt.covariance + sway * np.eye(2)
        prior[2:, 2:] = 2.0 * sway * np.eye(2)
        return prior

    def _placed(self, pixels: Array, xy: Array, fit: Fit, use: Bools, pair: FloorPair) -> _Place:
        candidates = int(np.count_nonzero(use))
        T, covariance = camera_motion(fit, pair.R_key, pair.R_now)
        failure = fit.failure or self._failure(fit, candidates)
        good = fit.inliers.copy()
        if not failure:
            covariance = covariance + self._lasting(fit, T) + self._jitter(pair.R_now)
            off_px = from_epipolar_segment(T, pair.rays, xy, 1.0 / self._config.min_depth_m) / self._px
            with np.errstate(invalid="ignore"):
                good |= off_px < _EPIPOLAR_PX
        weakness = "" if failure else self._weakness(fit, candidates, pixels)
        return _Place(T, covariance, fit, pixels, xy, candidates, good, failure, weakness)

    def _lasting(self, fit: Fit, T_key_cam: Array) -> Array:
        """Return the covariance [6, 6] by which errors of height and tilt, which last, exceed those of each motion.

        Their share of the way adds up over `correlation_m`, while a filter takes errors of motions for independent.
        """
        way = T_key_cam[:3, :3].T @ T_key_cam[:3, 3]
        length = float(np.linalg.norm(way))
        if length < 1e-6:
            return np.zeros((6, 6))
        planar = self._planar
        relative = planar.height_sigma_m / self._height_m
        if self._is_split:
            relative = float(np.hypot(relative, _SCALE_BY_TILT * np.sqrt(self._tilt.covariance[1, 1])))
        else:
            relative = scale_sigma(fit, relative, self._tilt.covariance)
        out = np.zeros((6, 6))
        out[3:, 3:] = relative**2 * max(length, planar.correlation_m) / length * np.outer(way, way)
        return out

    def _jitter(self, R_now: Array) -> Array:
        """Return the covariance [6, 6] of a motion whose ends were stamped a little early or late, at this speed."""
        turning, moving = R_now[2] * self._rate[0], self._rate[1:] @ R_now[:2]
        step = np.concatenate([turning, moving]) * self._planar.stamp_jitter_s
        return 2.0 * np.outer(step, step)

    def _failure(self, fit: Fit, candidates: int) -> str:
        agree = int(np.count_nonzero(fit.inliers))
        if agree < self._planar.min_points and not self._is_split:
            return f"only {agree} of {candidates} points on the floor agree on a motion"
        if agree < _UNEXPLAINED_RATIO * candidates:
            return f"only {agree} of {candidates} points that should be on the floor agree on a motion"
        if self._is_split or not np.isfinite(self._yaw_sigma_rad):
            return ""
        # the prior pulls: what is left of a contradiction is the smaller, the weaker the floor is
        limit = max(
            self._planar.yaw_gate_sigmas * np.hypot(np.sqrt(fit.covariance[0, 0]), _LENS_YAW_RAD + self._yaw_sigma_rad),
            np.deg2rad(self._planar.yaw_gate_deg),
        )
        off = abs(float(fit.motion[0]) - self._yaw_rad)
        if off > limit:
            return f"the floor turned by {np.rad2deg(off):.2f} deg more or less than the gyroscope says"
        return ""

    def _weakness(self, fit: Fit, candidates: int, pixels: Array) -> str:
        """Return why the tracking is degraded, or an empty string."""
        agree = int(np.count_nonzero(fit.inliers))
        cells = int(np.count_nonzero(self._regions.counts(pixels[fit.inliers])))
        if cells < self._planar.min_cells:
            return f"points on the floor in only {cells} of 8 parts of the image"
        if agree < self._config.degraded_inliers:
            return f"only {agree} points on the floor agree"
        if agree < self._config.degraded_inlier_ratio * candidates:
            return f"only {agree} of {candidates} points that should be on the floor agree"
        if fit.variance > _DEGRADED_VARIANCE:
            return f"points on the floor are {np.sqrt(fit.variance):.0f} times as noisy as expected"
        return ""

    def _frame_seed(self, frame: Frame) -> int:
        return (self._seed * 1_000_003 + frame.index) % 2**31

    # -- what comes of it --------------------------------------------------------------------------------------------

    def _report(self, frame: Frame, keyframe: Keyframe, place: _Place) -> TrackResult:
        floor = int(np.count_nonzero(place.fit.inliers))
        self._judge_floor(place)
        parallax_px = self._parallax_px(place)
        departure = Departure(
            dt_s=(frame.t_ns - keyframe.t_ns) * 1e-9,
            rotation_rad=float(np.linalg.norm(so3_log(np.ascontiguousarray(place.T_key_cam[:3, :3])))),
            parallax_px=parallax_px,
            alive=floor / max(self._keyframe_floor, 1),
            inliers=floor,
            fit=True,
            restarted=self._since_restart < self._config.restart_keyframes,
        )
        reason = (
            self._ran_dry(place) if self._is_split else keyframe_reason(departure, self._config, self.keyframe_spacing)
        )
        vo = self._measurement(frame, keyframe.id, place)
        if reason:
            new, observations = self._continue_from(frame, place)
            return TrackResult(vo, observations, new, parallax_px, reason)
        observations = self._observed(place.good, place.pixels, place.T_key_cam)
        alive = self._tracker.judge(place.good)
        self._landmarks.keep(alive)
        self._off_floor, self._confirmed = self._off_floor[alive], self._confirmed[alive]
        self._floor_candidates, self._last_px = self._floor_candidates[alive], self._last_px[alive]
        return TrackResult(vo, observations, None, parallax_px, place.weakness)

    def _ran_dry(self, place: _Place) -> str:
        """Return why method split needs new corners, or an empty string."""
        if self._frames_since_keyframe >= self._planar.history_frames:
            return f"{self._frames_since_keyframe} frames since the last base"
        found = place.pixels[place.good]
        if np.count_nonzero(self._regions.counts(found) < _FEW) > len(self._regions.floor) - self._planar.min_cells:
            return "regions of the floor have run dry"
        if np.count_nonzero(self._regions.counts_above(found) < _FEW) > len(self._regions.above) // 2:
            return "regions above the horizon have run dry"
        return ""

    def _judge_floor(self, place: _Place) -> None:
        """Take note which tracks move as the floor does, and which do not."""
        moved_px = np.linalg.norm(place.xy - self._landmarks.mean[:, :2], axis=1) / self._px
        with np.errstate(invalid="ignore"):
            telling = moved_px > _EPIPOLAR_PX  # less, and anything fits
        self._confirmed |= place.fit.inliers & telling
        below = np.isfinite(place.xy[:, 0]) & ~place.fit.inliers & telling & ~self._confirmed
        self._off_floor |= below
        self._floor_candidates = self._floor_candidates & ~self._off_floor

    def _measurement(self, frame: Frame, keyframe_id: int, place: _Place) -> VoMeasurement:
        adjoint = se3_adjoint(self._T_body_cam)
        covariance = adjoint @ place.covariance @ adjoint.T
        return VoMeasurement(
            t_ns=frame.t_ns,
            keyframe_id=keyframe_id,
            T_keyframe_body=body_motion(place.T_key_cam, self._T_body_cam),
            covariance=0.5 * (covariance + covariance.T),
            has_scale=True,
            tracking=Tracking.DEGRADED if place.weakness else Tracking.OK,
            inliers=int(np.count_nonzero(place.fit.inliers)),
        )

    def _parallax_px(self, place: _Place) -> float:
        on = place.fit.inliers
        turned = np.column_stack([place.xy[on], np.ones(int(on.sum()))]) @ place.T_key_cam[:3, :3].T
        moved = turned[:, :2] / turned[:, 2:] - self._landmarks.mean[on, :2]
        return float(np.median(np.linalg.norm(moved, axis=1)) / self._px)

    def _lose(self, frame: Frame, keyframe: Keyframe, place: _Place) -> TrackResult:
        self._lost = True
        if (frame.t_ns - self._t_placed_ns) * 1e-9 >= self._config.patience_s:
            return self._start(frame, place.failure)
        vo = lost_motion(frame.t_ns, keyframe.id, True, int(np.count_nonzero(place.fit.inliers)))
        return TrackResult(vo, no_observations(), None, 0.0, place.failure)

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def _start(self, frame: Frame, failure: str) -> TrackResult:
        """Begin anew with this frame as keyframe, if there is enough of the floor to see in it."""
        last_id = self._keyframe.id if self._keyframe is not None else -1
        self._forget()
        count = self._tracker.begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
        self._add_landmarks(count)
        lack = self._lack(frame)
        if lack:
            self._forget()
            vo = lost_motion(frame.t_ns, last_id, True)
            return TrackResult(vo, no_observations(), None, 0.0, f"{failure}; {lack}" if failure else lack)
        self._rate, self._lost = np.zeros(3), False
        keyframe = self._install(frame)
        observations = self._observed(np.ones(count, dtype=np.bool_), self._tracker.pixels, np.eye(4))
        if last_id < 0:
            vo = identity_motion(frame.t_ns, keyframe.id, True, count)
            return TrackResult(vo, observations, keyframe, 0.0, "first keyframe")
        self._since_restart = 0
        vo = lost_motion(frame.t_ns, last_id, True)
        return TrackResult(vo, observations, keyframe, 0.0, f"restarted: {failure}")

    def _forget(self) -> None:
        self._tracker.forget()
        self._landmarks = Landmarks()
        self._off_floor = self._confirmed = self._floor_candidates = np.zeros(0, dtype=np.bool_)

    def _lack(self, frame: Frame) -> str:
        """Return what a frame lacks to start from, or an empty string."""
        if not frame.images:
            return "planar odometry needs images"
        if len(self._tracker) < self._config.min_start_corners:
            return too_few(frame, len(self._tracker))
        floor = self._on_floor()
        cells = int(np.count_nonzero(self._regions.counts(self._tracker.pixels[floor])))
        if np.count_nonzero(floor) < self._planar.min_points or cells < self._planar.min_cells:
            return f"too little texture on the floor: {np.count_nonzero(floor)} corners in {cells} of 8 parts of it"
        return ""

    def _on_floor(self) -> Bools:
        """Return which tracks [N] of the keyframe lie where the floor should be."""
        rays, R = self._landmarks.mean[:, :2], self._tilt.R_level_cam
        pair = FloorPair(rays, rays, R, R, self._height_m, self._px)
        return pair.usable(self._max_distance_m) & ~self._off_floor

    def _continue_from(self, frame: Frame, place: _Place) -> tuple[Keyframe, Observations]:
        """Make the frame a keyframe: learn the tilt, carry tracks on, fill the gaps."""
        if not self._is_split:
            prior = self._tilt_prior()[:2, :2]
            self._tilt.learn(place.fit.tilt[:2], place.fit.covariance[3:5, 3:5], prior)
        kept = place.good
        moved = move(self._landmarks.mean[kept], self._landmarks.covariance[kept], place.T_key_cam)
        unknown, sigma_xy = np.full(int(kept.sum()), np.nan), self._planar.sigma_px * self._px
        landmarks = Landmarks()
        landmarks.mean, landmarks.covariance = fuse(*moved, place.xy[kept], unknown, sigma_xy, unknown, _FUSE_GATE)
        landmarks.mean[:, :2] = place.xy[kept]  # the patch that is followed from now on
        self._landmarks = landmarks
        self._off_floor, self._confirmed = self._off_floor[kept], self._confirmed[kept]
        count = self._tracker.begin(frame, kept, place.pixels)
        self._add_landmarks(count)
        keyframe = self._install(frame)
        return keyframe, self._observed(np.ones(len(self._tracker), dtype=np.bool_), self._tracker.pixels, np.eye(4))

    def _find(self, image: ImageU8, live: Array) -> Array:
        config = self._config
        if self._is_split:
            return self._regions.harris(image, live, config.min_distance_px)
        wanted = self._planar.max_tracks - len(live)
        return self._regions.shi_tomasi(
            image, live, wanted, config.cell_px, config.min_distance_px, config.min_corner_response
        )

    def _add_landmarks(self, count: int) -> None:
        """Give the tracker's last `count` corners landmarks: under the horizon on the floor, as a guess."""
        pixels = self._tracker.pixels[len(self._tracker) - count :]
        xy = self._camera.normalise(pixels)
        rho = self._floor_rho(xy)
        guessed: Array = np.where(np.isfinite(rho), rho, UNKNOWN_RHO)
        self._landmarks.append(xy, guessed, self._planar.sigma_px * self._px, np.full(count, np.nan))
        self._landmarks.covariance[len(self._landmarks) - count :, 2, 2] = (
            np.where(np.isfinite(rho), _GUESSED_RHO_SIGMA + 0.3 * guessed, 3.0 * UNKNOWN_RHO) ** 2
        )
        none = np.zeros(count, dtype=np.bool_)
        self._off_floor = np.concatenate([self._off_floor, none])
        self._confirmed = np.concatenate([self._confirmed, none])

    def _floor_rho(self, xy: Array) -> Array:
        """Return the inverse z-depth [N] in 1/m of the floor in directions [N, 2] of the newest frame; NaN above it."""
        down = -(np.column_stack([xy, np.ones(len(xy))]) @ self._tilt.R_level_cam[2])
        rho = down / self._height_m
        return np.where(rho * self._max_distance_m > 1.0, rho, np.nan)

    def _observed(self, which: Bools, pixels: Array, T_key_cam: Array) -> Observations:
        """Return the tracks `which` [N] at `pixels` [N, 2], with the depth of those known to be on the floor."""
        xy = self._camera.normalise(pixels[which])
        rho = np.where(self._confirmed[which] & ~self._off_floor[which], self._floor_rho(xy), np.nan)
        return Observations(self._tracker.ids[which].copy(), pixels[which].copy(), depth_m=1.0 / rho)

    def _install(self, frame: Frame) -> Keyframe:
        new_id = self._keyframe.id + 1 if self._keyframe is not None else self._first_id
        features = self._config.described_features
        keyframe = make_keyframe(new_id, frame, self._camera, self._T_body_cam, features, self._measure_depth)
        self._keyframe = keyframe
        self._since_restart += 1
        self._R_key = self._tilt.R_level_cam
        self._floor_candidates = self._on_floor()
        self._keyframe_floor = int(np.count_nonzero(self._floor_candidates))
        self._last_image, self._last_px = (frame.images[0] if frame.images else None), self._tracker.pixels.copy()
        self._frames_since_keyframe = 0
        self._motion = np.zeros(3)
        self._yaw_rad, self._yaw_sigma_rad = 0.0, 0.0
        self._t_placed_ns = frame.t_ns
        return keyframe

    def _measure_depth(self, pixels: Array, ids: NDArray[np.int64] | None) -> Array:
        """Return the z-depth [N] of features near tracks whose depth is known; NaN elsewhere."""
        depth: Array = np.full(len(pixels), np.nan)
        known = self._landmarks.known | (self._confirmed & ~self._off_floor)
        if not known.any() or len(pixels) == 0:
            return depth
        apart = np.linalg.norm(pixels[:, None] - self._tracker.pixels[known][None], axis=2)
        nearest = np.argmin(apart, axis=1)
        close = apart[np.arange(len(pixels)), nearest] < _NEAR_PX
        floor = (self._confirmed & ~self._off_floor)[known][nearest]
        rho = np.where(floor, self._floor_rho(self._camera.normalise(pixels)), self._landmarks.mean[known][nearest, 2])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(close & (rho > 1.0 / self._config.max_depth_m), 1.0 / rho, np.nan)


def _rotated(xy: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * xy[0] - s * xy[1], s * xy[0] + c * xy[1]])


def _composed(motion: Array, step: Array) -> Array:
    """Return a motion [3] followed by a step [3] in the frame it leads to."""
    return np.array([motion[0] + step[0], *(motion[1:] + _rotated(step[1:], motion[0]))])


def _between(a: Array, b: Array) -> Array:
    """Return the step [3] that leads from motion a to motion b, in the frame that a leads to."""
    return np.array([b[0] - a[0], *_rotated(b[1:] - a[1:], -a[0])])


def _camera_pose(motion: Array, R_key: Array, R_now: Array) -> Array:
    """Return T_key_now [4, 4] of cam0 for a motion [3] of the level frame."""
    c, s = np.cos(motion[0]), np.sin(motion[0])
    T = np.eye(4)
    T[:3, :3] = R_key.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R_now
    T[:3, 3] = R_key.T @ np.array([motion[1], motion[2], 0.0])
    return T
