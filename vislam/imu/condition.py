"""How an inertial unit is doing, beside its noise: its rate, holes, a range that ends too early, the force it feels."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImuSample
from vislam.core.streams import Happening, StreamEvent, StreamJudge
from vislam.imu.series import AXES

_NS = 1_000_000_000
_WINDOW, _AGAIN = 256, 96  # samples looked at together, and how many of them again in the next window
_HOLE = 2.5  # usual intervals; a longer one is a hole
_TOGETHER = 0.25  # of the mean interval: with a shorter usual one, samples come in bursts
_COARSE_STEPS = 8.0  # of the sensor's resolution
_AXES = [axis.name for axis in AXES]
_BY_CHANCE = 1e-3  # plateaus at the end of the range that chance would make in the whole recording


@dataclass(frozen=True, slots=True)
class InertialCondition:
    """What the samples of a recording show."""

    samples: int
    rate_hz: float  # NaN before there are two
    longest_gap_s: float
    saturated_axes: tuple[str, ...]  # "gyro x", ...: the range ends where the motion does not
    force_m_s2: float  # median norm of the mean force over short windows: gravity, where motion goes to and fro
    events: tuple[StreamEvent, ...] = ()  # when the range ended


class ConditionWatch:
    """Owns counts over all samples; memory grows by a number per window."""

    def __init__(self) -> None:
        """Start empty."""
        self._pending: list[Array] = []  # [6] each
        self._last_t_ns: int | None = None
        self._times_ns: list[int] = []  # of them
        self._intervals_ns: list[int] = []  # one per window: its median
        self._longest_ns = 0
        self._samples = 0
        self._forces: list[float] = []
        self._ends = np.stack([np.full(6, np.inf), np.full(6, -np.inf)])  # lowest and highest value per axis ...
        self._clips = [[StreamJudge("")] * 6 for _ in "<>"]  # ... when
        self._runs = np.zeros((2, 6), dtype=np.int64)  # ... and the longest run of it that a motion was cut off by
        self._steps = np.full(6, np.inf)  # smallest change: what the sensor resolves
        self._equal = np.zeros(6, dtype=np.int64)  # pairs of neighbours that are exactly equal

    def add(self, sample: ImuSample) -> None:
        """Take a sample, in time order."""
        if self._last_t_ns is not None:
            self._longest_ns = max(self._longest_ns, sample.t_ns - self._last_t_ns)
        self._last_t_ns = sample.t_ns
        self._samples += 1
        self._times_ns.append(sample.t_ns)
        self._pending.append(np.concatenate([sample.gyro_rad_s, sample.accel_m_s2]))
        if len(self._pending) == _WINDOW:
            self._look(np.array(self._times_ns), np.array(self._pending))
            self._pending, self._times_ns = self._pending[-_AGAIN:], self._times_ns[-_AGAIN:]

    def condition(self) -> InertialCondition:
        """Return what there is to say so far."""
        interval_ns = float(np.median(self._intervals_ns)) if self._intervals_ns else float("nan")
        longest_ns = self._longest_ns if self._longest_ns > _HOLE * interval_ns else 0
        force = float(np.median(self._forces)) if self._forces else float("nan")
        axes = self._saturated()
        events = [
            e
            for clips in self._clips
            for name, judge in zip(_AXES, clips, strict=True)
            if name in axes
            for e in judge.events
        ]
        return InertialCondition(self._samples, _NS / interval_ns, longest_ns / _NS, axes, force, tuple(events))

    def _look(self, t_ns: NDArray[np.int64], values: Array) -> None:
        """Take times [N] and values [N, 6] of a window that begins within the one before."""
        usual_ns, mean_ns = float(np.median(np.diff(t_ns))), float(np.mean(np.diff(t_ns)))
        self._intervals_ns.append(int(usual_ns if usual_ns > _TOGETHER * mean_ns else mean_ns))
        self._forces.append(float(np.linalg.norm(values[:, 3:].mean(axis=0))))
        changes = np.abs(np.diff(values, axis=0))
        self._equal += np.sum(changes == 0.0, axis=0)
        self._steps = np.minimum(self._steps, np.where(changes > 0.0, changes, np.inf).min(axis=0))
        for side, ends in enumerate((values.min(axis=0), values.max(axis=0))):
            beyond = ends < self._ends[0] if side == 0 else ends > self._ends[1]
            runs = np.where(ends == self._ends[side], self._runs[side], 0)
            for axis in np.flatnonzero(beyond | (ends == self._ends[side])):
                if beyond[axis]:
                    self._clips[side][axis] = StreamJudge(f"imu0 {_AXES[axis]}")
                seen = [int(np.searchsorted(t_ns, e.to_ns)) for e in self._clips[side][axis].events[-1:]]
                for begin, stop in _cut_off(values[:, axis], ends[axis], self._steps[axis], *seen):
                    runs[axis] = max(int(runs[axis]), stop - begin)
                    if stop - begin > 1 and (stop >= _AGAIN or len(self._forces) == 1):  # else it was seen before
                        times_ns = int(t_ns[begin]), int(t_ns[stop - 1])
                        self._clips[side][axis].note(Happening.CLIPPED, *times_ns, stop - begin)
            self._runs[side] = np.where(beyond, runs, np.maximum(runs, self._runs[side]))
            self._ends[side] = np.where(beyond, ends, self._ends[side])

    def _saturated(self) -> tuple[str, ...]:
        """Return the axes whose range ends in a plateau that equal neighbours elsewhere do not explain."""
        if self._samples <= _WINDOW:
            return ()
        share = (self._equal + 1.0) / self._samples
        expected = self._samples * share ** np.maximum(self._runs.max(axis=0) - 1, 0)
        return tuple(name for name, chance in zip(_AXES, expected, strict=True) if chance < _BY_CHANCE)


def _cut_off(values: Array, end: float, step: float, seen: int = -1) -> Iterator[tuple[int, int]]:
    """Yield where runs of `end` in [N] that a motion was cut off by begin and stop.

    A smooth peak in a sensor's coarse steps stays at its highest for a while, too; but half that long before, it was
    three steps lower, and a motion that is cut off was much farther away. Those up to `seen` were found before.
    """
    is_there = values == end
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_there, [False]]).astype(np.int8)))
    for begin, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        before = begin - max((stop - begin) // 2, 1)
        if begin <= seen or (before >= 0 and abs(values[before] - end) > _COARSE_STEPS * step):
            yield begin, stop
