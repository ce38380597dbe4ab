"""When something goes wrong, and how a stream of values is changed for as long."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, takewhile
from typing import Any

import numpy as np

from vislam.core import Frame, ImuSample, MagSample, Rig

Event = ImuSample | MagSample | Frame


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """When a fault is there (from the first time on, before the second), its chance, and the rig that it meets."""

    from_ns: int
    to_ns: int
    rng: np.random.Generator
    rig: Rig


Stream = Callable[[Iterator[Event], Moment], Iterator[Event]]
Change = Callable[[Any, Moment, list[Any]], Iterable[Any]]  # a value, and what was kept: what comes instead of it


def changed(kind: type, change: Change) -> Stream:
    """Return the fault that changes every value of a kind within its moment."""

    def stream(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
        kept: list[Any] = []
        for value in events:
            is_there = isinstance(value, kind) and moment.from_ns <= value.t_ns < moment.to_ns
            yield from change(value, moment, kept) if is_there else (value,)

    return stream


def gone(kind: type) -> Stream:
    """Return the fault that nothing of a kind arrives."""
    return changed(kind, lambda _, __, ___: ())


def stepped(kind: type, by_s: float) -> Stream:
    """Return the fault that the clock of a kind steps."""
    return changed(kind, lambda value, _, __: (replace(value, t_ns=value.t_ns + round(by_s * 1e9)),))


def held(kind: type, hold: Callable[[Any, Any], Any]) -> Stream:
    """Return the fault that puts something of its first value, given first, into all that follow."""

    def change(value: Any, _: Moment, kept: list[Any]) -> Iterable[Any]:
        kept[:] = kept or [value]
        return (hold(kept[0], value),)

    return changed(kind, change)


def again(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Play the log up to the moment, and then the same once more, as a player does that loops."""
    played = list(takewhile(lambda value: value.t_ns < moment.from_ns, events))
    return chain(played, played)


def glued(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Cut the moment out and move what follows into its place: two logs as one, whose stamps do not show the seam."""
    early_ns = moment.to_ns - moment.from_ns
    rest = gone(object)(events, moment)
    return (replace(v, t_ns=v.t_ns - early_ns) if v.t_ns >= moment.to_ns else v for v in rest)
