"""Virtual ICM-20948: registers in four banks, a FIFO of bytes that overwrites the oldest, by the data sheet."""

import struct

from vislam.hw.emulator.fifo_chip import FifoChip

_LSB_PER_DEG_S = (131.0, 65.5, 32.8, 16.4)
_BANK = 0x7F


class VirtualIcm20948(FifoChip):
    """Wakes up asleep in bank 0; `registers` are those of bank 0."""

    FIFO_REGISTER = 0x72
    IDENTITY = (0x00, 0xEA)
    CLEARED_BY_READING = 0x1B
    gyro_delay_ns, accel_delay_ns = round(0.225e9 / 119.5), round(0.225e9 / 111.4)

    @property
    def lets_through(self) -> bool:
        """Whether the magnetometer inside is on the bus."""
        return bool(self.registers[0x0F] & 0x02) and not self.registers[0x03] & 0x20

    def power_cycle(self) -> None:
        """Come up asleep."""
        super().power_cycle()
        self.banks = {bank: bytearray(256) for bank in (1, 2, 3)}
        self.registers[0x06] = 0x41
        self.banks[2][0x01] = self.banks[2][0x14] = 0x01

    def _bank(self) -> bytearray:
        number = self.registers[_BANK] >> 4 & 3
        return self.banks[number] if number else self.registers

    def _rate_hz(self) -> float:
        return 1125.0 / (1 + self.banks[2][0x00])

    def _write_register(self, register: int, value: int) -> None:
        self._run()
        if register == _BANK or self._bank() is not self.registers:
            (self.registers if register == _BANK else self._bank())[register] = value
            return
        if register in (0x00, 0x70, 0x71) or 0x19 <= register <= 0x1C or 0x2D <= register <= 0x3A:
            return
        if register == 0x06 and value & 0x80:
            self.power_cycle()
            return
        self.registers[register] = value
        if register == 0x68 and value & 0x01:
            self.fifo.clear()
        runs = self.registers[0x03] & 0x40 and self.registers[0x67] == 0x1E and not self.registers[0x06] & 0x40
        self._pace(bool(runs), register in (0x03, 0x67, 0x06))

    def _packed(self, t_ns: int) -> bytes:
        gyro_lsb = _LSB_PER_DEG_S[self.banks[2][0x01] >> 1 & 3]
        gyro, accel = self._counts(t_ns, gyro_lsb, 16384.0 / (1 << (self.banks[2][0x14] >> 1 & 3)))
        return struct.pack(">6h", *accel, *gyro)

    def _overran(self) -> None:
        self.registers[0x1B] |= 0x01

    def _begin_read(self, first: int, count: int) -> None:
        struct.pack_into(">H", self.registers, 0x70, len(self.fifo))
        self._to_temperature(0x39, ">", 21.0, 333.87)

    def _read_byte(self, register: int) -> int:
        bank = self._bank()
        if bank is not self.registers and register != _BANK:
            return bank[register]
        return super()._read_byte(register)
