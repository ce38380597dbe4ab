"""A board whose inertial chip has a FIFO: clock, stamps, faults and reconnection for every chip of `hw.chips.imus`."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from vislam.config import BoardConfig
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import ImuSample
from vislam.hw.accel_at_gyro import AccelBefore
from vislam.hw.chip_board import ChipBoard
from vislam.hw.chips import (
    BusError,
    FifoImu,
    I2cBus,
    ImuSetup,
    SelfTest,
    SettingsLostError,
    find_imu,
    lsm6dsox,
    mpu6050,
)
from vislam.hw.chips.fifo_imu import G_M_S2, SAMPLES, SATURATED_LSB, RawSamples, fresh
from vislam.hw.chips.known import find_any_magnetometer
from vislam.hw.health import Health
from vislam.hw.link import Link, refuse_shared
from vislam.hw.timing import Clock, SampleClock

_NS = 1_000_000_000
_WATCH_S = 0.5  # between looks at temperature and settings
_ASKED_PER_SAMPLE = 1.07  # no whole number: questions then sweep over the samples' phase, which narrows their times
TOLERANCE_M_S2 = 1.0  # zero of an MPU-6050 out of the box: 0.8 m/s^2; a wrong range is off by half
_MAX_STD_M_S2 = 0.3  # it moved


def force_at_rest(imu: FifoImu, clock: Clock) -> float | None:
    """Return what a chip measures of gravity (m/s^2); None where it moves or its samples do not come; see `fresh`."""
    forces = fresh(imu, clock).accel * imu.accel_m_s2
    if len(forces) < SAMPLES or forces.std(axis=0).max() > _MAX_STD_M_S2:
        return None
    return float(np.linalg.norm(forces.mean(axis=0)))


def scale_test(imu: FifoImu, force_m_s2: float | None) -> SelfTest:
    """Return whether a force at rest is gravity."""
    if force_m_s2 is None:
        what = f"{imu.doubt}; its scale is not known to fit: start it at rest"
        return SelfTest(imu.name, None, what, next_step="stand still and try again")
    passed = abs(force_m_s2 - G_M_S2) <= TOLERANCE_M_S2
    what = f"gravity is {force_m_s2:.2f} m/s^2 by its scale, {G_M_S2:.2f} within {TOLERANCE_M_S2:g} expected"
    return SelfTest(imu.name, passed, f"{imu.doubt}; {what}", (force_m_s2,))


class FifoBoard(ChipBoard):
    """An `InertialSource`. The chip paces gyro and accelerometer; its FIFO has how many samples are new.

    Stamps are those of the chip's clock as the counts place it in the host's, less the delay of the gyro's filter; the
    accelerometer is interpolated to them. A host that comes late loses nothing until the FIFO is full. See `ChipBoard`.

    Attributes:
        imu: the inertial chip; None before one was found.
    """

    stamped_by = "the chip's clock, from the counts of its FIFO"

    def __init__(
        self, config: BoardConfig, clock: Clock | None = None, must_be_there: bool = True, named: str = ""
    ) -> None:
        """Open the bus, find the chip and set it up.

        With `must_be_there` False a missing board is not an error: it is looked for as after unplugging. `named` is the
        chip's name on the command line, by which clones and chips of one id are known. Where the id does not settle the
        scale, gravity and a clone's self-test do, if the chip is at rest when it is first set up.

        Raises:
            UsageError: a rate that no such board has.
            HardwareError: bus or chip is missing or is another chip, or a clone of another scale; no smbus2.
        """
        if not config.rate_hz <= 1000.0:
            raise UsageError(f"board.rate_hz must be at most 1000, got {config.rate_hz:g}")
        self._imu_link = Link(self._start_imu, Health.GYRO_FAULT | Health.ACCEL_FAULT, self._test_imu)
        super().__init__(config, clock, (self._imu_link,), find_any_magnetometer)
        self._config = config
        self._setup = ImuSetup(config.rate_hz, config.gyro_range_deg_s, config.accel_range_g, config.firmware, named)
        self._gyro.limit = self._accel.limit = SATURATED_LSB
        self.imu: FifoImu | None = None
        self._scale_test: SelfTest | None = None
        self._stamps, self._at_gyro = SampleClock(config.rate_hz), AccelBefore()
        self._good_from_ns = self._next_watch_ns = 0
        self._must_empty = False
        self._links.begin(must_be_there)
        self._next_ns = self._clock.now_ns()

    @property
    def stamp_bound_ms(self) -> float | None:
        """By how much stamps can be off, beside the filters' delays; see `SampleClock`."""
        return self._stamps.bound_ms

    def run_self_tests(self) -> tuple[SelfTest, ...]:
        """Run the self-tests of chips whose driver has one; 0.6 s at rest, no samples meanwhile."""
        tests = super().run_self_tests()
        self.self_tests = tests if self._scale_test is None else (self._scale_test, *tests)
        return self.self_tests

    # ---- one round --------------------------------------------------------------------------------------------

    def _round(self, now: int) -> list[ImuSample]:
        if self._imu_link.is_up:
            self._imu_link.newest_ns += max(now - self._next_ns, 0)  # between calls the chip was not silent
        if not self._links.are_up:
            self._links.connect(now)
        samples: list[ImuSample] = []
        if self.imu is not None and self._imu_link.is_up:
            try:
                samples = self._fetched(self.imu)
                self._look(self.imu, now)
            except (BusError, SettingsLostError) as error:
                if self._must_empty or isinstance(error, SettingsLostError):
                    self._faults.events |= Health.IMU_GAP
                self._links.failed(self._imu_link, error)
        period_ns = round(_NS / (_ASKED_PER_SAMPLE * self.rate_hz))
        late = max(self._clock.now_ns() - self._next_ns, 0) // period_ns
        self._next_ns += (late + 1) * period_ns
        if not self._imu_link.is_up:
            self._next_ns = max(self._next_ns, self._links.retry_ns(self._imu_link))
        return samples

    def _fetched(self, imu: FifoImu) -> list[ImuSample]:
        if self._must_empty:
            imu.empty()
            self._restart()
            self._must_empty = False
        link = self._imu_link
        asked = self._clock.now_ns()
        waiting = imu.waiting()
        answered = self._clock.now_ns()
        link.nacks = 0
        if waiting.is_overrun:
            self._faults.add("fifo_overrun", Health.IMU_GAP)
            self._restart()
            link.newest_ns = answered  # it lives
        self._must_empty = True  # until all are fetched: a transfer that breaks off leaves parts of samples
        raw = imu.take(waiting.units) if waiting.units else None
        self._must_empty = False
        if raw is None or len(raw) == 0:
            if asked - link.newest_ns > self._silent_ns:
                self._faults.add("imu_silent")
                self._links.hung(link, link.fault, asked)
            return []
        link.newest_ns = self._clock.now_ns()  # not `asked`: a host put aside in between must not blame the chip
        samples = self._made(imu, raw, asked, answered)
        for watch in (self._gyro, self._accel):
            self._drop_hung(watch, link, asked)
        return samples

    def _made(self, imu: FifoImu, raw: RawSamples, asked: int, answered: int) -> list[ImuSample]:
        """Return samples of the body frame, at the times of what the gyro's filter lets through.

        `asked` and `answered` are around the question how many there are.
        """
        sound = zip(self._gyro.sound(raw.gyro.tolist()), self._accel.sound(raw.accel.tolist()), strict=True)
        delay_ns = round((imu.gyro_delay_s if self._config.delay_s is None else self._config.delay_s) * _NS)
        accel = self._at_gyro.moved(raw.accel, (imu.gyro_delay_s - imu.accel_delay_s) * imu.rate_hz)
        stamps = self._stamps.stamps(len(raw), asked, answered)
        return [
            self._inertial(t_ns - delay_ns, rate, force)
            for t_ns, rate, force, is_sound in zip(stamps, raw.gyro, accel, sound, strict=True)
            if t_ns >= self._good_from_ns and all(is_sound)
        ]

    def _look(self, imu: FifoImu, now: int) -> None:
        """Take the temperature and see that the settings are still there."""
        if now >= self._next_watch_ns:
            self._next_watch_ns = now + round(_WATCH_S * _NS)
            self._warmed(imu.temperature_c(), 0.5)

    def _restart(self) -> None:
        """Samples were lost: the next ones are stamped without those before."""
        self._stamps.restart()
        self._at_gyro.forget()

    # ---- coming and going -------------------------------------------------------------------------------------

    def _set_up(self, bus: I2cBus) -> FifoImu:
        imu = find_imu(bus, self._setup, self._config.chip, self._config.address)
        refuse_shared(bus, imu.address)
        imu.configure(self._clock)
        return imu

    def _start_imu(self, bus: I2cBus) -> None:
        imu = self._set_up(bus)
        if imu.doubt and self._scale_test is None:
            force = force_at_rest(imu, self._clock)
            is_asked = self._setup.named in (lsm6dsox.TWIN, mpu6050.CLONE)
            if force is not None and not is_asked and scale_test(imu, 2.0 * force).passed:
                self._setup, force = replace(self._setup, named=lsm6dsox.TWIN), 2.0 * force
                imu = self._set_up(bus)
            test = scale_test(imu, force)
            if test.passed is False and is_asked:
                raise HardwareError(f"{bus.path}: the {imu.name} does not fit: {test.what}; use another board")
            self.imu = imu
            self._imu_link.self_test = own = self._test_imu()
            self._scale_test, self.self_tests = test, (test,) if own is None else (test, own)
            imu.empty()
        self._good_from_ns = self._clock.now_ns() + round(imu.start_up_s * _NS)
        self._scaled(imu.gyro_rad_s, imu.accel_m_s2)
        self._stamps, self._at_gyro = SampleClock(imu.rate_hz), AccelBefore()
        self.imu, self.rate_hz, self._must_empty = imu, imu.rate_hz, False
        if self._config.mag is None and not self._mag.link.is_wanted:
            with suppress(BusError):  # one that is on the board answers now: what is inside the chip is on the bus
                self._mag.link.is_wanted = find_any_magnetometer(bus, self._config.mag_range_ga) is not None

    def _test_imu(self) -> SelfTest | None:
        return self.imu.self_test(self._clock) if isinstance(self.imu, mpu6050.Mpu6050) else None

    def _resume(self) -> None:
        self._must_empty = True
