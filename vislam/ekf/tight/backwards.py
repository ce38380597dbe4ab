"""Where the body was before its state was known: the tight filter run backwards in time.

Seen from its end a motion is a motion, too: with time reversed, velocities and rates of turn change their signs, forces
and gravity do not. So what a filter needs to go on from a state takes it to the time before that state just as well,
with scale, and with a covariance of its own. A state found late gives metres to what vision saw until then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vislam.config import EkfConfig, MachineConfig
from vislam.core.messages import ImuSample, ImuSpan, NavState, Observations, Tracking, VoMeasurement
from vislam.ekf.tight.filter import MsckfEkf
from vislam.imu import ImuNoise

if TYPE_CHECKING:
    from vislam.core.camera import Rig

_SPACING_NS = 90_000_000  # of frames that are used: parallax between nearer ones adds cost, not knowledge
_KNOWN_SHARE = 0.1  # of the way: sigma of a position, above which its scale is not known
_KNOWN_M = 0.05  # less is known well enough however short the way was
_REVERSED = np.diag(np.repeat([1.0, 1.0, -1.0, -1.0, 1.0], 3))  # velocity and gyro bias


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What a frame saw while the state was unknown."""

    t_ns: int
    observations: Observations
    at_rest: bool


class EarlyFrames:
    """Owns what frames saw while there was no state, and finds where they were once there is one."""

    def __init__(self, config: EkfConfig, rig: Rig, machine: MachineConfig) -> None:
        """Start empty; see `states_before`."""
        self._config, self._rig, self._machine = config, rig, machine
        self._seen: list[Sighting] = []

    def see(self, t_ns: int, observations: Observations, at_rest: bool) -> None:
        """Take a frame."""
        self._seen.append(Sighting(t_ns, replace(observations, descriptors=None), at_rest))

    def forget(self) -> None:
        """Forget all frames: they are not needed any more."""
        self._seen.clear()

    def restamp(self, shift_ns: int) -> None:
        """Bring all frames `shift_ns` later in the IMU's time."""
        self._seen = [replace(frame, t_ns=frame.t_ns + shift_ns) for frame in self._seen]

    def states(
        self, first: NavState, wanted_ns: list[int], cut: Callable[[int, int], ImuSpan | None], noise: ImuNoise
    ) -> dict[int, NavState]:
        """Return the states, by time, at those of the times wanted that are older than a state.

        `cut` gives the inertial data between two times.
        """
        wanted = sorted(t_ns for t_ns in wanted_ns if t_ns < first.t_ns)
        span = next((span for t_ns in wanted if (span := cut(t_ns, first.t_ns)) is not None), None)
        if span is None:
            return {}
        seen: list[Sighting] = []
        for frame in self._seen:
            if not seen or frame.t_ns in wanted or frame.t_ns - seen[-1].t_ns >= _SPACING_NS:
                seen.append(frame)
        states = states_before(first, span, seen, self._config, noise, self._rig, self._machine)
        return {t_ns: states[t_ns] for t_ns in wanted if t_ns in states}


def known_from(first: NavState, states: dict[int, NavState]) -> int:
    """Return the time from which states before a first one know their scale: a tenth of the way, or 5 cm."""
    last, way_m, from_ns = first, 0.0, first.t_ns
    for t_ns in sorted(states, reverse=True):
        state = states[t_ns]
        way_m += float(np.linalg.norm(state.T_world_body[:3, 3] - last.T_world_body[:3, 3]))
        grown_m2 = float(np.trace(state.covariance[3:6, 3:6] - first.covariance[3:6, 3:6]))
        if np.sqrt(max(grown_m2, 0.0)) <= max(_KNOWN_M, _KNOWN_SHARE * way_m):
            from_ns = t_ns
        last = state
    return from_ns


def states_before(
    state: NavState, span: ImuSpan, seen: Sequence[Sighting], config: EkfConfig, noise: ImuNoise, rig: Rig,
    machine: MachineConfig,
) -> dict[int, NavState]:  # fmt: skip
    """Return the states at the times of frames older than a state, by time.

    Args:
        state: in a gravity-aligned frame.
        span: inertial data that end at the state.
        seen: frames within the span, oldest first.
        config: of the tight filter.
        noise: of the IMU.
        rig: the cameras.
        machine: gravity is down in the frame of the state.
    """
    readout_s = config.tight_readout_s
    ekf = MsckfEkf(replace(config, tight_readout_s=None if readout_s is None else -readout_s), noise, machine, rig)
    mirror_ns = 2 * state.t_ns
    samples = [
        ImuSample(mirror_ns - t_ns, -gyro, accel)
        for t_ns, gyro, accel in zip(span.t_ns.tolist(), span.gyro_rad_s, span.accel_m_s2, strict=True)
    ][::-1]
    frames = [frame for frame in reversed(seen) if span.t_ns[0] <= frame.t_ns <= state.t_ns]
    ekf.initialise(_mirrored(state, mirror_ns))
    out: dict[int, NavState] = {}
    waiting: list[int] = []  # frames whose state is not asked for yet: what they saw enters with the sample after
    for sample in [*samples, None]:
        if sample is not None:
            ekf.predict(sample)
        while waiting and (found := ekf.state_at(waiting[0])) is not None:
            before = _mirrored(found, mirror_ns)
            out[before.t_ns] = before
            waiting.pop(0)
        while frames and (sample is None or mirror_ns - frames[0].t_ns <= sample.t_ns):
            frame = frames.pop(0)
            t_ns = mirror_ns - frame.t_ns
            learned_s = frame.observations.readout_s
            backwards = replace(frame.observations, readout_s=None if learned_s is None else -learned_s)
            ekf.update_vision(_motion(t_ns, backwards), backwards)
            if frame.at_rest:
                ekf.update_zero_velocity(t_ns)
            if t_ns > mirror_ns - state.t_ns:
                waiting.append(t_ns)
    for t_ns in waiting:
        found = ekf.state_at(t_ns)
        if found is not None:
            out[mirror_ns - t_ns] = _mirrored(found, mirror_ns)
    return out


def _mirrored(state: NavState, mirror_ns: int) -> NavState:
    return NavState(
        mirror_ns - state.t_ns, state.T_world_body, -state.velocity_world_m_s, -state.gyro_bias_rad_s,
        state.accel_bias_m_s2, _REVERSED @ state.covariance @ _REVERSED,
    )  # fmt: skip


def _motion(t_ns: int, seen: Observations) -> VoMeasurement:
    """Return what shows the filter only that a frame was tracked."""
    return VoMeasurement(t_ns, 0, np.eye(4), np.eye(6), False, Tracking.OK, len(seen.track_ids))
