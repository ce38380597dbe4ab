"""What both filters do with time: order measurements, go back to checkpoints, take the samples between."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.config import EkfConfig
from vislam.ekf.kernels import pose
from vislam.geometry import interpolate
from vislam.imu import ImuSeries
from vislam.messages import Array

REST_PAUSE_NS = 300_000_000  # frames at rest this far apart are of one rest: either looked back on all that is between


class Timed(Protocol):
    """Something that happened at a time."""

    @property
    def t_ns(self) -> int:
        """When."""
        ...


class Restorable(Timed, Protocol):
    """A filter at one instant, after `applied` events since the start."""

    @property
    def applied(self) -> int:
        """How many events it has seen."""
        ...

    @property
    def x(self) -> Array:
        """Nominal state; position, velocity and quaternion come first."""
        ...


E = TypeVar("E", bound=Timed)
C = TypeVar("C", bound=Restorable)


class Timeline(Generic[E, C]):
    """Events in time order (ties in order of arrival) and checkpoints, both bounded by `forget_before`."""

    def __init__(self, first: C) -> None:
        self.checkpoints = [first]
        self._events: list[E] = []
        self._forgotten = 0  # events dropped from the front; all numbering counts them

    @property
    def events(self) -> list[E]:
        """Those not forgotten, in time order."""
        return self._events

    def insert(self, event: E) -> int:
        """Sort an event in and return its number since the start."""
        place = bisect_right(self._events, event.t_ns, key=time_of)
        self._events.insert(place, event)
        return place + self._forgotten

    def event(self, number: int) -> E | None:
        """Return an event by its number, None past the last."""
        place = number - self._forgotten
        return self._events[place] if place < len(self._events) else None

    def checkpoint_at(self, t_ns: int) -> C | None:
        """Return the newest checkpoint at or before a time, None if it is older than all."""
        place = bisect_right(self.checkpoints, t_ns, key=time_of)
        return self.checkpoints[place - 1] if place else None

    def forget_before(self, t_ns: int) -> list[E]:
        """Drop what is not needed to go back to `t_ns` or later and return the events of it; one checkpoint stays."""
        keep = max(bisect_right(self.checkpoints, t_ns, key=time_of) - 1, 0)
        del self.checkpoints[:keep]
        drop = min(self.checkpoints[0].applied - self._forgotten, len(self._events))
        forgotten, self._events = self._events[:drop], self._events[drop:]
        self._forgotten += drop
        return forgotten


def time_of(item: Timed) -> int:
    """Return when something happened, as a key to search by."""
    return item.t_ns


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """The samples from one time to another, both ends interpolated."""

    t_ns: NDArray[np.int64]  # [N]
    samples: Array  # [N, 6] gyro, accel
    gaps_s: Array  # [N] length of the hole that the step to this sample lies in, else 0
    inner: slice  # of the series, between the ends


def stretch(series: ImuSeries, t0_ns: int, t1_ns: int, max_gap_ns: int) -> Stretch:
    """Return the samples between two times; a step longer than `max_gap_ns` is a hole."""
    times = series.t_ns
    inner = slice(int(np.searchsorted(times, t0_ns, side="right")), int(np.searchsorted(times, t1_ns)))
    stamps = np.concatenate(([t0_ns], times[inner], [t1_ns])).astype(np.int64)
    samples = np.concatenate((series.at(t0_ns)[None], series.values[inner], series.at(t1_ns)[None]))
    # A step inside a hole must know how long the whole hole is, not only its own part of it.
    neighbours = times[max(inner.start - 1, 0) : inner.stop + 1]
    covered = len(neighbours) == len(stamps)  # else the state is older than every sample, or newer
    holes = np.diff(neighbours if covered else stamps)
    gaps_s = np.concatenate(([0.0], np.where(holes > max_gap_ns, holes * 1e-9, 0.0)))
    return Stretch(stamps, samples, gaps_s, inner)


def keep_track(series: ImuSeries, piece: Stretch, track: Array) -> None:
    """Keep x[:10] of every time of the stretch [N, 10] beside the samples."""
    inner = piece.inner
    series.extra[inner] = track[1:-1]
    if inner.stop < len(series.t_ns) and series.t_ns[inner.stop] == piece.t_ns[-1]:
        series.extra[inner.stop] = track[-1]


def pose_between(series: ImuSeries, x: Array, checkpoint: Restorable, t_ns: int) -> Array:
    """Return the pose [4, 4] at a time between a checkpoint and the present state x, from the track."""
    if checkpoint.t_ns == t_ns:
        return pose(checkpoint.x, 0, 6)
    times, track = series.t_ns, series.extra
    after = int(np.searchsorted(times, t_ns))
    if after == len(times):  # the start, when it is newer than every sample
        return pose(x, 0, 6)
    before_ns, before = checkpoint.t_ns, checkpoint.x[:10]
    if after > 0 and int(times[after - 1]) > before_ns:
        before_ns, before = int(times[after - 1]), track[after - 1]
    alpha = (t_ns - before_ns) / (int(times[after]) - before_ns)
    return interpolate(pose(before.copy(), 0, 6), pose(track[after].copy(), 0, 6), alpha)


def bias_measurement(
    gyro_bias: Array, accel_bias: Array, gyro_sigma: float | Array, accel_sigma: float | Array
) -> Array | None:
    """Return biases and their sigmas as one vector [12]; None when they are not finite, or a sigma not positive."""
    sigmas = np.broadcast_to(gyro_sigma, 3), np.broadcast_to(accel_sigma, 3)
    bias = np.concatenate([gyro_bias, accel_bias, *sigmas]).astype(np.float64)
    return bias if np.isfinite(bias).all() and (bias[6:] > 0.0).all() else None


def reset_sigmas(config: EkfConfig) -> Array:
    """Return what a soft reset adds to the sigmas of the state [15]."""
    return np.repeat(
        [
            np.deg2rad(config.reset_rotation_deg),
            config.reset_position_m,
            config.reset_velocity_m_s,
            config.reset_gyro_bias_rad_s,
            config.reset_accel_bias_m_s2,
        ],
        3,
    )
