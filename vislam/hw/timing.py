"""Time as sensors see it: the host's clock, and the times of samples that a chip takes by a clock of its own."""

import time
from collections import deque
from collections.abc import Callable
from typing import Protocol, TypeVar

Sample = TypeVar("Sample")

_MAX_RATE_ERROR = 0.05  # of a chip's oscillator; ADXL345 and ITG3205 stay within 2 %
_WALL_LOOKS = 3
_RATE_GAIN = 0.02  # of a contradiction; settles in a second and averages over many of them
_QUESTIONS = 200  # of about the last second
_SLEW = 0.02  # share of an interval between samples by which a better middle may stretch it


class Clock(Protocol):
    """What drivers need of time; the emulator has one that takes none."""

    def now_ns(self) -> int:
        """Return the time in ns."""
        ...

    def sleep_until(self, t_ns: int) -> None:
        """Return at or after `t_ns`."""
        ...


class HostClock:
    """CLOCK_MONOTONIC: never set, never jumps."""

    def now_ns(self) -> int:
        """Return the time in ns."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Return at or after `t_ns`."""
        left = t_ns - time.monotonic_ns()
        if left > 0:
            time.sleep(left * 1e-9)


class SampleClock:
    """Host times of samples that a chip takes by its own clock, keeps in a FIFO and hands over in groups.

    Each question brackets the newest sample: it was there when the answer came, and the next one was not yet there
    when the question was put. The fit moves only when a question contradicts it, whatever jitter the questions have,
    and so ends up anywhere in what the questions leave open; stamps are put into the middle of what those of about the
    last second do.
    """

    def __init__(self, rate_hz: float) -> None:
        """Start with the rate by the chip's nominal clock."""
        self._nominal_ns = 1e9 / rate_hz
        self._period_ns = self._nominal_ns
        self._newest_ns: float | None = None
        self._last_ns = 0
        self._shift_ns = 0.0
        self._early: deque[float] = deque(maxlen=_QUESTIONS)
        self._late: deque[float] = deque(maxlen=_QUESTIONS)

    @property
    def rate_hz(self) -> float:
        """The chip's rate by the host's clock."""
        return 1e9 / self._period_ns

    @property
    def bound_ms(self) -> float | None:
        """By how much stamps can be off: half of what the questions of the last second leave open. None before."""
        if len(self._early) < 2:
            return None
        return 0.5e-6 * max(min(self._early) + min(self._late), 0.0)

    def restart(self) -> None:
        """Forget when the newest sample was, as after lost samples; the rate stays."""
        self._newest_ns = None
        self._shift_ns = 0.0
        self._early.clear()
        self._late.clear()

    def stamps(self, count: int, asked_ns: int, answered_ns: int) -> list[int]:
        """Return times [ns] of `count` new samples, at least one, that a question found; they always increase."""
        newest_ns = self._fitted(count, asked_ns, answered_ns)
        period_ns = self._period_ns
        self._early.append(newest_ns - (asked_ns - period_ns))
        self._late.append(answered_ns - newest_ns)
        wanted_ns = 0.5 * (min(self._late) - min(self._early))
        most_ns = _SLEW * count * period_ns
        self._shift_ns += max(min(wanted_ns - self._shift_ns, most_ns), -most_ns)
        found = []
        for k in range(count - 1, -1, -1):
            self._last_ns = max(round(newest_ns + self._shift_ns - k * period_ns), self._last_ns + 1)
            found.append(self._last_ns)
        return found

    def _fitted(self, count: int, asked_ns: int, answered_ns: int) -> int:
        """Return when the fit has the newest sample, moved into this question's bracket."""
        earliest, latest = asked_ns - self._period_ns, float(answered_ns)
        if self._newest_ns is None:
            self._newest_ns = 0.5 * (earliest + asked_ns)
            return round(self._newest_ns)
        expected = self._newest_ns + count * self._period_ns
        contradiction = min(latest - expected, 0.0) + max(earliest - expected, 0.0)
        period = self._period_ns + _RATE_GAIN * max(min(contradiction / count, self._nominal_ns), -self._nominal_ns)
        bound = _MAX_RATE_ERROR * self._nominal_ns
        self._period_ns = max(min(period, self._nominal_ns + bound), self._nominal_ns - bound)
        self._newest_ns = expected + contradiction
        return round(self._newest_ns)


def wall_ahead_ns() -> int:
    """Return by how much the wall clock is ahead of CLOCK_MONOTONIC, whenever the process is put aside meanwhile."""
    shortest_ns, ahead_ns = None, 0
    for _ in range(_WALL_LOOKS):
        begin_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        took_ns = time.monotonic_ns() - begin_ns
        if shortest_ns is None or took_ns < shortest_ns:
            shortest_ns, ahead_ns = took_ns, wall_ns - begin_ns - took_ns // 2
    return ahead_ns


def read_in_rounds(
    clock: Clock, timeout_s: float, next_ns: Callable[[], int], poll: Callable[[], list[Sample]]
) -> list[Sample]:
    """Return what the first round gives that gives anything; `timeout_s` at most is waited for the rounds to come."""
    deadline = clock.now_ns() + round(timeout_s * 1e9)
    while True:
        if next_ns() > deadline:
            clock.sleep_until(deadline)
            return []
        clock.sleep_until(next_ns())
        samples = poll()
        if samples:
            return samples
