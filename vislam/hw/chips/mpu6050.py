"""MPU-6050, MPU-6500, MPU-9250 and MPU-9255 of InvenSense: one register map, a FIFO of bytes.

Registers by RM-MPU-6000A-00 rev. 4.2 and RM-MPU-9250A-00 rev. 1.4 and 1.6 (sections 4.4 to 4.8, 4.34 to 4.38),
compared with the kernel's driver (inv_mpu_iio.h). A MPU-9250 has an AK8963 magnetometer inside, which answers at 0x0C
from then on.
"""

import numpy as np

from vislam.core.messages import Array
from vislam.hw.chips.bus import MAX_READS, I2cBus
from vislam.hw.chips.fifo_imu import (
    G_M_S2,
    NO_SAMPLES,
    SAMPLES,
    FifoImu,
    ImuSetup,
    RawSamples,
    Waiting,
    divided,
    fresh,
    next_of,
)
from vislam.hw.chips.self_test import SelfTest
from vislam.hw.timing import Clock

ADDRESSES = (0x68, 0x69)
ID_REGISTER = 0x75
IDS = {0x68: "MPU-6050", 0x70: "MPU-6500", 0x71: "MPU-9250", 0x73: "MPU-9255"}
# MPU-6515, MPU-6880, ICM-20689 and what is sold as an MPU-6050 or MPU-9250 with their ids: like an MPU-6500 where known
CLONE = "mpu6050-clone"  # its name on a command line
CLONE_IDS = frozenset((0x72, 0x74, 0x78, 0x98))
_DOUBT = "a clone, taken for an MPU-6500"
SAMPLE_BYTES = 12

_GYRO_CONFIG, _ACCEL_CONFIG = 0x1B, 0x1C
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
_STIMULUS = 0xE0  # of all axes, in GYRO_CONFIG and ACCEL_CONFIG
# Response over trim. MPU-6050: +-14 % (PS-MPU-6000A rev. 3.4, sections 6.1 and 6.2). For an MPU-6500 InvenSense's own
# driver (inv_check_gyro_self_test, inv_check_accel_self_test of its Linux inv_mpu_iio) takes 0.5 and more, of the
# accelerometer up to 1.5; half the scale would be at that limit, so it is the geometric mean of that and the right one
_FIRST_LIMITS, _LATER_LIMITS = (0.86, 1.14), (0.71, 1.41)
_MOVED, _NO_RESPONSE = 0.1, 0.1  # of the trim; noise is below 0.03


