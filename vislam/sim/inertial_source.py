"""Inertial samples for simulated vision: those of a real recording, or made while they are read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImuSample
from vislam.imu import ImuNoise
from vislam.sim.motion.spline import BodySpline
from vislam.sim.sensing import sense_imu

Stamps = NDArray[np.int64]

_CHUNK = 4000  # samples made at once


class InertialSource(Protocol):
    """Inertial samples in time order, and the biases in them."""

    def samples(self) -> Iterator[ImuSample]:
        """Yield the samples; can be called again and yields the same again."""
        ...

    def biases(self, t_ns: Stamps) -> tuple[Array, Array]:
        """Return gyro and accelerometer biases [N, 3] at times [N]; NaN where they are unknown."""
        ...


class RecordedImu:
    """The samples of a recording between two stamps, and the next one on either side."""

    def __init__(self, t_ns: Stamps, gyro_rad_s: Array, accel_m_s2: Array, begin_ns: int, end_ns: int) -> None:
        """Take samples at times [N], gyro and accel [N, 3]."""
        first = max(int(np.searchsorted(t_ns, begin_ns, "right")) - 1, 0)
        used = slice(first, int(np.searchsorted(t_ns, end_ns)) + 1)
        self._t_ns, self._gyro, self._accel = t_ns[used], gyro_rad_s[used], accel_m_s2[used]

    def samples(self) -> Iterator[ImuSample]:
        """Yield the samples."""
        for t_ns, gyro, accel in zip(self._t_ns.tolist(), self._gyro, self._accel, strict=True):
            yield ImuSample(t_ns, gyro, accel)

    def biases(self, t_ns: Stamps) -> tuple[Array, Array]:
        """Return NaN: they are unknown of a real IMU."""
        return np.full((len(t_ns), 3), np.nan), np.full((len(t_ns), 3), np.nan)


class SimulatedImu:
    """A simulated IMU on a spline; the samples are made in pieces, so that an hour needs little memory."""

    def __init__(
        self,
        motion: BodySpline,
        zero_ns: int,
        span_s: tuple[float, float],
        noise: ImuNoise,
        gravity_m_s2: float,
        seed: np.random.SeedSequence,
        disturbed: bool,
    ) -> None:
        """Sense a motion over a span of its seconds; `zero_ns` is the stamp of second 0. See `sense_imu`."""
        self._motion, self._zero_ns, self._noise, self._gravity = motion, zero_ns, noise, gravity_m_s2
        self._disturbed = disturbed
        count = int(np.floor((span_s[1] - span_s[0]) * noise.rate_hz + 1e-9)) + 1
        self._t_ns: Stamps = np.round((span_s[0] + np.arange(count) / noise.rate_hz) * 1e9).astype(np.int64)
        self._seeds = seed.spawn(-(-count // _CHUNK))

    def samples(self) -> Iterator[ImuSample]:
        """Yield the samples."""
        for t_ns, values in self._pieces():
            for t, row in zip((t_ns + self._zero_ns).tolist(), values, strict=True):
                yield ImuSample(t, row[:3], row[3:6])

    def biases(self, t_ns: Stamps) -> tuple[Array, Array]:
        """Return the biases in the samples, interpolated."""
        known = np.concatenate([values[:, 6:] for _, values in self._pieces()])
        columns = [np.interp(t_ns - self._zero_ns, self._t_ns, column) for column in known.T]
        return np.stack(columns[:3], axis=1), np.stack(columns[3:], axis=1)

    def _pieces(self) -> Iterator[tuple[Stamps, Array]]:
        """Yield times [n] and gyro, accel, gyro bias, accel bias [n, 12]; biases walk on from piece to piece."""
        last: Array | None = None
        for index, seed in enumerate(self._seeds):
            t_ns = self._t_ns[index * _CHUNK : (index + 1) * _CHUNK]
            rng = np.random.default_rng(seed)
            motion = self._motion.at(t_ns.astype(np.float64) * 1e-9)
            record = sense_imu(motion, self._noise, self._gravity, rng, self._disturbed)
            biases = np.hstack([record.gyro_bias_rad_s, record.accel_bias_m_s2])
            # every piece has a turn-on value of its own: only that of the first one counts
            shift = np.zeros(6) if last is None else last - biases[0]
            values = np.hstack([record.gyro_rad_s, record.accel_m_s2]) + shift
            biases = biases + shift
            last = biases[-1]
            yield t_ns, np.hstack([values, biases])
