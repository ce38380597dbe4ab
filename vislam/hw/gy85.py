"""The GY-85 board: three chips on one bus, merged into calibrated body-frame samples stamped at capture."""

from collections import deque
from contextlib import suppress

import numpy as np

from vislam.config import Gy85Config
from vislam.core.errors import UsageError
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.affine import Affine
from vislam.hw.board_magnetometer import BoardMagnetometer
from vislam.hw.chips import (
    Adxl345,
    BusError,
    I2cBus,
    Itg3205,
    SelfTest,
    SettingsLostError,
    adxl345,
    find_magnetometer,
    itg3205,
)
from vislam.hw.gyro_zero import GyroZero
from vislam.hw.health import Health
from vislam.hw.link import HELD_SAMPLES, START_ATTEMPTS, STUCK_SAMPLES, ChipLinks, Link, refuse_shared
from vislam.hw.timing import Clock, HostClock, SampleClock, read_in_rounds

_NS = 1_000_000_000
_MIN_RATE_HZ, _MAX_RATE_HZ = 1.0, 1000.0  # the gyro samples at 1 kHz inside
_G_M_S2 = 9.80665
_TEMPERATURE_TAU_S = 1.0  # its counts are noisy, its changes slow


class SampleTrack:
    """The newest samples of a chip that hands them over in groups; owns the fit of its clock."""

    def __init__(self, rate_hz: float, keep: int = 64) -> None:
        """Take the nominal rate; `keep` bounds what is held."""
        self._clock = SampleClock(rate_hz)
        self._times: deque[int] = deque(maxlen=keep)
        self._values: deque[Array] = deque(maxlen=keep)

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest sample, None when there is none."""
        return self._times[-1] if self._times else None

    @property
    def rate_hz(self) -> float:
        """The chip's rate by the host's clock."""
        return self._clock.rate_hz

    def restart(self) -> None:
        """Forget the samples, as after a hole; the rate stays."""
        self._clock.restart()
        self._times.clear()
        self._values.clear()

    def add(self, values: Array, asked_ns: int, answered_ns: int) -> None:
        """Take new samples [N, 3], N >= 1, that one question brought."""
        newest_ns = self._clock.newest_ns(len(values), asked_ns, answered_ns)
        period_ns = 1e9 / self._clock.rate_hz
        for k, value in enumerate(values):
            t_ns = newest_ns - round((len(values) - 1 - k) * period_ns)
            if self._times:
                t_ns = max(t_ns, self._times[-1] + 1)
            self._times.append(t_ns)
            self._values.append(value)

    def at(self, t_ns: int) -> Array | None:
        """Return the value [3] at a time, None if the samples do not reach around it; forgets what is older."""
        times, values = self._times, self._values
        while len(times) > 2 and times[1] <= t_ns:
            times.popleft()
            values.popleft()
        if len(times) < 2 or not times[0] <= t_ns <= times[1]:
            return None
        share = (t_ns - times[0]) / (times[1] - times[0])
        return (1.0 - share) * values[0] + share * values[1]


class Gy85:
    """Satisfies `InertialSource`. The gyro is the master of time; accelerometer samples are interpolated to its stamps.

    Stamps are those of the middle of what the gyro's filter lets through, some milliseconds before the transfer, by
    when newer accelerometer samples are there: a sample is given out in the call that captured it. A magnetometer
    sample may be stamped up to 15 ms before inertial ones that were given out earlier.

    One thread only. Transfers are bounded by `config.bus_timeout_s`, which is what a call may take longer than asked.
    """

    stamped_by = "the host, in the middle of the transfer"

    def __init__(self, config: Gy85Config, clock: Clock | None = None, must_be_there: bool = True) -> None:
        """Open the bus, set the chips up, test them (`config.self_test`: about 2 s, standing still).

        With `must_be_there` False a missing board is not an error: it is looked for as after unplugging.

        Raises:
            UsageError: a rate that no such board has.
            HardwareError: bus, gyro or accelerometer is missing or is another chip; smbus2 is not installed.
        """
        for name, rate_hz in (("rate_hz", config.rate_hz), ("mag_rate_hz", config.mag_rate_hz)):
            if not _MIN_RATE_HZ <= rate_hz <= _MAX_RATE_HZ:
                raise UsageError(f"gy85.{name} must be {_MIN_RATE_HZ:g} to {_MAX_RATE_HZ:g}, got {rate_hz:g}")
        self._config = config
        self._clock: Clock = HostClock() if clock is None else clock
        self.rate_hz = config.rate_hz
        self.self_tests: tuple[SelfTest, ...] = ()
        self._period_ns = round(_NS / config.rate_hz)
        c = config.calibration
        gyro_unit = np.deg2rad(1.0 / itg3205.LSB_PER_DEG_S)
        self._gyro_map = Affine.of(c.gyro_axes, c.gyro_matrix, c.gyro_bias_rad_s, gyro_unit)
        self._accel_map = Affine.of(c.accel_axes, c.accel_matrix, c.accel_bias_m_s2, _G_M_S2 / adxl345.LSB_PER_G)
        self._gyro: Itg3205 | None = None
        self._accel: Adxl345 | None = None
        self._mag = BoardMagnetometer(config, self._clock, find_magnetometer, config.mag)
        self._gyro_link = Link(self._start_gyro, Health.GYRO_FAULT)
        self._accel_link = Link(self._start_accel, Health.ACCEL_FAULT)
        self._links = ChipLinks(config, self._clock, (self._gyro_link, self._accel_link, self._mag.link))
        self._zero = GyroZero()
        self._temperature_c: float | None = None
        self._track = SampleTrack(config.accel_rate_hz)
        self._last_accel: Array = np.full(3, np.nan)
        self._pending: deque[tuple[int, Array]] = deque()  # gyro samples that wait for the accelerometer
        self._last_counts: tuple[int, int, int] | None = None
        self._last_gyro_ns = 0
        self._is_flowing = False
        self._last_out_ns = self._clock.now_ns()
        self._next_ns = self._clock.now_ns()
        self._links.begin(must_be_there)
        if config.self_test and self._gyro_link.is_up and self._accel_link.is_up:
            self.run_self_tests()
        self._next_ns = self._clock.now_ns()

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the gyro, smoothed over a second; None before the first sample."""
        return self._temperature_c

    @property
    def magnetometer_name(self) -> str | None:
        """Which of the chips that are sold as HMC5883L it is; None if there is none."""
        return self._mag.name

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Take the drift from a temperature on off; see `InertialSource`. TEMPERATURE_DRIFT is set when it is far."""
        self._zero = GyroZero(temperature_c, np.asarray(gyro_per_c))

    def run_self_tests(self) -> tuple[SelfTest, ...]:
        """Test accelerometer and magnetometer by their own means; about 2 s, standing still, no samples meanwhile."""
        tests = [self._self_tested(self._accel_link), self._self_tested(self._mag.link)]
        self.self_tests = tuple(test for test in tests if test is not None)
        with suppress(BusError):
            if self._accel is not None and self._accel_link.is_up:
                self._accel.read_fifo()  # what came in meanwhile
        self._track.restart()
        self._is_flowing = False
        now = self._clock.now_ns()
        self._next_ns = now
        for link in (self._accel_link, self._mag.link):
            link.newest_ns = now
        return self.self_tests

    def _self_tested(self, link: Link) -> SelfTest | None:
        if not link.is_up:
            return None
        for _ in range(START_ATTEMPTS):
            self._clock.sleep_until(link.retry_ns if not link.is_up else 0)
            self._links.connect(self._clock.now_ns())
            if not link.is_up:
                continue
            try:
                if link is self._accel_link and self._accel is not None:
                    link.self_test = self._accel.self_test(self._clock, self._config.supply_v)
                elif self._mag.chip is not None:
                    link.self_test = self._mag.chip.self_test(self._clock)
            except BusError as error:
                self._links.failed(link, error)
                link.drop(self._clock.now_ns())  # its stimulus may still be on: set it up again
            else:
                return link.self_test
        return None

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        return read_in_rounds(self._clock, timeout_s, lambda: self._next_ns, self._poll)

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        word = self._links.health()
        if self._clock.now_ns() - self._last_out_ns > self._config.silent_s * _NS:
            word |= Health.IMU_MISSING
        if self._zero.is_far(self._temperature_c, self._config.max_temperature_change_c):
            word |= Health.TEMPERATURE_DRIFT
        return word

    def counters(self) -> dict[str, int]:
        """Return how often each fault occurred since the start."""
        return dict(self._links.counts)

    def close(self) -> None:
        """Close the bus; may be called twice."""
        self._links.close()

    # ---- one round --------------------------------------------------------------------------------------------

    def _poll(self) -> list[ImuSample | MagSample]:
        now = self._clock.now_ns()
        late = (now - self._next_ns) // self._period_ns
        self._next_ns += (late + 1) * self._period_ns
        if late > 0 and self._gyro_link.is_up:
            self._links.counts["rounds_missed"] += late
            self._links.events |= Health.IMU_GAP
        if not self._links.are_up:
            self._links.connect(now)
        self._read_gyro()
        self._read_accel()
        samples: list[ImuSample | MagSample] = [*self._merge()]
        mag = self._mag.read(self._links, now)
        if mag is not None:
            samples.append(mag)
            samples.sort(key=lambda sample: sample.t_ns)
        return samples

    def _read_gyro(self) -> None:
        if self._gyro is None or not self._gyro_link.is_up:
            return
        asked = self._clock.now_ns()
        try:
            temperature, *counts = self._gyro.read()
        except (BusError, SettingsLostError) as error:
            self._links.events |= Health.IMU_GAP
            self._links.failed(self._gyro_link, error)
            return
        answered = self._clock.now_ns()
        link = self._gyro_link
        link.nacks = 0
        if asked < link.good_from_ns:
            return
        is_repeated = tuple(counts) == self._last_counts
        link.repeats = link.repeats + 1 if is_repeated else 0
        self._last_counts = (counts[0], counts[1], counts[2])
        if link.repeats >= HELD_SAMPLES:
            self._links.events |= Health.IMU_GAP
            if link.repeats >= STUCK_SAMPLES:
                self._links.hung(link, "gyro_stuck", asked)
            return
        self._take_temperature(temperature)
        if max(map(abs, counts)) >= itg3205.LIMIT_LSB:
            self._links.counts["gyro_saturated"] += 1
            self._links.events |= Health.GYRO_SATURATED
        rate = self._gyro_map.matrix @ np.array(counts, dtype=np.float64) + self._gyro_map.offset
        rate -= self._zero.drift_rad_s(self._temperature_c)
        # a process that was put aside within the call must not move the stamp by more than the call usually takes
        delay_s = self._gyro.delay_s if self._config.gyro_delay_s is None else self._config.gyro_delay_s
        t_ns = asked + min(answered - asked, self._period_ns) // 2 - round(delay_s * _NS)
        if t_ns <= self._last_gyro_ns:
            return
        self._last_gyro_ns = link.newest_ns = t_ns
        self._pending.append((t_ns, rate))

    def _read_accel(self) -> None:
        if self._accel is None or not self._accel_link.is_up:
            return
        link = self._accel_link
        asked = self._clock.now_ns()
        try:
            counts, was_full = self._accel.read_fifo()
        except BusError as error:
            self._links.failed(link, error)
            return
        link.nacks = 0
        if was_full:
            self._links.counts["accel_overrun"] += 1
            self._links.events |= Health.IMU_GAP
            self._track.restart()
        if len(counts) == 0:
            if asked - link.newest_ns > self._config.silent_s * _NS:
                self._links.hung(link, "accel_silent", asked)
            return
        if (abs(counts) >= self._accel.limit_lsb).any():
            self._links.counts["accel_saturated"] += int((abs(counts) >= self._accel.limit_lsb).any(axis=1).sum())
            self._links.events |= Health.ACCEL_SATURATED
        answered = self._clock.now_ns()
        link.newest_ns = answered  # not `asked`: a host put aside in between must not blame the chip
        values = counts @ self._accel_map.matrix.T + self._accel_map.offset
        self._track.add(values, asked, answered)
        for row in counts:
            link.repeats = link.repeats + 1 if (row == self._last_accel).all() else 0
            self._last_accel = row
        if link.repeats >= STUCK_SAMPLES:
            self._links.hung(link, "accel_stuck", asked)

    def _merge(self) -> list[ImuSample]:
        """Return the gyro samples for which accelerometer samples lie on both sides, with those interpolated."""
        merged = []
        newest_ns = self._track.newest_ns
        while self._pending and newest_ns is not None and self._pending[0][0] <= newest_ns:
            t_ns, rate = self._pending.popleft()
            force = self._track.at(t_ns)
            if force is None:
                self._unpaired()
            else:
                merged.append(ImuSample(t_ns, rate, force))
                self._is_flowing = True
        while self._pending and self._last_gyro_ns - self._pending[0][0] > self._config.silent_s * _NS:
            self._pending.popleft()
            self._unpaired()
        if merged:
            self._last_out_ns = self._clock.now_ns()
        return merged

    def _unpaired(self) -> None:
        if self._is_flowing:  # the first ones after a start come before the accelerometer's
            self._links.counts["gyro_unpaired"] += 1
            self._links.events |= Health.IMU_GAP

    def _take_temperature(self, temperature_c: float) -> None:
        if self._temperature_c is None:
            self._temperature_c = temperature_c
        gain = min(1.0 / (_TEMPERATURE_TAU_S * self.rate_hz), 1.0)
        self._temperature_c += gain * (temperature_c - self._temperature_c)

    # ---- coming and going -------------------------------------------------------------------------------------

    def _start_gyro(self, bus: I2cBus) -> None:
        refuse_shared(bus, itg3205.ADDRESS)
        self._gyro = Itg3205(bus, self._config.gyro_bandwidth_hz)
        self._gyro.configure(self._clock)
        self._gyro_link.good_from_ns = self._clock.now_ns() + round(itg3205.START_UP_S * _NS)

    def _start_accel(self, bus: I2cBus) -> None:
        refuse_shared(bus, adxl345.ADDRESS)
        self._accel = Adxl345(bus, self._config.accel_rate_hz, self._config.accel_range_g)
        self._accel.configure()
        self._track.restart()
        self._is_flowing = False
