"""LSM6DSOX, LSM6DSO and ISM330DHCX of ST: one register map, a FIFO of tagged words of seven bytes.

Registers by the data sheets DS12814 (LSM6DSOX, sections 6 and 9) and DS13012 (ISM330DHCX), compared with ST's own
driver (lsm6dsox_reg.h) and the kernel's (st_lsm6dsx).
"""

from collections.abc import Iterator

import numpy as np

from vislam.core.errors import HardwareError
from vislam.core.messages import Array
from vislam.hw.chips.bus import MAX_READS, I2cBus
from vislam.hw.chips.fifo_imu import G_M_S2, NO_SAMPLES, FifoImu, ImuSetup, RawSamples, Waiting, next_of
from vislam.hw.timing import Clock

ADDRESSES = (0x6A, 0x6B)
ID_REGISTER = 0x0F
# an LSM6DSO has 0x6C, too, and is alike in all that is used here; so has an LSM6DSO32, with twice the range (DS13180)
IDS = {0x6C: "LSM6DSOX", 0x6B: "ISM330DHCX"}
TWIN = "lsm6dso32"

_FIFO_CTRL1, _FIFO_CTRL4, _CTRL1_XL, _CTRL3_C, _TEMPERATURE = 0x07, 0x0A, 0x10, 0x12, 0x20
_FIFO_STATUS1, _FREQ_FINE, _FIFO_TAG = 0x3A, 0x63, 0x78
_RATES = {13: 1, 26: 2, 52: 3, 104: 4, 208: 5, 417: 6, 833: 7}  # code of output and of batching
_NOMINAL_HZ = 6667.0  # of the oscillator; rates are its 512th, 256th ... 8th
_HALVINGS = {1: 512, 2: 256, 3: 128, 4: 64, 5: 32, 6: 16, 7: 8}
_GYRO_RANGES = {250: 0, 500: 1, 1000: 2, 2000: 3}
_GYRO_MDEG_S = {250: 8.75, 500: 17.5, 1000: 35.0, 2000: 70.0}
_ACCEL_RANGES = {2: 0, 4: 2, 8: 3, 16: 1}
_ACCEL_MG = {2: 0.061, 4: 0.122, 8: 0.244, 16: 0.488}
_RESET, _BLOCK_UPDATE, _INCREMENT = 0x01, 0x40, 0x04
_CONTINUOUS, _OVERRUN = 0x06, 0x08
_RESET_S, _RESET_ASKED = 0.001, 50
_FREQ_STEP = 0.0015
_SHARED_ID, _ISM330DHCX_ID = 0x6C, 0x6B
_CTRL9_XL, _DEVICE_CONF = 0x18, 0xE2  # with what it has after a reset
GYRO, ACCEL = 0x01, 0x02  # sensors as tags name them
WORD_BYTES, FIFO_WORDS = 7, 512


