"""What virtual inertial chips with a FIFO have in common: a clock of their own, two sensors, bytes that wait."""

import math
import struct
from typing import ClassVar

from vislam.hw.emulator.chips import Chip, NowNs
from vislam.hw.emulator.sensing import IDEAL, Sensing, SensorError, Truth, quantised

_G_M_S2 = 9.80665
Counts = tuple[int, int, int]


class FifoChip(Chip):
    """Samples by its own clock while it runs; a register of the FIFO does not move the pointer on.

    Attributes:
        gyro_delay_ns: by which the gyro's filter is late.
        accel_delay_ns: by which the accelerometer's is.
        fifo: bytes that wait, oldest first.
    """

    FIFO_REGISTER = 0
    FIFO_BYTES = 512
    IDENTITY: ClassVar[tuple[int, int]]  # register, and what the usual chip of the kind has there
    CLEARED_BY_READING = -1  # the register that reports an overrun, where reading it clears it
    gyro_delay_ns = 0
    accel_delay_ns = 0

    def __init__(
        self,
        truth: Truth,
        now_ns: NowNs,
        gyro: SensorError = IDEAL,
        accel: SensorError = IDEAL,
        seed: int = 0,
        who_am_i: int | None = None,
    ) -> None:
        """Take the motion, the host's clock and the errors of both sensors; the gyro's rate error is the chip's.

        `who_am_i` makes it another chip of its kind.
        """
        self._who_am_i = self.IDENTITY[1] if who_am_i is None else who_am_i
        self._accel_sense = Sensing(accel, seed + 1)
        self.fifo = bytearray()
        self._next_ns = math.inf
        super().__init__(truth, now_ns, gyro, seed)

    def power_cycle(self) -> None:
        """Come up asleep with an empty FIFO."""
        super().power_cycle()
        self.registers[self.IDENTITY[0]] = self._who_am_i
        self._stop()

    def read(self, count: int) -> bytes:
        """Answer a message that reads: data belong together, but for those of the FIFO."""
        self._run()
        self._begin_read(self._pointer, count)
        values = bytearray()
        for _ in range(count):
            values.append(self._read_byte(self._pointer))
            self._pointer = self._next(self._pointer)
        return bytes(values)

    def _read_byte(self, register: int) -> int:
        if register == self.FIFO_REGISTER:
            return self.fifo.pop(0) if self.fifo else 0xFF
        value = self.registers[register]
        if register == self.CLEARED_BY_READING:
            self.registers[register] = 0
        return value

    def _next(self, pointer: int) -> int:
        return pointer if pointer == self.FIFO_REGISTER else (pointer + 1) & 0xFF

    # ---- what a kind of chip knows of itself ------------------------------------------------------------------

    def _rate_hz(self) -> float:
        """Return samples per second by the registers and the nominal clock."""
        raise NotImplementedError

    def _packed(self, t_ns: int) -> bytes:
        """Return the bytes that a sample of a time adds to the FIFO."""
        raise NotImplementedError

    def _overran(self) -> None:
        """Take note that old bytes were overwritten."""
        raise NotImplementedError

    # ---- what all do ------------------------------------------------------------------------------------------

    def _period_ns(self) -> float:
        return 1e9 / (self._rate_hz() * self._rate)

    def _pace(self, runs: bool, begins: bool) -> None:
        """Stop sampling, the FIFO left as it is, or begin again."""
        if not runs:
            self._next_ns = math.inf
        elif begins:
            self._start()

    def _start(self) -> None:
        self._next_ns = self._now_ns() + self._period_ns()

    def _stop(self) -> None:
        self._next_ns = math.inf
        self.fifo.clear()

    def _run(self) -> None:
        """Take the samples that are due; of those that would be overwritten at once, only the last ones."""
        now = self._now_ns()
        if now < self._next_ns or self.is_frozen:
            return
        period = self._period_ns()
        most = self.FIFO_BYTES // 6 + 8
        skipped = int((now - self._next_ns) / period) - most
        if skipped > 0:
            self._next_ns += skipped * period
        while self._next_ns <= now:
            self.fifo += self._packed(int(self._next_ns))
            self._next_ns += period
            if len(self.fifo) > self.FIFO_BYTES:
                del self.fifo[: len(self.fifo) - self.FIFO_BYTES]
                self._overran()

    def _counts(self, t_ns: int, lsb_per_deg_s: float, lsb_per_g: float) -> tuple[Counts, Counts]:
        """Return the counts of gyro and accelerometer, late by the filters."""
        bandwidth_hz = 0.5 * self._rate_hz()
        rate, _, _, temperature_c = self._truth(t_ns - self.gyro_delay_ns)
        _, force, _, _ = self._truth(t_ns - self.accel_delay_ns)
        gyro = self._sense(rate, t_ns, temperature_c, bandwidth_hz)
        accel = self._accel_sense(force, t_ns, temperature_c, bandwidth_hz)
        gyro_lsb, accel_lsb = lsb_per_deg_s * 180.0 / math.pi, lsb_per_g / _G_M_S2
        return quantised(gyro, gyro_lsb, -32768, 32767), quantised(accel, accel_lsb, -32768, 32767)

    def _to_temperature(self, register: int, order: str, zero_c: float, lsb_per_c: float) -> None:
        """Put the temperature into two registers, in the order of bytes that `struct` has for it."""
        temperature_c = self._truth(self._now_ns())[3]
        struct.pack_into(f"{order}h", self.registers, register, round((temperature_c - zero_c) * lsb_per_c))
