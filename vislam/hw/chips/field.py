"""What the board asks of its magnetometer."""

from dataclasses import dataclass
from typing import Protocol

from vislam.core.messages import Array
from vislam.hw.chips.self_test import SelfTest
from vislam.hw.timing import Clock


@dataclass(frozen=True, slots=True, eq=False)
class FieldReading:
    """One measurement in the chip's axes."""

    field_ut: Array  # [3]
    overflow: bool  # at least one axis is beyond the range


class Magnetometer(Protocol):
    """A three-axis field sensor."""

    name: str
    rate_hz: float

    def configure(self, clock: Clock) -> None:
        """Start measuring; raises BusError."""
        ...

    def read(self) -> FieldReading | None:
        """Return a new measurement, None if there is none yet; never waits. Raises BusError, SettingsLostError."""
        ...

    def self_test(self, clock: Clock) -> SelfTest:
        """Test the chip by its own means; raises BusError."""
        ...
