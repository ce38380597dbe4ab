"""What both filters do with time: order measurements, go back to checkpoints, take the samples between."""

from __future__ import annotations

from bisect import bisect_right
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numba import njit
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


class Stretch(NamedTuple):
    """The samples from one time to another, both ends interpolated."""

    t_ns: NDArray[np.int64]  # [N]
    samples: Array  # [N, 6] gyro, accel
    gaps_s: Array  # [N] length of the hole that the step to this sample lies in, else 0
    begin: int  # of the series, between the ends
    end: int


def stretch(series: ImuSeries, t0_ns: int, t1_ns: int, max_gap_ns: int) -> Stretch:
    """Return the samples between two times; a step longer than `max_gap_ns` is a hole. The series is not empty."""
    return _stretch(series.t_ns, series.values, t0_ns, t1_ns, max_gap_ns)


@njit(cache=True, nogil=True)
def _stretch(times: NDArray[np.int64], values: Array, t0_ns: int, t1_ns: int, max_gap_ns: int) -> Stretch:
    begin, end = int(np.searchsorted(times, t0_ns, side="right")), int(np.searchsorted(times, t1_ns))
    n = end - begin + 2
    stamps, samples, gaps_s = np.empty(n, dtype=np.int64), np.empty((n, 6)), np.zeros(n)
    stamps[0], stamps[1:-1], stamps[-1] = t0_ns, times[begin:end], t1_ns
    _sample_at(times, values, t0_ns, samples[0])
    samples[1:-1] = values[begin:end]
    _sample_at(times, values, t1_ns, samples[-1])
    # A step inside a hole must know how long the whole hole is, not only its own part of it.
    neighbours = times[max(begin - 1, 0) : end + 1]
    if len(neighbours) != n:  # the state is older than every sample, or newer
        neighbours = stamps
    for k in range(1, n):
        hole_ns = neighbours[k] - neighbours[k - 1]
        gaps_s[k] = hole_ns * 1e-9 if hole_ns > max_gap_ns else 0.0
    return Stretch(stamps, samples, gaps_s, begin, end)


@njit(cache=True, nogil=True)
def _sample_at(times: NDArray[np.int64], values: Array, t_ns: int, out: Array) -> None:
    """Write the sample at a time into `out` [6], as `ImuSeries.at` has it."""
    k = np.searchsorted(times, t_ns)
    if k == len(times):
        out[:] = values[k - 1]
    elif k == 0 or times[k] == t_ns:
        out[:] = values[k]
    else:
        alpha = (t_ns - times[k - 1]) / (times[k] - times[k - 1])
        out[:] = (1.0 - alpha) * values[k - 1] + alpha * values[k]


def keep_track(series: ImuSeries, piece: Stretch, track: Array) -> None:
    """Keep x[:10] of every time of the stretch [N, 10] beside the samples."""
    extra, end = series.extra, piece.end
    extra[piece.begin : end] = track[1:-1]
    if end < len(extra) and series.t_ns[end] == piece.t_ns[-1]:
        extra[end] = track[-1]


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
