"""Virtual ADXL345 and ITG3205: registers with their side effects, by the data sheets and the kernel's drivers."""

import math
import struct
from collections import deque
from collections.abc import Callable

from vislam.hw.emulator.sensing import IDEAL, Sensing, SensorError, Triple, Truth, quantised

_G_M_S2 = 9.80665
NowNs = Callable[[], int]


class Chip:
    """Registers behind a pointer that moves on by itself.

    Attributes:
        registers: [256].
        error: of what it senses (of the gyroscope, where it is two sensors).
        is_frozen: the chip hangs: it answers, and its data never change.
    """

    def __init__(self, truth: Truth, now_ns: NowNs, error: SensorError = IDEAL, seed: int = 0) -> None:
        """Take the motion, the host's clock and the errors, and power up."""
        self._truth, self._now_ns = truth, now_ns
        self.error, self._sense = error, Sensing(error, seed)
        self._rate = 1.0 + error.rate_error
        self.registers = bytearray(256)
        self.is_frozen = False
        self._pointer = 0
        self.power_cycle()

    @property
    def is_on_bus(self) -> bool:
        """Whether it answers at its address."""
        return True

    def power_cycle(self) -> None:
        """Set the registers as after power-up."""
        self.registers[:] = bytes(256)
        self._pointer = 0

    def write(self, data: bytes) -> None:
        """Take a message: the pointer, then values for registers."""
        if data:
            self._pointer = data[0]
            for value in data[1:]:
                self._write_register(self._pointer, value)
                self._pointer = self._next(self._pointer)

    def read(self, count: int) -> bytes:
        """Answer a message that reads."""
        first = self._pointer
        self._begin_read(first, count)
        values = bytearray(count)
        for k in range(count):
            values[k] = self.registers[self._pointer]
            self._pointer = self._next(self._pointer)
        self._end_read(first, count)
        return bytes(values)

    def _write_register(self, register: int, value: int) -> None:
        self.registers[register] = value

    def _begin_read(self, first: int, count: int) -> None:
        """Bring the registers up to date; data belong together within a message."""

    def _end_read(self, first: int, count: int) -> None:
        """Do what reading does."""

    def _next(self, pointer: int) -> int:
        return (pointer + 1) & 0xFF


class VirtualAdxl345(Chip):
    """Samples by its own clock; bypass or stream FIFO, full or 10-bit resolution, self-test, offset registers."""

    def __init__(
        self,
        truth: Truth,
        now_ns: NowNs,
        error: SensorError = IDEAL,
        seed: int = 0,
        self_test_g: Triple = (0.9, -0.9, 1.2),
    ) -> None:
        """Take the motion, the host's clock and the errors; `self_test_g` is the push (0.9 g: typical at 3.3 V)."""
        self._self_test_g = self_test_g
        super().__init__(truth, now_ns, error, seed)

    def power_cycle(self) -> None:
        """Go to standby with an empty FIFO."""
        super().power_cycle()
        self.registers[0x00], self.registers[0x2C], self.registers[0x30] = 0xE5, 0x0A, 0x02
        self._fifo: deque[int] = deque()  # times of samples; values are made when they are read
        self._newest_ns = 0
        self._next_ns = math.inf

    def _period_ns(self) -> float:
        return 1e9 * 2 ** (15 - (self.registers[0x2C] & 0x0F)) / (3200.0 * self._rate)

    def _write_register(self, register: int, value: int) -> None:
        self._run()
        was_measuring = self.registers[0x2D] & 0x08
        if register not in (0x00, 0x30, 0x39) and not 0x32 <= register <= 0x37:
            self.registers[register] = value
        if register == 0x2D and value & 0x08 and not was_measuring:
            self._next_ns = self._now_ns() + self._period_ns()
        elif register == 0x2D and not value & 0x08:
            self._next_ns = math.inf
        if register == 0x38 and value >> 6 == 0:
            self._fifo.clear()

    def _run(self) -> None:
        """Take the samples that are due."""
        now = self._now_ns()
        if now < self._next_ns or self.is_frozen:
            return
        period = self._period_ns()
        stream = self.registers[0x38] >> 6 == 2
        skipped = int((now - self._next_ns) / period) - 40
        if skipped > 0:
            self._next_ns += skipped * period
        while self._next_ns <= now:
            self._newest_ns = int(self._next_ns)
            self._next_ns += period
            if stream:
                self._fifo.append(self._newest_ns)
        self.registers[0x30] |= 0x80
        while len(self._fifo) > 32:
            self._fifo.popleft()
            self.registers[0x30] |= 0x01

    def _begin_read(self, first: int, count: int) -> None:
        self._run()
        self.registers[0x39] = len(self._fifo)
        if first <= 0x37 and first + count > 0x32:
            t_ns = self._fifo[0] if self._fifo else self._newest_ns
            if t_ns and not self.is_frozen:
                struct.pack_into("<3h", self.registers, 0x32, *self._counts(t_ns))

    def _end_read(self, first: int, count: int) -> None:
        if first <= 0x37 and first + count > 0x32:  # a message that reads any of the data takes the entry
            if self._fifo:
                self._fifo.popleft()
            self.registers[0x30] &= 0x7E

    def _counts(self, t_ns: int) -> tuple[int, int, int]:
        _, force, _, temperature_c = self._truth(t_ns)
        bandwidth_hz = 0.5e9 / self._period_ns()
        x, y, z = self._sense(force, t_ns, temperature_c, bandwidth_hz)
        data_format = self.registers[0x31]
        push = self._self_test_g if data_format & 0x80 else (0.0, 0.0, 0.0)
        range_g = 2 << (data_format & 3)
        lsb = 256.0 if data_format & 0x08 else 512.0 / range_g
        offset_g = [(o - 256 if o > 127 else o) * 4.0 / 256.0 for o in self.registers[0x1E:0x21]]
        value = (x / _G_M_S2 + push[0] + offset_g[0], y / _G_M_S2 + push[1] + offset_g[1], z / _G_M_S2 + push[2])
        limit = round(range_g * lsb)
        return quantised((value[0], value[1], value[2] + offset_g[2]), lsb, -limit, limit - 1)


