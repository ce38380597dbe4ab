"""The wait for gravity: the search for the first state, and the keyframes that wait for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.errors import TrackingLostError
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import StartFacts
from vislam.core.messages import Array, ImuSpan, NavState, Observations, VoMeasurement
from vislam.ekf.filtering import Filtering
from vislam.ekf.tight import EarlyFrames, known_from
from vislam.frontend import TrackResult
from vislam.frontend.start import Initialisation, Initialiser, level_at_once, moved_to
from vislam.imu import ImuBuffer
from vislam.trajectory import Trajectory
from vislam.trajectory.odometry_keyframe import OdometryKeyframe, WaitingKeyframes, first_keyframe_state

_OTHER_WAYS = "a start from rest, a second camera or depth needs less"


@dataclass(frozen=True, slots=True, eq=False)
class Released:
    """The keyframes that waited, in `odom`."""

    keyframes: list[OdometryKeyframe]
    T_odom_vo: Array  # [4, 4]
    solved: dict[int, Array] | None  # poses by time, with one camera, whose visual chain has no positions

    def place(self, t_ns: int, T_vo_body: Array) -> Array | None:
        """Return where the body was at a keyframe; None where one camera cannot tell."""
        return self.T_odom_vo @ T_vo_body if self.solved is None else self.solved.get(t_ns)


class GravityWait:
    """Finds the first state and starts the filter from it; keyframes wait in the frame `vo` till the start is settled.

    Until then the filter goes by the newest provisional start, if there is one.
    """

    def __init__(
        self,
        config: Config,
        rig: Rig,
        noise: ImuNoise,
        filtering: Filtering,
        buffer: ImuBuffer,
        early: EarlyFrames | None,
    ) -> None:
        """Begin without a state; `filtering` is started with the first one, `buffer` has the inertial samples.

        `early` keeps what one camera sees before its scale is known; None where vision is metric.
        """
        self.initialisation: Initialisation | None = None  # settled
        self.newest_start: Initialisation | None = None  # that the filter goes by; provisional ones come before
        self.first_state: NavState | None = None  # of keyframe 0, once gravity is known
        self.last_refusal = "no frame yet"  # why there is no first state
        self.scaled_from_ns: int | None = None  # before, poses of one camera have no scale; None: all have
        self.holds_keyframes = True  # until the start is settled, or gravity given up
        self.counters: dict[str, int] = {}
        self._config = config
        self._noise = noise
        self._filtering = filtering
        self._buffer = buffer
        self._refused: Initialisation | None = None  # the newest answer without a state
        self._begun_t_ns = 0  # when the first pose was given that was not taken back; 0: none was
        self._waiting = WaitingKeyframes()
        self._early = early
        self._initialiser = Initialiser(
            config.init, noise, config.machine.gravity_m_s2, rig.T_body_cams[0], rig.cameras[0],
            config.frontend.track_sigma_px, config.window,
        )  # fmt: skip

    @property
    def start(self) -> StartFacts | None:
        """How gravity was found; None until then."""
        found = self.initialisation
        if found is None or found.last is None or self.first_state is None:
            return None
        return StartFacts(
            found.status, found.reason, found.last, found.scale_sigma, found.excitation_m_s2, self._noise,
            self.first_state, self._begun_t_ns,
        )  # fmt: skip

    @property
    def search_counters(self) -> dict[str, dict[str, int]]:
        """Why starts were refused, and how many were taken back."""
        return {
            "initialisation refused": dict(self._initialiser.refusals),
            "initialisation": {"taken_back": self._initialiser.taken_back},
        }

    def resume(self, start: StartFacts) -> None:
        """Take over the settled start of an earlier run."""
        self.first_state, self.last_refusal = start.first_state, start.reason
        self.initialisation = Initialisation(
            start.status, start.reason, start.first_state, start.last, scale_sigma=start.scale_sigma,
            excitation_m_s2=start.excitation_m_s2,
        )  # fmt: skip
        self.newest_start, self.holds_keyframes = self.initialisation, False
        self._begun_t_ns = start.begun_t_ns

    def see(self, t_ns: int, observations: Observations, at_rest: bool) -> None:
        """Keep what one camera saw before its scale is known."""
        if self.initialisation is None and self._early is not None:
            self._early.see(t_ns, observations, at_rest)

    def seek(
        self, span: ImuSpan | None, track: TrackResult, still_image: bool, T_vo_body: Array, time_offset_sigma_s: float
    ) -> Released | None:
        """Look for the first gravity-aligned state with another frame; return what waited once it is settled.

        `span` is the inertial data since the last frame, None where they have a hole, `T_vo_body` [4, 4] where visual
        odometry has the body, and `time_offset_sigma_s` how well the camera's clock is known.
        """
        if self.initialisation is not None:
            return None
        self._initialiser.time_offset_sigma_s = time_offset_sigma_s
        found = self._initialiser.add(span, track.vo, still_image, track.observations)
        self.last_refusal = found.reason
        self._refused = found if found.first is None else None
        if found.first is None and self.newest_start is None:
            found = self._level(span, track.vo, T_vo_body) or found
        if found.last is None or found.first is None or found.T_odom_vo is None:
            return None
        before = self._filtering.ekf.pose_at(found.last.t_ns) if self.newest_start is not None else None
        return self._start_from(found if before is None else moved_to(found, before), track.vo)

    def take_refused(self) -> Initialisation | None:
        """Return the newest answer without a state, once."""
        refused, self._refused = self._refused, None
        return refused

    def hold(self, keyframe: OdometryKeyframe, T_odom_body: Array | None) -> None:
        """Let a keyframe in `vo` wait; `T_odom_body` [4, 4] is where a provisional start has it, if there is one."""
        self._waiting.add(keyframe, T_odom_body)

    def restamp(self, shift_ns: int) -> None:
        """Bring all that waits `shift_ns` later, as a change of the camera's time offset asks for."""
        self._initialiser.restamp(shift_ns, self._buffer.span)
        self._waiting.restamp(shift_ns, self._buffer.span)
        if self._early is not None:
            self._early.restamp(shift_ns)

    def is_late(self, now_t_ns: int) -> bool:
        """Return whether keyframes have waited too long; they must not wait for ever."""
        return self._waiting.waited_s(now_t_ns) >= self._config.init.give_up_s

    def give_up(self, T_upright: Array) -> Released | None:
        """Return the keyframes that still wait, up being where `T_upright` [4, 4] has it: vision alone does.

        With one camera a provisional start has to do, and without any there is nothing to return.
        """
        return self._release(T_upright) if self._early is None else self._release_untested()

    def give_up_scale(self, now_t_ns: int) -> Released | None:
        """Return the keyframes of one camera by its provisional start; raises TrackingLostError without one."""
        if self.newest_start is None:
            waited_s = self._waiting.waited_s(now_t_ns)
            raise TrackingLostError(f"no scale after {waited_s:.0f} s: {self.last_refusal}; {_OTHER_WAYS}")
        return self._release_untested()

    def _release_untested(self) -> Released | None:
        """Return the waiting keyframes by the newest provisional start of one camera; None without one."""
        found = self.newest_start
        if found is None or found.T_odom_vo is None:
            return None
        self.initialisation = replace(found, reason=f"{found.reason}; not confirmed: {self.last_refusal}")
        return self._release(found.T_odom_vo)

    def _start_from(self, found: Initialisation, vo: VoMeasurement) -> Released | None:
        """Start the filter, again if it runs; return what waited once the start is settled."""
        assert found.last is not None and found.T_odom_vo is not None
        if self.newest_start is None or found.takes_back:
            self._begun_t_ns = found.last.t_ns
        self.newest_start = found
        self._filtering.start(found.last, vo)
        if not found.is_settled:
            return None
        self.initialisation = found
        return self._release(found.T_odom_vo)

    def _level(self, span: ImuSpan | None, vo: VoMeasurement, T_vo_body: Array) -> Initialisation | None:
        """Return a provisional state from the newest samples alone, where vision is metric and goes on from there.

        The tight filter has tracks, not metres: it does not find the velocity at once.
        """
        if not vo.has_scale or vo.T_keyframe_body is None or self._filtering.coupling != "loose":
            return None
        if span is None and self._buffer.oldest_t_ns is not None:
            oldest_ns = vo.t_ns - round(self._config.init.level_s * 1e9)
            span = self._buffer.unbroken(max(oldest_ns, self._buffer.oldest_t_ns), vo.t_ns)
        if span is None:
            return None
        return level_at_once(span, vo.t_ns, T_vo_body, self._config.machine.gravity_m_s2, self._config.init)

    def _release(self, T_odom_vo: Array) -> Released:
        """Return the waiting keyframes in `odom`, and settle the state of the first.

        Without scale the visual chain has no positions; those that the initialisation solved for take their place.
        """
        found = self.initialisation
        first = None if found is None else found.first
        self.holds_keyframes = False
        solved: dict[int, Array] = {}
        states: dict[int, NavState] = {}
        if self._early is not None and found is not None and first is not None and found.T_odom_body is not None:
            states = self._early.states(first, self._waiting.t_ns, self._buffer.span, self._noise)
            solved = self._waiting.provisional
            solved |= {t_ns: state.T_world_body for t_ns, state in states.items()}
            solved |= self._waiting.between(Trajectory(np.array(found.t_ns, dtype=np.int64), found.T_odom_body))
            self.counters["keyframes_carried_back"] = len(states)
        keyframes = self._waiting.release(T_odom_vo, solved)
        if keyframes and first is not None:
            t_ns = keyframes[0].packet.keyframe.t_ns
            self.first_state = first_keyframe_state(states.get(t_ns, first), keyframes[0])
            if self._early is not None:
                self._leave_out(first, states, keyframes)
        if self._early is None:
            return Released(keyframes, T_odom_vo, None)
        self._early.forget()
        return Released(keyframes, T_odom_vo, solved)

    def _leave_out(self, first: NavState, states: dict[int, NavState], released: list[OdometryKeyframe]) -> None:
        """Note from when on scale is known, where that is later than the first keyframe."""
        known_ns = known_from(first, states)
        early = [keyframe for keyframe in released if keyframe.packet.keyframe.t_ns < known_ns]
        self.counters["keyframes_without_scale"] = len(early)
        if early:
            self.scaled_from_ns = known_ns
