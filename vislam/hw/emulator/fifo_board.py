"""A whole virtual board whose inertial chip has a FIFO."""

from dataclasses import replace
from typing import Literal

import numpy as np

from vislam.config import SensorCalibration
from vislam.hw.emulator.bmi270 import VirtualBmi270
from vislam.hw.emulator.bus import EmulatedBus
from vislam.hw.emulator.chips import Chip, NowNs
from vislam.hw.emulator.icm20948 import VirtualIcm20948
from vislam.hw.emulator.lsm6dsox import VirtualLsm6dso32, VirtualLsm6dsox
from vislam.hw.emulator.magnetometers import VirtualAkm, VirtualLis3mdl, VirtualQmc5883
from vislam.hw.emulator.mpu6050 import VirtualMpu6050
from vislam.hw.emulator.sensing import IDEAL, SensorError, Truth
from vislam.hw.emulator.stepped_clock import SteppedClock

FifoKind = Literal["LSM6DSOX", "LSM6DSO32", "ISM330DHCX", "MPU-6050", "MPU-6500", "MPU-9250", "ICM-20948", "BMI270"]
BoardMagnetometer = Literal["inside", "LIS3MDL", "QMC5883P", "none"]
_DEG = np.pi / 180.0
_ALIKE = SensorCalibration()
_Kind = VirtualLsm6dsox | VirtualMpu6050 | VirtualIcm20948 | VirtualBmi270
# kind -> class, id, address, and noise densities of the data sheets: deg/s/sqrt(Hz), 1e-6 g/sqrt(Hz)
_KINDS: dict[str, tuple[type[_Kind], int, int, float, float]] = {
    "LSM6DSOX": (VirtualLsm6dsox, 0x6C, 0x6A, 0.0038, 110.0),
    "LSM6DSO32": (VirtualLsm6dso32, 0x6C, 0x6A, 0.0038, 110.0),
    "ISM330DHCX": (VirtualLsm6dsox, 0x6B, 0x6A, 0.005, 80.0),
    "MPU-6050": (VirtualMpu6050, 0x68, 0x68, 0.005, 400.0),
    "MPU-6500": (VirtualMpu6050, 0x70, 0x68, 0.01, 300.0),
    "MPU-9250": (VirtualMpu6050, 0x71, 0x68, 0.01, 300.0),
    "BMI270": (VirtualBmi270, 0x24, 0x68, 0.008, 160.0),
    "ICM-20948": (VirtualIcm20948, 0xEA, 0x69, 0.015, 230.0),
}
_INSIDE = {"MPU-9250": "AK8963", "ICM-20948": "AK09916"}
_MAG_DENSITY = 0.05  # uT/sqrt(Hz)


def emulated_board(
    kind: FifoKind,
    truth: Truth,
    now_ns: NowNs,
    seed: int = 0,
    grade: Literal["exact", "calibrated", "raw"] = "calibrated",
    magnetometer: BoardMagnetometer = "inside",
    axes: SensorCalibration = _ALIKE,
    rate_error: float = 0.0,
    address: int | None = None,
    path: str = "/dev/i2c-emulated",
    smbus_only: bool = False,
    one_read: bool = False,
    stepped: SteppedClock | None = None,
) -> EmulatedBus:
    """Return a bus with one inertial chip and a magnetometer; same seed, same board, same noise.

    Args:
        kind: of the chip.
        truth: the motion, see `sensing.Truth`.
        now_ns: the host's clock, `time.monotonic_ns` in real time.
        seed: of errors and noise.
        grade: "exact" has quantisation only; "calibrated" what is left after a hand calibration (0.3 deg/s, 0.03 m/s^2)
            and the noise of the data sheets; "raw" a board out of the box (3 deg/s, 0.5 m/s^2, 2 %, 1 deg).
        magnetometer: "inside": the one that is in the inertial chip, if any; or one beside it.
        axes: how the chips lie; their axes are used.
        rate_error: of the chip's own clock, relative.
        address: None: the chip's usual one.
        path: of the device file.
        smbus_only: an adapter that has no combined messages.
        one_read: an adapter that takes one read per call, as a Raspberry Pi's.
        stepped: a clock that transfers move on.
    """
    make, who_am_i, usual, gyro_density, accel_density = _KINDS[kind]
    rng = np.random.default_rng(seed)
    gyro, accel = replace(IDEAL, axes=axes.gyro_axes), replace(IDEAL, axes=axes.accel_axes)
    mag = replace(IDEAL, axes=axes.mag_axes)
    if grade != "exact":
        raw = grade == "raw"
        scale, skew = (0.02, 0.017) if raw else (0.002, 5e-4)
        gyro = SensorError.drawn(
            rng, (3.0 if raw else 0.3) * _DEG, scale, skew, (gyro_density * _DEG,) * 3,
            walk=2e-5, bias_per_c=0.02 * _DEG, axes=axes.gyro_axes,
        )  # fmt: skip
        accel = SensorError.drawn(
            rng, 0.5 if raw else 0.03, scale, skew, (accel_density * 9.80665e-6,) * 3,
            walk=2e-4, bias_per_c=1e-3, axes=axes.accel_axes,
        )  # fmt: skip
        mag = SensorError.drawn(rng, 20.0 if raw else 0.5, scale, skew, (_MAG_DENSITY,) * 3, axes=axes.mag_axes)
    chip = make(truth, now_ns, replace(gyro, rate_error=rate_error), accel, seed + 1, who_am_i)
    chips: dict[int, Chip] = {usual if address is None else address: chip}
    if magnetometer == "LIS3MDL":
        chips[0x1C] = VirtualLis3mdl(truth, now_ns, mag, seed + 3)
    elif magnetometer == "QMC5883P":
        chips[0x2C] = VirtualQmc5883(truth, now_ns, mag, seed + 3, "P")
    elif magnetometer == "inside" and isinstance(chip, VirtualMpu6050 | VirtualIcm20948) and kind in _INSIDE:
        chips[0x0C] = VirtualAkm(truth, now_ns, mag, seed + 3, _INSIDE[kind], chip)
    return EmulatedBus(chips, path, smbus_only, one_read, stepped)
