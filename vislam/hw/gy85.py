"""The GY-85 board: three chips on one bus, merged into calibrated body-frame samples stamped at capture."""

from contextlib import suppress

import numpy as np

from vislam.config import Gy85Config
from vislam.core.errors import UsageError
from vislam.core.messages import ImuSample
from vislam.hw.accel_at_gyro import AccelAtGyro
from vislam.hw.chip_board import ChipBoard
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
from vislam.hw.health import Health
from vislam.hw.link import Link, refuse_shared
from vislam.hw.timing import Clock, SampleClock

_NS = 1_000_000_000
_MIN_RATE_HZ, _MAX_RATE_HZ = 1.0, 1000.0  # the gyro samples at 1 kHz inside
_G_M_S2 = 9.80665
_TEMPERATURE_TAU_S = 1.0  # its counts are noisy, its changes slow
_KEPT = 128  # samples of one chip that wait for the other


class Gy85(ChipBoard):
    """An `InertialSource`. The gyro is the master of time; accelerometer samples are interpolated to its stamps.

    Stamps are those of the middle of what the gyro's filter lets through, some milliseconds before the transfer, by
    when newer accelerometer samples are there: a sample is given out in the call that captured it. A magnetometer
    sample may be stamped up to 15 ms before inertial ones that were given out earlier. See `ChipBoard`.
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
        self._gyro_link = Link(self._start_gyro, Health.GYRO_FAULT, lambda: None)
        self._accel_link = Link(self._start_accel, Health.ACCEL_FAULT, self._test_accel)
        super().__init__(config, clock, (self._gyro_link, self._accel_link), find_magnetometer)
        self._config = config
        self._period_ns = round(_NS / config.rate_hz)
        self._scaled(float(np.deg2rad(1.0 / itg3205.LSB_PER_DEG_S)), _G_M_S2 / adxl345.LSB_PER_G)
        self._gyro.limit = itg3205.LIMIT_LSB
        self._itg3205: Itg3205 | None = None
        self._adxl345: Adxl345 | None = None
        self._stamps = SampleClock(config.accel_rate_hz)
        self._pairs = AccelAtGyro(_KEPT)
        self._good_from_ns = self._last_gyro_ns = 0
        self._links.begin(must_be_there)
        if config.self_test and self._gyro_link.is_up and self._accel_link.is_up:
            self.run_self_tests()
        self._next_ns = self._clock.now_ns()

    # ---- one round --------------------------------------------------------------------------------------------

    def _round(self, now: int) -> list[ImuSample]:
        late = (now - self._next_ns) // self._period_ns
        self._next_ns += (late + 1) * self._period_ns
        if late > 0 and self._gyro_link.is_up:
            self._faults.add("rounds_missed", Health.IMU_GAP, late)
        if not self._links.are_up:
            self._links.connect(now)
        self._read_gyro()
        self._read_accel()
        before = self._pairs.unpaired
        samples = [self._inertial(*merged) for merged in self._pairs.merged()]
        if self._pairs.unpaired > before:
            self._faults.add("gyro_unpaired", Health.IMU_GAP, self._pairs.unpaired - before)
        return samples

    def _read_gyro(self) -> None:
        if self._itg3205 is None or not self._gyro_link.is_up:
            return
        asked = self._clock.now_ns()
        try:
            temperature_c, *counts = self._itg3205.read()
        except (BusError, SettingsLostError) as error:
            self._faults.events |= Health.IMU_GAP
            self._links.failed(self._gyro_link, error)
            return
        answered = self._clock.now_ns()
        self._gyro_link.nacks = 0
        if asked < self._good_from_ns:
            return
        is_sound = self._gyro.sound([counts])[0]
        self._drop_hung(self._gyro, self._gyro_link, asked)
        if not is_sound:
            return
        self._warmed(temperature_c, 1.0 / (_TEMPERATURE_TAU_S * self.rate_hz))
        # a process that was put aside within the call must not move the stamp by more than the call usually takes
        delay_s = self._itg3205.delay_s if self._config.gyro_delay_s is None else self._config.gyro_delay_s
        t_ns = asked + min(answered - asked, self._period_ns) // 2 - round(delay_s * _NS)
        if t_ns > self._last_gyro_ns:
            self._last_gyro_ns = t_ns
            self._pairs.add_gyro(t_ns, counts)

    def _read_accel(self) -> None:
        if self._adxl345 is None or not self._accel_link.is_up:
            return
        link = self._accel_link
        asked = self._clock.now_ns()
        try:
            counts, was_full = self._adxl345.read_fifo()
        except BusError as error:
            self._links.failed(link, error)
            return
        link.nacks = 0
        if was_full:
            self._faults.add("accel_overrun", Health.IMU_GAP)
            self._forget()
        if len(counts) == 0:
            if asked - link.newest_ns > self._silent_ns:
                self._faults.add("accel_silent")
                self._links.hung(link, link.fault, asked)
            return
        answered = self._clock.now_ns()
        link.newest_ns = answered  # not `asked`: a host put aside in between must not blame the chip
        rows = counts.tolist()
        stamps = self._stamps.stamps(len(rows), asked, answered)
        for t_ns, row, is_sound in zip(stamps, rows, self._accel.sound(rows), strict=True):
            if is_sound:
                self._pairs.add_accel(t_ns, row)
            else:
                self._pairs.clear()
        self._drop_hung(self._accel, link, asked)

    # ---- coming and going -------------------------------------------------------------------------------------

    def _start_gyro(self, bus: I2cBus) -> None:
        refuse_shared(bus, itg3205.ADDRESS)
        self._itg3205 = Itg3205(bus, self._config.gyro_bandwidth_hz)
        self._itg3205.configure(self._clock)
        self._good_from_ns = self._clock.now_ns() + round(itg3205.START_UP_S * _NS)

    def _start_accel(self, bus: I2cBus) -> None:
        refuse_shared(bus, adxl345.ADDRESS)
        self._adxl345 = Adxl345(bus, self._config.accel_rate_hz, self._config.accel_range_g)
        self._adxl345.configure()
        self._accel.limit = self._adxl345.limit_lsb
        self._forget()

    def _test_accel(self) -> SelfTest | None:
        return None if self._adxl345 is None else self._adxl345.self_test(self._clock, self._config.supply_v)

    def _resume(self) -> None:
        with suppress(BusError):
            if self._adxl345 is not None and self._accel_link.is_up:
                self._adxl345.read_fifo()  # what came in meanwhile
        self._forget()

    def _forget(self) -> None:
        self._stamps.restart()
        self._pairs.clear()