class VirtualItg3205(Chip):
    """Samples at its internal rate; what is read is the newest sample, late by the filter's delay."""

    _BANDWIDTHS_HZ = (256.0, 188.0, 98.0, 42.0, 20.0, 10.0, 5.0, 5.0)
    _DELAYS_NS = (980_000, 1_900_000, 2_800_000, 4_800_000, 8_300_000, 13_400_000, 18_600_000, 18_600_000)

    def power_cycle(self) -> None:
        """Come up with the reserved range, internal clock, no filter."""
        super().power_cycle()
        self.registers[0x00] = 0x68
        self._start_ns = self._now_ns()
        self._sample = -1

    def _write_register(self, register: int, value: int) -> None:
        if register == 0x3E and value & 0x80:
            address = self.registers[0x00]
            self.power_cycle()
            self.registers[0x00] = address
        elif register in (0x15, 0x16, 0x17, 0x3E):
            self.registers[register] = value

    def _begin_read(self, first: int, count: int) -> None:
        if first > 0x22 or first + count <= 0x1A or self.is_frozen:
            return
        running_ns = self._now_ns() - self._start_ns
        choice = self.registers[0x16] & 7
        rate_hz = (8000.0 if choice == 0 else 1000.0) / (self.registers[0x15] + 1) * self._rate
        sample = int(running_ns * 1e-9 * rate_hz)
        self.registers[0x1A] = (0x04 if running_ns > 50_000_000 else 0) | (0x01 if sample != self._sample else 0)
        if sample == self._sample:
            return
        self._sample = sample
        t_ns = self._start_ns + int(sample * 1e9 / rate_hz) - self._DELAYS_NS[choice]
        rate, _, _, temperature_c = self._truth(t_ns)
        value = self._sense(rate, t_ns, temperature_c, self._BANDWIDTHS_HZ[choice])
        if running_ns < 50_000_000:
            value = (value[0] + 0.2, value[1] + 0.2, value[2] + 0.2)
        lsb = 14.375 * 180.0 / math.pi
        if self.registers[0x16] >> 3 & 3 != 3:
            lsb /= 8.0  # a reserved range: whatever it is, it is not the right one
        counts = quantised(value, lsb, -32768, 32767)
        struct.pack_into(">4h", self.registers, 0x1B, round((temperature_c - 35.0) * 280.0) - 13200, *counts)
