"""MPU-6050, MPU-6500, MPU-9250 and MPU-9255 of InvenSense: one register map, a FIFO of bytes.

Registers by RM-MPU-6000A-00 rev. 4.2 and RM-MPU-9250A-00 rev. 1.4 and 1.6 (sections 4.4 to 4.8, 4.34 to 4.38),
compared with the kernel's driver (inv_mpu_iio.h). A MPU-9250 has an AK8963 magnetometer inside, which answers at 0x0C
from then on.
"""

import numpy as np

from vislam.core.errors import HardwareError
from vislam.hw.chips.bus import MAX_READS, I2cBus, SettingsLostError
from vislam.hw.chips.fifo_imu import (
    G_M_S2,
    NO_SAMPLES,
    ImuSetup,
    RawSamples,
    Waiting,
    divided,
    next_of,
    popped,
    refuse_other,
)
from vislam.hw.timing import Clock

ADDRESSES = (0x68, 0x69)
ID_REGISTER = 0x75
IDS = {0x68: "MPU-6050", 0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255"}
# MPU-6515, MPU-6880, ICM-20689 and what is sold as an MPU-6050 or MPU-9250 with their ids: like an MPU-6500 where known
CLONE = "mpu6050-clone"  # its name on a command line
CLONE_IDS = frozenset((0x72, 0x74, 0x78, 0x98))
_DOUBT = "a clone, taken for an MPU-6500; its gyroscope's scale shows in `vislam calibrate imu`"
SAMPLE_BYTES = 12

_SMPLRT_DIV, _FIFO_EN, _INT_PIN_CFG, _INT_ENABLE, _INT_STATUS, _TEMPERATURE = 0x19, 0x23, 0x37, 0x38, 0x3A, 0x41
_USER_CTRL, _PWR_MGMT_1, _FIFO_COUNT, _FIFO_DATA = 0x6A, 0x6B, 0x72, 0x74
_INTERNAL_HZ = 1000.0
_GYRO_RANGES = {250: 0, 500: 1, 1000: 2, 2000: 3}
_LSB_PER_DEG_S = (131.0, 65.5, 32.8, 16.4)
_ACCEL_RANGES = {2: 0, 4: 1, 8: 2, 16: 3}
_RESET, _CLOCK_PLL_X, _BYPASS, _OVERFLOW = 0x80, 0x01, 0x02, 0x10
_GYRO_AND_ACCEL, _FIFO_ON, _FIFO_RESET = 0x78, 0x40, 0x04
_RESET_S, _WAKE_S = 0.1, 0.01
_FILTER = 2  # the widest below half of 200 Hz and more: about 95 Hz for both sensors
# bandwidth code 2, of gyro and accelerometer [s]: MPU-6050 (rev. 4.2, page 13); MPU-9250 (rev. 1.6, sections 4.5 and
# 4.8; of the accelerometer rev. 1.4 states 92 Hz and 7.8 ms, which no filter of that width needs)
_DELAYS_S = {0x68: (0.0028, 0.0030)}
_LATER_DELAYS_S = (0.0039, 0.00288)


class Mpu6050:
    """One chip, at 1000 Hz divided by a whole number, with filters of 98 and 94 Hz (MPU-9250: 92 and 99)."""

    start_up_s = 0.1
    max_zero_deg_s = 20.0  # MPU-6050; 5 of the later ones

    def __init__(self, bus: I2cBus, setup: ImuSetup, address: int = ADDRESSES[0]) -> None:
        """Take settings; nothing is sent yet."""
        self._bus, self.address = bus, address
        self._divider = divided(setup.rate_hz, _INTERNAL_HZ)
        self.rate_hz = _INTERNAL_HZ / self._divider
        gyro = _GYRO_RANGES[next_of(setup.gyro_range_deg_s, _GYRO_RANGES)]
        accel_g = next_of(setup.accel_range_g, _ACCEL_RANGES)
        self.gyro_rad_s = float(np.deg2rad(1.0 / _LSB_PER_DEG_S[gyro]))
        self.accel_m_s2 = accel_g / 32768.0 * G_M_S2
        self._is_clone_taken, self.doubt = setup.named == CLONE, ""
        self._settings = bytes((self._divider - 1, _FILTER, gyro << 3, _ACCEL_RANGES[accel_g] << 3))
        self._take_id(0x68)
        self._count = bus.prepare([(address, _INT_STATUS, 1), (address, _FIFO_COUNT, 2)])
        self._pops = bus.prepare([(address, _FIFO_DATA, SAMPLE_BYTES)] * MAX_READS)
        self._watch = bus.prepare([(address, _SMPLRT_DIV, 4), (address, _TEMPERATURE, 2)])

    def _take_id(self, found: int) -> None:
        if found in CLONE_IDS and self._is_clone_taken:
            self.name, self.doubt = f"MPU-6050 clone 0x{found:02x}", _DOUBT
        else:
            self.name = refuse_other(self._bus, self.address, found, IDS)
        self._is_first = found == 0x68
        self._fifo_bytes = 1024 if self._is_first else 512
        self.gyro_delay_s, self.accel_delay_s = _DELAYS_S.get(found, _LATER_DELAYS_S)

    def configure(self, clock: Clock) -> None:
        """Reset the chip, set it up and start it with an empty FIFO; raises BusError, HardwareError."""
        self._take_id(self._bus.read(self.address, ID_REGISTER, 1)[0])
        self._bus.write(self.address, _PWR_MGMT_1, _RESET)
        clock.sleep_until(clock.now_ns() + round(_RESET_S * 1e9))
        if self._bus.read(self.address, _PWR_MGMT_1, 1)[0] & _RESET:
            raise HardwareError(f"{self._bus.path}: the {self.name} does not come out of its reset; check its supply")
        self._bus.write(self.address, _PWR_MGMT_1, _CLOCK_PLL_X)  # also wakes it up
        clock.sleep_until(clock.now_ns() + round(_WAKE_S * 1e9))
        for offset, value in enumerate(self._settings):
            self._bus.write(self.address, _SMPLRT_DIV + offset, value)
        if not self._is_first:
            self._bus.write(self.address, _SMPLRT_DIV + 4, _FILTER)  # the accelerometer has a filter of its own
        self._bus.write(self.address, _INT_PIN_CFG, _BYPASS)  # a magnetometer behind it comes to the bus
        self._bus.write(self.address, _INT_ENABLE, _OVERFLOW)  # its status bit is set then
        self._bus.write(self.address, _FIFO_EN, _GYRO_AND_ACCEL)
        self.empty()

    def waiting(self) -> Waiting:
        """Return how many samples wait; after an overflow none, and the FIFO is emptied. Raises BusError.

        Bytes are overwritten one by one then, so that nothing in it begins where a sample does.
        """
        status, high, low = self._count.run()
        count = high << 8 | low
        if status & _OVERFLOW or count > self._fifo_bytes - SAMPLE_BYTES:
            self.empty()
            return Waiting(0, True)
        return Waiting(count // SAMPLE_BYTES, False)

    def take(self, units: int) -> RawSamples:
        """Take `units` samples; raises BusError: then `empty` it."""
        return decoded(popped(self._pops, units))

    def empty(self) -> None:
        """Throw away what the FIFO holds; raises BusError."""
        self._bus.write(self.address, _USER_CTRL, _FIFO_RESET)
        self._bus.write(self.address, _USER_CTRL, _FIFO_ON)

    def temperature_c(self) -> float:
        """Return the chip's temperature; raises BusError, SettingsLostError."""
        data = self._watch.run()
        if data[:4] != self._settings:
            raise SettingsLostError(f"{self.name}: settings {data[:4].hex()}, given {self._settings.hex()}")
        counts = int.from_bytes(data[4:], "big", signed=True)
        return counts / 340.0 + 36.53 if self._is_first else counts / 333.87 + 21.0


def decoded(data: bytes) -> RawSamples:
    """Return the samples in bytes of a FIFO: accelerometer, then gyro, x, y, z each, the high byte first."""
    if not data:
        return NO_SAMPLES
    counts = np.frombuffer(data, dtype=">i2").reshape(-1, 6).astype(np.float64)
    return RawSamples(counts[:, 3:], counts[:, :3])
