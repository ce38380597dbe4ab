"""Inertial samples in contiguous memory: appended at the end, forgotten at the front, cut anywhere."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImuSample, ImuSpan, NoiseScale
from vislam.core.stream_axes import Axis
from vislam.core.streams import StreamJudge

_FIRST_CAPACITY = 1024  # samples; doubles when the live part needs more
# rad/s, m/s^2. What is beyond every sensor comes from a broken transfer. A leap, there and back in three samples, would
# be a body that carries a camera at 10 g or that turns over 500 degrees a second, for one sample
AXES = (*(Axis(f"gyro {a}", 1e3, 10.0) for a in "xyz"), *(Axis(f"accelerometer {a}", 1e4, 100.0) for a in "xyz"))


class ImuSeries:
    """A growing, sliding window of samples; rows stay contiguous so that compiled code can run over them.

    Attributes:
        judge: which samples are taken, and what happened in the stream.
    """

    def __init__(self, extra: int = 0, max_gap_s: float = 0.0, rate_hz: float = 0.0) -> None:
        """Start empty.

        Args:
            extra: the number of further columns that a user keeps beside each sample, NaN at first.
            max_gap_s: shorter ones are no holes.
            rate_hz: the stated one; 0: none is.
        """
        self._t_ns: NDArray[np.int64] = np.empty(_FIRST_CAPACITY, dtype=np.int64)
        self._values: Array = np.empty((_FIRST_CAPACITY, 6))
        self._extra: Array = np.empty((_FIRST_CAPACITY, extra))
        self._begin = 0
        self._end = 0
        self._newest_t_ns = -(1 << 62)
        self.judge = StreamJudge("imu0", AXES, max_gap_s, rate_hz)

    def __len__(self) -> int:
        """Return the number of samples held."""
        return self._end - self._begin

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Times [N] of the samples held: a view, valid until the next `append`."""
        return self._t_ns[self._begin : self._end]

    @property
    def values(self) -> Array:
        """Samples [N, 6], gyro (rad/s) then accel (m/s^2): a view, valid until the next `append`."""
        return self._values[self._begin : self._end]

    @property
    def extra(self) -> Array:
        """What the user keeps beside each sample [N, extra]: a writable view, valid until the next `append`."""
        return self._extra[self._begin : self._end]

    @property
    def newest_t_ns(self) -> int | None:
        """Time of the newest sample, None when there is none yet."""
        return self._newest_t_ns if self._end > self._begin else None

    def append(self, sample: ImuSample, after_ns: int | None = None) -> bool:
        """Take a sample if the judge does, in place of those that were assumed after a time; return whether."""
        t_ns, six = sample.t_ns, [*sample.gyro_rad_s.tolist(), *sample.accel_m_s2.tolist()]
        if not self.judge.takes(t_ns, six):
            return False
        if after_ns is not None:
            if t_ns <= after_ns:  # too late: what was assumed there stays
                return False
            self.drop_after(after_ns)
        self._put(t_ns, six)
        return True

    def assume(self, t_ns: int, six: Array) -> None:
        """Put values [6] where no sample has come, after all others."""
        self._put(t_ns, six.tolist())

    def _put(self, t_ns: int, six: list[float]) -> None:
        if self._end == len(self._t_ns):
            self._make_room()
        self._values[self._end] = six
        self._extra[self._end] = np.nan
        self._t_ns[self._end] = t_ns
        self._newest_t_ns = t_ns
        self._end += 1

    def drop_after(self, t_ns: int) -> None:
        """Drop the samples after a time."""
        self._end = self._begin + int(np.searchsorted(self.t_ns, t_ns, side="right"))
        self._newest_t_ns = int(self._t_ns[self._end - 1])

    def forget_before(self, t_ns: int) -> int:
        """Drop samples not needed to interpolate at or after `t_ns`; return how many went."""
        dropped = max(int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1, 0)
        self._begin += dropped
        return dropped

    def at(self, t_ns: int) -> Array:
        """Return the sample [6] at `t_ns`, linearly interpolated; the nearest one outside of what is held."""
        times = self.t_ns
        k = int(np.searchsorted(times, t_ns))
        if k < len(times) and (times[k] == t_ns or k == 0):
            return self.values[k].copy()
        if k == len(times):
            return self.values[-1].copy()
        alpha = (t_ns - int(times[k - 1])) / (int(times[k]) - int(times[k - 1]))
        return (1.0 - alpha) * self.values[k - 1] + alpha * self.values[k]

    def cut(self, t0_ns: int, t1_ns: int) -> ImuSpan | None:
        """Return the samples of `[t0_ns, t1_ns]` with interpolated ends; None if they do not cover it."""
        times = self.t_ns
        if len(times) == 0 or t1_ns <= t0_ns or t0_ns < times[0] or t1_ns > times[-1]:
            return None
        inner = slice(int(np.searchsorted(times, t0_ns, side="right")), int(np.searchsorted(times, t1_ns)))
        stamps = np.concatenate(([t0_ns], times[inner], [t1_ns])).astype(np.int64)
        values = np.concatenate((self.at(t0_ns)[None], self.values[inner], self.at(t1_ns)[None]))
        return ImuSpan(stamps, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]))

    def _make_room(self) -> None:
        live = self._end - self._begin
        capacity = len(self._t_ns)
        if 2 * live > capacity:
            capacity *= 2
        t_ns: NDArray[np.int64] = np.empty(capacity, dtype=np.int64)
        values: Array = np.empty((capacity, 6))
        extra: Array = np.empty((capacity, self._extra.shape[1]))
        t_ns[:live] = self.t_ns
        values[:live] = self.values
        extra[:live] = self.extra
        self._t_ns, self._values, self._extra, self._begin, self._end = t_ns, values, extra, 0, live


def join(spans: Sequence[ImuSpan]) -> ImuSpan:
    """Return one span from consecutive spans, each beginning where the one before ended.

    Raises ValueError if they do not follow each other.
    """
    for a, b in pairwise(spans):
        if a.t_ns[-1] != b.t_ns[0]:
            raise ValueError(
                f"spans do not follow each other: one ends at {a.t_ns[-1]}, the next begins at {b.t_ns[0]}"
            )
    return ImuSpan(
        np.concatenate([spans[0].t_ns, *(span.t_ns[1:] for span in spans[1:])]),
        np.concatenate([spans[0].gyro_rad_s, *(span.gyro_rad_s[1:] for span in spans[1:])]),
        np.concatenate([spans[0].accel_m_s2, *(span.accel_m_s2[1:] for span in spans[1:])]),
        _joint_noise(spans),
    )


def shifted(span: ImuSpan, shift_ns: int) -> ImuSpan:
    """Return a span as if it had been measured `shift_ns` later."""
    return replace(span, t_ns=span.t_ns + shift_ns)


def _joint_noise(spans: Sequence[ImuSpan]) -> NoiseScale:
    if len({span.noise for span in spans}) == 1:
        return spans[0].noise
    durations = [int(span.t_ns[-1] - span.t_ns[0]) for span in spans]
    gyro, accel = np.sqrt(np.average([np.square(span.noise) for span in spans], axis=0, weights=durations)).tolist()
    return NoiseScale(gyro, accel)


def subtract_bias(span: ImuSpan, gyro_bias_rad_s: Array, accel_bias_m_s2: Array) -> ImuSpan:
    """Return the span with its biases [3] taken off."""
    return replace(span, gyro_rad_s=span.gyro_rad_s - gyro_bias_rad_s, accel_m_s2=span.accel_m_s2 - accel_bias_m_s2)
