"""The last seconds of inertial data, from which spans between frames are cut."""

from dataclasses import replace

import numpy as np

from vislam.config import ImuConfig, MachineConfig
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import ImuSample, ImuSpan
from vislam.core.streams import Happening, StreamEvent
from vislam.imu.noise_floor import NoiseFloor
from vislam.imu.series import ImuSeries

_NS = 1_000_000_000
_FORGOTTEN_NS = _NS  # after which a body may have turned any way


class ImuBuffer:
    """Takes samples in time order and cuts spans with interpolated ends; bounded by `config.buffer_s`.

    Attributes:
        counters: "samples" taken; those refused, by what happened; "gaps" longer than `machine.max_gap_s`.
        noise_floor: what the samples show of their noise; None without a model to compare with.
        outages: spans that `unbroken` could not give.
    """

    def __init__(self, config: ImuConfig, machine: MachineConfig, noise: ImuNoise | None = None) -> None:
        """Start empty; with a noise model the spans have what the samples show against it."""
        self.noise_floor = None if noise is None else NoiseFloor(noise)
        self.outages = 0
        self._series = ImuSeries(max_gap_s=machine.max_gap_s, rate_hz=0.0 if noise is None else noise.rate_hz)
        self._buffer_ns = round(config.buffer_s * _NS)
        self._max_gap_ns = round(machine.max_gap_s * _NS)
        self._samples = 0
        self._forget_at_ns = 0
        self._disbelieved: list[tuple[int, StreamEvent]] = []  # after which time, and the event that shows it
        self._believes = True  # now

    @property
    def newest_t_ns(self) -> int | None:
        """Time of the newest sample; None before the first."""
        return self._series.newest_t_ns

    @property
    def oldest_t_ns(self) -> int | None:
        """Time of the oldest sample still held; None before the first."""
        return int(self._series.t_ns[0]) if len(self._series) else None

    @property
    def counters(self) -> dict[str, int]:
        """What was taken, refused and missing so far."""
        gaps = sum(event.happening is Happening.HOLE for event in self.events)
        return {"samples": self._samples, **self._series.judge.refused, "gaps": gaps}

    @property
    def events(self) -> list[StreamEvent]:
        """What happened in the stream so far."""
        known = self._series.judge.events
        bursts_ns = [event.from_ns for event in known if event.happening is Happening.BURST]
        return [*known, *(event for after_ns, event in self._disbelieved if after_ns not in bursts_ns)]

    def burst_ns(self, t_ns: int) -> int | None:
        """Return after which time samples came in bursts, up to half a second before `t_ns`; None: they did not."""
        bursts = (e for e in self._series.judge.events if e.happening is Happening.BURST and t_ns - e.to_ns < _NS // 2)
        return next((event.from_ns for event in bursts), None)

    def believe(self, until_ns: int | None, since_ns: int) -> None:
        """Take samples after `until_ns` for no information, None: those that come from now on are some again.

        Since `since_ns` they are seen to contradict other sensors.
        """
        if until_ns is not None and self._believes:
            times = self._series.t_ns[np.searchsorted(self._series.t_ns, since_ns) :]
            event = StreamEvent(self._series.judge.stream, Happening.CONTRADICTING, since_ns, since_ns, len(times))
            self._disbelieved.append((until_ns, replace(event, to_ns=int(times[-1]))))
        self._believes = until_ns is None

    def add(self, sample: ImuSample) -> bool:
        """Take a sample; False, and a counter, if it is no measurement or not newer than the last."""
        if not self._series.append(sample):
            return False
        self._samples += 1
        if not self._believes:
            after_ns, event = self._disbelieved[-1]
            self._disbelieved[-1] = after_ns, replace(event, to_ns=sample.t_ns, rows=event.rows + 1)
        if self.noise_floor is not None:
            self.noise_floor.add(sample)
        if sample.t_ns >= self._forget_at_ns:  # now and then: forgetting costs more than taking in
            self._series.forget_before(sample.t_ns - self._buffer_ns)
            self._forget_at_ns = sample.t_ns + self._buffer_ns // 16
        return True

    def span(self, t0_ns: int, t1_ns: int) -> ImuSpan | None:
        """Return the samples of `[t0_ns, t1_ns]`, first and last interpolated to these times.

        None if the samples held do not cover it, or are not believed, or if t1 is not after t0. A hole in the samples
        is interpolated across; ask `gap_s` whether there is one before trusting the span.
        """
        span = self._series.cut(t0_ns, t1_ns) if self._is_believed(t0_ns, t1_ns) else None
        if span is None or self.noise_floor is None:
            return span
        return replace(span, noise=self.noise_floor.between(t0_ns, t1_ns))

    def as_felt(self, t0_ns: int, t1_ns: int) -> ImuSpan | None:
        """Return the samples of `[t0_ns, t1_ns]`, believed or not; None where there is a hole."""
        return None if self._longest_ns(t0_ns, t1_ns) > self._max_gap_ns else self._series.cut(t0_ns, t1_ns)

    def after_hole(self, t0_ns: int, t1_ns: int) -> ImuSpan | None:
        """Return the samples up to `t1_ns` since a hole of which a second or more lies in `[t0_ns, t1_ns]`; None: none.

        None as well while there are not two of them.
        """
        times = self._series.t_ns
        times = times[max(int(np.searchsorted(times, t0_ns)) - 1, 0) : np.searchsorted(times, t1_ns, side="right")]
        ends = np.flatnonzero(times[1:] - np.maximum(times[:-1], t0_ns) > _FORGOTTEN_NS) + 1
        return self.span(int(times[ends[-1]]), t1_ns) if len(ends) and ends[-1] + 1 < len(times) else None

    def unbroken(self, t0_ns: int, t1_ns: int) -> ImuSpan | None:
        """Return `span`, or None, and count it, where a hole in it is longer than `machine.max_gap_s`."""
        if self.gap_s(t0_ns, t1_ns) > self._max_gap_ns / _NS:
            self.outages += 1
            return None
        return self.span(t0_ns, t1_ns)

    def gap_s(self, t0_ns: int, t1_ns: int) -> float:
        """Return the longest time between neighbouring samples among those that `[t0_ns, t1_ns]` touches.

        Holes count whole even where the interval ends inside one. Infinite if the samples held do not cover it, or are
        not believed.
        """
        return self._longest_ns(t0_ns, t1_ns) / _NS if self._is_believed(t0_ns, t1_ns) else float("inf")

    def _longest_ns(self, t0_ns: int, t1_ns: int) -> float:
        times = self._series.t_ns
        if len(times) < 2 or t0_ns < times[0] or t1_ns > times[-1]:
            return float("inf")
        begin = max(int(np.searchsorted(times, t0_ns, side="right")) - 1, 0)
        end = min(int(np.searchsorted(times, t1_ns)) + 1, len(times))
        return float(np.diff(times[begin:end]).max(initial=0))

    def _is_believed(self, t0_ns: int, t1_ns: int) -> bool:
        last = len(self._disbelieved) - 1
        return not any(
            after_ns < t1_ns and (t0_ns < event.to_ns or (n == last and not self._believes))
            for n, (after_ns, event) in enumerate(self._disbelieved)
        )
