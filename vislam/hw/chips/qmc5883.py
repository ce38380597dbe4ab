"""Magnetometers that are sold as HMC5883L but are not: QMC5883L (marked DB5883) and QMC5883P."""

import struct
from dataclasses import dataclass

import numpy as np

from vislam.hw.chips.bus import I2cBus, SettingsLostError
from vislam.hw.chips.field import FieldReading, Magnetometer
from vislam.hw.timing import Clock

_UT_PER_GA = 100.0
_READY, _OVERFLOW = 0x01, 0x02


@dataclass(frozen=True, slots=True)
class Variant:
    """Where one of the two keeps what (data sheets of QST: QMC5883L 1.0, QMC5883P rev. C)."""

    name: str
    address: int
    id_register: int
    id_value: int
    data: int  # x, y, z, little-endian
    status: int
    narrow: tuple[tuple[int, int], ...]  # registers and values: 2 gauss, 100 Hz, continuous; the first one is not kept
    wide: tuple[tuple[int, int], ...]  # the same with 8 gauss
    lsb_per_ga: tuple[float, float]  # narrow, wide


QMC5883L = Variant(
    "QMC5883L", 0x0D, 0x0D, 0xFF, 0x00, 0x06,
    narrow=((0x0B, 0x01), (0x0A, 0x00), (0x09, 0x09)),  # set/reset period; no interrupt; rate and mode
    wide=((0x0B, 0x01), (0x0A, 0x00), (0x09, 0x19)),
    lsb_per_ga=(12000.0, 3000.0),
)  # fmt: skip
QMC5883P = Variant(
    "QMC5883P", 0x2C, 0x00, 0x80, 0x01, 0x09,
    narrow=((0x29, 0x06), (0x0B, 0x0C), (0x0A, 0x0B)),  # signs of axes; range with set and reset; rate and mode
    wide=((0x29, 0x06), (0x0B, 0x08), (0x0A, 0x0B)),
    lsb_per_ga=(15000.0, 3750.0),
)  # fmt: skip
_NARROW_GA = 2.0


class Qmc5883(Magnetometer):
    """One chip of either kind, measuring at 100 Hz."""

    rate_hz = 100.0
    untested = "this chip has no self-test with stated limits"

    def __init__(self, variant: Variant, bus: I2cBus, range_ga: float, address: int = 0) -> None:
        """Take settings; nothing is sent yet. The address is the variant's."""
        self._bus, self._variant = bus, variant
        wide = range_ga > _NARROW_GA
        self._setup = variant.wide if wide else variant.narrow
        self._lsb_per_ga = variant.lsb_per_ga[wide]
        # the status first, as reading data clears it; then from the data to the settings in one go
        last = max(register for register, _ in self._setup[1:])
        self._reads = bus.prepare(
            [(variant.address, variant.status, 1), (variant.address, variant.data, last - variant.data + 1)]
        )
        self.name = variant.name

    def configure(self, clock: Clock) -> None:
        """Start measuring; raises BusError."""
        for register, value in self._setup:
            self._bus.write(self._variant.address, register, value)

    def read(self) -> FieldReading | None:
        """Return a new measurement, None if there is none yet; never waits. Raises BusError, SettingsLostError."""
        data = self._reads.run()
        for register, value in self._setup[1:]:
            if data[1 + register - self._variant.data] != value:
                raise SettingsLostError(f"{self.name}: register 0x{register:02x} is not 0x{value:02x} as given")
        if not data[0] & _READY:
            return None
        counts = np.array(struct.unpack_from("<3h", data, 1), dtype=np.float64)
        return FieldReading(counts * (_UT_PER_GA / self._lsb_per_ga), bool(data[0] & _OVERFLOW))
