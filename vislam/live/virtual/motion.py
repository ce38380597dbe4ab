"""How the virtual cart moves: a unicycle whose wheels follow commands, exact at every instant and in every process.

Time is cut into segments of constant accelerations, decided a little ahead. The process that steers publishes the last
seconds of them; all that need the truth (chips, camera, evaluation) evaluate the same segments, so all agree. Where
that process is put aside the wheels turn on as they do, and what others have sensed meanwhile stays true.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np

from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array
from vislam.live.wire.slot import SlotReader, SlotWriter, wait_for

SEGMENT_S = 0.05
LEAD = 2  # segments decided ahead: a command takes 0.1 to 0.15 s to act, as on a real cart
_KEPT = 120  # segments that are published: 6 s
_ROUNDING_S = 1e-9
_COLUMNS = 8
_FIRST_S = 60.0  # that a follower waits for the first one
_GAUSS = np.polynomial.legendre.leggauss(4)  # over 50 ms at 1 rad/s its error is below a nanometre


@dataclass(frozen=True, slots=True)
class Segment:
    """The cart at the begin of a segment, and its accelerations until the next."""

    t_s: float  # since the epoch
    x_m: float
    y_m: float
    yaw_rad: float
    speed_m_s: float
    rate_rad_s: float
    accel_m_s2: float
    angular_accel_rad_s2: float

    def at(self, t_s: float) -> Segment:
        """Return the cart at a time of this segment, or beyond it, where it goes on without acceleration."""
        dt = t_s - self.t_s
        if dt <= SEGMENT_S + _ROUNDING_S:
            return self._after(dt, t_s)
        end = self._after(SEGMENT_S, self.t_s + SEGMENT_S)
        return replace(end, accel_m_s2=0.0, angular_accel_rad_s2=0.0)._after(dt - SEGMENT_S, t_s)

    def _after(self, dt: float, t_s: float) -> Segment:
        speed, rate = self.speed_m_s + self.accel_m_s2 * dt, self.rate_rad_s + self.angular_accel_rad_s2 * dt
        nodes, weights = 0.5 * dt * (_GAUSS[0] + 1.0), 0.5 * dt * _GAUSS[1]
        yaws = self.yaw_rad + nodes * (self.rate_rad_s + 0.5 * self.angular_accel_rad_s2 * nodes)
        speeds = self.speed_m_s + self.accel_m_s2 * nodes
        x_m = self.x_m + float(weights @ (speeds * np.cos(yaws)))
        y_m = self.y_m + float(weights @ (speeds * np.sin(yaws)))
        yaw = self.yaw_rad + dt * (self.rate_rad_s + 0.5 * self.angular_accel_rad_s2 * dt)
        return Segment(t_s, x_m, y_m, yaw, speed, rate, self.accel_m_s2, self.angular_accel_rad_s2)

    def T_world_body(self, height_m: float) -> Array:
        """Return the pose [4, 4] of the body, above the middle of the axle."""
        return transform(so3_exp(np.array([0.0, 0.0, self.yaw_rad])), np.array([self.x_m, self.y_m, height_m]))


@dataclass(frozen=True, slots=True)
class Wheels:
    """What the drive can do."""

    max_speed_m_s: float = 1.0
    max_rate_rad_s: float = 1.2
    max_accel_m_s2: float = 0.8
    max_angular_accel_rad_s2: float = 2.0


class Drive:
    """Turns commands into segments; owned by the process that steers."""

    def __init__(self, name: str | None, x_m: float, y_m: float, yaw_rad: float, wheels: Wheels | None = None) -> None:
        """Stand at a place; `name` is that of the shared memory that segments are published in, None: in none."""
        self._wheels = wheels or Wheels()
        self._segments = [Segment(0.0, x_m, y_m, yaw_rad, 0.0, 0.0, 0.0, 0.0)]
        self._slot = None if name is None else SlotWriter(name, 8 * _COLUMNS * _KEPT)
        self._publish()

    def advance(self, now_s: float, speed_m_s: float, rate_rad_s: float) -> list[Segment]:
        """Decide segments until `LEAD` ahead of now, towards the commanded twist; return the new ones.

        What has passed undecided, and what may pass until it is published, goes on without acceleration.
        """
        new = []
        while self._segments[-1].t_s < now_s + LEAD * SEGMENT_S:
            w, old = self._wheels, self._segments[-1]
            end = old.at(old.t_s + SEGMENT_S)
            wanted = np.clip(speed_m_s, -w.max_speed_m_s, w.max_speed_m_s)
            turning = np.clip(rate_rad_s, -w.max_rate_rad_s, w.max_rate_rad_s)
            accel = np.clip((wanted - end.speed_m_s) / SEGMENT_S, -w.max_accel_m_s2, w.max_accel_m_s2)
            limit = w.max_angular_accel_rad_s2
            spin = np.clip((turning - end.rate_rad_s) / SEGMENT_S, -limit, limit)
            if end.t_s < now_s + SEGMENT_S - _ROUNDING_S:
                accel = spin = 0.0
            new.append(replace(end, accel_m_s2=float(accel), angular_accel_rad_s2=float(spin)))
            self._segments.append(new[-1])
        if new:
            del self._segments[:-_KEPT]
            self._publish()
        return new

    def at(self, t_s: float) -> Segment:
        """Return the cart at a time that is kept."""
        return locate(self._segments, t_s)

    def segment(self, t_s: float) -> Segment:
        """Return the segment of a time that is kept."""
        return _segment(self._segments, t_s)

    def close(self) -> None:
        """Remove the shared memory."""
        if self._slot is not None:
            self._slot.close()

    def _publish(self) -> None:
        if self._slot is not None:
            self._slot.write(np.array([_row(segment) for segment in self._segments]).tobytes())


class Follower:
    """Reads the segments in another process."""

    def __init__(self, slot: SlotReader) -> None:
        """Take what a `Drive` publishes."""
        self._slot = slot
        self._segments: list[Segment] = []
        self._sequence = 0

    @classmethod
    def waiting(cls, name: str) -> Follower:
        """Open what a `Drive` publishes, or is about to. Raises DataError when there is none for long."""
        follower, deadline = cls(wait_for(name)), time.monotonic() + _FIRST_S
        follower._read()
        while not follower._segments:  # the memory is there a moment before what is in it
            if time.monotonic() > deadline:
                raise DataError(f"the virtual cart publishes no motion in {name}; was its process stopped?")
            time.sleep(0.01)
            follower._read()
        return follower

    def at(self, t_s: float) -> Segment:
        """Return the cart at a time in the last seconds; before the first segment it stands."""
        return self.segment(t_s).at(max(t_s, 0.0))

    def segment(self, t_s: float) -> Segment:
        """Return the segment of a time."""
        if not self._segments or t_s > self._segments[-1].t_s:
            self._read()
        return _segment(self._segments, t_s)

    def _read(self) -> None:
        if self._slot.sequence == self._sequence:
            return
        read = self._slot.read()
        if read is not None:
            self._sequence = read[0]
            rows = np.frombuffer(read[1]).reshape(-1, _COLUMNS).tolist()
            self._segments = [Segment(*row) for row in rows]


def locate(segments: list[Segment], t_s: float) -> Segment:
    """Return the cart at a time, from the segments around it."""
    return _segment(segments, t_s).at(max(t_s, segments[0].t_s))


def _segment(segments: list[Segment], t_s: float) -> Segment:
    return segments[max(bisect_right(segments, t_s, key=_begin) - 1, 0)]


def _begin(segment: Segment) -> float:
    return segment.t_s


def _row(s: Segment) -> tuple[float, ...]:
    return s.t_s, s.x_m, s.y_m, s.yaw_rad, s.speed_m_s, s.rate_rad_s, s.accel_m_s2, s.angular_accel_rad_s2
