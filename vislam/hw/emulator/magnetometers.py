"""Virtual HMC5883L (or DA5883), QMC5883L, QMC5883P, LIS3MDL, AK09916 and AK8963."""

import struct

from vislam.hw.emulator.chips import Chip, NowNs
from vislam.hw.emulator.icm20948 import VirtualIcm20948
from vislam.hw.emulator.mpu6050 import VirtualMpu6050
from vislam.hw.emulator.sensing import IDEAL, SensorError, Triple, Truth, quantised

_UT_PER_GA = 100.0


class VirtualHmc5883l(Chip):
    """Order X, Z, Y; the gain lags one measurement; -4096 beyond the range; a part of the data read locks the rest."""

    _LSB_PER_GA = (1370, 1090, 820, 660, 440, 390, 330, 230)
    _RATES_HZ = (0.75, 1.5, 3.0, 7.5, 15.0, 30.0, 75.0, 75.0)

    def __init__(
        self,
        truth: Truth,
        now_ns: NowNs,
        error: SensorError = IDEAL,
        seed: int = 0,
        status_works: bool = True,
        coil_ga: Triple = (1.16, 1.16, 1.08),
    ) -> None:
        """Take the motion, the host's clock and the errors; without a working status it is a DA5883."""
        self._status_works, self._coil_ga = status_works, coil_ga
        super().__init__(truth, now_ns, error, seed)

    def power_cycle(self) -> None:
        """Come up in single-measurement mode with gain 1."""
        super().power_cycle()
        self.registers[0x00], self.registers[0x01], self.registers[0x02] = 0x10, 0x20, 0x01
        self.registers[0x0A:0x0D] = b"H43"
        self._start_ns = self._now_ns()
        self._sample = 0
        self._gain = 1
        self._locked = False

    def lock(self) -> None:
        """Lock the data, as a read that broke off in the middle of them does; a write of the mode frees them too."""
        self._locked = True

    def _write_register(self, register: int, value: int) -> None:
        if register > 0x02:
            return
        self._run()
        self.registers[register] = value
        if register == 0x02:
            self._start_ns, self._sample, self._locked = self._now_ns(), 0, False

    def _period_ns(self) -> float:
        return 1e9 / (self._RATES_HZ[self.registers[0x00] >> 2 & 7] * self._rate)

    def _run(self) -> None:
        mode = self.registers[0x02] & 3
        sample = int((self._now_ns() - self._start_ns) / self._period_ns())
        if mode > 1 or sample == self._sample or self._locked or self.is_frozen:
            return
        steps, self._sample = sample - self._sample, sample
        t_ns = self._start_ns + int(sample * self._period_ns())
        if steps > 1:
            self._gain = self.registers[0x01] >> 5
        _, _, field, temperature_c = self._truth(t_ns)
        coil = self.registers[0x00] & 3
        x, y, z = self._sense(field, t_ns, temperature_c, 0.5e9 / self._period_ns())
        gauss = (x / _UT_PER_GA, y / _UT_PER_GA, z / _UT_PER_GA)
        if coil in (1, 2):  # the chip takes the outer field out by itself
            sign = 1.0 if coil == 1 else -1.0
            gauss = (sign * self._coil_ga[0], sign * self._coil_ga[1], sign * self._coil_ga[2])
        counts = quantised(gauss, self._LSB_PER_GA[self._gain], -32768, 32767)
        x_, y_, z_ = (-4096 if abs(value) > 2047 else value for value in counts)
        struct.pack_into(">3h", self.registers, 0x03, x_, z_, y_)
        self._gain = self.registers[0x01] >> 5
        if mode == 1:
            self.registers[0x02] = 0x03

    def _begin_read(self, first: int, count: int) -> None:
        self._run()
        into_ns = (self._now_ns() - self._start_ns) % self._period_ns()
        ready = self._sample > 0 and into_ns >= 250_000
        self.registers[0x09] = (0x01 if ready else 0) | (0x02 if self._locked else 0) if self._status_works else 0

    def _end_read(self, first: int, count: int) -> None:
        if first <= 0x08 and first + count > 0x03:
            self._locked = first > 0x03 or first + count < 0x09

    def _next(self, pointer: int) -> int:
        return {0x08: 0x03, 0x0C: 0x00}.get(pointer, (pointer + 1) & 0xFF)


