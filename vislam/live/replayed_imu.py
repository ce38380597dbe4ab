"""Inertial samples of a recording in real time. Apart from the frames: the fast process loads no OpenCV."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.config import SensorCalibration
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.imu_source import InertialSource
from vislam.live.epoch import Epoch

_NS = 1_000_000_000
_MISSING_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class InertialTable:
    """Samples of a whole recording."""

    t_ns: NDArray[np.int64]  # [N]
    values: Array  # [N, 6] gyro, accel
    rate_hz: float


class ReplayedImu(InertialSource):
    """An `InertialSource`; no recording has a temperature."""

    def __init__(self, table: InertialTable, epoch: Epoch, outages: tuple[tuple[float, float], ...] = ()) -> None:
        """Play a table from the epoch on; it is unplugged in each of `outages`, seconds since then."""
        super().__init__(SensorCalibration(), _MISSING_S)  # they come calibrated
        self.rate_hz = table.rate_hz
        self._epoch = epoch
        since_ns = table.t_ns - table.t_ns[0]
        kept = np.ones(len(since_ns), dtype=np.bool_)
        for begin, end in outages:
            kept &= (since_ns < begin * _NS) | (since_ns >= end * _NS)
        self._since_ns, self._values = since_ns[kept].tolist(), table.values[kept]
        self._next = 0

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return the samples whose time has come."""
        begin_ns = self._epoch.begin_ns()
        deadline_ns = time.monotonic_ns() + round(timeout_s * _NS)
        due_ns = begin_ns + self._since_ns[self._next] if self._next < len(self._since_ns) else 1 << 62
        wait_ns = min(due_ns, deadline_ns) - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / _NS)
        now_ns = time.monotonic_ns()
        samples: list[ImuSample | MagSample] = []
        while self._next < len(self._since_ns) and begin_ns + self._since_ns[self._next] <= now_ns:
            row = self._values[self._next]
            samples.append(ImuSample(begin_ns + self._since_ns[self._next], row[:3].copy(), row[3:].copy()))
            self._next += 1
        self._last_out_ns = now_ns if samples else max(self._last_out_ns, begin_ns)
        return samples

    def counters(self) -> dict[str, int]:
        """Return how many samples were played."""
        return {"samples": self._next}

    def close(self) -> None:
        """Play no more."""
        self._next = len(self._since_ns)
