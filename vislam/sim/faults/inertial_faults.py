"""What goes wrong with an inertial unit and with the way of its samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from vislam.core.messages import Array, ImuSample
from vislam.sim.faults.moment import Event, Moment, Stream, changed

_GRAVITY_M_S2 = 9.81
_VIBRATION = np.array([0.10, 0.12, 0.08, 3.0, 4.0, 5.0])  # amplitudes, rad/s and m/s^2 ...
_VIBRATION_HZ = 87.0  # ... of a propeller, beyond half the rate of many units, so that it is aliased
_ACCEL_RANGE_SHARE, _GYRO_RANGE_RAD_S = 0.05, 0.5
_NOISE = 8.0 * np.sqrt(200.0) * np.repeat([1.7e-4, 2.0e-3], 3)  # eight times an ADIS16448's, as in the EuRoC drone
_SPIKE = np.repeat([30.0, 150.0], 3)  # the ranges of a cheap unit
_SPIKES, _LATE, _TWICE = 0.01, 0.02, 0.5  # shares of the samples
_BURST = 20  # samples
_WITHIN_NS = 50_000  # between the samples of one transfer
_COARSE_NS = 10_000_000


def _six(change: Callable[[Array, Moment, int], Array]) -> Stream:
    """Return the fault that changes the numbers [6] (gyro, accel) of every sample, by the moment and its time."""

    def row(sample: ImuSample, moment: Moment) -> ImuSample:
        six = change(np.concatenate([sample.gyro_rad_s, sample.accel_m_s2]), moment, sample.t_ns)
        return ImuSample(sample.t_ns, six[:3], six[3:])

    return changed(ImuSample, row)


def scaled(*factors: float) -> Stream:
    """Return the fault that multiplies the numbers of a sample (gyro, accel)."""
    return _six(lambda six, _, __: six * np.array(factors))


IN_G = scaled(1.0, 1.0, 1.0, *(1.0 / _GRAVITY_M_S2,) * 3)
STRETCHED = scaled(1.0, 1.0, 1.0, *(1.0 + _ACCEL_RANGE_SHARE,) * 3)
NOISY = _six(lambda six, moment, _: six + _NOISE * moment.rng.standard_normal(6))
NO_NUMBER = _six(lambda six, _, __: np.full(6, np.nan))
SPIKES = _six(lambda six, m, _: _SPIKE * m.rng.choice([-1.0, 1.0], 6) if m.rng.random() < _SPIKES else six)
SHAKEN = _six(lambda six, m, t_ns: six + _VIBRATION * np.sin(
    2.0 * np.pi * _VIBRATION_HZ * 1e-9 * (t_ns - m.from_ns) + np.arange(6)))  # fmt: skip
CLIPPED = _six(lambda six, _, __: np.concatenate([np.clip(six[:3], -_GYRO_RANGE_RAD_S, _GYRO_RANGE_RAD_S), six[3:]]))
COARSE = changed(ImuSample, lambda sample, _: replace(sample, t_ns=sample.t_ns // _COARSE_NS * _COARSE_NS))


def every(nth: int, is_kept: bool = False) -> Stream:
    """Return the fault that one sample of some arrives, unfiltered; `is_kept`: the others repeat its numbers."""

    def stream(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
        count, last = 0, None
        for value in events:
            if not isinstance(value, ImuSample) or not moment.has(value.t_ns):
                yield value
                continue
            count += 1
            last = value if count % nth == 1 or last is None else last
            if is_kept or last is value:
                yield replace(last, t_ns=value.t_ns)

    return stream


def twice(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Send half of the rows twice."""
    for value in events:
        yield value
        if isinstance(value, ImuSample) and moment.has(value.t_ns) and moment.rng.random() < _TWICE:
            yield value


def disordered(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Let one row in fifty come after the next one."""
    waiting: list[ImuSample] = []
    for value in events:
        if isinstance(value, ImuSample) and not waiting and moment.has(value.t_ns) and moment.rng.random() < _LATE:
            waiting.append(value)
            continue
        yield value
        if isinstance(value, ImuSample) and waiting:
            yield waiting.pop()


def in_bursts(events: Iterator[Event], moment: Moment) -> Iterator[Event]:
    """Send samples together and stamp them when they arrive, as a driver does that reads a full FIFO."""
    waiting: list[ImuSample] = []
    for value in events:
        if not isinstance(value, ImuSample) or not moment.has(value.t_ns):
            yield value
            continue
        waiting.append(value)
        if len(waiting) == _BURST:
            for n, sample in enumerate(waiting):
                yield replace(sample, t_ns=value.t_ns + (n + 1 - _BURST) * _WITHIN_NS)
            waiting.clear()
