"""The ADXL345 accelerometer: full resolution, FIFO in stream mode, self-test (data sheet, revision E)."""

import numpy as np

from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.chips.bus import MAX_READS, I2cBus
from vislam.hw.chips.self_test import SelfTest
from vislam.hw.timing import Clock

ADDRESS = 0x53
LSB_PER_G = 256.0  # at full resolution, in every range
FIFO_DEPTH = 32

_DEVID, _BW_RATE, _POWER_CTL, _DATA_FORMAT, _DATA, _FIFO_CTL, _FIFO_STATUS = 0x00, 0x2C, 0x2D, 0x31, 0x32, 0x38, 0x39
_ID = 0xE5
_RATES = {100: 0x0A, 200: 0x0B, 400: 0x0C, 800: 0x0D}
_RANGES = {2: 0, 4: 1, 8: 2, 16: 3}
_SELF_TEST, _FULL_RESOLUTION, _MEASURE, _STREAM = 0x80, 0x08, 0x08, 0x80

# Page 22 of revision E: change of output at 2.5 V, and its factor at other supplies
_SELF_TEST_LSB = np.array([[50.0, 540.0], [-540.0, -50.0], [75.0, 875.0]])
_SUPPLY_V = (2.0, 2.5, 3.3, 3.6)
_FACTOR_XY, _FACTOR_Z = (0.64, 1.0, 1.77, 2.11), (0.8, 1.0, 1.47, 1.69)
_SELF_TEST_SAMPLES = 100
_SELF_TEST_SETTLE_S = 0.03
_SELF_TEST_MAX_STD_LSB = 15.0  # 0.6 m/s^2: it was moved; the chip's own noise is 2


def self_test_limits_lsb(supply_v: float) -> Array:
    """Return the least and greatest change [3, 2] that the data sheet allows at a supply voltage."""
    xy = np.interp(supply_v, _SUPPLY_V, _FACTOR_XY)
    z = np.interp(supply_v, _SUPPLY_V, _FACTOR_Z)
    return _SELF_TEST_LSB * np.array([[xy], [xy], [z]])


class Adxl345:
    """One chip. Its own clock paces the samples; the FIFO holds 80 ms of them at 400 Hz."""

    name = "ADXL345"

    def __init__(self, bus: I2cBus, rate_hz: int, range_g: int, address: int = ADDRESS) -> None:
        """Take settings; nothing is sent yet."""
        self._bus, self._address = bus, address
        self._rate, self._format = _RATES[rate_hz], _FULL_RESOLUTION | _RANGES[range_g]
        self.rate_hz = rate_hz
        self.limit_lsb = round(range_g * LSB_PER_G) - 1  # an axis at this value or beyond is saturated
        self._status = bus.prepare([(address, _FIFO_STATUS, 1)])
        self._pops = bus.prepare([(address, _DATA, 6)] * MAX_READS)

    def configure(self) -> None:
        """Set the chip up and start it with an empty FIFO; raises BusError, HardwareError for another chip's id."""
        found = self._bus.read(self._address, _DEVID, 1)[0]
        if found != _ID:
            raise HardwareError(
                f"{self._bus.path}: the chip at 0x{self._address:02x} has id 0x{found:02x}, an ADXL345 0x{_ID:02x}; "
                "check which board this is"
            )
        for register, value in (
            (_POWER_CTL, 0),
            (_BW_RATE, self._rate),
            (_DATA_FORMAT, self._format),
            (_FIFO_CTL, 0),  # bypass empties the FIFO
            (_FIFO_CTL, _STREAM),
            (_POWER_CTL, _MEASURE),
        ):
            self._bus.write(self._address, register, value)

    def read_fifo(self) -> tuple[Array, bool]:
        """Return the counts [N, 3] that the FIFO holds, oldest first, and whether it was full: some may be lost.

        Raises BusError.
        """
        waiting = min(self._status.run()[0] & 0x3F, FIFO_DEPTH)
        data = b""
        for first in range(0, waiting, MAX_READS):
            data += self._pops.run(min(waiting - first, MAX_READS))
        return np.frombuffer(data, dtype="<i2").reshape(-1, 3).astype(np.float64), waiting == FIFO_DEPTH

    def self_test(self, clock: Clock, supply_v: float) -> SelfTest:
        """Push the proof mass electrically and compare the change with the data sheet; must stand still, about 0.6 s.

        The rate must be 100 to 800 Hz, which it always is here. Raises BusError.
        """
        before = self._mean(clock)
        self._bus.write(self._address, _DATA_FORMAT, self._format | _SELF_TEST)
        try:
            pushed = self._mean(clock)
        finally:
            self._bus.write(self._address, _DATA_FORMAT, self._format)
        self._empty(clock)
        if before is None or pushed is None:
            return SelfTest(self.name, False, f"fewer than {_SELF_TEST_SAMPLES} samples came in time")
        moved = max(before[1].max(), pushed[1].max())
        if moved > _SELF_TEST_MAX_STD_LSB:
            what = f"moved by {moved:.0f} LSB rms, {_SELF_TEST_MAX_STD_LSB:.0f} allowed; stand still"
            return SelfTest(self.name, None, what)
        change = pushed[0] - before[0]
        limits = self_test_limits_lsb(supply_v)
        passed = bool((change >= limits[:, 0]).all() and (change <= limits[:, 1]).all())
        words = [
            f"{axis} {value:.0f} ({low:.0f} to {high:.0f})"
            for axis, value, (low, high) in zip("XYZ", change, limits, strict=True)
        ]
        return SelfTest(self.name, passed, f"change in LSB: {', '.join(words)}", tuple(change.tolist()))

    def _mean(self, clock: Clock) -> tuple[Array, Array] | None:
        """Return mean and deviation [3] of samples taken from a while after now; None if they do not come."""
        self._empty(clock)
        period_ns = round(1e9 / self.rate_hz)
        give_up_ns = clock.now_ns() + 3 * _SELF_TEST_SAMPLES * period_ns
        counts = np.zeros((0, 3))
        while len(counts) < _SELF_TEST_SAMPLES:
            if clock.now_ns() > give_up_ns:
                return None
            clock.sleep_until(clock.now_ns() + 8 * period_ns)
            counts = np.vstack([counts, self.read_fifo()[0]])
        return counts.mean(axis=0), counts.std(axis=0)

    def _empty(self, clock: Clock) -> None:
        """Let a change of the stimulus settle and drop the samples until then."""
        clock.sleep_until(clock.now_ns() + round(_SELF_TEST_SETTLE_S * 1e9))
        self.read_fifo()
