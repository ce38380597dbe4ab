"""The search for the first gravity-aligned state: from rest, or in motion by aligning vision with inertial data.

Fed with one entry per frame, it answers "waiting" and why until it is sure; a wrong start costs a whole run, a late one
a second.
"""

from collections.abc import Callable
from enum import StrEnum

import numpy as np

from vislam.config import InitConfig, WindowConfig
from vislam.core.camera import Camera
from vislam.core.geometry import level_rotation, transform
from vislam.core.messages import Array, ImuSpan, NavState, Observations, Tracking, VoMeasurement
from vislam.frontend.start.answer import WINDOW_S, Initialisation, moving
from vislam.frontend.start.from_tracks import VO_INFLATION, Sighted, StartFromTracks
from vislam.frontend.start.inertial_alignment import VisualMotion, Window, excitation, refine, solve_linear
from vislam.frontend.start.refusals import Refusals
from vislam.frontend.start.solution import from_alignment
from vislam.frontend.start.views import Entry, FrameWindow, metric_motions
from vislam.imu import ImuNoise, RestDetector, join
from vislam.imu.resting import GRAVITY_TOLERANCE_M_S2, rest_accel_bias, rest_covariance

_WINDOW_MIN_S = 1.0  # try from here on
_MONO_WINDOW_MIN_S = 1.0
_NODE_SPACING_S = 0.1  # frames closer than this add noise and cost, not knowledge
_ATTEMPT_S = 0.3  # between attempts: one costs up to 0.1 s, and a window changes little in this time
_MAX_NODES = 45  # bounds the cost of one attempt (dense, cubic); longer windows get wider spacing
_MONO_MAX_NODES = 20  # the same without scale, where every node also carries its sightings of points
# a metric start waits for this, no longer than its window: 3 mm at 1 m/s
_MAX_TIME_OFFSET_SIGMA_S = 0.003
_NS = 1_000_000_000


class Phase(StrEnum):
    """Where the search for the first state stands."""

    EMPTY = "empty"  # nothing seen, or vision or inertial data just broke off
    COLLECTING = "collecting"  # in motion, too little seen to try
    RESTING = "resting"  # at rest, not yet for long enough
    MOVING = "moving"  # in motion, solving now and then
    FOUND = "found"


