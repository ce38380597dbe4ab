"""The samples between two times, as compiled code runs through them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.imu import ImuSeries


class Stretch(NamedTuple):
    """The samples from one time to another, both ends interpolated."""

    t_ns: NDArray[np.int64]  # [N]
    samples: Array  # [N, 6] gyro, accel
    gaps_s: Array  # [N] length of the hole that the step to this sample lies in, else 0
    begin: int  # of the series, between the ends
    end: int


def stretch(series: ImuSeries, t0_ns: int, t1_ns: int, max_gap_ns: int, known_ns: int) -> Stretch:
    """Return the samples between two times. The series is not empty.

    A step longer than `max_gap_ns` is a hole, and so is what comes after `known_ns`: samples there are assumed.
    """
    return _stretch(series.t_ns, series.values, t0_ns, t1_ns, max_gap_ns, known_ns)


@njit(cache=True, nogil=True)
def _stretch(
    times: NDArray[np.int64], values: Array, t0_ns: int, t1_ns: int, max_gap_ns: int, known_ns: int
) -> Stretch:
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
        hole_ns = neighbours[k] - neighbours[k - 1] if stamps[k] <= known_ns else stamps[k] - known_ns
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
