"""The magnetometer of a board: found, set up, and polled at its rate."""

from collections.abc import Callable

from vislam.config import BoardConfig, Gy85Config
from vislam.core.errors import HardwareError
from vislam.hw.chips import BusError, Hmc5883l, I2cBus, Magnetometer, SelfTest, SettingsLostError
from vislam.hw.chips.field import FieldReading
from vislam.hw.health import Health
from vislam.hw.imu_source import Faults
from vislam.hw.link import ChipLinks, Link
from vislam.hw.timing import Clock

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
