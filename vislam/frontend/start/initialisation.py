"""The first gravity-aligned state: from rest, or in motion by aligning what the camera saw with inertial data.

Fed with one entry per frame, it answers "waiting" and why until it is sure; a wrong start costs a whole run, a late one
a second.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from vislam.config import InitConfig, WindowConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import level_rotation, so3_exp, transform
from vislam.core.messages import Array, ImuSpan, NavState, Observations, Tracking, VoMeasurement
from vislam.frontend.start.bundle import refine_tracks
from vislam.frontend.start.closed_form import (
    InertialPath,
    Start,
    Tracks,
    epipolar_noise,
    inertial_path,
    median_parallax,
    solve_shape,
    solve_start,
)
from vislam.frontend.start.inertial_alignment import VisualMotion, Window, excitation, refine, solve_linear
from vislam.frontend.start.rest import level_covariance, rest_accel_bias, rest_covariance
from vislam.frontend.start.solution import Solution, from_alignment, from_bundle
from vislam.frontend.start.views import Entry, FrameWindow, gather_tracks, metric_motions
from vislam.imu import ImuNoise, RestDetector, join
from vislam.window.bundle import BundleSolution

_NS = 1_000_000_000
_AGREE_SIGMAS = 3.0
_MAX_OUTLIERS = 0.3  # of the observations
_MAX_BIAS_SIGMAS = 3.5  # of the accelerometer's bias
_MOST_NOISE = 3.0  # times what is told of tracks; more is disagreement
_AMPLE = 3.0  # times the least excitation or parallax; more of it is no longer what a start lacks
_FOREIGN_OFFSET_S = 0.002  # a time offset found in the window that is larger than this is applied before the start


class Phase(StrEnum):
    """Where the search for the first state stands."""

    EMPTY = "empty"  # nothing seen, or vision or inertial data just broke off
    COLLECTING = "collecting"  # in motion, too little seen to try
    RESTING = "resting"  # at rest, not yet for long enough
    MOVING = "moving"  # in motion, solving now and then
    FOUND = "found"


@dataclass(frozen=True, slots=True, eq=False)
class Initialisation:
    """An answer: "waiting", "failed" (the window contradicts physics; still trying), or a state "static" or "moving".

    `T_odom_vo` takes poses chained from visual odometry (identity at the first frame fed) to `odom`: gravity-aligned,
    heading and position zero at that frame. Without scale the chain has no lengths; then odom's position is zero at the
    first frame of the window, and only the rotation of `T_odom_vo` means something.
    """

    status: str
    reason: str
    first: NavState | None = None  # at the first frame of the window
    last: NavState | None = None  # at its last
    T_odom_vo: Array | None = None  # [4, 4]
    t_ns: tuple[int, ...] = ()  # of the frames in the window that were solved for
    T_odom_body: Array | None = None  # [N, 4, 4] at these times
    cause: str = ""  # of a refusal, in a word: what it is counted under
    scale_sigma: float = 0.0  # relative, of lengths in the window; 0 where vision is metric or nothing has moved yet
    excitation_m_s2: float = 0.0  # rms change of acceleration in the window; near zero scale cannot be seen
    time_offset_s: float = 0.0  # of the camera's clock beyond what was applied, as this window has it
    time_offset_sigma_s: float = float("inf")
    is_settled: bool = True  # False: provisional, not yet tested against the seconds after it
    takes_back: bool = False  # the provisional one before did not survive its test


def moved_to(found: Initialisation, T_odom_body: Array) -> Initialisation:
    """Return an answer in another odom, in which its last position and heading are those of `T_odom_body` [4, 4].

    The vertical stays as it was found. An `odom` that a provisional start began goes on that way without a jump.
    """
    assert found.first is not None and found.last is not None and found.T_odom_vo is not None
    T_last = found.last.T_world_body
    R = T_odom_body[:3, :3] @ T_last[:3, :3].T
    heading_rad = float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
    R_turn = so3_exp(np.array([0.0, 0.0, heading_rad]))
    shift = transform(R_turn, T_odom_body[:3, 3] - R_turn @ T_last[:3, 3])
    poses = None if found.T_odom_body is None else shift @ found.T_odom_body
    first, last = _moved(found.first, shift), _moved(found.last, shift)
    return replace(found, first=first, last=last, T_odom_vo=shift @ found.T_odom_vo, T_odom_body=poses)


def _moved(state: NavState, T: Array) -> NavState:
    """Return a state in a world moved and turned by T [4, 4]."""
    R = T[:3, :3]
    turn = np.eye(15)
    turn[3:6, 3:6] = turn[6:9, 6:9] = R
    return replace(
        state, T_world_body=T @ state.T_world_body, velocity_world_m_s=R @ state.velocity_world_m_s,
        covariance=turn @ state.covariance @ turn.T,
    )  # fmt: skip


def level_at_once(
    span: ImuSpan, t_ns: int, T_vo_body: Array, gravity_m_s2: float, config: InitConfig
) -> Initialisation:
    """Return a provisional state at the end of a few samples: level by their mean force, at any plausible velocity.

    For vision that measures metres, which finds the rest within frames. `T_vo_body` [4, 4] is where visual odometry is
    then.
    """
    force = span.accel_m_s2.mean(axis=0)
    norm = float(np.linalg.norm(force))
    up = force if norm > 0.5 * gravity_m_s2 else np.array([0.0, 0.0, gravity_m_s2])
    T_odom_vo = transform(level_rotation(T_vo_body[:3, :3] @ up), np.zeros(3))
    T_odom_body = T_odom_vo @ T_vo_body
    covariance = level_covariance(norm - gravity_m_s2, T_odom_body[:3, :3], gravity_m_s2, config)
    state = NavState(t_ns, T_odom_body, np.zeros(3), np.zeros(3), np.zeros(3), covariance)
    tilt_deg = np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    reason = f"level by the newest samples, to {tilt_deg:.0f} deg"
    return Initialisation("level", reason, state, state, T_odom_vo, (t_ns,), T_odom_body[None], is_settled=False)


class Initialiser:
    """Owns a window of the last frames and decides. Losing vision or inertial data empties it.

    Attributes:
        phase: where the search stands.
        refusals: how often it was refused, by cause.
        taken_back: how often a provisional start did not survive its test.
        time_offset_sigma_s: how well the camera's clock is known; the owner keeps it up to date.
    """

    def __init__(
        self,
        config: InitConfig,
        noise: ImuNoise,
        gravity_m_s2: float,
        T_body_cam0: Array,
        camera: Camera | None = None,
        track_sigma_px: float = 1.0,
        window: WindowConfig | None = None,
    ) -> None:
        """Start empty; `T_body_cam0` [4, 4] and what follows are needed only without scale.

        Args:
            config: how the first state is found.
            noise: of the IMU.
            gravity_m_s2: its norm.
            T_body_cam0: where the camera is.
            camera: its calibration.
            track_sigma_px: what is told of the noise of tracks; the window's own shows in what is solved.
            window: settings of its least squares.
        """
        self.phase = Phase.EMPTY
        self.refusals: dict[str, int] = {}
        self.taken_back = 0
        self.time_offset_sigma_s = 0.0
        self._config = config
        self._gravity = float(gravity_m_s2)
        self._T_body_cam = T_body_cam0
        self._camera = camera
        self._track_sigma_px = track_sigma_px
        self._rest = RestDetector(config, noise)
        self._noise = noise
        self._window = FrameWindow()
        self._next_attempt_ns = 0
        self._before: Solution | None = None  # the attempt before
        self._offset_s: float | None = None  # of the camera's clock, by the last attempt that could be believed
        self._provisional: Solution | None = None  # given out, under test
        self._bundle_config = replace(window or WindowConfig(), sigma_px=track_sigma_px)
        self._last = Initialisation("waiting", "no frame yet")

    def add(
        self,
        span: ImuSpan | None,
        vo: VoMeasurement,
        at_rest_by_image: bool,
        observations: Observations | None = None,
    ) -> Initialisation:
        """Take one frame and answer.

        Args:
            span: inertial data since the frame before, no bias taken off; None for the first frame or across a hole.
            vo: visual motion at the frame.
            at_rest_by_image: the image hardly moved since the frame before (below `config.still_px`).
            observations: the tracks in the frame; without scale they are what a moving start is made of.
        """
        still_by_imu = self._rest.add(span)
        entries = self._window.entries
        if vo.tracking is Tracking.LOST or vo.T_keyframe_body is None:
            if span is not None and self._window.bridge(span, vo.has_scale):
                return self._refuse("vision", "vision is lost")
            return self._restart("vision", "vision is lost")
        whole = self._window.since_newest(span)
        follows = whole is not None
        if entries and not follows:
            self._restart("inertial data", "inertial data has a hole")
        self._window.append(whole, vo, observations, at_rest_by_image and follows)
        self._window.trim(self._config.window_s if vo.has_scale else self._config.mono_window_s)
        self.phase = self._next_phase(vo, still_by_imu and at_rest_by_image)
        match self.phase:
            case Phase.RESTING:
                found = self._from_rest()
            case Phase.MOVING if vo.t_ns >= self._next_attempt_ns:
                found = self._from_motion()
                self._next_attempt_ns = vo.t_ns + round(self._config.attempt_s * _NS)
            case Phase.COLLECTING:
                found = self._refuse("duration", self._needed(vo))
            case _:
                return self._last
        if found.first is not None and found.is_settled:
            self.phase = Phase.FOUND
        self._last = found if found.first is None else Initialisation("waiting", "just found")
        return found

    def restamp(self, shift_ns: int, cut: Callable[[int, int], ImuSpan | None]) -> None:
        """Shift the times of all frames seen, because the camera's clock turned out to be off by `shift_ns`.

        `cut` gives the inertial data between two times, as `ImuBuffer.span`.
        """
        self._rest.clear()
        self._before = self._offset_s = None
        self._window.restamp(shift_ns, cut)
        self._next_attempt_ns += shift_ns if self._next_attempt_ns else 0

    def _next_phase(self, vo: VoMeasurement, still: bool) -> Phase:
        if still:
            return Phase.RESTING
        need_s = self._config.window_min_s if vo.has_scale else self._config.mono_window_min_s
        return Phase.COLLECTING if self._window.seen_s < need_s else Phase.MOVING

    def _needed(self, vo: VoMeasurement) -> str:
        need_s = self._config.window_min_s if vo.has_scale else self._config.mono_window_min_s
        return f"{self._window.seen_s:.2f} s of motion seen, {need_s:.2f} s needed"

    def _restart(self, cause: str, reason: str) -> Initialisation:
        self._window.clear()
        self._rest.clear()
        self._next_attempt_ns = 0
        self._before = self._offset_s = None
        self.phase = Phase.EMPTY
        self._last = self._refuse(cause, reason)
        return self._last

    def _refuse(self, cause: str, reason: str, status: str = "waiting") -> Initialisation:
        self.refusals[cause] = self.refusals.get(cause, 0) + 1
        return Initialisation(status, reason, cause=cause)

    # -- at rest -----------------------------------------------------------------------------------------------------

    def _from_rest(self) -> Initialisation:
        """Gravity and gyro bias from the means over the frames at rest."""
        entries = self._window.entries
        start = len(entries) - 1
        while start > 0 and entries[start].still:
            start -= 1
        entries = entries[start:]
        spans = [entry.span for entry in entries[1:] if entry.span is not None]
        rested_s = (entries[-1].t_ns - entries[0].t_ns) / _NS
        if not spans or rested_s < self._config.rest_s:
            return self._refuse("duration", f"at rest for {rested_s:.2f} s of {self._config.rest_s:.2f} s needed")
        span = join(spans)
        gyro, force = span.gyro_rad_s.mean(axis=0), span.accel_m_s2.mean(axis=0)
        norm = float(np.linalg.norm(force))
        if abs(norm - self._gravity) > self._config.gravity_tolerance_m_s2:
            return self._contradiction(norm)
        T_odom_vo = transform(level_rotation(entries[-1].T_vo_body[:3, :3] @ force), np.zeros(3))
        poses = np.array([T_odom_vo @ entry.T_vo_body for entry in entries])
        covariance = rest_covariance(span, poses[-1][:3, :3], self._gravity, self._config, self._noise)
        accel_bias = rest_accel_bias(span, self._gravity, self._config)
        first, last = (
            NavState(entry.t_ns, pose, np.zeros(3), gyro, accel_bias, covariance)
            for entry, pose in ((entries[0], poses[0]), (entries[-1], poses[-1]))
        )
        times = tuple(entry.t_ns for entry in entries)
        return Initialisation("static", f"at rest for {rested_s:.2f} s", first, last, T_odom_vo, times, poses)

    # -- in motion ---------------------------------------------------------------------------------------------------

    def _from_motion(self) -> Initialisation:
        """Gravity, velocity, biases and scale from the window, if it says enough about them."""
        metric = self._window.entries[-1].vo.has_scale
        try:
            return self._from_metric_motion() if metric else self._from_tracks()
        except np.linalg.LinAlgError:
            return self._refuse("geometry", "the motion does not determine gravity and velocity yet")

    def _from_metric_motion(self) -> Initialisation:
        """Align metric visual odometry with inertial data."""
        config = self._config
        sigma_s = self.time_offset_sigma_s
        if sigma_s > config.max_time_offset_sigma_s and self._window.seen_s < 0.95 * config.window_s:
            limit_ms = 1e3 * config.max_time_offset_sigma_s
            return self._refuse("time offset", f"camera clock known to {1e3 * sigma_s:.1f} ms of {limit_ms:.1f}; turn")
        chosen = self._window.choose_nodes(config.node_spacing_s, config.max_nodes)
        window = self._inertial_window(chosen, metric_motions(chosen, config.vo_inflation))
        linear = solve_linear(window)
        norm = float(np.linalg.norm(linear.gravity_m_s2))
        refusal = self._gravity_refusal(norm, linear.gravity_norm_sigma_m_s2)
        if refusal is not None:
            return refusal
        solution = from_alignment(tuple(entry.t_ns for entry in chosen), refine(window, linear))
        refusal = self._quality_refusal(solution, "move with more acceleration, or turn")
        return refusal or self._moving(chosen, solution, metric=True, excitation_m_s2=excitation(window))

    def _from_tracks(self) -> Initialisation:
        """Structure from motion with inertial data: scale is unknown to the camera."""
        config, camera = self._config, self._camera
        if camera is None:
            return self._refuse("calibration", "without scale a moving start needs the camera's calibration")
        chosen = self._window.choose_nodes(config.node_spacing_s, config.mono_max_nodes)
        told = gather_tracks(chosen, camera, self._T_body_cam, self._track_sigma_px, config.max_points)
        window = self._inertial_window(chosen, [])
        path = inertial_path(window)
        sigma_xy, good = epipolar_noise(told, path.rotations)
        tracks = replace(told, sigma_xy=min(sigma_xy, _MOST_NOISE * told.sigma_xy)).only(good)
        refusal = self._sight_refusal(tracks, path, camera.fx)
        if refusal is not None:
            return refusal
        start, bundle = self._solved(window, chosen, tracks, path, Rig((camera,), (self._T_body_cam,)))
        if not bundle.converged:
            return self._start_refusal(start) or self._refuse("geometry", "the window's least squares does not settle")
        solution = from_bundle(tuple(entry.t_ns for entry in chosen), bundle)
        before, self._before = self._before, solution
        refusal = (
            self._bundle_refusal(bundle, start)
            or self._quality_refusal(solution, self._lacking(tracks, path, camera.fx))
            or self._clock_refusal(bundle)
            or self._repetition_refusal(before, solution)
        )
        if refusal is not None:
            return refusal
        found = self._moving(chosen, solution, metric=False, excitation_m_s2=path.excitation_m_s2)
        return self._tested(
            replace(found, time_offset_s=bundle.time_offset_s, time_offset_sigma_s=bundle.time_offset_sigma_s), solution
        )

    def _solved(
        self, window: Window, chosen: list[Entry], tracks: Tracks, path: InertialPath, rig: Rig
    ) -> tuple[Start, BundleSolution]:
        """Return the window's least squares and the closed form that led to it.

        The closed form over points fails where few points last; the shape that epipolar constraints tell is then the
        start.
        """
        start = solve_start(window, path, tracks)
        y = np.concatenate([start.velocity_m_s, start.gravity_m_s2, start.accel_bias_m_s2, [1.0]])
        found: BundleSolution | None = None
        for first in (lambda: y, lambda: solve_shape(window, path, tracks)):
            with suppress(np.linalg.LinAlgError):
                bundle = refine_tracks(
                    window, chosen, tracks, path, first(), self._bundle_config, rig, self.time_offset_sigma_s,
                    self._config.vo_inflation,
                )  # fmt: skip
                if bundle.converged and self._bias_m_s2(bundle) <= self._most_bias_m_s2:
                    return start, bundle
                found = found or bundle
        if found is None:
            raise np.linalg.LinAlgError("neither start leads anywhere")
        return start, found

    def _tested(self, found: Initialisation, solution: Solution) -> Initialisation:
        """Return a first solution as provisional, and a later one as what the seconds since then made of it."""
        config, earlier = self._config, self._provisional
        if earlier is None:
            self._provisional = solution
            return replace(found, is_settled=False)
        tested_s = (solution.t_ns[-1] - earlier.t_ns[-1]) / _NS
        if tested_s < config.test_s:
            return self._refuse("test", f"the start is tested for {tested_s:.1f} s of {config.test_s:.1f} s")
        contradiction = solution.contradiction(earlier, _AGREE_SIGMAS)
        if contradiction is None:
            self._provisional = solution
            return replace(found, is_settled=False, reason=f"{found.reason}; one before could not be tested")
        if contradiction:
            self._provisional = solution
            self.taken_back += 1
            return replace(
                found,
                is_settled=False,
                takes_back=True,
                reason=f"{found.reason}; the start before was taken back: {contradiction}",
            )
        if found.scale_sigma > config.settled_scale_sigma and self._window.seen_s < 0.95 * config.mono_window_s:
            return self._refuse("test", f"scale sigma {100.0 * found.scale_sigma:.1f} % while the window grows")
        return found

    def _inertial_window(self, chosen: list[Entry], motions: list[VisualMotion]) -> Window:
        return Window(
            spans=self._window.spans(chosen),
            motions=motions,
            rotations=np.array([entry.T_vo_body[:3, :3] for entry in chosen]),
            noise=self._noise,
            gravity_m_s2=self._gravity,
            lever_m=self._T_body_cam[:3, 3].copy(),
            gyro_bias_sigma_rad_s=self._config.gyro_bias_sigma_rad_s,
            accel_bias_sigma_m_s2=self._config.accel_bias_sigma_m_s2,
        )

    # -- refusals ----------------------------------------------------------------------------------------------------

    def _contradiction(self, norm: float) -> Initialisation:
        reason = (
            f"gravity norm {norm:.2f} m/s2, expected {self._gravity:.2f}: check the accelerometer's unit and "
            "calibration and the camera-IMU extrinsics"
        )
        return self._refuse("gravity", reason, "failed")

    def _gravity_refusal(self, norm: float, sigma: float) -> Initialisation | None:
        allowed = self._config.gravity_tolerance_m_s2
        if sigma > 2.0 * allowed:
            reason = f"gravity norm {norm:.1f} +- {sigma:.1f} m/s2: too little acceleration or turning"
            return self._refuse("gravity", reason)
        if abs(norm - self._gravity) > allowed + _AGREE_SIGMAS * sigma:
            return self._contradiction(norm)
        return None

    def _sight_refusal(self, tracks: Tracks, path: InertialPath, fx: float) -> Initialisation | None:
        """Refuse a window in which there is too little to see."""
        config = self._config
        if tracks.points < config.min_points:
            return self._refuse("points", f"{tracks.points} points of {config.min_points} needed followed long enough")
        parallax_px = median_parallax(tracks, path.rotations) * fx
        if parallax_px < config.min_parallax_px:
            return self._refuse("parallax", f"parallax {parallax_px:.0f} px of {config.min_parallax_px:.0f} needed")
        if path.excitation_m_s2 < config.min_excitation_m_s2:
            return self._refuse(
                "excitation",
                f"acceleration changes by {path.excitation_m_s2:.2f} m/s2 of {config.min_excitation_m_s2:.2f} needed: "
                "scale cannot be seen in uniform motion, speed up, brake or turn",
            )
        return None

    def _start_refusal(self, start: Start) -> Initialisation | None:
        """Refuse where the linear solution, gravity left free, is far from what gravity can be."""
        # in a short window this norm errs by more than its sigma says: twice the room
        allowed = 2.0 * (self._config.gravity_tolerance_m_s2 + _AGREE_SIGMAS * start.free_norm_sigma_m_s2)
        is_foreign = abs(start.free_norm_m_s2 - self._gravity) > allowed
        return self._contradiction(start.free_norm_m_s2) if is_foreign else None

    @property
    def _most_bias_m_s2(self) -> float:
        return _MAX_BIAS_SIGMAS * self._config.accel_bias_sigma_m_s2

    @staticmethod
    def _bias_m_s2(bundle: BundleSolution) -> float:
        return float(np.linalg.norm(bundle.accel_bias_m_s2[-1]))

    def _bundle_refusal(self, bundle: BundleSolution, start: Start) -> Initialisation | None:
        bias, limit = self._bias_m_s2(bundle), self._most_bias_m_s2
        if bias > limit:  # a motion that is not understood hides in it
            refusal = self._start_refusal(start)
            reason = f"accelerometer bias {bias:.2f} m/s2 of {limit:.2f}: check its calibration and the extrinsics"
            return refusal or self._refuse("accel bias", reason)
        if bundle.outliers > _MAX_OUTLIERS:
            reason = f"{bundle.outliers:.0%} of the sightings contradict the inertial data"
            return self._refuse("disagreement", reason, "failed")
        if bundle.sigma_px > _MOST_NOISE * self._track_sigma_px:
            reason = f"sightings scatter by {bundle.sigma_px:.1f} px about what the inertial data allow"
            return self._refuse("disagreement", reason, "failed")
        return None

    def _clock_refusal(self, bundle: BundleSolution) -> Initialisation | None:
        """Refuse, and tell the offset of the camera's clock, where it shows and the attempt before showed it, too."""
        offset_s, sigma_s = bundle.time_offset_s, bundle.time_offset_sigma_s
        before_s, self._offset_s = self._offset_s, offset_s
        if abs(offset_s) <= max(_FOREIGN_OFFSET_S, _AGREE_SIGMAS * sigma_s):
            return None
        refusal = self._refuse(
            "time offset", f"camera clock found off by {1e3 * offset_s:.1f} +- {1e3 * sigma_s:.1f} ms"
        )
        if before_s is None or abs(offset_s - before_s) > max(_FOREIGN_OFFSET_S, _AGREE_SIGMAS * sigma_s):
            return refusal
        return replace(refusal, time_offset_s=offset_s, time_offset_sigma_s=sigma_s)

    def _repetition_refusal(self, before: Solution | None, now: Solution) -> Initialisation | None:
        """Refuse what the attempt before does not confirm: a wrong minimum does not come twice at the same scale."""
        if self._provisional is not None:
            return None
        if before is None:
            return self._refuse("confirmation", "one more look needed to confirm the scale")
        contradiction = now.contradiction(before, _AGREE_SIGMAS)
        if contradiction is None:
            contradiction = "no frame in common"
        return self._refuse("confirmation", f"against the attempt before: {contradiction}") if contradiction else None

    def _lacking(self, tracks: Tracks, path: InertialPath, fx: float) -> str:
        """Return what would make the window say more, as far as it can be told."""
        config = self._config
        if path.excitation_m_s2 < _AMPLE * config.min_excitation_m_s2:
            return f"acceleration changes by {path.excitation_m_s2:.2f} m/s2 only: speed up, brake or turn"
        parallax_px = median_parallax(tracks, path.rotations) * fx
        if parallax_px < _AMPLE * config.min_parallax_px:
            return f"parallax is {parallax_px:.0f} px only: move sideways, or nearer to what is seen"
        if self._window.seen_s < 0.95 * config.mono_window_s:
            return f"{self._window.seen_s:.1f} s seen, more come"
        return "the IMU's noise, with what the ride shakes, hides the scale"

    def _quality_refusal(self, solution: Solution, lacking: str) -> Initialisation | None:
        config = self._config
        if solution.residual_ratio > config.max_residual_ratio:
            reason = f"vision and IMU disagree: chi2 {solution.residual_ratio:.1f} of {config.max_residual_ratio:.1f}"
            advice = "per degree of freedom; check time stamps and extrinsics"
            return self._refuse("disagreement", f"{reason} {advice}", "failed")
        P = solution.last_covariance
        velocity = np.sqrt(np.linalg.eigvalsh(P[6:9, 6:9])[-1])
        gyro = np.sqrt(np.linalg.eigvalsh(P[9:12, 9:12])[-1])
        for name, value, limit, unit in (
            ("scale", solution.scale_sigma * 100.0, config.max_scale_sigma * 100.0, "%"),
            ("tilt", np.rad2deg(solution.tilt_sigma_rad), config.max_tilt_sigma_deg, "deg"),
            ("velocity", velocity, config.max_velocity_sigma_m_s, "m/s"),
            ("gyro bias", gyro, config.max_gyro_bias_sigma_rad_s, "rad/s"),
        ):
            if not value <= limit:
                return self._refuse(name, f"{name} sigma {value:.3g} {unit} of {limit:.3g} needed: {lacking}")
        return None

    # -- the answer --------------------------------------------------------------------------------------------------

    def _moving(self, chosen: list[Entry], solution: Solution, metric: bool, excitation_m_s2: float) -> Initialisation:
        """Express the solution in odom."""
        up_vo = chosen[0].T_vo_body[:3, :3] @ solution.T_world_body[0, 2, :3]
        T_odom_vo = transform(level_rotation(up_vo), np.zeros(3))
        origin = T_odom_vo @ chosen[0].T_vo_body
        turn = np.eye(4)
        turn[:3, :3] = origin[:3, :3] @ solution.T_world_body[0, :3, :3].T
        turn[:3, 3] = origin[:3, 3] if metric else 0.0
        poses = turn @ solution.T_world_body
        inflation = max(solution.residual_ratio, 1.0)  # what the model does not explain makes the answer less certain
        first, last = (
            NavState(
                t_ns=solution.t_ns[i],
                T_world_body=poses[i],
                velocity_world_m_s=turn[:3, :3] @ solution.velocities_m_s[i],
                gyro_bias_rad_s=solution.gyro_bias_rad_s,
                accel_bias_m_s2=solution.accel_bias_m_s2,
                covariance=_turn(covariance, turn[:3, :3]) * inflation,
            )
            for i, covariance in ((0, solution.first_covariance), (-1, solution.last_covariance))
        )
        reason = f"{len(poses)} frames over {(last.t_ns - first.t_ns) / _NS:.2f} s, chi2 {solution.residual_ratio:.2f}"
        scale_sigma = 0.0 if metric else solution.scale_sigma * float(np.sqrt(inflation))
        if not metric:
            reason = f"{reason}, scale sigma {100.0 * scale_sigma:.1f} %"
        return Initialisation(
            "moving", reason, first, last, T_odom_vo, solution.t_ns, poses,
            scale_sigma=scale_sigma, excitation_m_s2=excitation_m_s2,
        )  # fmt: skip


def _turn(covariance: Array, R: Array) -> Array:
    """Return the covariance with position and velocity in turned world axes; the chosen origin gets its sigma back."""
    J = np.eye(15)
    J[3:6, 3:6] = J[6:9, 6:9] = R
    out = J @ covariance @ J.T
    out[:6, :6] += np.eye(6) * 1e-8
    return out
