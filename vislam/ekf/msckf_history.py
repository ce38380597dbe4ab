"""What the tight filter remembers so that it can go back. A frame takes effect at its stamp plus the time offset."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from enum import StrEnum

from vislam.ekf.msckf_state import Window
from vislam.ekf.msckf_tracks import FrameTracks
from vislam.ekf.msckf_update import Outcome
from vislam.ekf.timeline import Timeline, time_of
from vislam.messages import AS_MODELLED, Array, NoiseScale


class Kind(StrEnum):
    """What an event does to the filter."""

    FRAME = "frame"
    REST = "rest"
    BIAS = "bias"
    NOISE = "noise"


@dataclass(slots=True, eq=False)
class Event:
    """A measurement, and what became of it the last time it was applied."""

    t_ns: int  # of a frame and of rest by the camera's clock; of bias and noise by the IMU's
    kind: Kind
    frame: FrameTracks | None = None
    bias: Array | None = None  # [12] gyro, accel, and their sigmas
    noise: NoiseScale = AS_MODELLED  # from here on, over what the filter was made with
    outcome: Outcome | None = None  # None while it waits for the IMU

    def effective_t_ns(self, window: Window) -> int:
        """Return when it happened by the IMU's clock, as far as is known before it is used."""
        if self.kind in (Kind.BIAS, Kind.NOISE):
            return self.t_ns
        return self.t_ns + round(window.time_offset_s * 1e9)


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


class TightHistory(Timeline[Event, Checkpoint]):
    """What came to the filter and where it can go back to."""

    def has_frame(self, t_ns: int) -> bool:
        """Whether a frame of this stamp is here already."""
        place = bisect_right(self._events, t_ns, key=time_of)
        while place > 0 and self._events[place - 1].t_ns == t_ns:
            place -= 1
            if self._events[place].kind is Kind.FRAME:
                return True
        return False

    def is_too_old(self, event: Event) -> bool:
        """Whether an event belongs before the oldest checkpoint."""
        first = self.checkpoints[0]
        if event.effective_t_ns(first.window) < first.t_ns:
            return True
        place = bisect_right(self._events, event.t_ns, key=time_of)
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
