"""From the counts of a FIFO to calibrated samples: stamps, scale, saturation, a sensor that hangs."""

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np

from vislam.config import BoardConfig
from vislam.core.messages import Array, ImuSample
from vislam.hw.affine import Affine
from vislam.hw.chips import FifoImu
from vislam.hw.chips.fifo_imu import SATURATED_LSB, RawSamples
from vislam.hw.gyro_zero import GyroZero
from vislam.hw.health import Health
from vislam.hw.link import HELD_SAMPLES, STUCK_SAMPLES
from vislam.hw.timing import SampleClock

_QUESTIONS = 200  # of about the last second
_SLEW = 0.02  # share of an interval between samples by which a better middle may stretch it


class FifoStamps:
    """Stamps samples by the counts of a FIFO: a question that finds n new ones brackets when the newest was taken.

    Owns the fit of the chip's clock. That moves only when a question contradicts it, and so ends up anywhere in what
    the questions leave open; stamps are put into the middle of what those of about the last second do.
    """

    def __init__(self, rate_hz: float) -> None:
        """Take the rate by the chip's nominal clock."""
        self._clock = SampleClock(rate_hz)
        self._last_ns = 0
        self._shift_ns = 0.0
        self._early: deque[float] = deque(maxlen=_QUESTIONS)
        self._late: deque[float] = deque(maxlen=_QUESTIONS)

    @property
    def rate_hz(self) -> float:
        """The chip's rate by the host's clock."""
        return self._clock.rate_hz

    @property
    def bound_ms(self) -> float | None:
        """By how much stamps can be off: half of what the questions of the last second leave open. None before."""
        if len(self._early) < 2:
            return None
        return 0.5e-6 * max(min(self._early) + min(self._late), 0.0)

    def restart(self) -> None:
        """Forget when the newest sample was, as after lost samples; the rate stays."""
        self._clock.restart()
        self._shift_ns = 0.0
        self._early.clear()
        self._late.clear()

    def of(self, count: int, asked_ns: int, answered_ns: int) -> list[int]:
        """Return times [ns] of `count` new samples, at least one, that a question found; they always increase."""
        newest_ns = self._clock.newest_ns(count, asked_ns, answered_ns)
        period_ns = 1e9 / self._clock.rate_hz
        self._early.append(newest_ns - (asked_ns - period_ns))
        self._late.append(answered_ns - newest_ns)
        wanted_ns = 0.5 * (min(self._late) - min(self._early))
        most_ns = _SLEW * count * period_ns
        self._shift_ns += max(min(wanted_ns - self._shift_ns, most_ns), -most_ns)
        stamps = []
        for k in range(count - 1, -1, -1):
            self._last_ns = max(round(newest_ns + self._shift_ns - k * period_ns), self._last_ns + 1)
            stamps.append(self._last_ns)
        return stamps


@dataclass(slots=True)
class _Watch:
    """Whether one of the two sensors of a chip still measures, and within its range."""

    name: str
    saturated: Health
    fault: Health
    last: Array = field(default_factory=lambda: np.full(3, np.nan))
    repeats: int = 0  # equal samples in a row ...
    runs: list[int] = field(default_factory=list)  # ... up to each of those that were looked at last

    def looked(self, counts: Array, tallies: Counter[str]) -> Health:
        """Take counts [N, 3]; return the health bit of saturation."""
        self.runs = []
        for row in counts:
            self.repeats = self.repeats + 1 if (row == self.last).all() else 0
            self.last = row
            self.runs.append(self.repeats)
        beyond = int((abs(counts) >= SATURATED_LSB).any(axis=1).sum())
        if beyond:
            tallies[f"{self.name}_saturated"] += beyond
        return self.saturated if beyond else Health(0)


@dataclass(frozen=True, slots=True)
class Made:
    """What one look into the FIFO gave."""

    samples: list[ImuSample]
    events: Health
    is_stuck: bool  # a sensor hangs: the chip must be set up again


