"""What boards on an I2C bus share: rounds of questions, the magnetometer beside the inertial chips, self-tests."""

from collections.abc import Callable

from vislam.config import BoardConfig, Gy85Config
from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample, MagSample
from vislam.hw.chips import BusError, Hmc5883l, I2cBus, Magnetometer, SelfTest, SettingsLostError
from vislam.hw.chips.field import FieldReading
from vislam.hw.health import Health
from vislam.hw.imu_source import Faults, InertialSource, Watch
from vislam.hw.link import ChipLinks, Link
from vislam.hw.timing import Clock, read_in_rounds

_NS = 1_000_000_000
_SILENT_READS = 20  # in a row without anything new, of a chip that measures faster than it is asked


class BoardMagnetometer:
    """Owns the chip, its link, and when it is asked again.

    Attributes:
        chip: None before one was found.
        link: how it stands with it.
    """

    def __init__(
        self,
        config: Gy85Config | BoardConfig,
        clock: Clock,
        faults: Faults,
        find: Callable[[I2cBus, float], Magnetometer | None],
        is_wanted: bool,
    ) -> None:
        """Take the board's settings, clock and faults, and how such chips are found on a bus for a range in gauss."""
        self._config, self._clock, self._faults, self._find = config, clock, faults, find
        self._next_ns = 0
        self.chip: Magnetometer | None = None
        self.link = Link(self.start, Health.MAG_FAULT, self._test, is_inertial=False, is_wanted=is_wanted)

    @property
    def name(self) -> str | None:
        """Which chip was found; None if there is none."""
        return None if self.chip is None else self.chip.name

    def start(self, bus: I2cBus) -> None:
        """Find the chip and set it up, with the scale that its last self-test gave; raises HardwareError."""
        found = self._find(bus, self._config.mag_range_ga)
        if found is None:
            raise HardwareError(f"{bus.path}: no magnetometer answers")
        if isinstance(found, Hmc5883l) and isinstance(self.chip, Hmc5883l):
            found.scale = self.chip.scale
        self.chip = found
        found.configure(self._clock)

    def read(self, links: ChipLinks, now: int) -> tuple[int, FieldReading] | None:
        """Return a measurement and its time if one is due and new; faults go to the board's and to the link.

        One during whose transfer the host was put aside for longer than a measurement takes has no time: it is dropped.
        """
        if self.chip is None or not self.link.is_up or now < self._next_ns:
            return None
        rate_hz = min(self._config.mag_rate_hz, self.chip.rate_hz)
        self._next_ns = max(self._next_ns + round(_NS / rate_hz), now)
        asked = self._clock.now_ns()  # not `now`: the inertial chips were read since
        try:
            reading = self.chip.read()
        except (BusError, SettingsLostError) as error:
            links.failed(self.link, error)
            return None
        answered, period_ns = self._clock.now_ns(), _NS / self.chip.rate_hz
        self.link.nacks = 0
        if reading is None:
            self.link.silent += 1
            if self.link.silent >= _SILENT_READS:
                self._faults.add("mag_silent")
                links.hung(self.link, self.link.fault, now)
            return None
        self.link.silent = 0
        # the measurement ended up to a period ago, and took most of one
        return ((asked + answered) // 2 - round(0.5 * period_ns), reading) if answered - asked < period_ns else None

    def _test(self) -> SelfTest | None:
        return None if self.chip is None else self.chip.self_test(self._clock)


class ChipBoard(InertialSource):
    """An `InertialSource` for a board that fills `_round`. One thread only.

    Transfers are bounded, which is what a call may take longer than asked.

    Attributes:
        self_tests: what those that were run found.
    """

    def __init__(
        self,
        config: Gy85Config | BoardConfig,
        clock: Clock | None,
        inertial: tuple[Link, ...],
        find: Callable[[I2cBus, float], Magnetometer | None],
    ) -> None:
        """Take settings, clock and chips; nothing is opened yet. `find` is how a magnetometer is found on a bus."""
        super().__init__(config.calibration, config.silent_s, config.max_temperature_change_c, clock)
        self.rate_hz = config.rate_hz
        self.self_tests: tuple[SelfTest, ...] = ()
        self._mag = BoardMagnetometer(config, self._clock, self._faults, find, config.mag is True)
        self._links = ChipLinks(config, self._clock, self._faults, (*inertial, self._mag.link))
        self._next_ns = self._last_out_ns  # when the next round is due

    @property
    def magnetometer_name(self) -> str | None:
        """Which magnetometer was found; None if there is none."""
        return self._mag.name

    def run_self_tests(self) -> tuple[SelfTest, ...]:
        """Test the chips by their own means; about 2 s, standing still, no samples meanwhile."""
        self.self_tests = self._links.tested()
        self._resume()
        self._next_ns = self._last_out_ns = self._clock.now_ns()
        return self.self_tests

    def read(self, timeout_s: float) -> list[ImuSample | MagSample]:
        """Return what was captured, see `InertialSource`; waits for the next sample, `timeout_s` at most."""
        return read_in_rounds(self._clock, timeout_s, lambda: self._next_ns, self._poll)

    def health(self) -> Health:
        """Return the sensor bits that hold now and the events since the last call."""
        return super().health() | self._links.health()

    def close(self) -> None:
        """Close the bus; may be called twice."""
        self._links.close()

    def _poll(self) -> list[ImuSample | MagSample]:
        now = self._clock.now_ns()
        inertial = self._round(now)
        if inertial:
            self._last_out_ns = self._clock.now_ns()
        samples: list[ImuSample | MagSample] = [*inertial]
        found = self._mag.read(self._links, now)
        if found is not None:
            samples += self._magnetic(found[0], found[1].field_ut.tolist(), found[1].overflow)
            self._drop_hung(self._field, self._mag.link, now)
            samples.sort(key=lambda sample: sample.t_ns)
        return samples

    def _round(self, now: int) -> list[ImuSample]:
        """Ask the inertial chips once, and set `_next_ns`; what a wire can do raises nothing."""
        raise NotImplementedError

    def _resume(self) -> None:
        """Forget what came of the inertial chips before and during self-tests."""
        raise NotImplementedError

    def _drop_hung(self, watch: Watch, link: Link, now: int) -> None:
        """Have a chip set up again that gives one value for ever."""
        if watch.is_stuck:
            watch.begin()
            self._links.hung(link, watch.fault, now)
