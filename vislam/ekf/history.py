"""What a filter remembers so that it can go back: measurements in time order and states to start again from."""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

from vislam.core.messages import Array, NoiseScale
from vislam.core.readings import OwnStart, Reading

S = TypeVar("S")
M = TypeVar("M")
Statistics = dict[str, tuple[int, float, int]]  # by kind of measurement: number, sum of NIS, of degrees of freedom


class AtRest(NamedTuple):
    """The body does not move."""


class KnownBias(NamedTuple):
    """Biases of the IMU that were found elsewhere."""

    values: Array  # [12] gyro, accel, and their sigmas


class Innovation(NamedTuple):
    """What a reading was off by."""

    sensor: str
    source: int  # of the sensor
    t_ns: int
    white: Array  # [m] over what it may be off by, uncorrelated
    residual: Array  # [m]
    noise: Array  # [m] variances of the sensor's
    own_share: float  # of what it may be off by, that is the sensor's


@dataclass(slots=True, eq=False)
class Outcome:
    """What became of a measurement."""

    accepted: bool = False
    nis: float = float("nan")
    reason: str = ""
    counts: dict[str, int] = field(default_factory=dict)
    statistics: Statistics = field(default_factory=dict)
    innovation: Innovation | None = None  # of a reading that was accepted

    def count(self, name: str, number: int = 1) -> None:
        """Add to a counter."""
        if number:
            self.counts[name] = self.counts.get(name, 0) + number

    def accept(self, name: str) -> None:
        """Take the measurement for used."""
        self.accepted = True
        self.count(name)

    def test(self, kind: str, number: int, nis: float, dof: int) -> None:
        """Add tests to the statistics."""
        add(self.statistics, kind, (number, nis, dof))


@dataclass(slots=True, eq=False)
class Event(Generic[M]):
    """A measurement, and what became of it the last time it was applied."""

    t_ns: int  # by the clock of the sensor: the core knows when that was by the IMU's
    # noise: from here on, over what the filter was made with
    measurement: M | AtRest | KnownBias | NoiseScale | Reading | OwnStart
    outcome: Outcome | None = None  # None while it waits for the IMU


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint(Generic[S]):
    """The whole filter at one instant, after `applied` events since the start."""

    t_ns: int
    applied: int
    state: S
    after_event: bool  # taken right after the last of them


class History(Generic[S, M]):
    """Events in order of their stamps and checkpoints, both bounded by `forget_before`.

    Of one stamp, readings of other sensors come last, by name, and what begins a sensor before them: several of them
    often have one stamp. The rest stands in order of arrival.
    """

    def __init__(self, first: Checkpoint[S], time_of: Callable[[Event[M], S], int]) -> None:
        """Begin at a checkpoint; `time_of` gives when an event happened by the IMU's clock, as far as a state knows."""
        self.checkpoints = [first]
        self._time_of = time_of
        self._events: list[Event[M]] = []
        self._forgotten = 0  # events dropped from the front; all numbering counts them

    @property
    def events(self) -> list[Event[M]]:
        """Those not forgotten, in time order."""
        return self._events

    def insert(self, event: Event[M]) -> int:
        """Sort an event in and return its number since the start."""
        place = bisect_right(self._events, _turn(event), key=_turn)
        self._events.insert(place, event)
        return place + self._forgotten

    def event(self, number: int) -> Event[M] | None:
        """Return an event by its number, None past the last."""
        place = number - self._forgotten
        return self._events[place] if place < len(self._events) else None

    def holds(self, t_ns: int, kind: type[object]) -> bool:
        """Whether a measurement of this kind and stamp is here already."""
        return any(isinstance(event.measurement, kind) for event in self.of(t_ns))

    def of(self, t_ns: int) -> Iterator[Event[M]]:
        """Yield the events of a stamp, newest first."""
        place = bisect_right(self._events, t_ns, key=_stamp)
        while place > 0 and self._events[place - 1].t_ns == t_ns:
            place -= 1
            yield self._events[place]

    def checkpoint_at(self, t_ns: int) -> Checkpoint[S] | None:
        """Return the newest checkpoint at or before a time, None if it is older than all."""
        place = bisect_right(self.checkpoints, t_ns, key=_stamp)
        return self.checkpoints[place - 1] if place else None

    def is_too_old(self, event: Event[M]) -> bool:
        """Whether an event belongs before the oldest checkpoint."""
        first = self.checkpoints[0]
        if self._time_of(event, first.state) < first.t_ns:
            return True
        return bisect_right(self._events, event.t_ns, key=_stamp) + self._forgotten < first.applied

    def rewind(self, number: int) -> Checkpoint[S]:
        """Drop the checkpoints that come after event `number` in the order of things; return the newest that is left.

        The caller has made sure that the event is not too old.
        """
        event = self.event(number)
        while len(self.checkpoints) > 1:
            last = self.checkpoints[-1]
            if last.applied < number or (last.applied == number and last.after_event):
                break  # after an event that happened later, one still comes after it: stamps decide the order
            if last.applied == number and event is not None and last.t_ns <= self._time_of(event, last.state):
                break
            self.checkpoints.pop()
        return self.checkpoints[-1]

    def back_to(self, t_ns: int) -> Checkpoint[S]:
        """Drop the checkpoints after a time, not the oldest; return the newest that is left."""
        del self.checkpoints[max(bisect_right(self.checkpoints, t_ns, key=_stamp), 1) :]
        return self.checkpoints[-1]

    def forget_before(self, t_ns: int) -> list[Event[M]]:
        """Drop what is not needed to go back to `t_ns` or later and return the events of it; one checkpoint stays."""
        keep = max(bisect_right(self.checkpoints, t_ns, key=_stamp) - 1, 0)
        del self.checkpoints[:keep]
        drop = min(self.checkpoints[0].applied - self._forgotten, len(self._events))
        forgotten, self._events = self._events[:drop], self._events[drop:]
        self._forgotten += drop
        return forgotten


def _turn(event: Event[M]) -> tuple[int, int, str, tuple[float, ...]]:
    what = event.measurement
    if isinstance(what, Reading):
        return event.t_ns, 2, what.sensor, tuple(what.values.tolist())
    return (event.t_ns, 1, what.sensor, ()) if isinstance(what, OwnStart) else (event.t_ns, 0, "", ())


def _stamp(item: Event[M] | Checkpoint[S]) -> int:
    return item.t_ns


def add(sums: Statistics, kind: str, more: tuple[int, float, int]) -> None:
    """Add a number of tests, their NIS and their degrees of freedom to the sums, in place."""
    number, nis, dof = sums.get(kind, (0, 0.0, 0))
    sums[kind] = (number + more[0], nis + more[1], dof + more[2])


def add_all(sums: Statistics, events: Iterable[Event[M]]) -> None:
    """Add the tests of events to the sums, in place."""
    for event in events:
        if event.outcome is not None:
            for kind, more in event.outcome.statistics.items():
                add(sums, kind, more)
