"""Virtual LSM6DSOX or ISM330DHCX: a FIFO of 512 tagged words, by the data sheets and the kernel's driver."""

import math
import struct

from vislam.hw.emulator.fifo_chip import FifoChip

_TAG, _DATA_END = 0x78, 0x7E
_GYRO_START_NS = 35_000_000


class VirtualLsm6dsox(FifoChip):
    """Continuous or bypass mode; a word leaves the FIFO with its last byte; the gyro's words begin 35 ms later.

    The id 0x6C is a LSM6DSOX, 0x6B an ISM330DHCX.
    """

    FIFO_BYTES = 512 * 7
    IDENTITY = (0x0F, 0x6C)
    _HALVINGS = (0, 512, 256, 128, 64, 32, 16, 8)
    _GYRO_MDEG_S = (8.75, 17.5, 35.0, 70.0)
    _ACCEL_MG = (0.061, 0.488, 0.122, 0.244)

    def power_cycle(self) -> None:
        """Come up with both sensors off; FREQ_FINE has how far the oscillator is from its nominal rate."""
        super().power_cycle()
        self.registers[0x12], self.registers[0x18] = 0x04, 0xE0
        self.registers[0x63] = max(min(round((self._rate - 1.0) / 0.0015), 127), -128) & 0xFF
        self._slot = 0
        self._gyro_from_ns = math.inf

    def _rate_hz(self) -> float:
        return 6667.0 / self._HALVINGS[self.registers[0x10] >> 4 & 7]

    def _write_register(self, register: int, value: int) -> None:
        self._run()
        if register in (0x0F, 0x3A, 0x3B, 0x63) or 0x20 <= register <= 0x2D or register >= _TAG:
            return
        if register == 0x12 and value & 0x01:
            self.power_cycle()
            return
        self.registers[register] = value
        if register == 0x11 and value >> 4:
            self._gyro_from_ns = self._now_ns() + _GYRO_START_NS
        if register == 0x0A and value & 7 == 0:
            self._stop()
            self.registers[0x3B] = 0
        elif register in (0x0A, 0x10, 0x11) and self.registers[0x0A] & 7 == 6 and self.registers[0x10] >> 4:
            self._start()
        if self._rate_hz_known():
            self.gyro_delay_ns = round(0.225e9 * 3.0 / self._rate_hz())
            self.accel_delay_ns = round(0.225e9 * 2.0 / self._rate_hz())

    def _rate_hz_known(self) -> bool:
        return self.registers[0x10] >> 4 != 0

    def _packed(self, t_ns: int) -> bytes:
        mg = self._ACCEL_MG[self.registers[0x10] >> 2 & 3]
        mdeg_s = self._GYRO_MDEG_S[self.registers[0x11] >> 2 & 3]
        gyro, accel = self._counts(t_ns, 1e3 / mdeg_s, 1e3 / mg)
        self._slot = (self._slot + 1) & 3
        batched = self.registers[0x09]
        words = b""
        if batched >> 4 and t_ns >= self._gyro_from_ns:
            words += self._word(0x01, gyro)
        if batched & 0x0F:
            words += self._word(0x02, accel)
        return words

    def _word(self, sensor: int, counts: tuple[int, int, int]) -> bytes:
        tag = sensor << 3 | self._slot << 1
        return bytes((tag | tag.bit_count() & 1,)) + struct.pack("<3h", *counts)

    def _overran(self) -> None:
        self.registers[0x3B] |= 0x48  # overrun, and that it happened since this was last read

    def _begin_read(self, first: int, count: int) -> None:
        words = len(self.fifo) // 7
        self.registers[0x3A] = words & 0xFF
        self.registers[0x3B] = self.registers[0x3B] & 0xF8 | words >> 8 & 3
        if first <= 0x21 and first + count > 0x20:
            self._to_temperature(0x20, "<", 25.0, 256.0)

    def _read_byte(self, register: int) -> int:
        if _TAG <= register <= _DATA_END:
            place = register - _TAG
            value = self.fifo[place] if len(self.fifo) > place else 0
            if register == _DATA_END:
                del self.fifo[:7]
            return value
        value = self.registers[register]
        if register == 0x3B:
            self.registers[0x3B] &= 0x03
        return value

    def _next(self, pointer: int) -> int:
        return _TAG if pointer == _DATA_END else (pointer + 1) & 0xFF


class VirtualLsm6dso32(VirtualLsm6dsox):
    """The same id, and twice the ranges of acceleration."""

    _ACCEL_MG = (0.122, 0.976, 0.244, 0.488)
