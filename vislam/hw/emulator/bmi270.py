"""Virtual BMI270: does nothing before it was given its configuration; a FIFO of frames, by the data sheet."""

import struct

from vislam.hw.emulator.fifo_chip import FifoChip

_INIT_DATA = 0x5E


class VirtualBmi270(FifoChip):
    """FIFO without headers; a frame that is read in part is read again; the oldest frames are overwritten.

    Attributes:
        given: the configuration that it was sent.
        takes: whether it is content with that.
        cas: 512 times what of the rate about z shows in that about x; its register has it once the chip has started.
    """

    FIFO_REGISTER = 0x26
    FIFO_BYTES = 2048 // 12 * 12
    IDENTITY = (0x00, 0x24)
    CLEARED_BY_READING = 0x1D
    takes = True
    cas = -21

    def power_cycle(self) -> None:
        """Come up in advanced power save without a configuration."""
        super().power_cycle()
        self.registers[0x40], self.registers[0x42] = 0xA8, 0xA9
        self.registers[0x7C] = 0x03
        self.given = bytearray()

    def _rate_hz(self) -> float:
        return 25.0 * 2 ** ((self.registers[0x42] & 0x0F) - 6)

    def write(self, data: bytes) -> None:
        """Take a message; the register of the configuration's data does not move on."""
        if data and data[0] == _INIT_DATA:
            place = 2 * (self.registers[0x5B] & 0x0F | self.registers[0x5C] << 4)
            if len(self.given) < place + len(data) - 1:
                self.given += bytes(place + len(data) - 1 - len(self.given))
            self.given[place : place + len(data) - 1] = data[1:]
            self._pointer = _INIT_DATA
        else:
            super().write(data)

    def _write_register(self, register: int, value: int) -> None:
        self._run()
        if register in (0x00, 0x1D, 0x21, 0x24, 0x25):
            return
        if register == 0x7E:
            if value == 0xB6:
                self.power_cycle()
            elif value == 0xB0:
                self.fifo.clear()
                self.registers[0x1D] = 0
            return
        self.registers[register] = value
        if register == 0x59 and value == 1:
            is_awake = not self.registers[0x7C] & 0x01
            self.registers[0x21] = 0x01 if self.takes and is_awake and self.given else 0x02
            self.registers[0x1E if len(self.given) < 1024 else 0x3C] = self.cas & 0x7F
        runs = self.registers[0x21] == 0x01 and self.registers[0x7D] & 0x06 == 0x06 and self.registers[0x49] == 0xC0
        begins = register in (0x7D, 0x49, 0x42)
        self._pace(runs, begins)
        if runs and begins:
            self.gyro_delay_ns = self.accel_delay_ns = round(0.225e9 / (0.4 * self._rate_hz()))

    def _packed(self, t_ns: int) -> bytes:
        gyro_lsb = 32768.0 / (2000.0 / (1 << (self.registers[0x43] & 7)))
        gyro, accel = self._counts(t_ns, gyro_lsb, 16384.0 / (1 << (self.registers[0x41] & 3)))
        leaked = min(max(gyro[0] + round(self.cas * gyro[2] / 512), -32768), 32767)
        return struct.pack("<6h", leaked, *gyro[1:], *accel)

    def _overran(self) -> None:
        self.registers[0x1D] |= 0x01

    def _begin_read(self, first: int, count: int) -> None:
        struct.pack_into("<H", self.registers, 0x24, len(self.fifo))
        self._to_temperature(0x22, "<", 23.0, 512.0)

    def read(self, count: int) -> bytes:
        """Answer a message that reads; what is read of a frame in part stays in the FIFO, and none is 0x8000."""
        if self._pointer != self.FIFO_REGISTER:
            return super().read(count)
        self._run()
        whole = count // 12 * 12
        data = bytes(self.fifo[:count])
        del self.fifo[:whole]
        return data + (b"\x00\x80" * count)[: count - len(data)]
