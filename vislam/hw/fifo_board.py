"""A board whose inertial chip has a FIFO: clock, stamps, faults and reconnection for every chip of `hw.chips.imus`."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from vislam.config import BoardConfig
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import Array, ImuSample, MagSample
from vislam.hw.board_magnetometer import BoardMagnetometer
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
from vislam.hw.chips.fifo_imu import G_M_S2, SAMPLES, fresh
from vislam.hw.chips.magnetometer import find_any_magnetometer
from vislam.hw.fifo_samples import FifoSamples
from vislam.hw.gyro_zero import GyroZero
from vislam.hw.health import Health
from vislam.hw.link import ChipLinks, Link, refuse_shared
from vislam.hw.timing import Clock, HostClock, read_in_rounds

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


class FifoBoard:
    """Satisfies `InertialSource`. The chip paces gyro and accelerometer; its FIFO has how many samples are new.

    Stamps are those of the chip's clock as the counts place it in the host's, less the delay of the gyro's filter; the
    accelerometer is interpolated to them. A host that comes late loses nothing until the FIFO is full. One thread
    only. Transfers are bounded by `config.bus_timeout_s`.
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
        self._config = config
        self._clock: Clock = HostClock() if clock is None else clock
        self._setup = ImuSetup(config.rate_hz, config.gyro_range_deg_s, config.accel_range_g, config.firmware, named)
        self.rate_hz = config.rate_hz
        self.self_tests: tuple[SelfTest, ...] = ()
        self._imu: FifoImu | None = None
        self._mag = BoardMagnetometer(config, self._clock, find_any_magnetometer, config.mag is True)
        self._imu_link = Link(self._start_imu, Health.GYRO_FAULT | Health.ACCEL_FAULT)
        self._links = ChipLinks(config, self._clock, (self._imu_link, self._mag.link))
        self._samples = FifoSamples(config)
        self._must_empty = False
        self._last_out_ns = self._next_ns = self._clock.now_ns()
        self._next_watch_ns = 0
        self._links.begin(must_be_there)
        self._next_ns = self._clock.now_ns()

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the chip, smoothed over a second; None before it was read."""
        return self._samples.temperature_c

    @property
    def imu(self) -> FifoImu | None:
        """The inertial chip; None before one was found."""
        return self._imu

    @property
    def magnetometer_name(self) -> str | None:
        """Which magnetometer was found; None if there is none."""
        return self._mag.name

    @property
    def stamp_bound_ms(self) -> float | None:
        """By how much stamps can be off, beside the filters' delays; see `FifoStamps`."""
        return self._samples.stamps.bound_ms

    def zeroed_at(self, temperature_c: float, gyro_per_c: Array) -> None:
        """Take the drift from a temperature on off; see `InertialSource`. TEMPERATURE_DRIFT is set when it is far."""
        self._samples.zero = GyroZero(temperature_c, np.asarray(gyro_per_c))

    def run_self_tests(self) -> tuple[SelfTest, ...]:
        """Run the self-test of a chip whose driver has one, if it was not run; 0.6 s at rest, no samples meanwhile."""
        link = self._imu_link
        if isinstance(self._imu, mpu6050.Mpu6050) and link.is_up and link.self_test is None:
            try:
                link.self_test = self._imu.self_test(self._clock)
                self.self_tests += (link.self_test,)
            except BusError as error:
                self._links.failed(link, error)
                link.drop(self._clock.now_ns())  # its stimulus may still be on: set it up again
            self._must_empty, self._last_out_ns = True, self._clock.now_ns()
        return self.self_tests

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        return read_in_rounds(self._clock, timeout_s, lambda: self._next_ns, self._poll)

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        word = self._links.health()
        if self._clock.now_ns() - self._last_out_ns > self._config.silent_s * _NS:
            word |= Health.IMU_MISSING
        if self._samples.is_far:
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
        if self._imu_link.is_up:
            self._imu_link.newest_ns += max(now - self._next_ns, 0)  # between calls the chip was not silent
        if not self._links.are_up:
            self._links.connect(now)
        samples: list[ImuSample | MagSample] = []
        if self._imu is not None and self._imu_link.is_up:
            try:
                samples += self._inertial(self._imu)
                self._look(self._imu, now)
            except (BusError, SettingsLostError) as error:
                if self._must_empty or isinstance(error, SettingsLostError):
                    self._links.events |= Health.IMU_GAP
                self._links.failed(self._imu_link, error)
        mag = self._mag.read(self._links, now)
        if mag is not None:
            samples.append(mag)
            samples.sort(key=lambda sample: sample.t_ns)
        period_ns = round(_NS / (_ASKED_PER_SAMPLE * self.rate_hz))
        late = max(self._clock.now_ns() - self._next_ns, 0) // period_ns
        self._next_ns += (late + 1) * period_ns
        if not self._imu_link.is_up:
            self._next_ns = max(self._next_ns, self._links.retry_ns(self._imu_link))
        return samples

    def _inertial(self, imu: FifoImu) -> list[ImuSample]:
        if self._must_empty:
            imu.empty()
            self._samples.restart()
            self._must_empty = False
        link = self._imu_link
        asked = self._clock.now_ns()
        waiting = imu.waiting()
        answered = self._clock.now_ns()
        link.nacks = 0
        if waiting.is_overrun:
            self._links.counts["fifo_overrun"] += 1
            self._links.events |= Health.IMU_GAP
            self._samples.restart()
            link.newest_ns = answered  # it lives
        self._must_empty = True  # until all are fetched: a transfer that breaks off leaves parts of samples
        raw = imu.take(waiting.units) if waiting.units else None
        self._must_empty = False
        if raw is None or len(raw) == 0:
            if asked - link.newest_ns > self._config.silent_s * _NS:
                self._links.hung(link, "imu_silent", asked)
            return []
        link.newest_ns = self._clock.now_ns()  # not `asked`: a host put aside in between must not blame the chip
        made = self._samples.made(raw, asked, answered, self._links.counts)
        self._links.events |= made.events
        if made.is_stuck:
            link.drop(asked)
        if made.samples:
            self._last_out_ns = self._clock.now_ns()
        return made.samples

    def _look(self, imu: FifoImu, now: int) -> None:
        """Take the temperature and see that the settings are still there."""
        if now < self._next_watch_ns:
            return
        self._next_watch_ns = now + round(_WATCH_S * _NS)
        self._samples.take_temperature(imu.temperature_c())

    # ---- coming and going -------------------------------------------------------------------------------------

    def _set_up(self, bus: I2cBus) -> FifoImu:
        imu = find_imu(bus, self._setup, self._config.chip, self._config.address)
        refuse_shared(bus, imu.address)
        imu.configure(self._clock)
        return imu

    def _start_imu(self, bus: I2cBus) -> None:
        imu = self._set_up(bus)
        if imu.doubt and not self.self_tests:
            force = force_at_rest(imu, self._clock)
            is_asked = self._setup.named in (lsm6dsox.TWIN, mpu6050.CLONE)
            if force is not None and not is_asked and scale_test(imu, 2.0 * force).passed:
                self._setup, force = replace(self._setup, named=lsm6dsox.TWIN), 2.0 * force
                imu = self._set_up(bus)
            test = scale_test(imu, force)
            if test.passed is False and is_asked:
                raise HardwareError(f"{bus.path}: the {imu.name} does not fit: {test.what}; use another board")
            if isinstance(imu, mpu6050.Mpu6050):
                self._imu_link.self_test = imu.self_test(self._clock)
            self.self_tests = (test,) if self._imu_link.self_test is None else (test, self._imu_link.self_test)
            imu.empty()
        self._samples.begin(imu, self._clock.now_ns() + round(imu.start_up_s * _NS))
        self._imu, self.rate_hz, self._must_empty = imu, imu.rate_hz, False
        if self._config.mag is None and not self._mag.link.is_wanted:
            with suppress(BusError):  # one that is on the board answers now: what is inside the chip is on the bus
                self._mag.link.is_wanted = find_any_magnetometer(bus, self._config.mag_range_ga) is not None
