"""Virtual MPU-6050, MPU-6500, MPU-9250: a FIFO of bytes that overwrites the oldest, by the register maps."""

import struct

from vislam.hw.emulator.fifo_chip import Counts, FifoChip
from vislam.hw.emulator.sensing import Sensing, quantised

_LSB_PER_DEG_S = (131.0, 65.5, 32.8, 16.4)
_FIRST = 0x68  # id of the first of them


class VirtualMpu6050(FifoChip):
    """Wakes up asleep; FIFO and its reset by USER_CTRL; an overflow loses the boundaries of samples.

    The id 0x68 is a MPU-6050, 0x70 a MPU-6500, 0x71 a MPU-9250.

    Attributes:
        codes: of the trims for self-test, gyro and accelerometer, 0: none stored; put in place by `power_cycle`.
        responds: to self-test.
    """

    codes: tuple[int, ...] = (7, 12, 20, 5, 18, 31)
    responds = True
    FIFO_REGISTER = 0x74
    IDENTITY = (0x75, _FIRST)
    CLEARED_BY_READING = 0x3A

    @property
    def lets_through(self) -> bool:
        """Whether a magnetometer behind it is on the bus."""
        return bool(self.registers[0x37] & 0x02) and not self.registers[0x6A] & 0x20

    def power_cycle(self) -> None:
        """Come up asleep (the later ones awake) with the FIFO off."""
        super().power_cycle()
        is_first = self._who_am_i == _FIRST
        self.FIFO_BYTES = 1024 if is_first else 512
        self.gyro_delay_ns, self.accel_delay_ns = (2_800_000, 3_000_000) if is_first else (3_900_000, 2_880_000)
        self.registers[0x6B] = 0x40 if is_first else 0x01
        gyro, accel = self.codes[:3], self.codes[3:]
        if is_first:
            self.registers[0x0D:0x10] = bytes(g | a >> 2 << 5 for g, a in zip(gyro, accel, strict=True))
            self.registers[0x10] = (accel[0] & 3) << 4 | (accel[1] & 3) << 2 | accel[2] & 3
        else:
            self.registers[0x00:0x03], self.registers[0x0D:0x10] = bytes(gyro), bytes(accel)

    def _rate_hz(self) -> float:
        inside = 8000.0 if self.registers[0x1A] & 7 in (0, 7) else 1000.0
        return inside / (1 + self.registers[0x19])

    def _write_register(self, register: int, value: int) -> None:
        self._run()
        if register in (0x3A, 0x72, 0x73, 0x75) or 0x3B <= register <= 0x48:
            return
        if register == 0x6B and value & 0x80:
            self.power_cycle()
            return
        self.registers[register] = value
        if register == 0x6A and value & 0x04:
            self.fifo.clear()
            self.registers[0x6A] &= ~0x04 & 0xFF
        runs = self.registers[0x6A] & 0x40 and self.registers[0x23] == 0x78 and not self.registers[0x6B] & 0x40
        self._pace(bool(runs), register in (0x6A, 0x23, 0x6B, 0x19, 0x1A))

    def _packed(self, t_ns: int) -> bytes:
        gyro_lsb = _LSB_PER_DEG_S[self.registers[0x1B] >> 3 & 3]
        gyro, accel = self._counts(t_ns, gyro_lsb, 16384.0 / (1 << (self.registers[0x1C] >> 3 & 3)))
        if (self.registers[0x1B] | self.registers[0x1C]) & 0xE0 and self.responds:
            gyro, accel = self._pushed(gyro, 0, self._sense), self._pushed(accel, 1, self._accel_sense)
        return struct.pack(">6h", *accel, *gyro)

    def _pushed(self, counts: Counts, sensor: int, sense: Sensing) -> Counts:
        """Return counts with the response to self-test, which is the trim times the sensor's scale."""
        is_first, setting = self._who_am_i == _FIRST, self.registers[0x1B + sensor]
        share = 2.0 ** (2 if sensor and is_first else 0) / (1 << (setting >> 3 & 3))
        x, y, z = (
            share * sense.scale[i] * self._trim(self.codes[3 * sensor + i], sensor, i) if setting & 0x80 >> i else 0.0
            for i in range(3)
        )
        return quantised((counts[0] + x, counts[1] + y, counts[2] + z), 1.0, -32768, 32767)

    def _trim(self, code: int, sensor: int, axis: int) -> float:
        """Return the trim in LSB; of an MPU-6050 at 250 deg/s and 8 g, of a later one at 250 deg/s and 2 g."""
        if not code:
            return 0.0
        if self._who_am_i != _FIRST:
            return float(2620.0 * 1.01 ** (code - 1))
        if sensor:
            return float(4096.0 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0))
        return float((-1.0 if axis == 1 else 1.0) * 25.0 * 131.0 * 1.046 ** (code - 1))

    def _overran(self) -> None:
        if self.registers[0x38] & 0x10:
            self.registers[0x3A] |= 0x10

    def _begin_read(self, first: int, count: int) -> None:
        struct.pack_into(">H", self.registers, 0x72, len(self.fifo))
        self._to_temperature(0x41, ">", *((36.53, 340.0) if self._who_am_i == _FIRST else (21.0, 333.87)))
