"""How a board stands with one of its chips, and chips that the kernel has taken."""

from __future__ import annotations

from dataclasses import dataclass

from vislam.core.errors import HardwareError
from vislam.hw.chips import I2cBus, SelfTest, kernel_driver, unbind_command


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


def refuse_shared(bus: I2cBus, address: int) -> None:
    """Raise HardwareError, with the command that releases it, where a driver of the kernel owns the chip."""
    driver = kernel_driver(bus.path, address)
    if driver is not None:
        raise HardwareError(
            f"{bus.path}: the kernel's driver {driver} owns the chip at 0x{address:02x}; release it: "
            f"{unbind_command(bus.path, address, driver)}"
        )
