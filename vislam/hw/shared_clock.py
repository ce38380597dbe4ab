"""The clock of a device with an IMU and cameras, put on the host's: one line for all that it stamps."""

import threading
from bisect import bisect_left
from collections import deque

from vislam.config import BridgeClockConfig
from vislam.hw.bridge.clock import DeviceClock

_WRAP_US = 2**32
_KEPT = 512  # ticks: more than a second of a gyro
_BEYOND_US = 500_000  # after the newest tick or before the oldest, that is still of this clock


class SharedClock:
    """Places what a device stamps [us, 32 bits] on CLOCK_MONOTONIC.

    The gyro, which comes most often and soonest, lays the line under its arrivals. Whatever else the device stamps is
    placed between the gyro's samples around it, so that nothing the line does can part images from inertial samples.
    For any thread.
    """

    def __init__(self, config: BridgeClockConfig, delay_s: float) -> None:
        """Take the settings of the line, and how late the gyro's samples arrive at the fastest."""
        self._line = DeviceClock(config)
        self._delay_ns = round(delay_s * 1e9)
        self._lock = threading.Lock()
        self._device_us: deque[int] = deque(maxlen=_KEPT)  # unwrapped
        self._host_ns: deque[int] = deque(maxlen=_KEPT)
        self._steps = 0

    @property
    def steps(self) -> int:
        """How often a new line was begun."""
        return self._steps

    @property
    def is_settled(self) -> bool:
        """Whether the line is trusted: `at` then knows all that this clock stamped lately."""
        return len(self._device_us) >= 2

    def tick(self, device_us: int, arrival_ns: int) -> int | None:
        """Return the host's time of a sample of the gyro that has just arrived; None while the line is not trusted."""
        with self._lock:
            stamp_ns = self._line.stamp(device_us % _WRAP_US, arrival_ns)
            if self._line.steps != self._steps:
                self._steps = self._line.steps
                self._device_us.clear()
                self._host_ns.clear()
            if stamp_ns is None:
                return None
            known = self._device_us[-1] if self._device_us else 0
            self._device_us.append(known + (device_us - known) % _WRAP_US)
            self._host_ns.append(stamp_ns - self._delay_ns)
            return self._host_ns[-1]

    def at(self, device_us: int) -> int | None:
        """Return the host's time of another stamp; None where no tick is near: too early, or by another clock."""
        with self._lock:
            ticks = self._device_us
            if len(ticks) < 2:
                return None
            since_us = (device_us - ticks[-1] + _WRAP_US // 2) % _WRAP_US - _WRAP_US // 2
            t_us = ticks[-1] + since_us
            if since_us > _BEYOND_US or t_us < ticks[0] - _BEYOND_US:
                return None
            after = min(max(bisect_left(ticks, t_us), 1), len(ticks) - 1)
            u0, u1, h0, h1 = ticks[after - 1], ticks[after], self._host_ns[after - 1], self._host_ns[after]
            return h0 + round((t_us - u0) * (h1 - h0) / (u1 - u0))
