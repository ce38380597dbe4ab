"""The HMC5883L magnetometer, and the DA5883, which differs in that its status register never works."""

import struct

import numpy as np

from vislam.core.messages import Array
from vislam.hw.chips.bus import I2cBus, SettingsLostError
from vislam.hw.chips.field import FieldReading, Magnetometer
from vislam.hw.chips.self_test import SelfTest
from vislam.hw.timing import Clock

ADDRESS = 0x1E
_CONFIG_A, _CONFIG_B, _MODE, _STATUS, ID_REGISTER = 0x00, 0x01, 0x02, 0x09, 0x0A  # data: 0x03 to 0x08
IDS = b"H43"
_UT_PER_GA = 100.0

# range in gauss -> code and LSB per gauss (data sheet, page 13)
_GAINS = {
    0.88: (0, 1370.0), 1.3: (1, 1090.0), 1.9: (2, 820.0), 2.5: (3, 660.0), 4.0: (4, 440.0), 4.7: (5, 390.0),
    5.6: (6, 330.0), 8.1: (7, 230.0),
}  # fmt: skip
_RATE_75_HZ, _AVERAGE_1, _CONTINUOUS = 6 << 2, 0, 0
_OVERFLOW = -4096
_LOCK, _READY = 0x02, 0x01
_SILENT_READS = 5  # ready is off for 250 us of 13 ms only

# Self-test (page 19): a coil adds a known field; at 390 LSB/Ga every axis must answer 243 to 575.
_BIAS_GA = np.array([1.16, 1.16, 1.08])
_SELF_TEST_LSB = (243, 575)
_SELF_TEST_CONFIG_A, _SELF_TEST_RANGE = 0x70, 4.7  # 8 averages, 15 Hz
_SELF_TEST_PERIOD_S = 1.0 / 15.0
_POSITIVE, _NEGATIVE = 1, 2


class Hmc5883l(Magnetometer):
    """One chip, measuring at 75 Hz.

    Attributes:
        name: HMC5883L, or DA5883 once several reads in a row found its status register empty: then each read is new.
        scale: [3] per axis, from the last self-test; it also takes out what temperature does to the gain.
    """

    rate_hz = 75.0

    def __init__(self, bus: I2cBus, range_ga: float, address: int = ADDRESS) -> None:
        """Take settings; nothing is sent yet."""
        self._bus, self._address = bus, address
        self._code, self._lsb_per_ga = _GAINS[min((r for r in _GAINS if r >= range_ga), default=max(_GAINS))]
        # settings and data in one go: a chip that lost its power for a moment is seen at once
        self._reads = bus.prepare([(address, _STATUS, 1), (address, _CONFIG_A, 9)])
        self._settings = b""
        self.name = "HMC5883L"
        self.scale: Array = np.ones(3)
        self._to_drop = 0
        self._silent = 0

    def configure(self, clock: Clock) -> None:
        """Start measuring; raises BusError."""
        self._set(_RATE_75_HZ | _AVERAGE_1, self._code)

    def read(self) -> FieldReading | None:
        """Return a new measurement, None if there is none yet; never waits. Raises BusError, SettingsLostError."""
        data = self._reads.run()
        status = data[0]
        if data[1:4] != self._settings:
            raise SettingsLostError(f"{self.name}: settings {data[1:4].hex()}, given {self._settings.hex()}")
        if status & _READY:
            self._silent = 0
            self.name = "HMC5883L"
        elif self.name == "HMC5883L":
            self._silent += 1
            if self._silent >= _SILENT_READS:
                self.name = "DA5883"
        if self.name == "HMC5883L" and (not status & _READY or status & _LOCK):
            return None  # locked data are old; having read all six bytes frees them
        if self._to_drop:
            self._to_drop -= 1
            return None
        x, z, y = struct.unpack_from(">3h", data, 4)
        counts = np.array([x, y, z], dtype=np.float64)
        overflow = bool((counts == _OVERFLOW).any())
        return FieldReading(counts * self.scale * (_UT_PER_GA / self._lsb_per_ga), overflow)

    def self_test(self, clock: Clock) -> SelfTest:
        """Measure the coil's field in both directions and take the scale of each axis from it; about 0.6 s.

        Raises BusError.
        """
        answers = []
        try:
            for direction in (_POSITIVE, _NEGATIVE):
                self._set(_SELF_TEST_CONFIG_A | direction, _GAINS[_SELF_TEST_RANGE][0])
                for _ in range(4):  # the first has the old gain, the second may hold both
                    clock.sleep_until(clock.now_ns() + round(1.1e9 * _SELF_TEST_PERIOD_S))
                    x, z, y = struct.unpack_from(">3h", self._reads.run(), 4)
                answers.append(np.array([x, y, z], dtype=np.float64))
        finally:
            self.configure(clock)
        low, high = _SELF_TEST_LSB
        signed = [answers[0], -answers[1]]
        passed = all(bool(((values >= low) & (values <= high)).all()) for values in signed)
        mean = 0.5 * (signed[0] + signed[1])
        if passed:
            self.scale = _BIAS_GA * _GAINS[_SELF_TEST_RANGE][1] / mean
        words = [f"{axis} {p:.0f}/{n:.0f}" for axis, p, n in zip("XYZ", answers[0], answers[1], strict=True)]
        return SelfTest(self.name, passed, f"coil in LSB: {', '.join(words)} ({low} to {high})", tuple(mean.tolist()))

    def _set(self, config_a: int, gain_code: int) -> None:
        self._settings = bytes((config_a, gain_code << 5, _CONTINUOUS))
        for register, value in zip((_CONFIG_A, _CONFIG_B, _MODE), self._settings, strict=True):
            self._bus.write(self._address, register, value)
        self._to_drop = 1  # the first measurement after a change still has the old gain
        self._silent = 0
