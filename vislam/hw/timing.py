"""Time as sensors see it: the host's clock, and the times of samples that a chip takes by a clock of its own."""

import time
from collections.abc import Callable
from typing import Protocol, TypeVar

Sample = TypeVar("Sample")

_MAX_RATE_ERROR = 0.05  # of a chip's oscillator; ADXL345 and ITG3205 stay within 2 %
_WALL_LOOKS = 3
_RATE_GAIN = 0.02  # of a contradiction; settles in a second and averages over many of them


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
    """Host times of samples that a chip takes by its own clock and hands over in groups.

    Each question brackets the newest sample: it was there when the answer came, and the next one was not yet there
    when the question was put. The estimate is moved only when it leaves the bracket, and so settles on the chip's own
    even spacing, whatever jitter the questions have.
    """

    def __init__(self, rate_hz: float) -> None:
        """Start with the nominal rate."""
        self._nominal_ns = 1e9 / rate_hz
        self._period_ns = self._nominal_ns
        self._newest_ns: float | None = None

    @property
    def rate_hz(self) -> float:
        """The chip's rate by the host's clock."""
        return 1e9 / self._period_ns

    def restart(self) -> None:
        """Forget when the newest sample was, as after lost samples; the rate stays."""
        self._newest_ns = None

    def newest_ns(self, count: int, asked_ns: int, answered_ns: int) -> int:
        """Return the time of the newest of `count` new samples that a question found, `count` >= 1."""
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
