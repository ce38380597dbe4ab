"""The GY-85 board: three chips on one bus, merged into calibrated body-frame samples stamped at capture."""

from __future__ import annotations

from collections import Counter, deque
from contextlib import suppress

import numpy as np

from vislam.config import Gy85Config
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.affine import Affine
from vislam.hw.chips import (
    Adxl345,
    BusError,
    Hmc5883l,
    I2cBus,
    Itg3205,
    Magnetometer,
    SelfTest,
    SettingsLostError,
    adxl345,
    find_magnetometer,
    itg3205,
)
from vislam.hw.field_watch import FieldWatch
from vislam.hw.gyro_zero import GyroZero
from vislam.hw.health import Health
from vislam.hw.link import START_ATTEMPTS, Link, first_connection, refuse_shared
from vislam.hw.timing import Clock, HostClock, read_in_rounds
from vislam.hw.track import SampleTrack

_NS = 1_000_000_000
_MIN_RATE_HZ, _MAX_RATE_HZ = 1.0, 1000.0  # the gyro samples at 1 kHz inside
_G_M_S2 = 9.80665
_TEMPERATURE_TAU_S = 1.0  # its counts are noisy, its changes slow


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
        self._field = FieldWatch(Affine.of(c.mag_axes, c.mag_matrix, c.mag_bias_ut, 1.0), config.stuck_samples)
        self._counts: Counter[str] = Counter()
        self._bus: I2cBus | None = None
        self._gyro: Itg3205 | None = None
        self._accel: Adxl345 | None = None
        self._mag: Magnetometer | None = None
        self._gyro_link, self._accel_link, self._mag_link = Link(), Link(), Link()
        self._events = Health(0)
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
        self._next_mag_ns = 0
        self._retry_bus_ns = 0
        problem = first_connection(self._connect, self._clock, config.reopen_s, must_be_there)
        if must_be_there and problem is not None:
            self.close()
            raise problem
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
        return None if self._mag is None else self._mag.name

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Take the drift from a temperature on off; see `InertialSource`. TEMPERATURE_DRIFT tells when it is far."""
        self._zero = GyroZero(temperature_c, np.asarray(gyro_per_c))

    def run_self_tests(self) -> tuple[SelfTest, ...]:
        """Test accelerometer and magnetometer by their own means; about 2 s, standing still, no samples meanwhile."""
        tests = [self._self_tested(self._accel_link), self._self_tested(self._mag_link)]
        self.self_tests = tuple(test for test in tests if test is not None)
        with suppress(BusError):
            if self._accel is not None and self._accel_link.is_up:
                self._accel.read_fifo()  # what came in meanwhile
        self._track.restart()
        self._is_flowing = False
        now = self._clock.now_ns()
        self._next_ns = now
        for link in (self._accel_link, self._mag_link):
            link.newest_ns = now
        return self.self_tests

    def _self_tested(self, link: Link) -> SelfTest | None:
        if not link.is_up:
            return None
        for _ in range(START_ATTEMPTS):
            self._clock.sleep_until(link.retry_ns if not link.is_up else 0)
            self._connect(self._clock.now_ns())
            if not link.is_up:
                continue
            try:
                if link is self._accel_link and self._accel is not None:
                    link.self_test = self._accel.self_test(self._clock, self._config.supply_v)
                elif self._mag is not None:
                    link.self_test = self._mag.self_test(self._clock)
            except BusError as error:
                self._failed(link, error)
                link.drop(self._clock.now_ns())  # its stimulus may still be on: set it up again
            else:
                return link.self_test
        return None

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        return read_in_rounds(self._clock, timeout_s, lambda: self._next_ns, self._poll)

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        word, self._events = self._events, Health(0)
        now = self._clock.now_ns()
        if now - self._last_out_ns > self._config.silent_s * _NS:
            word |= Health.IMU_MISSING
        for link, bit in ((self._gyro_link, Health.GYRO_FAULT), (self._accel_link, Health.ACCEL_FAULT)):
            if not link.is_up or (link.self_test is not None and link.self_test.passed is False):
                word |= bit
        if self._config.mag:
            link = self._mag_link
            is_bad = not link.is_up or (link.self_test is not None and link.self_test.passed is False)
            word |= Health.MAG_FAULT if is_bad else Health(0)
        if self._bus is None:
            word |= Health.BUS_FAULT
        if self._zero.is_far(self._temperature_c, self._config.max_temperature_change_c):
            word |= Health.TEMPERATURE_DRIFT
        return word

    def counters(self) -> dict[str, int]:
        """Return how often each fault occurred since the start."""
        return dict(self._counts)

    def close(self) -> None:
        """Close the bus; may be called twice."""
        if self._bus is not None:
            self._bus.close()
        self._bus = None
        for link in (self._gyro_link, self._accel_link, self._mag_link):
            link.is_up = False

    # ---- one round --------------------------------------------------------------------------------------------

    def _poll(self) -> list[ImuSample | MagSample]:
        now = self._clock.now_ns()
        late = (now - self._next_ns) // self._period_ns
        self._next_ns += (late + 1) * self._period_ns
        if late > 0 and self._gyro_link.is_up:
            self._counts["rounds_missed"] += late
            self._events |= Health.IMU_GAP
        if not (self._gyro_link.is_up and self._accel_link.is_up and (self._mag_link.is_up or not self._config.mag)):
            self._connect(now)
        self._read_gyro()
        self._read_accel()
        samples: list[ImuSample | MagSample] = [*self._merge()]
        mag = self._read_mag(now) if self._config.mag and now >= self._next_mag_ns else None
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
            self._failed(self._gyro_link, error)
            return
        answered = self._clock.now_ns()
        link = self._gyro_link
        link.nacks = 0
        if asked < link.good_from_ns:
            return
        is_repeated = tuple(counts) == self._last_counts
        link.repeats = link.repeats + 1 if is_repeated else 0
        self._last_counts = (counts[0], counts[1], counts[2])
        if link.repeats >= self._config.stuck_samples:
            self._counts["gyro_stuck"] += 1
            link.drop(asked)
            return
        self._take_temperature(temperature)
        if max(map(abs, counts)) >= itg3205.LIMIT_LSB:
            self._counts["gyro_saturated"] += 1
            self._events |= Health.GYRO_SATURATED
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
            self._failed(link, error)
            return
        link.nacks = 0
        if was_full:
            self._counts["accel_overrun"] += 1
            self._events |= Health.IMU_GAP
            self._track.restart()
        if len(counts) == 0:
            if asked - link.newest_ns > self._config.silent_s * _NS:
                self._counts["accel_silent"] += 1
                link.drop(asked)
            return
        if (abs(counts) >= self._accel.limit_lsb).any():
            self._counts["accel_saturated"] += int((abs(counts) >= self._accel.limit_lsb).any(axis=1).sum())
            self._events |= Health.ACCEL_SATURATED
        answered = self._clock.now_ns()
        link.newest_ns = answered  # not `asked`: a host put aside in between must not blame the chip
        values = counts @ self._accel_map.matrix.T + self._accel_map.offset
        self._track.add(values, asked, answered)
        for row in counts:
            link.repeats = link.repeats + 1 if (row == self._last_accel).all() else 0
            self._last_accel = row
        if link.repeats >= self._config.stuck_samples:
            self._counts["accel_stuck"] += 1
            link.drop(asked)

    def _read_mag(self, now: int) -> MagSample | None:
        if self._mag is None or not self._mag_link.is_up:
            return None
        link = self._mag_link
        rate_hz = min(self._config.mag_rate_hz, self._mag.rate_hz)
        self._next_mag_ns = max(self._next_mag_ns + round(_NS / rate_hz), now)
        try:
            reading = self._mag.read()
        except (BusError, SettingsLostError) as error:
            self._failed(link, error)
            return None
        sample, fault = self._field.taken(reading, link, now, self._mag.rate_hz, self._counts)
        if fault == "mag_overflow":
            self._events |= Health.MAG_FAULT
        elif fault:
            link.drop(now)
        return sample

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
            self._counts["gyro_unpaired"] += 1
            self._events |= Health.IMU_GAP

    def _take_temperature(self, temperature_c: float) -> None:
        if self._temperature_c is None:
            self._temperature_c = temperature_c
        gain = min(1.0 / (_TEMPERATURE_TAU_S * self.rate_hz), 1.0)
        self._temperature_c += gain * (temperature_c - self._temperature_c)

    # ---- coming and going -------------------------------------------------------------------------------------

    def _failed(self, link: Link, error: BusError | SettingsLostError) -> None:
        """Take note of a failed read; the chip is given up after several, or at once if the wire is dead."""
        if link is self._gyro_link:
            self._events |= Health.IMU_GAP
        now = self._clock.now_ns()
        if isinstance(error, SettingsLostError):
            self._counts["settings_lost"] += 1
            link.drop(now)
            return
        self._events |= Health.BUS_FAULT
        link.nacks += 1
        if error.kind != "nack" or link.nacks >= self._config.nacks_to_reopen:
            link.drop(now)
        if error.kind == "gone":
            for other in (self._gyro_link, self._accel_link, self._mag_link):
                other.drop(now)

    def _connect(self, now: int) -> HardwareError | None:
        """Set up what is down and due; return what keeps gyro or accelerometer from coming up."""
        reopen_ns = round(self._config.reopen_s * _NS)
        if self._bus is None:
            if now < self._retry_bus_ns:
                return None
            self._retry_bus_ns = now + reopen_ns
            try:
                self._bus = I2cBus(self._config.bus, self._config.bus_timeout_s, self._counts)
            except BusError as error:
                return error
        problem: HardwareError | None = None
        starts = [(self._gyro_link, self._start_gyro), (self._accel_link, self._start_accel)]
        if self._config.mag:
            starts.append((self._mag_link, self._start_mag))
        for link, start in starts:
            if link.is_up or now < link.retry_ns:
                continue
            link.retry_ns = now + reopen_ns
            try:
                start(self._bus)
            except HardwareError as error:
                problem = problem if problem is not None or link is self._mag_link else error
                self._events |= Health.BUS_FAULT if isinstance(error, BusError) else Health(0)
                continue
            if link.came_up(self._clock.now_ns()):
                self._counts["reopened"] += 1
        if not any(link.is_up for link, _ in starts):
            self.close()  # an adapter that comes back has a new device file
        return problem

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

    def _start_mag(self, bus: I2cBus) -> None:
        found = find_magnetometer(bus, self._config.mag_range_ga)
        if found is None:
            raise HardwareError(f"{bus.path}: no magnetometer answers at 0x1e, 0x0d or 0x2c")
        if isinstance(found, Hmc5883l) and isinstance(self._mag, Hmc5883l):
            found.scale = self._mag.scale
        self._mag = found
        found.configure()