class FifoSamples:
    """Owns the calibration, the stamps and the temperature of one inertial chip with a FIFO."""

    def __init__(self, config: BoardConfig) -> None:
        """Take settings; samples can be made once a chip has begun."""
        self._config = config
        self.stamps = FifoStamps(config.rate_hz)
        self.zero = GyroZero()
        self.temperature_c: float | None = None  # smoothed over about a second
        self._gyro = _Watch("gyro", Health.GYRO_SATURATED, Health.GYRO_FAULT)
        self._accel = _Watch("accel", Health.ACCEL_SATURATED, Health.ACCEL_FAULT)
        self._delay_ns = self._good_ns = 0
        self._back = 0.0  # share of a period from the accelerometer's time to the gyro's
        self._accel_before: Array | None = None
        self._begin_maps(1.0, 1.0)

    @property
    def is_far(self) -> bool:
        """Whether the chip is warmer or colder than where its biases were taken, by more than is allowed."""
        return self.zero.is_far(self.temperature_c, self._config.max_temperature_change_c)

    def begin(self, imu: FifoImu, good_from_ns: int) -> None:
        """Take the scale and rate of a chip that was just set up; its samples are good from a time on."""
        self._begin_maps(imu.gyro_rad_s, imu.accel_m_s2)
        self.stamps = FifoStamps(imu.rate_hz)
        delay_s = imu.gyro_delay_s if self._config.delay_s is None else self._config.delay_s
        self._delay_ns, self._good_ns = round(delay_s * 1e9), good_from_ns
        self._back = (imu.gyro_delay_s - imu.accel_delay_s) * imu.rate_hz
        self._accel_before = None
        for watch in (self._gyro, self._accel):
            watch.repeats = min(watch.repeats, HELD_SAMPLES)  # until it gives another value

    def restart(self) -> None:
        """Samples were lost: the next ones are stamped without those before."""
        self.stamps.restart()
        self._accel_before = None

    def take_temperature(self, found_c: float) -> None:
        """Take what the chip reports, about twice a second."""
        self.temperature_c = found_c if self.temperature_c is None else 0.5 * (self.temperature_c + found_c)

    def made(self, raw: RawSamples, asked_ns: int, answered_ns: int, tallies: Counter[str]) -> Made:
        """Return samples of the body frame, at the times of what the gyro's filter lets through; counts faults.

        `asked_ns` and `answered_ns` are around the question how many there are.
        """
        events = self._gyro.looked(raw.gyro, tallies) | self._accel.looked(raw.accel, tallies)
        stuck = [watch for watch in (self._gyro, self._accel) if watch.repeats >= STUCK_SAMPLES]
        for watch in stuck:
            tallies[f"{watch.name}_stuck"] += 1
            events |= watch.fault
        if max(self._gyro.runs) >= HELD_SAMPLES:
            events |= Health.IMU_GAP
        drift = self.zero.drift_rad_s(self.temperature_c)
        rates = raw.gyro @ self._gyro_map.matrix.T + self._gyro_map.offset - drift
        forces = self._at_gyro(raw.accel) @ self._accel_map.matrix.T + self._accel_map.offset
        stamps = self.stamps.of(len(raw), asked_ns, answered_ns)
        samples = [
            ImuSample(t_ns - self._delay_ns, rate, force)
            for t_ns, rate, force, run in zip(stamps, rates, forces, self._gyro.runs, strict=True)
            if t_ns >= self._good_ns and run < HELD_SAMPLES
        ]
        return Made(samples, events, bool(stuck))

    def _at_gyro(self, accel: Array) -> Array:
        """Return counts [N, 3] between those of the accelerometer, for the gyro's filter is late by more than its own.

        Where it is late by less, by some 0.2 ms, they lie as far ahead on the line of the last two.
        """
        before = np.vstack([accel[:1] if self._accel_before is None else self._accel_before, accel[:-1]])
        self._accel_before = accel[-1:]
        return accel - self._back * (accel - before)

    def _begin_maps(self, gyro_rad_s: float, accel_m_s2: float) -> None:
        c = self._config.calibration
        self._gyro_map = Affine.of(c.gyro_axes, c.gyro_matrix, c.gyro_bias_rad_s, gyro_rad_s)
        self._accel_map = Affine.of(c.accel_axes, c.accel_matrix, c.accel_bias_m_s2, accel_m_s2)