class Mpu6050(FifoImu):
    """One chip, at 1000 Hz divided by a whole number, with filters of 98 and 94 Hz (MPU-9250: 92 and 99)."""

    max_zero_deg_s = 20.0  # MPU-6050; 5 of the later ones

    def __init__(self, bus: I2cBus, setup: ImuSetup, address: int = ADDRESSES[0]) -> None:
        """Take settings; nothing is sent yet."""
        super().__init__(bus, address, "")
        self._divider = divided(setup.rate_hz, _INTERNAL_HZ)
        self.rate_hz = _INTERNAL_HZ / self._divider
        gyro = _GYRO_RANGES[next_of(setup.gyro_range_deg_s, _GYRO_RANGES)]
        accel_g = next_of(setup.accel_range_g, _ACCEL_RANGES)
        self.gyro_rad_s = float(np.deg2rad(1.0 / _LSB_PER_DEG_S[gyro]))
        self.accel_m_s2 = accel_g / 32768.0 * G_M_S2
        self._is_clone_taken = setup.named == CLONE
        self._kept = bytes((self._divider - 1, _FILTER, gyro << 3, _ACCEL_RANGES[accel_g] << 3))
        self._take_id(0x68, IDS[0x68])
        self._count = bus.prepare([(address, _INT_STATUS, 1), (address, _FIFO_COUNT, 2)])
        self._pops = bus.prepare([(address, _FIFO_DATA, SAMPLE_BYTES)] * MAX_READS)
        self._watch = bus.prepare([(address, _SMPLRT_DIV, 4), (address, _TEMPERATURE, 2)])

    def _take_id(self, found: int, name: str) -> None:
        self.name = name
        self._is_first = found == 0x68
        self._fifo_bytes = 1024 if self._is_first else 512
        self.gyro_delay_s, self.accel_delay_s = _DELAYS_S.get(found, _LATER_DELAYS_S)

    def configure(self, clock: Clock) -> None:
        """Reset the chip, set it up and start it with an empty FIFO; raises BusError, HardwareError."""
        clones = {clone: f"MPU-6050 clone 0x{clone:02x}" for clone in CLONE_IDS if self._is_clone_taken}
        name, found = self._identified(ID_REGISTER, IDS | clones)
        self._take_id(found, name)
        self.doubt = _DOUBT if found in clones else ""
        self._write(_PWR_MGMT_1, _RESET)
        self._await_reset(clock, _PWR_MGMT_1, _RESET, _RESET_S)
        self._write(_PWR_MGMT_1, _CLOCK_PLL_X)  # also wakes it up
        clock.sleep_until(clock.now_ns() + round(_WAKE_S * 1e9))
        self._write(_SMPLRT_DIV, *self._kept)
        if not self._is_first:
            self._write(_SMPLRT_DIV + 4, _FILTER)  # the accelerometer has a filter of its own
        self._write(_INT_PIN_CFG, _BYPASS)  # a magnetometer behind it comes to the bus
        self._write(_INT_ENABLE, _OVERFLOW)  # its status bit is set then
        self._write(_FIFO_EN, _GYRO_AND_ACCEL)
        self.empty()

    def waiting(self) -> Waiting:
        """Return how many samples wait, see `FifoImu`."""
        status, high, low = self._count.run()
        return self._whole(high << 8 | low, bool(status & _OVERFLOW), self._fifo_bytes, SAMPLE_BYTES)

    def take(self, units: int) -> RawSamples:
        """Take `units` samples; raises BusError: then `empty` it."""
        return decoded(self._popped(units))

    def empty(self) -> None:
        """Throw away what the FIFO holds; raises BusError."""
        self._write(_USER_CTRL, _FIFO_RESET)
        self._write(_USER_CTRL, _FIFO_ON)

    def _celsius(self, data: bytes) -> float:
        counts = int.from_bytes(data, "big", signed=True)
        return counts / 340.0 + 36.53 if self._is_first else counts / 333.87 + 21.0

    def _trims(self) -> tuple[Array, Array]:
        """Return the responses [3], [3] in LSB that the maker stored for gyro and accelerometer; 0: none."""
        if self._is_first:
            *codes, low = self._read(0x0D, 4)
            gyro = np.array(codes) & 0x1F
            accel = np.array(codes) >> 5 << 2 | low >> np.array([4, 2, 0]) & 3
            of_gyro = np.array([25.0, -25.0, 25.0]) * 131.0 * 1.046 ** (gyro - 1.0)
            of_accel = 4096.0 * 0.34 * (0.92 / 0.34) ** ((accel - 1.0) / 30.0)
        else:
            gyro, accel = (np.array(list(self._read(first, 3))) for first in (0x00, 0x0D))
            of_gyro, of_accel = 2620.0 * 1.01 ** (gyro - 1.0), 2620.0 * 1.01 ** (accel - 1.0)
        return np.where(gyro > 0, of_gyro, 0.0), np.where(accel > 0, of_accel, 0.0)

    def self_test(self, clock: Clock) -> SelfTest:
        """Let the chip push its sensors and compare the change with the trim its maker stored; at rest, about 0.6 s.

        Passed: both scales fit. Failed: an axis is off, by how much is said. None: no trim is stored, nothing responds,
        or it moved. Formulas: RM-MPU-6000A rev. 4.2, section 4.1; MPU-6500 as in `_LATER_LIMITS`. Raises BusError.
        """
        trims, accel_range = self._trims(), _ACCEL_RANGES[8 if self._is_first else 2] << 3  # the trims are of these
        taken = []
        try:
            for stimulus in (0, _STIMULUS, 0):
                self._write(_GYRO_CONFIG, stimulus, stimulus | accel_range)  # at 250 deg/s; ACCEL_CONFIG follows
                taken.append(fresh(self, clock))
        finally:
            try:
                self._write(_GYRO_CONFIG, self._kept[2])
            finally:
                self._write(_ACCEL_CONFIG, self._kept[3])
        self.empty()
        if min(map(len, taken)) < SAMPLES:
            return SelfTest(self.name, None, f"fewer than {SAMPLES} samples came in time", next_step="check its supply")
        limits = _FIRST_LIMITS if self._is_first else _LATER_LIMITS
        gyro = _judged("gyroscope", [raw.gyro for raw in taken], trims[0], limits)
        accel = _judged("accelerometer", [raw.accel for raw in taken], trims[1], limits)
        worst = min(gyro, accel, key=lambda test: (False, None, True).index(test.passed))
        what = f"{gyro.what}; {accel.what}"
        return SelfTest(self.name, worst.passed, what, gyro.measured + accel.measured, worst.next_step)


def _judged(sensor: str, taken: list[Array], trim: Array, limits: tuple[float, float]) -> SelfTest:
    """Return what samples before, during and after the stimulus say of one sensor."""
    if not trim.all():
        what = f"the {sensor}'s scale cannot be judged: no trim is stored"
        return SelfTest(sensor, None, what, next_step="vislam calibrate imu")
    before, pushed, after = (counts.mean(axis=0) for counts in taken)
    change = pushed - 0.5 * (before + after)
    moved = np.max(np.abs([after - before, *(counts.std(axis=0) for counts in taken)]) / abs(trim))
    if moved > _MOVED:
        what = f"the {sensor}'s scale cannot be judged: it moved by {moved:.1f} of the trim, {_MOVED:g} allowed"
        return SelfTest(sensor, None, what, next_step="stand still and try again")
    ratio, (low, high) = change / trim, limits
    measured = tuple(change.tolist())
    if abs(ratio).max() < _NO_RESPONSE:
        what = f"the {sensor}'s scale cannot be judged: it does not respond"
        return SelfTest(sensor, None, what, measured, "vislam calibrate imu")
    is_off = (ratio < low) | (ratio > high)
    axes = ", ".join(
        f"{'xyz'[i]} {ratio[i]:.2f} of its trim ({change[i]:.0f} LSB, {trim[i]:.0f} asked)"
        for i in np.flatnonzero(is_off)
    )
    if axes:
        what = f"the {sensor}'s scale is off: {axes}, {low:g} to {high:g} allowed"
        return SelfTest(sensor, False, what, measured, "vislam calibrate imu")
    what = f"the {sensor} responds with {' '.join(f'{r:.2f}' for r in ratio)} of its trim ({low:g} to {high:g})"
    return SelfTest(sensor, True, what, measured)


def decoded(data: bytes) -> RawSamples:
    """Return the samples in bytes of a FIFO: accelerometer, then gyro, x, y, z each, the high byte first."""
    if not data:
        return NO_SAMPLES
    counts = np.frombuffer(data, dtype=">i2").reshape(-1, 6).astype(np.float64)
    return RawSamples(counts[:, 3:], counts[:, :3])
