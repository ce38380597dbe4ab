"""One inertial sample for each of the gyro's, from an accelerometer that has times of its own."""

from collections import deque
from typing import Any

import numpy as np

from vislam.core.messages import Array


class AccelAtGyro:
    """Keeps samples of a gyro and an accelerometer until the latter can be interpolated to the former's stamps.

    Attributes:
        unpaired: samples of the gyro that were given up, those before the accelerometer's first left aside.
    """

    def __init__(self, keep: int) -> None:
        """Keep at most `keep` samples of one that wait for the other."""
        self._gyro: deque[tuple[int, Any]] = deque(maxlen=keep)
        self._accel: deque[tuple[int, Any]] = deque(maxlen=keep)
        self._complete: list[tuple[int, Array, Array]] = []  # of before a hole
        self._last_ns = self.unpaired = 0
        self._is_flowing = False

    def add_gyro(self, t_ns: int, rate: Any) -> None:
        """Take a rate [3]; stamps must rise."""
        self.unpaired += self._is_flowing and len(self._gyro) == self._gyro.maxlen
        self._gyro.append((t_ns, rate))

    def add_accel(self, t_ns: int, force: Any) -> None:
        """Take a specific force [3]; stamps must rise."""
        self._accel.append((t_ns, force))

    def clear(self) -> None:
        """Begin behind a hole: what waits for a sample of before it is forgotten."""
        self._complete = self.merged()
        self._gyro.clear()
        self._accel.clear()
        self._is_flowing = False

    def merged(self) -> list[tuple[int, Array, Array]]:
        """Return stamp, rate [3] and force [3] of the gyro's samples around which the accelerometer has some."""
        gyro, accel = self._gyro, self._accel
        merged, self._complete = self._complete, []
        while gyro and accel and gyro[0][0] <= accel[-1][0]:
            t_ns, rate = gyro.popleft()
            while len(accel) > 1 and accel[1][0] <= t_ns:
                accel.popleft()
            if t_ns < accel[0][0] or t_ns <= self._last_ns:
                self.unpaired += self._is_flowing
                continue  # before the accelerometer's first
            force = np.asarray(accel[0][1])
            if t_ns > accel[0][0]:
                share = (t_ns - accel[0][0]) / (accel[1][0] - accel[0][0])
                force = (1.0 - share) * force + share * np.asarray(accel[1][1])
            self._last_ns, self._is_flowing = t_ns, True
            merged.append((t_ns, rate, force))
        return merged


class AccelBefore:
    """Moves the accelerometer's counts to the gyro's time, where one clock takes both and their filters differ.

    They lie between those of the last two samples; where the gyro's filter is late by less, as far ahead on their line.
    """

    def __init__(self) -> None:
        """Begin without a sample."""
        self._before: Array | None = None

    def forget(self) -> None:
        """Samples were lost."""
        self._before = None

    def moved(self, accel: Array, share: float) -> Array:
        """Return counts [N, 3] that are older by a share of the time between two samples."""
        before = np.vstack([accel[:1] if self._before is None else self._before, accel[:-1]])
        self._before = accel[-1:]
        return np.asarray(accel - share * (accel - before))
