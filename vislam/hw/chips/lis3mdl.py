"""The LIS3MDL magnetometer of ST (data sheet DS9463, sections 6 and 7; compared with the kernel's st_magn driver)."""

import struct

import numpy as np

from vislam.hw.chips.bus import I2cBus, kept
from vislam.hw.chips.field import FieldReading, Magnetometer
from vislam.hw.timing import Clock

ADDRESSES = (0x1C, 0x1E)
ID_REGISTER, ID = 0x0F, 0x3D

_CTRL_REG1, _STATUS = 0x20, 0x27
_GAINS = {4.0: (0x00, 6842.0), 8.0: (0x20, 3421.0), 12.0: (0x40, 2281.0), 16.0: (0x60, 1711.0)}  # code, LSB per gauss
# high performance at 80 Hz; then range, continuous, high performance of z, and data that belong together
_HIGH_80_HZ, _CONTINUOUS, _HIGH_Z, _BLOCK_UPDATE = 0x5C, 0x00, 0x08, 0x40
_READY = 0x08
_INCREMENT = 0x80  # in the register's number: the next byte is of the next register
_UT_PER_GA = 100.0
_LIMIT_LSB = 32767


class Lis3mdl(Magnetometer):
    """One chip, measuring at 80 Hz."""

    name = "LIS3MDL"  # its self-test has limits for a chip that is alone in a quiet field
    rate_hz = 80.0

    def __init__(self, bus: I2cBus, range_ga: float, address: int = ADDRESSES[0]) -> None:
        """Take settings; nothing is sent yet."""
        self._bus, self._address = bus, address
        code, self._lsb_per_ga = _GAINS[min((r for r in _GAINS if r >= range_ga), default=max(_GAINS))]
        self._settings = bytes((_HIGH_80_HZ, code, _CONTINUOUS, _HIGH_Z, _BLOCK_UPDATE))
        # settings and data in one go: a chip that lost its power for a moment is seen at once
        self._reads = bus.prepare([(address, _CTRL_REG1 | _INCREMENT, 5), (address, _STATUS | _INCREMENT, 7)])

    def configure(self, clock: Clock) -> None:
        """Start measuring; raises BusError."""
        for offset, value in enumerate(self._settings):
            self._bus.write(self._address, _CTRL_REG1 + offset, value)

    def read(self) -> FieldReading | None:
        """Return a new measurement, None if there is none yet; never waits. Raises BusError, SettingsLostError."""
        data = kept(self.name, self._reads.run(), self._settings)
        if not data[0] & _READY:
            return None
        counts = np.array(struct.unpack_from("<3h", data, 1), dtype=np.float64)
        return FieldReading(counts * (_UT_PER_GA / self._lsb_per_ga), bool((abs(counts) >= _LIMIT_LSB).any()))
