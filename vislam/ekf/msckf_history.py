"""What the tight filter remembers so that it can go back. A frame takes effect at its stamp plus the time offset."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from enum import StrEnum

from vislam.ekf.msckf_state import Window
from vislam.ekf.msckf_tracks import FrameTracks
from vislam.ekf.msckf_update import Outcome
from vislam.messages import Array


class Kind(StrEnum):
    """What an event does to the filter."""

    FRAME = "frame"
    REST = "rest"
    BIAS = "bias"


@dataclass(slots=True, eq=False)
class Event:
    """A measurement, and what became of it the last time it was applied."""

    t_ns: int  # of the frame by the camera's clock; of a bias by the IMU's
    kind: Kind
    frame: FrameTracks | None = None
    bias: Array | None = None  # [12] gyro, accel, and their sigmas
    outcome: Outcome | None = None  # None while it waits for the IMU

    def effective_t_ns(self, window: Window) -> int:
        """Return when it happened by the IMU's clock, as far as is known before it is used."""
        return self.t_ns if self.kind is Kind.BIAS else self.t_ns + round(window.time_offset_s * 1e9)


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """The whole filter at one instant, after `applied` events since the start."""

    t_ns: int
    applied: int
    x: Array  # [16]
    Phi: Array  # [15, 15]
    Q: Array  # [15, 15]
    window: Window
    after_event: bool  # taken right after the last of them


class TightHistory:
    """Events in time order (ties in order of arrival) and checkpoints, both bounded by `forget_before`."""

    def __init__(self, first: Checkpoint) -> None:
        self.checkpoints = [first]
        self._events: list[Event] = []
        self._forgotten = 0  # events dropped from the front; all numbering counts them

    def has_frame(self, t_ns: int) -> bool:
        """Whether a frame of this stamp is here already."""
        place = bisect_right(self._events, t_ns, key=_time)
        while place > 0 and self._events[place - 1].t_ns == t_ns:
            place -= 1
            if self._events[place].kind is Kind.FRAME:
                return True
        return False

    def insert(self, event: Event) -> int:
        """Sort an event in and return its number since the start."""
        place = bisect_right(self._events, event.t_ns, key=_time)
        self._events.insert(place, event)
        return place + self._forgotten

    def event(self, number: int) -> Event | None:
        """Return an event by its number, None past the last."""
        place = number - self._forgotten
        return self._events[place] if place < len(self._events) else None

    def is_too_old(self, event: Event) -> bool:
        """Whether an event belongs before the oldest checkpoint."""
        first = self.checkpoints[0]
        if event.effective_t_ns(first.window) < first.t_ns:
            return True
        place = bisect_right(self._events, event.t_ns, key=_time)
        return place + self._forgotten < first.applied

    def rewind(self, number: int) -> Checkpoint:
        """Drop the checkpoints that come after event `number` in the order of things; return the newest that is left.

        The caller has made sure that the event is not too old.
        """
        event = self.event(number)
        while len(self.checkpoints) > 1:
            last = self.checkpoints[-1]
            if last.applied < number or (last.applied == number and last.after_event):
                break  # after an event that happened later, one still comes after it: stamps decide the order
            if last.applied == number and event is not None and last.t_ns <= event.effective_t_ns(last.window):
                break
            self.checkpoints.pop()
        return self.checkpoints[-1]

    def checkpoint_at(self, t_ns: int) -> Checkpoint | None:
        """Return the newest checkpoint at or before a time, None if it is older than all."""
        place = bisect_right(self.checkpoints, t_ns, key=_time)
        return self.checkpoints[place - 1] if place else None

    def forget_before(self, t_ns: int) -> None:
        """Drop what is not needed to go back to `t_ns` or later; one checkpoint always stays."""
        keep = max(bisect_right(self.checkpoints, t_ns, key=_time) - 1, 0)
        del self.checkpoints[:keep]
        drop = min(self.checkpoints[0].applied - self._forgotten, len(self._events))
        del self._events[:drop]
        self._forgotten += drop


def _time(item: Event | Checkpoint) -> int:
    return item.t_ns
