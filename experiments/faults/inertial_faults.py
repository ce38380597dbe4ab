"""What goes wrong with an inertial unit and with the way of its samples."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from faults.fault_moment import Moment, Stream, changed

from vislam.core import Array, ImuSample

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

    def row(sample: ImuSample, moment: Moment, _: list[ImuSample]) -> Iterable[ImuSample]:
        six = change(np.concatenate([sample.gyro_rad_s, sample.accel_m_s2]), moment, sample.t_ns)
        return (ImuSample(sample.t_ns, six[:3], six[3:]),)

    return changed(ImuSample, row)


def scaled(*factors: float) -> Stream:
    """Return the fault that multiplies the numbers of a sample (gyro, accel)."""
    return _six(lambda six, _, __: six * np.array(factors))


def thinned(nth: int) -> Stream:
    """Return the fault that one sample of some arrives, unfiltered, as of a bus that is too slow."""

    def change(sample: ImuSample, _: Moment, kept: list[ImuSample]) -> Iterable[ImuSample]:
        kept.append(sample)
        return (sample,) if len(kept) % nth == 1 else ()

    return changed(ImuSample, change)


def _twin(sample: ImuSample, _: Moment, kept: list[ImuSample]) -> Iterable[ImuSample]:
    if kept:
        return (replace(kept.pop(), t_ns=sample.t_ns),)
    kept.append(sample)
    return (sample,)


def _disordered(sample: ImuSample, moment: Moment, kept: list[ImuSample]) -> Iterable[ImuSample]:
    if kept:
        return sample, kept.pop()
    if moment.rng.random() >= _LATE:
        return (sample,)
    kept.append(sample)
    return ()


def _burst(sample: ImuSample, _: Moment, kept: list[ImuSample]) -> Iterable[ImuSample]:
    kept.append(sample)
    if len(kept) < _BURST:
        return ()
    burst = [replace(row, t_ns=sample.t_ns + (n + 1 - _BURST) * _WITHIN_NS) for n, row in enumerate(kept)]
    kept.clear()
    return burst


IN_G = scaled(1.0, 1.0, 1.0, *(1.0 / _GRAVITY_M_S2,) * 3)
STRETCHED = scaled(1.0, 1.0, 1.0, *(1.0 + _ACCEL_RANGE_SHARE,) * 3)
NOISY = _six(lambda six, moment, _: six + _NOISE * moment.rng.standard_normal(6))
NO_NUMBER = _six(lambda six, _, __: np.full(6, np.nan))
SPIKES = _six(lambda six, m, _: _SPIKE * m.rng.choice([-1.0, 1.0], 6) if m.rng.random() < _SPIKES else six)
SHAKEN = _six(lambda six, m, t_ns: six + _VIBRATION * np.sin(
    2.0 * np.pi * _VIBRATION_HZ * 1e-9 * (t_ns - m.from_ns) + np.arange(6)))  # fmt: skip
CLIPPED = _six(lambda six, _, __: np.concatenate([np.clip(six[:3], -_GYRO_RANGE_RAD_S, _GYRO_RANGE_RAD_S), six[3:]]))
COARSE = changed(ImuSample, lambda sample, _, __: (replace(sample, t_ns=sample.t_ns // _COARSE_NS * _COARSE_NS),))
TWICE = changed(ImuSample, lambda sample, m, _: (sample, sample) if m.rng.random() < _TWICE else (sample,))
TWINS, DISORDERED, BURSTS = (changed(ImuSample, change) for change in (_twin, _disordered, _burst))
