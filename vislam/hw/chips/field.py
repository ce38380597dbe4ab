"""What the board asks of its magnetometer."""

from dataclasses import dataclass

from vislam.core.messages import Array
from vislam.hw.chips.self_test import SelfTest
from vislam.hw.timing import Clock


@dataclass(frozen=True, slots=True, eq=False)
class FieldReading:
    """One measurement in the chip's axes."""

    field_ut: Array  # [3]
    overflow: bool  # at least one axis is beyond the range


class Magnetometer:
    """A three-axis field sensor."""

    name: str
    rate_hz: float
    untested = "its self-test is not run; the field's plausibility is checked"

    def configure(self, clock: Clock) -> None:
        """Start measuring; raises BusError."""
        raise NotImplementedError

    def read(self) -> FieldReading | None:
        """Return a new measurement, None if there is none yet; never waits. Raises BusError, SettingsLostError."""
        raise NotImplementedError

    def self_test(self, clock: Clock) -> SelfTest:
        """Test the chip by its own means, if that is done; raises BusError."""
        return SelfTest(self.name, None, self.untested)
