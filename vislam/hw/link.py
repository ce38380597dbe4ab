"""How a board stands with its bus and its chips: which are up, what failed, what is set up again and when."""

from collections.abc import Callable
from dataclasses import dataclass

from vislam.config import BoardConfig, Gy85Config
from vislam.core.errors import HardwareError
from vislam.hw.chips import BusError, I2cBus, SelfTest, SettingsLostError, kernel_driver, unbind_command
from vislam.hw.health import Health
from vislam.hw.imu_source import Faults
from vislam.hw.timing import Clock

_NACKS_TO_REOPEN = 5  # in a row until a chip counts as gone: single ones are noise on the wire
BUS_TIMEOUT_S = 0.02  # of one transfer, in steps of 10 ms; the longest one takes 5 ms at 400 kHz
START_ATTEMPTS = 3  # a wire may be disturbed just then


@dataclass(slots=True, eq=False)
class Link:
    """How it stands with one chip: `start` finds it and sets it up, `fault` is its bit in the health word.

    `test` runs its self-test, and raises BusError where that broke off; it returns None where the chip has none.
    """

    start: Callable[[I2cBus], None]
    fault: Health
    test: Callable[[], SelfTest | None]
    is_inertial: bool = True  # the board is nothing without it
    is_wanted: bool = True
    retry_ns: int = 0
    newest_ns: int = 0  # when it last gave something new
    nacks: int = 0
    silent: int = 0  # reads in a row that found nothing new
    is_up: bool = False
    self_test: SelfTest | None = None

    @property
    def is_bad(self) -> bool:
        """Whether the chip is down or failed its self-test."""
        return not self.is_up or (self.self_test is not None and self.self_test.passed is False)

    def drop(self, now_ns: int) -> None:
        """Take the chip for lost; it is looked for in the next round, then at the board's own pace."""
        self.is_up = False
        self.retry_ns = max(self.retry_ns, now_ns)

    def came_up(self, now_ns: int) -> bool:
        """Take the chip for set up; return whether it was so before."""
        was_up = self.newest_ns != 0
        self.is_up, self.newest_ns = True, now_ns
        self.nacks = self.silent = 0
        return was_up


class ChipLinks:
    """Owns a board's bus: opens it and sets its chips up, again and again where they go away, and tests them."""

    def __init__(self, config: Gy85Config | BoardConfig, clock: Clock, faults: Faults, links: tuple[Link, ...]) -> None:
        """Take the board's settings and its chips, in the order in which they are set up; nothing is opened yet."""
        self._config, self._clock, self._faults, self._links = config, clock, faults, links
        self._bus: I2cBus | None = None
        self._retry_bus_ns = 0

    @property
    def are_up(self) -> bool:
        """Whether no chip has to be set up."""
        return all(link.is_up for link in self._links if link.is_wanted)

    def health(self) -> Health:
        """Return the bits of bus and chips that hold now."""
        word = Health(0)
        for link in self._links:
            if link.is_wanted and link.is_bad:
                word |= link.fault
        return word if self._bus is not None else word | Health.BUS_FAULT

    def close(self) -> None:
        """Close the bus; may be called twice."""
        if self._bus is not None:
            self._bus.close()
        self._bus = None
        for link in self._links:
            link.is_up = False

    def retry_ns(self, link: Link) -> int:
        """Return when a chip that is down is looked for again."""
        return link.retry_ns if self._bus is not None else max(link.retry_ns, self._retry_bus_ns)

    def begin(self, must_be_there: bool) -> None:
        """Connect for the first time.

        Raises HardwareError: what keeps an inertial chip from coming up, where it must be there; a wire may be
        disturbed twice.
        """
        problem = self.connect(self._clock.now_ns())
        for _ in range(START_ATTEMPTS - 1):
            if problem is None or not must_be_there:
                return
            self._clock.sleep_until(self._clock.now_ns() + round(self._config.reopen_s * 1e9))
            problem = self.connect(self._clock.now_ns())
        if problem is not None and must_be_there:
            self.close()
            raise problem

    def connect(self, now: int) -> HardwareError | None:
        """Set up what is down and due; return what keeps an inertial chip from coming up."""
        reopen_ns = round(self._config.reopen_s * 1e9)
        if self._bus is None:
            if now < self._retry_bus_ns:
                return None
            self._retry_bus_ns = now + reopen_ns
            try:
                self._bus = I2cBus(self._config.bus, BUS_TIMEOUT_S, self._faults.counts)
            except BusError as error:
                return error
        problem: HardwareError | None = None
        for link in self._links:
            if link.is_up or now < link.retry_ns or not link.is_wanted:
                continue
            link.retry_ns = now + reopen_ns
            try:
                link.start(self._bus)
            except HardwareError as error:
                problem = error if problem is None and link.is_inertial else problem
                self._faults.events |= Health.BUS_FAULT if isinstance(error, BusError) else Health(0)
                continue
            if link.came_up(self._clock.now_ns()):
                self._faults.add("reopened")
        if not any(link.is_up for link in self._links):
            self.close()  # an adapter that comes back has a new device file
        return problem

    def tested(self) -> tuple[SelfTest, ...]:
        """Run the self-tests of the chips that are up; one that breaks off is set up again, and tried again."""
        found = []
        for link in [link for link in self._links if link.is_up]:
            for _ in range(START_ATTEMPTS):
                self._clock.sleep_until(link.retry_ns if not link.is_up else 0)
                self.connect(self._clock.now_ns())
                if not link.is_up:
                    continue
                try:
                    link.self_test = link.test()
                except BusError as error:
                    self.failed(link, error)
                    link.drop(self._clock.now_ns())  # its stimulus may still be on
                else:
                    found += [] if link.self_test is None else [link.self_test]
                    break
        for link in self._links:
            link.newest_ns = self._clock.now_ns()  # no sample was asked of them meanwhile
        return tuple(found)

    def hung(self, link: Link, fault: Health, now_ns: int) -> None:
        """Take note of a chip that answers and gives nothing new; it is set up again, which may be too soon to see."""
        self._faults.events |= fault
        link.drop(now_ns)

    def failed(self, link: Link, error: BusError | SettingsLostError) -> None:
        """Take note of a failed transfer; the chip is given up after several, or at once if the wire is dead."""
        now = self._clock.now_ns()
        if isinstance(error, SettingsLostError):
            self._faults.add("settings_lost")
            link.drop(now)
            return
        self._faults.events |= Health.BUS_FAULT
        link.nacks += 1
        if error.kind != "nack" or link.nacks >= _NACKS_TO_REOPEN:
            link.drop(now)
        if error.kind == "gone":
            for other in self._links:
                other.drop(now)


def refuse_shared(bus: I2cBus, address: int) -> None:
    """Raise HardwareError, with the command that releases it, where a driver of the kernel owns the chip."""
    driver = kernel_driver(bus.path, address)
    if driver is not None:
        raise HardwareError(
            f"{bus.path}: the kernel's driver {driver} owns the chip at 0x{address:02x}; release it: "
            f"{unbind_command(bus.path, address, driver)}"
        )
