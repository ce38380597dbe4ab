"""What every filter does with time: measurements late and out of order, going back and running forward, counters.

The filter goes back to the time of a measurement and runs forward again, so the answer depends only on the set of
measurements, not on when they came. What a state is and how it is corrected is the core's.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic

import numpy as np

from vislam.config import MachineConfig
from vislam.core.geometry import interpolate
from vislam.core.messages import Array, ImuSample, NavState
from vislam.ekf.filter_core import Core, S
from vislam.ekf.history import Checkpoint, Event, History, M, Outcome, Statistics, add_all
from vislam.ekf.loose.kernels import pose
from vislam.ekf.stretch import keep_track, stretch
from vislam.ekf.whiteness import SharedError, Whiteness
from vislam.imu import ImuSeries

_CHECKPOINT_S = 0.05  # a rewind replays at most this much more than the delay, 4 kB each
_NS = 1_000_000_000
_HABIT_NS = _NS // 2  # in which an acceleration that nothing measures fades away
_WAITS = "waits for an inertial sample as new"


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """What the filter did with a measurement; `nis` is NaN where none was computed."""

    accepted: bool
    nis: float
    reason: str


class _Counting(Generic[S, M]):
    """What came in and what became of it, in numbers."""

    _series: ImuSeries
    _history: History[S, M] | None
    _counts: dict[str, int]
    _statistics: Statistics
    _whiteness: Whiteness

    @property
    def counters(self) -> dict[str, int]:
        """What came in and what became of it."""
        return {**self._counts, **{f"imu_{reason}": n for reason, n in self._series.judge.refused.items()}}

    @property
    def nis_statistics(self) -> Statistics:
        """Return count, sum of the normalised innovation squared and sum of its degrees of freedom, by measurement.

        Of the measurements that were accepted, each as of the last time it was applied; what the gate refused is in
        `counters`. The second over the third is 1 where the noise that the filter assumes is the true one.
        """
        sums = dict(self._statistics)
        add_all(sums, [] if self._history is None else self._history.events)
        return sums

    @property
    def shared_errors(self) -> dict[str, SharedError]:
        """Return, by sensor, what its readings clearly err together by, though the filter took each for itself."""
        return self._whiteness.shared([] if self._history is None else self._history.events)

    def _forget(self, events: list[Event[M]]) -> None:
        add_all(self._statistics, events)
        self._whiteness.add(events)

    def _refuse(self, counter: str, reason: str) -> UpdateResult:
        self._counts[counter] += 1
        return UpdateResult(False, float("nan"), reason)

    def _account(self, outcome: Outcome, sign: int) -> None:
        for name, number in outcome.counts.items():
            self._counts[name] += sign * number


class Timeline(_Counting[S, M]):
    """Owns the state, its covariance and the last seconds of samples and measurements. One thread only.

    Until it is begun, samples are only kept; a state in the past is then brought to the present through them.
    """

    def __init__(self, core: Core[S, M], state: S, history_s: float, machine: MachineConfig) -> None:
        """Set up an uninitialised filter; holes in the samples of more than `max_gap_s` are bridged and counted."""
        self._core = core
        self._state = state
        self._checkpoint_ns = round(_CHECKPOINT_S * _NS)
        self._history_ns = round(history_s * _NS)
        self._max_gap_ns, self._gravity_m_s2 = round(machine.max_gap_s * _NS), float(machine.gravity_m_s2)
        self._series = ImuSeries(10, machine.max_gap_s)  # beside each sample, x[:10] as of the last run through it
        self._history: History[S, M] | None = None
        self._t_ns = 0
        self._known_ns: int | None = None  # of the newest sample that came; later ones are assumed
        self._believes = True  # samples, see `believe`
        self._applied = 0
        self._stops_at_event = False  # see `replayed_once`
        self._counts: dict[str, int] = dict.fromkeys(("imu_samples", "imu_gaps", *core.counters), 0)
        self._statistics, self._whiteness = {}, Whiteness()  # of events that the history has forgotten

    @property
    def initialised(self) -> bool:
        """Whether there is a state."""
        return self._history is not None

    @property
    def dead_reckoning_s(self) -> float:
        """Seconds since vision last corrected the state, or since `initialise`; infinite before."""
        return (self._t_ns - self._state.last_vision_t_ns) / _NS if self.initialised else float("inf")

    def predict(self, sample: ImuSample) -> None:
        """Take a sample and bring the state to its time.

        Samples that are no measurement of a new time, see `StreamJudge`, are counted and change nothing. What was
        assumed before it, see `assume`, is taken back.
        """
        if not self._believes:
            return
        before, history, kept_ns = self._known_ns, self._history, None
        if history is not None and before is not None and before != self._series.newest_t_ns:
            kept_ns = max(before, history.checkpoints[0].t_ns)
        if not self._series.append(sample, kept_ns):
            return
        self._known_ns = sample.t_ns
        self._counts["imu_samples"] += 1
        if kept_ns is not None and history is not None:
            self._restore(history.back_to(kept_ns))
        dt_ns = 0 if before is None else sample.t_ns - before
        if dt_ns > self._max_gap_ns:
            self._counts["imu_gaps"] += 1
        if history is None:
            if sample.t_ns - int(self._series.t_ns[0]) > 2 * self._history_ns:
                self._series.forget_before(sample.t_ns - self._history_ns)
            return
        if before != self._t_ns or dt_ns > self._max_gap_ns or history.event(self._applied) is not None:
            self._run()
            return
        values = self._series.values  # the way of nearly every sample: one step, no measurement on it
        self._core.step(self._state, values[-2], values[-1], dt_ns * 1e-9)
        self._series.extra[-1] = self._state.x[:10]
        self._t_ns = sample.t_ns
        if sample.t_ns - history.checkpoints[-1].t_ns >= self._checkpoint_ns:
            self._take_checkpoint()

    def believe(self, until_ns: int | None) -> None:
        """Go on without the samples after a time, also those that come; None: with those that come from now on.

        Frames then take the filter on, see `assume`.
        """
        history, believed, self._believes = self._history, self._believes, until_ns is None
        if history is None or self._known_ns is None or believed is self._believes:
            return
        if until_ns is None:  # what was assumed meanwhile stays
            self._known_ns = self._series.newest_t_ns
            return
        self._series.drop_after(max(until_ns, history.checkpoints[0].t_ns, int(self._series.t_ns[0])))
        self._known_ns = self._series.newest_t_ns
        self._restore(history.back_to(self._known_ns or 0))
        self._run()

    def assume(self, t_ns: int) -> None:
        """Go on to a frame that no sample reaches, as unsure as in a hole, and apply what waits.

        The newest sample fades into uniform motion. Samples that come later take its place, as far back as the history
        reaches.
        """
        history = self._history
        if self._known_ns is None or history is None:
            return
        while (event := history.event(self._applied)) is not None and event.t_ns <= t_ns:
            number = self._applied
            self._go_on(self._core.time_of(event, self._state))
            if self._applied == number:
                break
        self._go_on(t_ns)

    def _go_on(self, t_ns: int) -> None:
        """Go on to a time without samples, and apply what waits until then."""
        if t_ns > (self._series.newest_t_ns or t_ns):
            uniform = _in_uniform_motion(self._state.x, self._gravity_m_s2)
            share = np.exp((self._t_ns - t_ns) / _HABIT_NS)
            self._series.assume(t_ns, uniform + share * (self._series.values[-1] - uniform))
            self._run()

    @contextmanager
    def replayed_once(self) -> Iterator[None]:
        """Inside, go no farther than each measurement; what came after them is replayed at the end, once for all."""
        self._stops_at_event = True
        try:
            yield
        finally:
            self._stops_at_event = False
            self._run()

    def state(self) -> NavState:
        """Return the state at the newest sample. Raises ValueError before `initialise`."""
        if self._history is None:
            raise ValueError("the filter has no state yet; call initialise first")
        return self._nav_state(self._t_ns, self._state)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the filtered state at a time within the history, None outside of it."""
        state = self._state_then(t_ns)
        return None if state is None else self._nav_state(t_ns, state)

    def pose_at(self, t_ns: int) -> Array | None:
        """Return T_odom_body [4, 4] at a time within the history, interpolated; None outside of it."""
        checkpoint = self._checkpoint_at(t_ns)
        if checkpoint is None:
            return None
        if checkpoint.t_ns == t_ns:
            return pose(checkpoint.state.x, 0, 6)
        times, track = self._series.t_ns, self._series.extra
        after = int(np.searchsorted(times, t_ns))
        if after == len(times):  # the start, when it is newer than every sample
            return pose(self._state.x, 0, 6)
        before_ns, before = checkpoint.t_ns, checkpoint.state.x[:10]
        if after > 0 and int(times[after - 1]) > before_ns:
            before_ns, before = int(times[after - 1]), track[after - 1]
        alpha = (t_ns - before_ns) / (int(times[after]) - before_ns)
        return interpolate(pose(before.copy(), 0, 6), pose(track[after].copy(), 0, 6), alpha)

    def _begin(self, t_ns: int, state: S) -> None:
        """Start at a state, at any time, and run it through the samples that are already here. Forgets the past."""
        self._t_ns, self._applied, self._state = t_ns, 0, state
        self._series.extra[:] = np.nan
        self._history = History(self._snapshot(after_event=True), self._core.time_of)
        self._run()

    def _insert(self, event: Event[M]) -> UpdateResult:
        history = self._history
        if history is None:
            return self._refuse("before_start", "the filter has no state yet")
        t_ns = self._core.time_of(event, self._state)
        oldest = history.checkpoints[0].t_ns
        if history.is_too_old(event):
            return self._refuse("too_late", f"{(oldest - event.t_ns) / _NS:.3f} s older than the history")
        newest = max(self._series.newest_t_ns or oldest, self._t_ns)
        if t_ns - newest > self._history_ns:
            return self._refuse("too_early", f"{(t_ns - newest) / _NS:.3f} s ahead of the newest inertial sample")
        number = history.insert(event)
        if t_ns < self._t_ns or number < self._applied:
            self._counts["rewinds"] += 1
            self._restore(history.rewind(number))
        elif t_ns > self._t_ns:  # a sample as new has to come first
            return UpdateResult(False, float("nan"), _WAITS)
        self._run(t_ns if self._stops_at_event else None)
        outcome = event.outcome
        if outcome is None:
            return UpdateResult(False, float("nan"), _WAITS)
        return UpdateResult(outcome.accepted, outcome.nis, outcome.reason)

    def _run(self, until_ns: int | None = None) -> None:
        """Go on from the present state through every sample and event that is here, or until a time."""
        history = self._history
        newest = self._series.newest_t_ns if until_ns is None else until_ns
        if history is None:
            return
        while (event := history.event(self._applied)) is not None:
            t_ns = self._core.time_of(event, self._state)
            if t_ns > max(newest or 0, self._t_ns):
                break
            self._advance(t_ns)
            self._apply(event, t_ns)
            self._applied += 1
            self._take_checkpoint(after_event=True)
        if newest is not None:
            self._advance(newest)

    def _advance(self, t_ns: int) -> None:
        while self._t_ns < t_ns:
            step_ns = min(t_ns, self._t_ns + self._checkpoint_ns)
            if step_ns < t_ns:  # stop on a sample: stopping between two would change the arithmetic
                step_ns = int(self._series.t_ns[np.searchsorted(self._series.t_ns, step_ns)])
                step_ns = min(step_ns, t_ns)
            self._integrate(self._state, self._t_ns, step_ns, keep=True)
            self._t_ns = step_ns
            if self._history is not None and step_ns - self._history.checkpoints[-1].t_ns >= self._checkpoint_ns:
                self._take_checkpoint()

    def _integrate(self, state: S, t0_ns: int, t1_ns: int, keep: bool = False) -> None:
        if t1_ns <= t0_ns:
            return
        piece = stretch(self._series, t0_ns, t1_ns, self._max_gap_ns, self._known_ns or t1_ns)
        track = np.empty((len(piece.t_ns), 10))
        self._core.run(state, piece, track)
        if keep:
            keep_track(self._series, piece, track)

    def _apply(self, event: Event[M], t_ns: int) -> None:
        if event.outcome is not None:  # a rerun: what it was counted as before no longer holds
            self._account(event.outcome, -1)
        event.outcome = self._core.apply(self._state, event, self._rate_at(t_ns), (self._t_ns - t_ns) * 1e-9)
        self._account(event.outcome, 1)

    def _rate_at(self, t_ns: int) -> Array:
        """Return what the gyro showed [3]."""
        return self._series.at(t_ns)[:3] if len(self._series) else np.zeros(3)

    def _checkpoint_at(self, t_ns: int) -> Checkpoint[S] | None:
        return self._history.checkpoint_at(t_ns) if self._history is not None and t_ns <= self._t_ns else None

    def _state_then(self, t_ns: int) -> S | None:
        checkpoint = self._checkpoint_at(t_ns)
        if checkpoint is None:
            return None
        state = checkpoint.state.copy()
        self._integrate(state, checkpoint.t_ns, t_ns)
        return state

    def _snapshot(self, after_event: bool) -> Checkpoint[S]:
        return Checkpoint(self._t_ns, self._applied, self._state.copy(), after_event)

    def _take_checkpoint(self, after_event: bool = False) -> None:
        history = self._history
        assert history is not None
        history.checkpoints.append(self._snapshot(after_event))
        if self._t_ns - history.checkpoints[0].t_ns > self._history_ns + 8 * self._checkpoint_ns:
            self._forget(history.forget_before(self._t_ns - self._history_ns))
            self._series.forget_before(history.checkpoints[0].t_ns)

    def _restore(self, checkpoint: Checkpoint[S]) -> None:
        self._t_ns, self._applied, self._state = checkpoint.t_ns, checkpoint.applied, checkpoint.state.copy()

    def _nav_state(self, t_ns: int, state: S) -> NavState:
        x, covariance = state.x, self._core.covariance(state)
        return NavState(t_ns, pose(x, 0, 6), x[3:6].copy(), x[13:16].copy(), x[10:13].copy(), covariance)


def _in_uniform_motion(x: Array, gravity_m_s2: float) -> Array:
    """Return what an IMU shows [6] of a body that neither turns nor speeds up, in a state x."""
    return np.concatenate([x[13:16], pose(x, 0, 6)[2, :3] * gravity_m_s2 + x[10:13]])
