"""The BMI270 of Bosch: needs a configuration at every start, then a FIFO of frames without headers.

Registers and the order of the start by the data sheet BST-BMI270-DS000 (sections 4.4, 4.6, 4.8 and 5.2), compared with
ArduPilot's and Bosch's own drivers. The configuration is Bosch's, under the BSD licence of its driver; it is not part
of vislam: the user names its file.
"""

import re
from pathlib import Path

import numpy as np

from vislam.core.errors import HardwareError
from vislam.hw.chips.bus import MAX_READS, I2cBus
from vislam.hw.chips.fifo_imu import G_M_S2, NO_SAMPLES, FifoImu, ImuSetup, RawSamples, Waiting, next_of
from vislam.hw.timing import Clock

ADDRESSES = (0x68, 0x69)
ID_REGISTER = 0x00
IDS = {0x24: "BMI270"}
FRAME_BYTES, FIFO_BYTES = 12, 2048

_INT_STATUS_1, _INTERNAL_STATUS, _TEMPERATURE, _FIFO_LENGTH, _FIFO_DATA = 0x1D, 0x21, 0x22, 0x24, 0x26
_ACC_CONF, _FIFO_CONFIG_0, _INIT_CTRL, _INIT_ADDR, _INIT_DATA = 0x40, 0x48, 0x59, 0x5B, 0x5E
_FEATURE_PAGE, _CAS, _SMALL_CAS = 0x2F, 0x3C, 0x1E  # of gyro x to z: in page 0, and of bmi270_maximum_fifo
_PWR_CONF, _PWR_CTRL, _CMD = 0x7C, 0x7D, 0x7E
_RATES = {25: 0x06, 50: 0x07, 100: 0x08, 200: 0x09, 400: 0x0A, 800: 0x0B}
_GYRO_RANGES = {250: 3, 500: 2, 1000: 1, 2000: 0}
_ACCEL_RANGES = {2: 0, 4: 1, 8: 2, 16: 3}
_ACCEL_NORMAL, _GYRO_NORMAL = 0xA0, 0xE0  # filters of normal width, low noise
_SOFT_RESET, _FLUSH = 0xB6, 0xB0
_WITHOUT_HEADERS, _ALL_ON, _FULL, _STARTED = 0xC0, 0x0E, 0x01, 0x01
_RESET_S, _WAKE_S, _START_S, _START_ASKED = 0.002, 0.0005, 0.01, 15
_CHUNK = 32  # bytes in one message: as much as adapters without combined messages take
_SMALL_BYTES = 1024  # bmi270_maximum_fifo has 328, the configurations with features 8192
_MOST_FILE_BYTES, _MOST_BYTES = 1 << 20, 8192
_ARRAY = re.compile(r"config_file\[\w*\]\s*=\s*\{([^}]*)\}")
_HELP = "Bosch's driver on GitHub (BMI270_SensorAPI) has it: name bmi270_maximum_fifo.c or bmi270.c in board.firmware"


