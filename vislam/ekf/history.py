"""What the filter remembers so that it can go back: measurements in time order and states to start again from."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from vislam.messages import Array, VoMeasurement

OUTCOMES = (  # every counter a measurement can end in, and what they cause
    "keyframes",
    "vo_accepted",
    "vo_gated",  # failed the chi-square gate
    "vo_opposed",  # moved against the direction seen
    "vo_no_keyframe",  # relative to a keyframe that is not the cloned one
    "vo_no_scale",  # accumulated vision needs metric motion
    "vo_lost",
    "vo_invalid",
    "zero_velocity_accepted",
    "zero_velocity_gated",
    "bias_accepted",
    "bias_gated",
    "bias_invalid",
    "before_start",
    "too_late",
    "too_early",
    "rewinds",
    "soft_resets",
)


class Kind(StrEnum):
    """What an event does to the filter."""

    KEYFRAME = "keyframe"
    VO = "vo"
    ZERO_VELOCITY = "zero_velocity"
    BIAS = "bias"


@dataclass(slots=True, eq=False)
class Event:
    """A measurement, and what became of it the last time it was applied."""

    t_ns: int
    kind: Kind
    keyframe_id: int = -1
    vo: VoMeasurement | None = None
    bias: Array | None = None  # [12] gyro, accel, and their sigmas
    outcome: str = ""  # the counter it stands in; "" while it waits for the IMU
    was_reset: bool = False
    accepted: bool = False
    nis: float = float("nan")
    degrees: int = 0  # of freedom, of `nis`
    reason: str = "waits for an inertial sample as new"


@dataclass(frozen=True, slots=True, eq=False)
class Ledger:
    """What the filter knows besides x and P."""

    clone_id: int | None = None
    shared: Array = field(default_factory=lambda: np.zeros((6, 6)))  # added to the clone for shared landmark errors
    rejects: int = 0  # in a row
    rejects_since_ns: int = 0
    last_vo_t_ns: int = 0
    T_odom_keyframe: Array | None = None  # [4, 4] where accumulated vision has the keyframe
    T_odom_vo: Array | None = None  # [4, 4] where it had the body last, and when
    vo_t_ns: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """The whole filter at one instant, after `applied` events since the start."""

    t_ns: int
    applied: int
    x: Array
    P: Array
    ledger: Ledger


class History:
    """Events in time order (ties in order of arrival) and checkpoints, both bounded by `forget_before`."""

    def __init__(self, first: Checkpoint) -> None:
        self.checkpoints = [first]
        self._events: list[Event] = []
        self._forgotten = 0  # events dropped from the front; all numbering counts them

    def insert(self, event: Event) -> int:
        """Sort an event in and return its number since the start."""
        place = bisect_right(self._events, event.t_ns, key=_time)
        self._events.insert(place, event)
        return place + self._forgotten

    def event(self, number: int) -> Event | None:
        """Return an event by its number, None past the last."""
        place = number - self._forgotten
        return self._events[place] if place < len(self._events) else None

    def rewind(self, number: int, t_ns: int) -> Checkpoint:
        """Drop the checkpoints that an event of this number and time invalidates; return the newest that is left.

        The caller has made sure that the event is not older than the first checkpoint.
        """
        while self.checkpoints[-1].t_ns > t_ns or self.checkpoints[-1].applied > number:
            self.checkpoints.pop()
        return self.checkpoints[-1]

    def checkpoint_at(self, t_ns: int) -> Checkpoint | None:
        """Return the newest checkpoint at or before a time, None if it is older than all."""
        place = bisect_right(self.checkpoints, t_ns, key=_time)
        return self.checkpoints[place - 1] if place else None

    @property
    def events(self) -> list[Event]:
        """Those not forgotten, in time order."""
        return self._events

    def forget_before(self, t_ns: int) -> list[Event]:
        """Drop what is not needed to go back to `t_ns` or later and return the events of it; one checkpoint stays."""
        keep = max(bisect_right(self.checkpoints, t_ns, key=_time) - 1, 0)
        del self.checkpoints[:keep]
        drop = min(self.checkpoints[0].applied - self._forgotten, len(self._events))
        forgotten, self._events = self._events[:drop], self._events[drop:]
        self._forgotten += drop
        return forgotten


def add_nis(sums: dict[str, tuple[int, float, int]], events: Iterable[Event]) -> dict[str, tuple[int, float, int]]:
    """Return count, sum of NIS and sum of degrees of freedom by kind, with those of accepted events added."""
    out = dict(sums)
    for event in events:
        if event.accepted and event.degrees:
            count, nis, degrees = out.get(event.kind.value, (0, 0.0, 0))
            out[event.kind.value] = count + 1, nis + event.nis, degrees + event.degrees
    return out


def _time(item: Event | Checkpoint) -> int:
    return item.t_ns