class _Sampling(Chip):
    """Measures by its own clock since its mode was set; what is read is the newest measurement."""

    def _begin(self) -> None:
        self._start_ns, self._sample = self._now_ns(), 0

    def _new_field(self, rate_hz: float) -> Triple | None:
        """Return a measurement [uT] that was not there before, at a rate by the nominal clock; None without one."""
        rate_hz *= self._rate
        sample = int((self._now_ns() - self._start_ns) * 1e-9 * rate_hz)
        if sample == self._sample or self.is_frozen:
            return None
        self._sample = sample
        t_ns = self._start_ns + int(sample * 1e9 / rate_hz)
        _, _, field, temperature_c = self._truth(t_ns)
        return self._sense(field, t_ns, temperature_c, 0.5 * rate_hz)


class VirtualQmc5883(_Sampling):
    """QMC5883L ("L") or QMC5883P ("P"): little-endian X, Y, Z, ready and overflow bits that reading the data clears."""

    def __init__(
        self,
        truth: Truth,
        now_ns: NowNs,
        error: SensorError = IDEAL,
        seed: int = 0,
        variant: str = "L",
    ) -> None:
        """Take the motion, the host's clock and the errors."""
        self._is_p = variant == "P"
        self._data, self._status, self._control = (0x01, 0x09, 0x0A) if self._is_p else (0x00, 0x06, 0x09)
        super().__init__(truth, now_ns, error, seed)

    def power_cycle(self) -> None:
        """Come up suspended."""
        super().power_cycle()
        self.registers[0x00 if self._is_p else 0x0D] = 0x80 if self._is_p else 0xFF
        self._begin()

    def _write_register(self, register: int, value: int) -> None:
        if register in (0x09, 0x0A, 0x0B, 0x29) and register != self._status:
            self.registers[register] = value
        if register == self._control:
            self._begin()

    def _begin_read(self, first: int, count: int) -> None:
        control = self.registers[self._control]
        value = self._new_field((10.0, 50.0, 100.0, 200.0)[control >> 2 & 3]) if control & 3 else None
        if value is None:
            return
        if self._is_p:
            lsb = (1000.0, 2500.0, 3750.0, 15000.0)[self.registers[0x0B] >> 2 & 3]
        else:
            lsb = 3000.0 if control >> 4 & 1 else 12000.0
        exact = quantised(value, lsb / _UT_PER_GA, -(1 << 20), 1 << 20)
        counts = [min(max(count, -32768), 32767) for count in exact]
        struct.pack_into("<3h", self.registers, self._data, *counts)
        self.registers[self._status] = 0x01 | (0x02 if tuple(counts) != exact else 0)

    def _end_read(self, first: int, count: int) -> None:
        if first <= self._data + 5 and first + count > self._data:
            self.registers[self._status] = 0


class VirtualLis3mdl(_Sampling):
    """Little-endian X, Y, Z; a register's number moves on only with its highest bit set; ready until data are read."""

    _RATES_HZ = (0.625, 1.25, 2.5, 5.0, 10.0, 20.0, 40.0, 80.0)
    _LSB_PER_GA = (6842.0, 3421.0, 2281.0, 1711.0)

    def power_cycle(self) -> None:
        """Come up powered down."""
        super().power_cycle()
        self.registers[0x0F], self.registers[0x20], self.registers[0x22] = 0x3D, 0x10, 0x03
        self._begin()

    def write(self, data: bytes) -> None:
        """Take a message: the pointer and whether it moves on, then values for registers."""
        self._moves_on = bool(data[0] & 0x80) if data else False
        super().write(bytes((data[0] & 0x7F,)) + data[1:] if data else data)

    def _next(self, pointer: int) -> int:
        return pointer + 1 & 0x7F if self._moves_on else pointer

    def _write_register(self, register: int, value: int) -> None:
        if 0x20 <= register <= 0x24:
            self.registers[register] = value
            self._begin()

    def _begin_read(self, first: int, count: int) -> None:
        is_down = self.registers[0x22] & 3
        value = None if is_down else self._new_field(self._RATES_HZ[self.registers[0x20] >> 2 & 7])
        if value is None:
            return
        lsb = self._LSB_PER_GA[self.registers[0x21] >> 5 & 3]
        struct.pack_into("<3h", self.registers, 0x28, *quantised(value, lsb / _UT_PER_GA, -32768, 32767))
        self.registers[0x27] |= 0x08

    def _end_read(self, first: int, count: int) -> None:
        if first <= 0x2D and first + count > 0x28:
            self.registers[0x27] = 0