class Bmi270(FifoImu):
    """One chip, filters of about 0.4 of the rate in both sensors.

    Their delays are those of second-order filters of such a width (0.225 periods): no delay is taken from the data
    sheet.
    """

    max_zero_deg_s = 1.0

    def __init__(self, bus: I2cBus, setup: ImuSetup, address: int = ADDRESSES[0]) -> None:
        """Take settings; nothing is sent yet. Raises HardwareError for a configuration that cannot be read."""
        super().__init__(bus, address, IDS[0x24])
        rate = next_of(setup.rate_hz, _RATES)
        gyro, accel = next_of(setup.gyro_range_deg_s, _GYRO_RANGES), next_of(setup.accel_range_g, _ACCEL_RANGES)
        self.rate_hz = float(rate)
        self.gyro_rad_s = float(np.deg2rad(gyro / 32768.0))
        self.accel_m_s2 = accel / 32768.0 * G_M_S2
        self.gyro_delay_s = self.accel_delay_s = 0.225 / (0.4 * rate)
        self._kept = bytes(
            (_ACCEL_NORMAL | _RATES[rate], _ACCEL_RANGES[accel], _GYRO_NORMAL | _RATES[rate], _GYRO_RANGES[gyro])
        )
        self._configuration = configuration(setup.firmware)
        self._count = bus.prepare([(address, _INT_STATUS_1, 1), (address, _FIFO_LENGTH, 2)])
        self._pops = bus.prepare([(address, _FIFO_DATA, FRAME_BYTES)] * MAX_READS)
        self._watch = bus.prepare([(address, _ACC_CONF, 4), (address, _TEMPERATURE, 2)])
        self._cross = 0.0  # of the rate about z that shows in that about x

    def configure(self, clock: Clock) -> None:
        """Reset the chip, send its configuration, set it up, start it with an empty FIFO: 0.3 s at most at 400 kHz.

        Raises BusError, HardwareError.
        """
        self._identified(ID_REGISTER, IDS)
        self._write(_CMD, _SOFT_RESET)
        clock.sleep_until(clock.now_ns() + round(_RESET_S * 1e9))
        self._write(_PWR_CONF, 0)
        clock.sleep_until(clock.now_ns() + round(_WAKE_S * 1e9))
        self._send()
        for _ in range(_START_ASKED):
            clock.sleep_until(clock.now_ns() + round(_START_S * 1e9))
            status = self._read(_INTERNAL_STATUS)[0] & 0x0F
            if status == _STARTED:
                break
        else:
            raise HardwareError(
                f"{self._bus.path}: the {self.name} does not take its configuration (status {status}); {_HELP}"
            )
        self._cross = self._read_cross()
        self._write(_ACC_CONF, *self._kept)
        self._write(_FIFO_CONFIG_0, 0, _WITHOUT_HEADERS)  # the oldest frames are overwritten
        self._write(_PWR_CTRL, _ALL_ON)
        self.empty()

    def _read_cross(self) -> float:
        """Return the chip's factor_zx, seven bits with sign of 2**-9, as Bosch's driver finds it."""
        is_small = len(self._configuration) <= _SMALL_BYTES
        if not is_small:
            self._write(_FEATURE_PAGE, 0)
        found = self._read(_SMALL_CAS if is_small else _CAS)[0] & 0x7F
        return (found - 128 if found & 0x40 else found) / 512.0

    def _send(self) -> None:
        self._write(_INIT_CTRL, 0)
        for first in range(0, len(self._configuration), _CHUNK):
            word = first // 2
            self._bus.write_block(self.address, _INIT_ADDR, bytes((word & 0x0F, word >> 4)))
            self._bus.write_block(self.address, _INIT_DATA, self._configuration[first : first + _CHUNK])
        self._write(_INIT_CTRL, 1)

    def waiting(self) -> Waiting:
        """Return how many frames wait, see `FifoImu`."""
        status, low, high = self._count.run()
        return self._whole((high & 0x3F) << 8 | low, bool(status & _FULL), FIFO_BYTES, FRAME_BYTES)

    def take(self, units: int) -> RawSamples:
        """Take `units` frames, each the gyro and then the accelerometer; raises BusError: then `empty` it."""
        data = self._popped(units)
        if not data:
            return NO_SAMPLES
        counts = np.frombuffer(data, dtype="<i2").reshape(-1, 6).astype(np.float64)
        gyro = counts[:, :3] - self._cross * counts[:, 2:3] * np.array([1.0, 0.0, 0.0])
        return RawSamples(gyro, counts[:, 3:])

    def empty(self) -> None:
        """Throw away what the FIFO holds; raises BusError."""
        self._write(_CMD, _FLUSH)

    def _celsius(self, data: bytes) -> float:
        return 23.0 + int.from_bytes(data, "little", signed=True) / 512.0


def configuration(file: str | None) -> bytes:
    """Return the configuration in a file: its bytes, or the array of them in a C file of Bosch's driver.

    Raises HardwareError where there is none.
    """
    if file is None:
        raise HardwareError(f"a BMI270 needs its configuration file; {_HELP}")
    try:
        with Path(file).open("rb") as stream:
            data = stream.read(_MOST_FILE_BYTES)
    except OSError as error:
        raise HardwareError(f"{file}: {error.strerror}; {_HELP}") from error
    if file.endswith((".c", ".h")):
        match = _ARRAY.search(data.decode("ascii", errors="replace"))
        words = re.findall(r"0[xX][0-9a-fA-F]{1,2}\b", match[1]) if match else []
        data = bytes(int(word, 16) for word in words)
    if not 0 < len(data) <= _MOST_BYTES or len(data) % 2:
        raise HardwareError(f"{file} holds {len(data)} bytes of configuration, 2 to {_MOST_BYTES} are needed; {_HELP}")
    return data
