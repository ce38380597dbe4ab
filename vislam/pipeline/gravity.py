"""The wait for gravity: the search for the first state, and the keyframes that wait for it."""

from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum

import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.errors import TrackingLostError
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import FrontMemory, StartFacts
from vislam.core.messages import Array, ImuSpan, KeyframePacket, NavState, Tracking, VoMeasurement
from vislam.ekf.tight import EarlyFrames, known_from
from vislam.frontend import TrackResult
from vislam.frontend.camera_clock import CameraClock
from vislam.frontend.result import identity_motion
from vislam.frontend.start import Initialisation, Initialiser, level_at_once, moved_to
from vislam.frontend.stillness import MIN_FRAMES
from vislam.pipeline.blind_start import BlindStart, Said
from vislam.pipeline.chain import KeyframeChain
from vislam.pipeline.inertial_stages import Inertial
from vislam.trajectory import Trajectory
from vislam.trajectory.odometry_keyframe import OdometryKeyframe, WaitingKeyframes, first_keyframe_state

_LEVEL_S = 0.1  # with metric vision: samples before the first frame that say at once what is level
_OTHER_WAYS = "a start from rest, a second camera or depth needs less"


class Phase(StrEnum):
    """How far a run has come to a state that it may believe; `Start` has the ways from one to the next."""

    SEEKING = "seeking gravity"  # no state: keyframes wait in the frame of visual odometry
    PROVISIONAL = "provisional"  # the filter runs from a start that is still tested: keyframes wait
    SETTLED = "settled"  # the filter's frame is `odom`: keyframes leave at once
    RESUMED = "resumed"  # before the first frame, which is the newest keyframe of an earlier run
    VISION_ALONE = "vision alone"  # no IMU, or one whose gravity was given up: keyframes leave at once


class Start:
    """The phase of a run and the states that led to it.

    Attributes:
        phase: now.
        settled: the start that survived its test, or had to do without; None before.
        newest: the start that the filter runs from, provisional or settled; None before, and where it was given up.
        first_state: of keyframe 0, once gravity is known.
        refusal: why there was no state when it was last looked for.
        scaled_from_ns: before, poses of one camera have no scale; None: all have.
    """

    def __init__(self, has_imu: bool) -> None:
        """Begin to seek gravity, or without an IMU with vision alone."""
        self.phase = Phase.SEEKING if has_imu else Phase.VISION_ALONE
        self.settled: Initialisation | None = None
        self.newest: Initialisation | None = None
        self.first_state: NavState | None = None
        self.refusal = "no frame yet"
        self.scaled_from_ns: int | None = None
        self._begun_t_ns = 0  # when the first pose was given that was not taken back; 0: none was
        self._memory: FrontMemory | None = None  # of the earlier run, while RESUMED

    @property
    def holds_keyframes(self) -> bool:
        """Whether keyframes wait: they are not yet where they will be in `odom`."""
        return self.phase in (Phase.SEEKING, Phase.PROVISIONAL)

    def facts(self, noise: ImuNoise | None) -> StartFacts | None:
        """Return how gravity was found; None until then, or without an IMU."""
        found = self.settled
        if noise is None or found is None or found.last is None or self.first_state is None:
            return None
        return StartFacts(
            found.status, found.reason, found.last, found.scale_sigma, found.excitation_m_s2, noise,
            self.first_state, self._begun_t_ns,
        )  # fmt: skip

    def resume(self, memory: FrontMemory) -> None:
        """Wait for the frame at which an earlier run ended; with the start of that run, if it had one."""
        self._memory, self.phase = memory, Phase.RESUMED
        start = memory.start
        if start is None or memory.state is None:
            return
        self.first_state, self.refusal = start.first_state, start.reason
        self.settled = self.newest = Initialisation(
            start.status, start.reason, start.first_state, start.last, scale_sigma=start.scale_sigma,
            excitation_m_s2=start.excitation_m_s2,
        )  # fmt: skip
        self._begun_t_ns = start.begun_t_ns

    def see_again(self, has_imu: bool) -> FrontMemory | None:
        """Go on from RESUMED with the first frame; return what the earlier run left. None in any other phase."""
        memory, self._memory = self._memory, None
        if memory is not None:
            without = Phase.SEEKING if has_imu else Phase.VISION_ALONE
            self.phase = without if self.settled is None else Phase.SETTLED
        return memory

    def try_out(self, found: Initialisation) -> None:
        """Run the filter from a start; a settled one has to be settled as well."""
        assert found.last is not None
        if self.phase is Phase.SEEKING or found.takes_back:
            self._begun_t_ns = found.last.t_ns
        self.newest, self.phase = found, Phase.PROVISIONAL

    def settle(self, found: Initialisation) -> None:
        """Believe a start."""
        self.settled, self.phase = found, Phase.SETTLED

    def begin_blind(self, state: NavState) -> VoMeasurement:
        """Take the filter's state at the first keyframe of a run without a camera; return the motion up to it: none."""
        self.first_state = state
        return replace(identity_motion(state.t_ns, 0, True, 0), tracking=Tracking.BLIND)

    def give_up(self) -> None:
        """Go on without gravity, by vision that is metric."""
        self.newest, self.phase = None, Phase.VISION_ALONE


