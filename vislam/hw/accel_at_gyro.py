"""One inertial sample for each of the gyro's, from sensors that stamp each for itself."""

from collections import deque

from vislam.core.messages import Array


class AccelAtGyro:
    """Keeps samples of a gyro and an accelerometer until the latter can be interpolated to the former's stamps."""

    def __init__(self, keep: int) -> None:
        """Keep at most `keep` samples of one that wait for the other."""
        self._gyro: deque[tuple[int, Array]] = deque(maxlen=keep)
        self._accel: deque[tuple[int, Array]] = deque(maxlen=keep)
        self._last_ns = 0

    def add_gyro(self, t_ns: int, rate: Array) -> None:
        """Take a rate [3]; stamps must rise."""
        self._gyro.append((t_ns, rate))

    def add_accel(self, t_ns: int, force: Array) -> None:
        """Take a specific force [3]; stamps must rise."""
        self._accel.append((t_ns, force))

    def clear(self) -> None:
        """Forget what waits, as after a hole."""
        self._gyro.clear()
        self._accel.clear()

    def merged(self) -> list[tuple[int, Array, Array]]:
        """Return stamp, rate [3] and force [3] of the gyro's samples around which the accelerometer has some."""
        gyro, accel = self._gyro, self._accel
        merged = []
        while gyro and accel and gyro[0][0] <= accel[-1][0]:
            t_ns, rate = gyro.popleft()
            while len(accel) > 1 and accel[1][0] <= t_ns:
                accel.popleft()
            if t_ns < accel[0][0] or t_ns <= self._last_ns:
                continue  # before the accelerometer's first
            force = accel[0][1]
            if t_ns > accel[0][0]:
                share = (t_ns - accel[0][0]) / (accel[1][0] - accel[0][0])
                force = (1.0 - share) * force + share * accel[1][1]
            self._last_ns = t_ns
            merged.append((t_ns, rate, force))
        return merged
