"""The ICM-20948 of InvenSense: four banks of registers, a FIFO of bytes, an AK09916 magnetometer inside.

Registers by the data sheet DS-000189 rev. 1.3 (sections 7 and 8, FIFO in 4.15), compared with SparkFun's and other
public drivers. The magnetometer answers at 0x0C from then on.
"""

import numpy as np

from vislam.core.errors import HardwareError
from vislam.hw.chips.bus import MAX_READS, I2cBus
from vislam.hw.chips.fifo_imu import G_M_S2, FifoImu, ImuSetup, RawSamples, Waiting, divided, next_of
from vislam.hw.chips.mpu6050 import SAMPLE_BYTES, decoded
from vislam.hw.timing import Clock

ADDRESSES = (0x69, 0x68)
ID_REGISTER = 0x00
IDS = {0xEA: "ICM-20948"}

_BANK = 0x7F
# bank 0
_USER_CTRL, _PWR_MGMT_1, _INT_PIN_CFG, _OVERFLOWS, _TEMPERATURE = 0x03, 0x06, 0x0F, 0x1B, 0x39
_FIFO_EN_2, _FIFO_RST, _FIFO_MODE, _FIFO_COUNT, _FIFO_DATA = 0x67, 0x68, 0x69, 0x70, 0x72
# bank 2
_GYRO_DIVIDER, _GYRO_CONFIG, _ALIGN, _ACCEL_DIVIDER_HIGH, _ACCEL_DIVIDER_LOW, _ACCEL_CONFIG = (
    0x00, 0x01, 0x09, 0x10, 0x11, 0x14,
)  # fmt: skip
_INTERNAL_HZ = 1125.0
_GYRO_RANGES = {250: 0, 500: 1, 1000: 2, 2000: 3}
_LSB_PER_DEG_S = (131.0, 65.5, 32.8, 16.4)
_ACCEL_RANGES = {2: 0, 4: 1, 8: 2, 16: 3}
_RESET, _CLOCK_AUTO, _BYPASS, _FIFO_ON = 0x80, 0x01, 0x02, 0x40
_GYRO_AND_ACCEL, _ALL_FIFOS, _STREAM = 0x1E, 0x1F, 0x00
_FILTER = 2 << 3 | 1  # 119.5 Hz of the gyro, 111.4 Hz of the accelerometer
_RESET_S, _WAKE_S = 0.1, 0.02
FIFO_BYTES = 512  # by the data sheet; where a chip has more, no more is used


class Icm20948(FifoImu):
    """One chip, at 1125 Hz divided by a whole number, with filters of 120 and 111 Hz.

    Their delays are those of second-order filters of such widths (0.225 periods): the data sheet states none.
    """

    def __init__(self, bus: I2cBus, setup: ImuSetup, address: int = ADDRESSES[0]) -> None:
        """Take settings; nothing is sent yet."""
        super().__init__(bus, address, IDS[0xEA])
        divider = divided(setup.rate_hz, _INTERNAL_HZ)
        self.rate_hz = _INTERNAL_HZ / divider
        gyro = _GYRO_RANGES[next_of(setup.gyro_range_deg_s, _GYRO_RANGES)]
        accel_g = next_of(setup.accel_range_g, _ACCEL_RANGES)
        self.gyro_rad_s = float(np.deg2rad(1.0 / _LSB_PER_DEG_S[gyro]))
        self.accel_m_s2 = accel_g / 32768.0 * G_M_S2
        self.gyro_delay_s, self.accel_delay_s = 0.225 / 119.5, 0.225 / 111.4
        self._settings = (
            (_GYRO_DIVIDER, divider - 1),
            (_GYRO_CONFIG, _FILTER | gyro << 1),
            (_ALIGN, 1),  # both sensors begin together
            (_ACCEL_DIVIDER_HIGH, 0),
            (_ACCEL_DIVIDER_LOW, divider - 1),
            (_ACCEL_CONFIG, _FILTER | _ACCEL_RANGES[accel_g] << 1),
        )
        self._count = bus.prepare([(address, _OVERFLOWS, 1), (address, _FIFO_COUNT, 2)])
        self._pops = bus.prepare([(address, _FIFO_DATA, SAMPLE_BYTES)] * MAX_READS)
        self._watch = bus.prepare([(address, _USER_CTRL, 1), (address, _FIFO_EN_2, 1), (address, _TEMPERATURE, 2)])
        self._kept = bytes((_FIFO_ON, _GYRO_AND_ACCEL))

    def configure(self, clock: Clock) -> None:
        """Reset the chip, set it up and start it with an empty FIFO; raises BusError, HardwareError."""
        self._write(_BANK, 0)
        self._identified(ID_REGISTER, IDS)
        self._write(_PWR_MGMT_1, _RESET)
        self._await_reset(clock, _PWR_MGMT_1, _RESET, _RESET_S)
        self._write(_PWR_MGMT_1, _CLOCK_AUTO)  # also wakes it up
        clock.sleep_until(clock.now_ns() + round(_WAKE_S * 1e9))
        self._write(_BANK, 2 << 4)
        for register, value in self._settings:
            self._write(register, value)
        found = tuple((register, self._read(register)[0]) for register, _ in self._settings)
        self._write(_BANK, 0)  # where all that is read while it runs lies
        if found != self._settings:
            raise HardwareError(f"{self._bus.path}: the {self.name} does not keep its settings; check its supply")
        self._write(_INT_PIN_CFG, _BYPASS)  # the magnetometer comes to the bus
        self._write(_FIFO_MODE, _STREAM)
        self._write(_FIFO_EN_2, _GYRO_AND_ACCEL)
        self._write(_USER_CTRL, _FIFO_ON)
        self.empty()

    def waiting(self) -> Waiting:
        """Return how many samples wait, see `FifoImu`."""
        overflows, high, low = self._count.run()
        return self._whole((high & 0x1F) << 8 | low, bool(overflows & _ALL_FIFOS), FIFO_BYTES, SAMPLE_BYTES)

    def take(self, units: int) -> RawSamples:
        """Take `units` samples; raises BusError: then `empty` it."""
        return decoded(self._popped(units))

    def empty(self) -> None:
        """Throw away what the FIFO holds; raises BusError."""
        self._write(_FIFO_RST, _ALL_FIFOS)
        self._write(_FIFO_RST, 0)

    def _celsius(self, data: bytes) -> float:
        return int.from_bytes(data, "big", signed=True) / 333.87 + 21.0
