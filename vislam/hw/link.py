"""How a board stands with one of its chips, and chips that the kernel has taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from vislam.core.errors import HardwareError
from vislam.hw.chips import I2cBus, SelfTest, kernel_driver, unbind_command
from vislam.hw.timing import Clock

START_ATTEMPTS = 3  # a wire may be disturbed just then


@dataclass(slots=True)
class Link:
    """How it stands with one chip."""

    retry_ns: int = 0
    good_from_ns: int = 0
    newest_ns: int = 0  # when it last gave something new
    nacks: int = 0
    repeats: int = 0  # equal samples in a row
    silent: int = 0  # reads in a row that found nothing new
    is_up: bool = False
    self_test: SelfTest | None = None

    def drop(self, now_ns: int) -> None:
        """Take the chip for lost; it is looked for in the next round, then at the board's own pace."""
        self.is_up = False
        self.retry_ns = max(self.retry_ns, now_ns)

    def came_up(self, now_ns: int) -> bool:
        """Take the chip for set up; return whether it was so before."""
        was_up = self.newest_ns != 0
        self.is_up, self.newest_ns = True, now_ns
        self.nacks = self.repeats = self.silent = 0
        return was_up


def first_connection(
    connect: Callable[[int], HardwareError | None], clock: Clock, reopen_s: float, must_be_there: bool
) -> HardwareError | None:
    """Return what keeps a board from coming up; where it must be there, a wire may be disturbed twice."""
    problem = connect(clock.now_ns())
    for _ in range(START_ATTEMPTS - 1):
        if problem is None or not must_be_there:
            break
        clock.sleep_until(clock.now_ns() + round(reopen_s * 1e9))
        problem = connect(clock.now_ns())
    return problem


def refuse_shared(bus: I2cBus, address: int) -> None:
    """Raise HardwareError, with the command that releases it, where a driver of the kernel owns the chip."""
    driver = kernel_driver(bus.path, address)
    if driver is not None:
        raise HardwareError(
            f"{bus.path}: the kernel's driver {driver} owns the chip at 0x{address:02x}; release it: "
            f"{unbind_command(bus.path, address, driver)}"
        )
