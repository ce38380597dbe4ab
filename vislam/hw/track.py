"""Samples of a chip with a clock of its own, asked for at the times of another one."""

from __future__ import annotations

from collections import deque

from vislam.core.messages import Array
from vislam.hw.timing import SampleClock


class SampleTrack:
    """The newest samples of a chip that hands them over in groups; owns the fit of its clock."""

    def __init__(self, rate_hz: float, keep: int = 64) -> None:
        """Take the nominal rate; `keep` bounds what is held."""
        self._clock = SampleClock(rate_hz)
        self._times: deque[int] = deque(maxlen=keep)
        self._values: deque[Array] = deque(maxlen=keep)

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest sample, None when there is none."""
        return self._times[-1] if self._times else None

    @property
    def rate_hz(self) -> float:
        """The chip's rate by the host's clock."""
        return self._clock.rate_hz

    def restart(self) -> None:
        """Forget the samples, as after a hole; the rate stays."""
        self._clock.restart()
        self._times.clear()
        self._values.clear()

    def add(self, values: Array, asked_ns: int, answered_ns: int) -> None:
        """Take new samples [N, 3], N >= 1, that one question brought."""
        newest_ns = self._clock.newest_ns(len(values), asked_ns, answered_ns)
        period_ns = 1e9 / self._clock.rate_hz
        for k, value in enumerate(values):
            t_ns = newest_ns - round((len(values) - 1 - k) * period_ns)
            if self._times:
                t_ns = max(t_ns, self._times[-1] + 1)
            self._times.append(t_ns)
            self._values.append(value)

    def at(self, t_ns: int) -> Array | None:
        """Return the value [3] at a time, None if the samples do not reach around it; forgets what is older."""
        times, values = self._times, self._values
        while len(times) > 2 and times[1] <= t_ns:
            times.popleft()
            values.popleft()
        if len(times) < 2 or not times[0] <= t_ns <= times[1]:
            return None
        share = (t_ns - times[0]) / (times[1] - times[0])
        return (1.0 - share) * values[0] + share * values[1]