class Lsm6dsox(FifoImu):
    """One chip; both sensors in high-performance mode at one rate, which the chip's FREQ_FINE corrects.

    The gyro's second filter lets through a third of the rate, the accelerometer's half. Their delays are those of
    second-order filters of such widths (0.225 periods of the cut-off): ST's data sheets state none.
    """

    # start_up_s: the gyro's turn-on time is 35 ms, its filters settle then
    max_zero_deg_s = 10.0  # 1 typical over the life of a soldered chip; none is stated as the largest

    def __init__(self, bus: I2cBus, setup: ImuSetup, address: int = ADDRESSES[0]) -> None:
        """Take settings; nothing is sent yet."""
        super().__init__(bus, address, IDS[0x6C])
        self._code = _RATES[next_of(setup.rate_hz, _RATES)]
        self._is_twin = setup.named == TWIN
        twice = 2 if self._is_twin else 1
        gyro, accel = next_of(setup.gyro_range_deg_s, _GYRO_RANGES), next_of(setup.accel_range_g / twice, _ACCEL_RANGES)
        self.rate_hz = _NOMINAL_HZ / _HALVINGS[self._code]
        self.gyro_rad_s = float(np.deg2rad(1e-3 * _GYRO_MDEG_S[gyro]))
        self.accel_m_s2 = 1e-3 * twice * _ACCEL_MG[accel] * G_M_S2
        self.gyro_delay_s, self.accel_delay_s = 0.225 * 3.0 / self.rate_hz, 0.225 * 2.0 / self.rate_hz
        self._kept = bytes((self._code << 4 | _ACCEL_RANGES[accel] << 2, self._code << 4 | _GYRO_RANGES[gyro] << 2))
        self._count = bus.prepare([(address, _FIFO_STATUS1, 2)])
        self._pops = bus.prepare([(address, _FIFO_TAG, 2 * WORD_BYTES)] * MAX_READS)
        self._single = bus.prepare([(address, _FIFO_TAG, WORD_BYTES)])
        self._watch = bus.prepare([(address, _CTRL1_XL, 2), (address, _TEMPERATURE, 2)])
        self._half: dict[int, tuple[int, Array]] = {}  # by sensor: time slot and counts of a word without its other

    def configure(self, clock: Clock) -> None:
        """Reset the chip, set it up and start it with an empty FIFO; raises BusError, HardwareError."""
        self.name, found = self._identified(ID_REGISTER, IDS)
        if found == _SHARED_ID:
            self.name = TWIN.upper() if self._is_twin else self.name
            self.doubt = "an LSM6DSOX and an LSM6DSO32 have one id"
        elif self._is_twin:
            raise HardwareError(
                f"{self._bus.path}: an {TWIN.upper()} is asked for, the chip is an {self.name}; name that"
            )
        self._write(_CTRL3_C, _RESET)
        self._await_reset(clock, _CTRL3_C, _RESET, _RESET_S, _RESET_ASKED)
        error = self._read(_FREQ_FINE)[0]
        fine = error - 256 if error > 127 else error
        self.rate_hz = _NOMINAL_HZ * (1.0 + _FREQ_STEP * fine) / _HALVINGS[self._code]
        if found == _ISM330DHCX_ID:
            self._write(_CTRL9_XL, _DEVICE_CONF)  # "set to 1": DS13012, 9.19, and ST's examples
        self._write(_CTRL3_C, _BLOCK_UPDATE | _INCREMENT)
        self._write(_FIFO_CTRL1, 0, 0, self._code << 4 | self._code)  # no watermark; both are batched
        self._write(_CTRL1_XL, *self._kept)
        self.empty()

    def waiting(self) -> Waiting:
        """Return how many words wait; raises BusError."""
        low, high = self._count.run()
        units = (high & 0x03) << 8 | low
        return Waiting(min(units, FIFO_WORDS), bool(high & _OVERRUN))

    def take(self, units: int) -> RawSamples:
        """Take words and return the samples that are whole; raises BusError: then `empty` it."""
        data = self._popped(units // 2)
        if units % 2:
            data += self._single.run()
        both = list(self._paired(data))
        if not both:
            return NO_SAMPLES
        return RawSamples(np.array([gyro for gyro, _ in both]), np.array([accel for _, accel in both]))

    def empty(self) -> None:
        """Throw away what the FIFO holds; raises BusError."""
        self._write(_FIFO_CTRL4, 0)  # bypass empties it
        self._write(_FIFO_CTRL4, _CONTINUOUS)
        self._half = {}

    def _celsius(self, data: bytes) -> float:
        return 25.0 + int.from_bytes(data, "little", signed=True) / 256.0

    def _paired(self, data: bytes) -> Iterator[tuple[Array, Array]]:
        """Yield gyro and accelerometer counts [3] of one time slot each.

        The gyro begins later than the accelerometer, and words of other sensors are possible: a word without the
        other of its slot (a count of two bits in the tag) is left out.
        """
        for place in range(0, len(data) - WORD_BYTES + 1, WORD_BYTES):
            tag = data[place]
            sensor, slot = tag >> 3, tag >> 1 & 0x03
            if sensor not in (GYRO, ACCEL):
                continue
            self._half[sensor] = slot, np.frombuffer(data, "<i2", 3, place + 1).astype(np.float64)
            other = self._half.get(GYRO + ACCEL - sensor)
            if other is not None and other[0] == slot:
                yield self._half[GYRO][1], self._half[ACCEL][1]
                self._half = {}
