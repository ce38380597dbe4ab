"""The ITG3205 gyroscope (ITG3200 alike): range, filter, clock and temperature. It has neither FIFO nor self-test."""

import struct

from vislam.core.errors import HardwareError
from vislam.hw.chips.bus import I2cBus, kept
from vislam.hw.timing import Clock

ADDRESS = 0x68
LSB_PER_DEG_S = 14.375
LIMIT_LSB = 28750  # 2000 deg/s, where the stated range ends
START_UP_S = 0.05  # the first samples have a larger offset

_WHO_AM_I, _SMPLRT_DIV, _PWR_MGM = 0x00, 0x15, 0x3E
_ID = 0x34  # bits 6 to 1
_RESET, _CLOCK_PLL_X = 0x80, 0x01
_RESET_S = 0.002
_FULL_SCALE = 3 << 3  # the only value that is not reserved; it is not the one after power-up
_FILTERS = {256: 0, 188: 1, 98: 2, 42: 3, 20: 4, 10: 5, 5: 6}

# Of the filter, in seconds. Stated for the MPU-6000, whose gyro filter has the same bandwidths; the ITG3205's own
# data sheet shows curves only.
DELAY_S = {256: 0.00098, 188: 0.0019, 98: 0.0028, 42: 0.0048, 20: 0.0083, 10: 0.0134, 5: 0.0186}


class Itg3205:
    """One chip. It samples inside at 1 kHz (8 kHz at 256 Hz of bandwidth); a reader gets the newest sample."""

    name = "ITG3205"

    def __init__(self, bus: I2cBus, bandwidth_hz: int, address: int = ADDRESS) -> None:
        """Take settings; nothing is sent yet."""
        self._bus, self._address = bus, address
        self._settings = bytes((0, _FULL_SCALE | _FILTERS[bandwidth_hz]))  # divider 1, range and filter
        # from the settings to the last axis in one go: a chip that lost its power for a moment is seen at once
        self._burst = bus.prepare([(address, _SMPLRT_DIV, 14)])
        self.delay_s = DELAY_S[bandwidth_hz] + (0.5 / 8000 if bandwidth_hz == 256 else 0.5 / 1000)

    def configure(self, clock: Clock) -> None:
        """Reset the chip and set it up; its samples are good `START_UP_S` later.

        Raises BusError, HardwareError for another chip's id.
        """
        found = self._bus.read(self._address, _WHO_AM_I, 1)[0]
        if (found >> 1) & 0x3F != _ID:
            raise HardwareError(
                f"{self._bus.path}: the chip at 0x{self._address:02x} has the id 0x{found:02x}, an ITG3205 0x68 or "
                "0x69; check which board this is"
            )
        self._bus.write(self._address, _PWR_MGM, _RESET)
        clock.sleep_until(clock.now_ns() + round(_RESET_S * 1e9))
        self._bus.write(self._address, _PWR_MGM, _CLOCK_PLL_X)  # steadier than the internal oscillator
        for offset, value in enumerate(self._settings):
            self._bus.write(self._address, _SMPLRT_DIV + offset, value)

    def read(self) -> tuple[float, int, int, int]:
        """Return temperature in deg C and the counts of x, y, z; raises BusError, SettingsLostError."""
        temperature, x, y, z = struct.unpack_from(">4h", kept(self.name, self._burst.run(), self._settings), 4)
        return 35.0 + (temperature + 13200) / 280.0, x, y, z
