"""Times of samples that a chip takes by a clock of its own and keeps in a FIFO."""

from __future__ import annotations

from collections import deque

from vislam.hw.timing import SampleClock

_QUESTIONS = 200  # of about the last second
_SLEW = 0.02  # share of an interval between samples by which a better middle may stretch it


class FifoStamps:
    """Stamps samples by the counts of a FIFO: a question that finds n new ones brackets when the newest was taken.

    Owns the fit of the chip's clock. That moves only when a question contradicts it, and so ends up anywhere in what
    the questions leave open; stamps are put into the middle of what those of about the last second do.
    """

    def __init__(self, rate_hz: float) -> None:
        """Take the rate by the chip's nominal clock."""
        self._clock = SampleClock(rate_hz)
        self._last_ns = 0
        self._shift_ns = 0.0
        self._early: deque[float] = deque(maxlen=_QUESTIONS)
        self._late: deque[float] = deque(maxlen=_QUESTIONS)

    @property
    def rate_hz(self) -> float:
        """The chip's rate by the host's clock."""
        return self._clock.rate_hz

    @property
    def bound_ms(self) -> float | None:
        """By how much stamps can be off: half of what the questions of the last second leave open. None before."""
        if len(self._early) < 2:
            return None
        return 0.5e-6 * max(min(self._early) + min(self._late), 0.0)

    def restart(self) -> None:
        """Forget when the newest sample was, as after lost samples; the rate stays."""
        self._clock.restart()
        self._shift_ns = 0.0
        self._early.clear()
        self._late.clear()

    def of(self, count: int, asked_ns: int, answered_ns: int) -> list[int]:
        """Return times [ns] of `count` new samples, at least one, that a question found; they always increase."""
        newest_ns = self._clock.newest_ns(count, asked_ns, answered_ns)
        period_ns = 1e9 / self._clock.rate_hz
        self._early.append(newest_ns - (asked_ns - period_ns))
        self._late.append(answered_ns - newest_ns)
        wanted_ns = 0.5 * (min(self._late) - min(self._early))
        most_ns = _SLEW * count * period_ns
        self._shift_ns += max(min(wanted_ns - self._shift_ns, most_ns), -most_ns)
        stamps = []
        for k in range(count - 1, -1, -1):
            self._last_ns = max(round(newest_ns + self._shift_ns - k * period_ns), self._last_ns + 1)
            stamps.append(self._last_ns)
        return stamps
