"""The magnetometers of AKM that sit inside other chips: AK09916 in an ICM-20948, AK8963 in a MPU-9250.

Both answer at 0x0C once the chip around them lets the bus through. Registers by the data sheets of AK09916
(015007392-E-02, section 11) and AK8963 (MS1356-E-02, section 8), compared with the kernel's ak8975 driver. What is
given out is turned into the axes of the inertial chip (ICM-20948: DS-000189 section 5; MPU-9250: PS-MPU-9250A-01
section 9.1).
"""

import struct
from dataclasses import dataclass

import numpy as np

from vislam.core.messages import Array
from vislam.hw.chips.bus import I2cBus, kept
from vislam.hw.chips.field import FieldReading, Magnetometer
from vislam.hw.timing import Clock

ADDRESS = 0x0C
_UT_PER_LSB = 0.15
_READY, _OVERFLOW = 0x01, 0x08
_DOWN, _FUSES = 0x00, 0x0F
_DOWN_S = 0.0001  # in power-down before another mode, section 9.3 of AK09916's and 6.3 of AK8963's data sheet


@dataclass(frozen=True, slots=True)
class Variant:
    """Where one of the two keeps what."""

    name: str
    id_register: int
    id_value: int
    status: int  # then x, y, z, little-endian
    length: int  # from there to the second status, which must be read for new data to come
    control: int
    continuous_100_hz: int
    fuses: int | None  # three bytes of sensitivity, readable in a mode of their own
    turned: tuple[tuple[int, int], ...]  # axis of the magnetometer and sign, for x, y, z of the inertial chip


AK09916 = Variant("AK09916", 0x01, 0x09, 0x10, 9, 0x31, 0x08, None, ((0, 1), (1, -1), (2, -1)))
AK8963 = Variant("AK8963", 0x00, 0x48, 0x02, 8, 0x0A, 0x16, 0x10, ((1, 1), (0, 1), (2, -1)))


class Akm(Magnetometer):
    """One chip of either kind, measuring at 100 Hz."""

    rate_hz = 100.0

    def __init__(self, variant: Variant, bus: I2cBus, range_ga: float = 0.0, address: int = ADDRESS) -> None:
        """Take settings; nothing is sent yet. Range and address are fixed: 4.9 mT."""
        self._bus, self._variant, self.name = bus, variant, variant.name
        self._reads = bus.prepare([(ADDRESS, variant.control, 1), (ADDRESS, variant.status, variant.length)])
        self._scale: Array = np.ones(3)

    def configure(self, clock: Clock) -> None:
        """Read the sensitivity where the chip keeps one, start measuring; raises BusError."""
        v = self._variant
        self._power_down(clock)
        if v.fuses is not None:
            self._bus.write(ADDRESS, v.control, _FUSES)
            fuses = np.frombuffer(self._bus.read(ADDRESS, v.fuses, 3), dtype=np.uint8)
            self._scale = 1.0 + (fuses.astype(np.float64) - 128.0) / 256.0
            self._power_down(clock)
        self._bus.write(ADDRESS, v.control, v.continuous_100_hz)

    def _power_down(self, clock: Clock) -> None:
        self._bus.write(ADDRESS, self._variant.control, _DOWN)
        clock.sleep_until(clock.now_ns() + round(_DOWN_S * 1e9))

    def read(self) -> FieldReading | None:
        """Return a new measurement, None if there is none yet; never waits. Raises BusError, SettingsLostError."""
        data = kept(self.name, self._reads.run(), bytes([self._variant.continuous_100_hz]))
        if not data[0] & _READY:
            return None
        counts = np.array(struct.unpack_from("<3h", data, 1), dtype=np.float64) * self._scale
        field_ut = _UT_PER_LSB * np.array([sign * counts[axis] for axis, sign in self._variant.turned])
        return FieldReading(field_ut, bool(data[-1] & _OVERFLOW))