class GravityWait:
    """Finds the first state and starts the filter from it; keyframes wait in the frame `vo` till the start is settled.

    Until then the filter uses the newest provisional start, if there is one.
    """

    def __init__(
        self,
        config: Config,
        rig: Rig,
        noise: ImuNoise,
        start: Start,
        chain: KeyframeChain,
        inertial: Inertial,
        knows_scale: bool,
        said: Callable[[int], Said],
    ) -> None:
        """Bring `start` forward from the samples of `inertial`, and start its filter.

        `chain` is that of the keyframes. `knows_scale` is whether vision measures metres: where it does not, what is
        seen before scale is known is kept. `said` is what further sensors say, see `ReadingIntake.said`.
        """
        self.counters: dict[str, int] = {}
        self._start, self._chain = start, chain
        self._config = config
        self._noise = noise
        self._filtering, self._buffer = inertial.filtering, inertial.buffer
        self._refused: Initialisation | None = None  # the newest answer without a state
        self._moved = 1 - MIN_FRAMES  # frames that were not still, beyond the first ones, of which that is not known
        self._waiting = WaitingKeyframes()
        self._early = None if knows_scale else EarlyFrames(config.ekf, rig, config.machine)
        gravity_m_s2 = config.machine.gravity_m_s2
        self._initialiser: Initialiser | BlindStart
        if rig.is_blind:
            self._initialiser = BlindStart(config.init, noise, gravity_m_s2, said)
        else:
            self._initialiser = Initialiser(
                config.init, noise, gravity_m_s2, rig.T_body_cams[0], rig.cameras[0],
                config.frontend.track_sigma_px, config.window,
            )  # fmt: skip

    @property
    def search_counters(self) -> dict[str, dict[str, int]]:
        """Why starts were refused, and how many were taken back."""
        return {
            "initialisation refused": dict(self._initialiser.refusals),
            "initialisation": {"taken_back": self._initialiser.taken_back},
        }

    def seek(
        self, span: ImuSpan | None, track: TrackResult, still_image: bool, at_rest: bool, time_offset_sigma_s: float
    ) -> list[OdometryKeyframe]:
        """Look for the first gravity-aligned state with another frame; return what waited once it is settled.

        Args:
            span: inertial data since the last frame; None where they have a hole.
            track: of the frame.
            still_image: whether the image stood still up to it.
            at_rest: whether the body rests, by image and samples.
            time_offset_sigma_s: how well the camera's clock is known.
        """
        start = self._start
        if not start.holds_keyframes:
            return []
        self._moved += not still_image
        if self._early is not None:
            self._early.see(track.vo.t_ns, track.observations, at_rest)
        self._initialiser.time_offset_sigma_s = time_offset_sigma_s
        found = self._initialiser.add(span, track.vo, still_image, track.observations)
        start.refusal = found.reason if found.first is None else start.refusal
        self._refused = found if found.first is None else None
        if found.first is None and start.phase is Phase.SEEKING:
            found = self._level(span, track.vo) or found
        if found.last is None or found.first is None or found.T_odom_vo is None:
            return []
        before = self._filtering.ekf.pose_at(found.last.t_ns) if start.phase is Phase.PROVISIONAL else None
        return self._start_from(found if before is None else moved_to(found, before), track.vo)

    def follow_clock(self, clock: CameraClock, vo: VoMeasurement) -> int:
        """Let a frame, or the search, correct the camera's clock; return by how many ns that moves what waits.

        What has left stays as it was.
        """
        if self._start.phase is Phase.VISION_ALONE:
            return 0
        refused, self._refused = self._refused, None
        is_settled = self._start.settled is not None
        if refused is not None and np.isfinite(refused.time_offset_sigma_s):
            shift_ns = clock.tell(refused.time_offset_s, refused.time_offset_sigma_s)
        else:
            shift_ns = clock.follow(vo, self._buffer, is_settled)
        if shift_ns == 0 or is_settled:
            return 0
        self._initialiser.restamp(shift_ns, self._buffer.span)
        self._waiting.restamp(shift_ns, self._buffer.span)
        if self._early is not None:
            self._early.restamp(shift_ns)
        self._chain.t_ns += shift_ns
        clock.took_keyframe()
        return shift_ns

    def hold(self, packet: KeyframePacket, T_odom_body: Array | None, T_upright: Array) -> list[OdometryKeyframe]:
        """Let the newest keyframe wait; where others have waited too long, give up and return all.

        One camera then has to do with a provisional start, and raises TrackingLostError without one; metric vision goes
        on without the IMU.

        Args:
            packet: of the keyframe.
            T_odom_body: [4, 4] where a provisional start has it, if there is one.
            T_upright: [4, 4] where up is without gravity.
        """
        self._waiting.add(OdometryKeyframe(packet, self._chain.T_vo_body.copy()), T_odom_body)
        waited_s = self._waiting.waited_s(packet.keyframe.t_ns)
        if waited_s < self._config.init.give_up_s:
            return []
        if self._early is not None:
            if self._start.newest is None:
                raise TrackingLostError(f"no scale after {waited_s:.0f} s: {self._start.refusal}; {_OTHER_WAYS}")
            return self._release_untested()
        self.counters["imu_given_up"] = 1
        self._start.give_up()
        released = self._release(T_upright)
        self._chain.stand_up(T_upright)
        return released

    def finish(self, T_upright: Array) -> list[OdometryKeyframe]:
        """Return the keyframes that still wait when a recording ends, up being where `T_upright` [4, 4] has it.

        With one camera a provisional start has to do, and without any there is nothing to return.
        """
        if not self._start.holds_keyframes:
            return []
        return self._release(T_upright) if self._early is None else self._release_untested()

    def _release_untested(self) -> list[OdometryKeyframe]:
        """Return the waiting keyframes by the newest provisional start of one camera; without one, none."""
        found = self._start.newest
        if found is None or found.T_odom_vo is None:
            return []
        self.counters["start_unconfirmed"] = 1
        self._start.settle(replace(found, reason=f"{found.reason}; not confirmed: {self._start.refusal}"))
        return self._release(found.T_odom_vo)

    def _start_from(self, found: Initialisation, vo: VoMeasurement) -> list[OdometryKeyframe]:
        """Start the filter, again if it runs; return what waited once the start is settled."""
        assert found.last is not None and found.T_odom_vo is not None
        self._start.try_out(found)
        sees = vo.T_keyframe_body is not None
        self._filtering.start(found.last, vo if sees else identity_motion(found.last.t_ns, -1, True, 0))
        if not found.is_settled:
            return []
        self._start.settle(found)
        return self._release(found.T_odom_vo)

    def _level(self, span: ImuSpan | None, vo: VoMeasurement) -> Initialisation | None:
        """Return a provisional state from the newest samples alone, where vision is metric and goes on from there.

        The tight filter has tracks, not metres: it does not find the velocity at once.
        """
        if not vo.has_scale or vo.T_keyframe_body is None or self._filtering.coupling != "loose":
            return None
        if span is None and self._buffer.oldest_t_ns is not None:
            oldest_ns = vo.t_ns - round(_LEVEL_S * 1e9)
            span = self._buffer.unbroken(max(oldest_ns, self._buffer.oldest_t_ns), vo.t_ns)
        if span is None:
            return None
        return level_at_once(span, vo.t_ns, self._chain.T_vo_body, self._config.machine.gravity_m_s2, self._config.init)

    def _release(self, T_odom_vo: Array) -> list[OdometryKeyframe]:
        """Return the waiting keyframes in `odom`, with the newest placed there and the state of the first settled.

        Without scale the visual chain has no positions; those that the initialisation solved for take their place.
        """
        found = self._start.settled
        first = None if found is None else found.first
        solved: dict[int, Array] = {}
        states: dict[int, NavState] = {}
        if self._early is not None and found is not None and first is not None and found.T_odom_body is not None:
            states = self._early.states(first, self._waiting.t_ns, self._buffer.span, self._noise)
            if found.status == "static" and self._moved <= 0:  # samples may begin after the camera
                states = {t: replace(first, t_ns=t) for t in self._waiting.t_ns if t < first.t_ns} | states
            solved = self._waiting.provisional
            solved |= {t_ns: state.T_world_body for t_ns, state in states.items()}
            solved |= self._waiting.between(Trajectory(np.array(found.t_ns, dtype=np.int64), found.T_odom_body))
            self.counters["keyframes_carried_back"] = len(states)
        keyframes = self._waiting.release(T_odom_vo, solved)
        if keyframes and first is not None:
            t_ns = keyframes[0].packet.keyframe.t_ns
            self._start.first_state = first_keyframe_state(states.get(t_ns, first), keyframes[0])
            if self._early is not None:
                self._leave_out(first, states, keyframes)
        if self._early is None:
            self._chain.place(T_odom_vo @ self._chain.T_vo_keyframe)
        else:
            self._early.forget()
            self._chain.place(solved.get(self._chain.t_ns))
        return keyframes

    def _leave_out(self, first: NavState, states: dict[int, NavState], released: list[OdometryKeyframe]) -> None:
        """Note from when on scale is known, where that is later than the first keyframe."""
        known_ns = known_from(first, states)
        early = [keyframe for keyframe in released if keyframe.packet.keyframe.t_ns < known_ns]
        self.counters["keyframes_without_scale"] = len(early)
        if early:
            self._start.scaled_from_ns = known_ns
