"""When something goes wrong, and how a stream of values is changed for as long."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from vislam.core.camera import Rig
from vislam.core.messages import Frame, ImuSample, MagSample

Event = ImuSample | MagSample | Frame
_Value = TypeVar("_Value", Frame, ImuSample)


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """When a fault is there (from the first time on, before the second), its chance, and the rig that it meets."""

    from_ns: int
    to_ns: int
    rng: np.random.Generator
    rig: Rig

    def has(self, t_ns: int) -> bool:
        """Whether a time is within."""
        return self.from_ns <= t_ns < self.to_ns


Stream = Callable[[Iterator[Event], Moment], Iterator[Event]]


def changed(kind: type[_Value], change: Callable[[_Value, Moment], _Value | None]) -> Stream:
    """Return the fault that changes every value of a kind within its moment; None: it never arrives."""

    def stream(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
        for value in events:
            there = change(value, moment) if isinstance(value, kind) and moment.has(value.t_ns) else value
            if there is not None:
                yield there

    return stream


def held(kind: type[_Value], hold: Callable[[_Value, _Value], _Value]) -> Stream:
    """Return the fault that puts something of its first value, given first, into all that follow within its moment."""

    def stream(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
        first: _Value | None = None
        for value in events:
            if isinstance(value, kind) and moment.has(value.t_ns):
                first = value if first is None else first
                yield hold(first, value)
            else:
                yield value

    return stream


def _gone(events: Iterator[Event], moment: Moment, kinds: tuple[type, ...]) -> Iterator[Event]:
    return (value for value in events if not (isinstance(value, kinds) and moment.has(value.t_ns)))


def gone(*kinds: type) -> Stream:
    """Return the fault that nothing of some kinds arrives."""
    return partial(_gone, kinds=kinds)


def _stepped(events: Iterator[Event], moment: Moment, kinds: tuple[type, ...], by_s: float) -> Iterator[Event]:
    for value in events:
        is_moved = isinstance(value, kinds) and moment.has(value.t_ns)
        yield replace(value, t_ns=value.t_ns + round(by_s * 1e9)) if is_moved else value


def stepped(by_s: float, *kinds: type) -> Stream:
    """Return the fault that the clock of some kinds steps."""
    return partial(_stepped, kinds=kinds, by_s=by_s)


def again(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Play the log up to the moment, and then the same once more, as `--loop` of a player does."""
    played = []
    for value in events:
        if value.t_ns >= moment.from_ns:
            break
        played.append(value)
        yield value
    yield from played


def glued(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Cut the moment out and move what follows into its place: two logs as one, whose stamps do not show the seam."""
    return _stepped(gone(object)(events, moment), replace(moment, from_ns=moment.to_ns, to_ns=1 << 62), (object,),
                    (moment.from_ns - moment.to_ns) * 1e-9)  # fmt: skip


def ended(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """End the recording."""
    for value in events:
        if value.t_ns >= moment.from_ns:
            return
        yield value
