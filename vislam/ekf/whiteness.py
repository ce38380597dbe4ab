"""Whether what readings are off by hangs together: a filter takes each for itself, and so believes many too much.

Innovations of a filter whose model is right are white. Errors that neighbours share make them alike for a while, though
each is small: the filter follows them. How fast they change is seen nonetheless, and with it how long they last if they
are as large as the sensor's sigma has it.
"""

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from vislam.core.messages import Array
from vislam.ekf.history import Event, Innovation, M

_BIN_NS = 1_000_000_000  # readings of so long count as one: what a fast sensor shares within is a part of it
_KEPT = 4096  # of a source
_FEWEST = 30  # bins
_CLEAR = 3.1  # sigmas of a white sequence's correlation: one in a thousand
_OWN_SHARE = 0.5  # of what an innovation may be, that is the sensor's: below, it is the filter that errs


class SharedError(NamedTuple):
    """An error that readings of a sensor share, as innovations show it."""

    excess: float  # variance of the mean of many, over what it were if each erred for itself as stated
    sigmas: tuple[float, ...]  # of each number of the residual
    correlation_s: float


class _Bin(NamedTuple):
    """Readings of one source within a second; sums."""

    number: int
    readings: int
    white: Array  # [m]
    square: Array  # [m] of the residual
    noise: Array  # [m] its stated variance


class Whiteness:
    """Owns the innovations of a filter, in order of time."""

    def __init__(self) -> None:
        """Start with none."""
        self._bins: dict[tuple[str, int], deque[_Bin]] = {}

    def add(self, events: Iterable[Event[M]]) -> None:
        """Take what became of events that come after those so far."""
        for event in events:
            one = None if event.outcome is None else event.outcome.innovation
            if one is not None and one.own_share >= _OWN_SHARE:
                bins = self._bins.setdefault((one.sensor, one.source), deque(maxlen=_KEPT))
                _take(bins, one)

    def shared(self, events: Iterable[Event[M]]) -> dict[str, SharedError]:
        """Return, by sensor, the errors that readings share, with `events` that come after those so far."""
        all_ = Whiteness()
        all_._bins = {key: bins.copy() for key, bins in self._bins.items()}
        all_.add(events)
        names = dict.fromkeys(name for name, _ in all_._bins)
        found = {name: _shared([list(b) for (one, _), b in all_._bins.items() if one == name]) for name in names}
        return {name: error for name, error in found.items() if error is not None}


def _take(bins: deque[_Bin], one: Innovation) -> None:
    new = _Bin(one.t_ns // _BIN_NS, 1, one.white, one.residual**2, one.noise)
    if bins and bins[-1].number == new.number:
        last = bins.pop()
        new = _Bin(new.number, last.readings + 1, *(a + b for a, b in zip(last[2:], new[2:], strict=True)))
    bins.append(new)


def _shared(sources: list[list[_Bin]]) -> SharedError | None:
    """Return what readings of a sensor's sources share; None: nothing that is clear."""
    sources = [bins for bins in sources if len(bins) >= _FEWEST]
    if not sources:
        return None
    white = [np.array([one.white / np.sqrt(one.readings) for one in bins]) for bins in sources]  # of each [N, m]
    variance = _mean([z * z for z in white])
    noise = 1.0 / np.sqrt(sum(z.size for z in white))  # of a correlation
    alike: list[float] = []
    for lag in range(1, max(map(len, white)) // 4):
        correlation = _mean([z[lag:] * z[:-lag] for z in white if len(z) > lag]) / variance
        if correlation < (2.0 * noise if alike else _CLEAR * noise):
            break
        alike.append(correlation)
    if not alike:
        return None
    step_s = float(np.median(np.concatenate([np.diff([one.number for one in bins]) for bins in sources])))
    lasts_s = step_s * max(sum(alike) / alike[0] - 0.5, 1.0)
    span_s = step_s * max(map(len, white))
    count = sum(one.readings for bins in sources for one in bins)
    square, stated = (sum(one[k] for bins in sources for one in bins) / count for k in (3, 4))
    seen = alike[0] * square  # of the residual's variance; the filter follows the rest of the error
    slower = np.clip((stated - (1.0 - alike[0]) * square) / seen, 1.0, max(span_s / lasts_s, 1.0))
    excess = variance * (1.0 + 2.0 * sum(alike))
    return SharedError(excess, tuple(np.sqrt(seen * slower).tolist()), lasts_s * float(np.median(slower)))


def _mean(parts: list[Array]) -> float:
    return float(sum(part.sum() for part in parts) / max(sum(part.size for part in parts), 1))