class VirtualAkm(_Sampling):
    """AK09916 ("AK09916") or AK8963 inside another chip: silent until that lets the bus through.

    Reading the second status frees the data for the next; the AK8963 keeps its sensitivity in fuses.
    """

    def __init__(
        self,
        truth: Truth,
        now_ns: NowNs,
        error: SensorError = IDEAL,
        seed: int = 0,
        variant: str = "AK09916",
        around: VirtualMpu6050 | VirtualIcm20948 | None = None,
        fuses: tuple[int, int, int] = (176, 178, 166),
    ) -> None:
        """Take the motion, the host's clock and the errors, in axes of the chip around; `fuses` of an AK8963."""
        self._is_8963, self._around, self._fuses = variant == "AK8963", around, fuses
        self._data, self._control = (0x02, 0x0A) if self._is_8963 else (0x10, 0x31)
        super().__init__(truth, now_ns, error, seed)

    @property
    def is_on_bus(self) -> bool:
        """Whether it answers at all."""
        return self._around is None or self._around.lets_through

    def power_cycle(self) -> None:
        """Come up powered down."""
        super().power_cycle()
        self.registers[0x00] = 0x48
        if not self._is_8963:
            self.registers[0x01] = 0x09
        self._is_held = False
        self._down_ns = -1_000_000
        self._begin()

    def _write_register(self, register: int, value: int) -> None:
        if register == self._control:
            now = self._now_ns()
            if value == 0:
                self._down_ns = now
            elif now - self._down_ns < 100_000:
                return  # it is not ready for another mode
            self.registers[register] = value
            self._is_held = False
            self._begin()
            in_fuses = self._is_8963 and value & 0x0F == 0x0F
            if self._is_8963:
                self.registers[0x10:0x13] = bytes(self._fuses) if in_fuses else bytes(3)

    def _rate_hz(self) -> float:
        mode = self.registers[self._control] & 0x1F
        if self._is_8963:
            return {0x12: 8.0, 0x16: 100.0}.get(mode, 0.0)
        return {0x02: 10.0, 0x04: 20.0, 0x06: 50.0, 0x08: 100.0}.get(mode, 0.0)

    def _begin_read(self, first: int, count: int) -> None:
        value = None if self._is_held or not self._rate_hz() else self._new_field(self._rate_hz())
        if value is None:
            return
        x, y, z = value
        own = (y, x, -z) if self._is_8963 else (x, -y, -z)
        if self._is_8963:
            a, b, c = (1.0 + (fuse - 128) / 256.0 for fuse in self._fuses)
            own = (own[0] / a, own[1] / b, own[2] / c)
        struct.pack_into("<3h", self.registers, self._data + 1, *quantised(own, 1.0 / 0.15, -32752, 32752))
        self.registers[self._data] |= 0x01
        self.registers[self._second_status()] = (0x08 if sum(map(abs, own)) > 4912.0 else 0) | 0x10 * self._is_8963

    def _second_status(self) -> int:
        return 0x09 if self._is_8963 else 0x18

    def _end_read(self, first: int, count: int) -> None:
        last = first + count - 1
        if first <= self._data + 6 and last > self._data:
            self._is_held = True
        if first <= self._second_status() <= last:
            self._is_held = False
            self.registers[self._data] = 0
