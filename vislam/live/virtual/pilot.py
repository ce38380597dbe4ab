"""What steers the virtual cart from another process: the newest command, and a watchdog."""

import math
import struct

from vislam.core.errors import DataError
from vislam.live.wire.slot import SlotReader, SlotWriter

_COMMAND = struct.Struct("<2d")
WATCHDOG_S = 0.3  # without a new command the cart stops


class CommandWriter:
    """Owns the place where a controller's newest command is."""

    def __init__(self, name: str) -> None:
        """Make the shared memory."""
        self._slot = SlotWriter(name, _COMMAND.size)

    def command(self, speed_m_s: float, rate_rad_s: float) -> None:
        """Ask the wheels for a twist."""
        self._slot.write(_COMMAND.pack(speed_m_s, rate_rad_s))

    def close(self) -> None:
        """Remove the shared memory; the cart then stops."""
        self._slot.close()


class CommandReader:
    """Reads commands; one that does not come again for too long, or is no number, means that it is not steered."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._slot: SlotReader | None = None
        self._sequence = 0
        self._since_s = 0.0

    def newest(self, now_s: float) -> tuple[float, float]:
        """Return speed and rate to drive with at a time; zero when it is not steered."""
        if self._slot is None:
            try:
                self._slot = SlotReader(self._name)
            except DataError:
                return 0.0, 0.0
        read = self._slot.read()
        if read is None:
            return 0.0, 0.0
        if read[0] != self._sequence:
            self._sequence, self._since_s = read[0], now_s
        if now_s - self._since_s > WATCHDOG_S:
            return 0.0, 0.0
        speed, rate = _COMMAND.unpack(read[1])
        return (speed, rate) if math.isfinite(speed) and math.isfinite(rate) else (0.0, 0.0)