class Initialiser:
    """Owns a window of the last frames and decides. Losing vision or inertial data empties it.

    Attributes:
        phase: where the search stands.
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
            track_sigma_px: noise assumed of tracks; the window's own shows in what is solved.
            window: settings of its least squares.
        """
        self.phase = Phase.EMPTY
        self.time_offset_sigma_s = 0.0
        self._config = config
        self._gravity = float(gravity_m_s2)
        self._lever_m = T_body_cam0[:3, 3].copy()
        self._rest = RestDetector(config, noise)
        self._noise = noise
        self._window = FrameWindow()
        self._next_attempt_ns = 0
        self._refusals = Refusals(config, self._gravity, track_sigma_px)
        self._by_tracks: StartFromTracks | None = None
        if camera is not None:
            self._by_tracks = StartFromTracks(
                config, self._refusals, camera, T_body_cam0, track_sigma_px, window or WindowConfig()
            )
        self._last = Initialisation("waiting", "no frame yet")

    @property
    def refusals(self) -> dict[str, int]:
        """How often a start was refused, by cause."""
        return self._refusals.counts

    @property
    def taken_back(self) -> int:
        """How often a provisional start did not survive its test."""
        return 0 if self._by_tracks is None else self._by_tracks.taken_back

    def add(
        self, span: ImuSpan | None, vo: VoMeasurement, at_rest_by_image: bool, observations: Observations | None = None
    ) -> Initialisation:
        """Take one frame and answer.

        Args:
            span: inertial data since the frame before, no bias taken off; None for the first frame or across a hole.
            vo: visual motion at the frame.
            at_rest_by_image: the image hardly moved since the frame before (see `Stillness`).
            observations: the tracks in the frame; without scale they are what a moving start is made of.
        """
        still_by_imu = self._rest.add(span)
        entries = self._window.entries
        if vo.tracking is Tracking.LOST or vo.T_keyframe_body is None:
            if span is not None and self._window.bridge(span, vo.has_scale):
                return self._refusals.refuse("vision", "vision is lost")
            return self._restart("vision", "vision is lost")
        whole = self._window.since_newest(span)
        follows = whole is not None
        if entries and not follows:
            self._restart("inertial data", "inertial data has a hole")
        self._window.append(whole, vo, observations, at_rest_by_image and follows)
        self._window.trim(WINDOW_S if vo.has_scale else self._config.mono_window_s)
        self.phase = self._next_phase(vo, still_by_imu and at_rest_by_image)
        match self.phase:
            case Phase.RESTING:
                found = self._from_rest()
            case Phase.MOVING if vo.t_ns >= self._next_attempt_ns:
                found = self._from_motion()
                self._next_attempt_ns = vo.t_ns + round(_ATTEMPT_S * _NS)
            case Phase.COLLECTING:
                found = self._refusals.refuse("duration", self._needed(vo))
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
        if self._by_tracks is not None:
            self._by_tracks.forget()
        self._window.restamp(shift_ns, cut)
        self._next_attempt_ns += shift_ns if self._next_attempt_ns else 0

    def _next_phase(self, vo: VoMeasurement, still: bool) -> Phase:
        if still:
            return Phase.RESTING
        need_s = _WINDOW_MIN_S if vo.has_scale else _MONO_WINDOW_MIN_S
        return Phase.COLLECTING if self._window.seen_s < need_s else Phase.MOVING

    def _needed(self, vo: VoMeasurement) -> str:
        need_s = _WINDOW_MIN_S if vo.has_scale else _MONO_WINDOW_MIN_S
        return f"{self._window.seen_s:.2f} s of motion seen, {need_s:.2f} s needed"

    def _restart(self, cause: str, reason: str) -> Initialisation:
        self._window.clear()
        self._rest.clear()
        self._next_attempt_ns = 0
        if self._by_tracks is not None:
            self._by_tracks.forget()
        self.phase = Phase.EMPTY
        self._last = self._refusals.refuse(cause, reason)
        return self._last

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
            return self._refusals.refuse(
                "duration", f"at rest for {rested_s:.2f} s of {self._config.rest_s:.2f} s needed"
            )
        span = join(spans)
        gyro, force = span.gyro_rad_s.mean(axis=0), span.accel_m_s2.mean(axis=0)
        norm = float(np.linalg.norm(force))
        if abs(norm - self._gravity) > GRAVITY_TOLERANCE_M_S2:
            return self._refusals.contradiction(norm)
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
        """Gravity, velocity, biases and scale from the window, if it shows enough of them."""
        metric = self._window.entries[-1].vo.has_scale
        try:
            return self._from_metric_motion() if metric else self._from_tracks()
        except np.linalg.LinAlgError:
            return self._refusals.refuse("geometry", "the motion does not determine gravity and velocity yet")

    def _from_metric_motion(self) -> Initialisation:
        """Align metric visual odometry with inertial data."""
        refusals = self._refusals
        sigma_s = self.time_offset_sigma_s
        if sigma_s > _MAX_TIME_OFFSET_SIGMA_S and self._window.seen_s < 0.95 * WINDOW_S:
            limit_ms = 1e3 * _MAX_TIME_OFFSET_SIGMA_S
            reason = f"camera clock known to {1e3 * sigma_s:.1f} ms of {limit_ms:.1f}; turn"
            return refusals.refuse("time offset", reason)
        chosen = self._window.choose_nodes(_NODE_SPACING_S, _MAX_NODES)
        window = self._inertial_window(chosen, metric_motions(chosen, VO_INFLATION))
        linear = solve_linear(window)
        norm = float(np.linalg.norm(linear.gravity_m_s2))
        refusal = refusals.gravity(norm, linear.gravity_norm_sigma_m_s2)
        if refusal is not None:
            return refusal
        solution = from_alignment(tuple(entry.t_ns for entry in chosen), refine(window, linear))
        refusal = refusals.quality(solution, "move with more acceleration, or turn")
        return refusal or moving(chosen[0].T_vo_body, solution, metric=True, excitation_m_s2=excitation(window))

    def _from_tracks(self) -> Initialisation:
        """Structure from motion with inertial data: scale is unknown to the camera."""
        if self._by_tracks is None:
            return self._refusals.refuse("calibration", "without scale a moving start needs the camera's calibration")
        chosen = self._window.choose_nodes(_NODE_SPACING_S, _MONO_MAX_NODES)
        window = self._inertial_window(chosen, [])
        return self._by_tracks.solve(Sighted(chosen, window, self._window.seen_s, self.time_offset_sigma_s))

    def _inertial_window(self, chosen: list[Entry], motions: list[VisualMotion]) -> Window:
        return Window(
            spans=self._window.spans(chosen),
            motions=motions,
            rotations=np.array([entry.T_vo_body[:3, :3] for entry in chosen]),
            noise=self._noise,
            gravity_m_s2=self._gravity,
            lever_m=self._lever_m,
            gyro_bias_sigma_rad_s=self._config.gyro_bias_sigma_rad_s,
            accel_bias_sigma_m_s2=self._config.accel_bias_sigma_m_s2,
        )
