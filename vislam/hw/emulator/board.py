"""Whole virtual boards: a GY-85, and boards whose inertial chip has a FIFO."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from vislam.config import SensorCalibration
from vislam.hw.emulator.bmi270 import VirtualBmi270
from vislam.hw.emulator.bus import EmulatedBus
from vislam.hw.emulator.chips import Chip, NowNs, VirtualAdxl345, VirtualItg3205
from vislam.hw.emulator.icm20948 import VirtualIcm20948
from vislam.hw.emulator.lsm6dsox import VirtualLsm6dso32, VirtualLsm6dsox
from vislam.hw.emulator.magnetometers import VirtualAkm, VirtualHmc5883l, VirtualLis3mdl, VirtualQmc5883
from vislam.hw.emulator.mpu6050 import VirtualMpu6050
from vislam.hw.emulator.sensing import SensorError, Triple, Truth

MagnetometerKind = Literal["HMC5883L", "DA5883", "QMC5883L", "QMC5883P", "none"]
FifoKind = Literal["LSM6DSOX", "LSM6DSO32", "ISM330DHCX", "MPU-6050", "MPU-6500", "MPU-9250", "ICM-20948", "BMI270"]
BoardMagnetometer = Literal["inside", "LIS3MDL", "QMC5883P", "none"]
Grade = Literal["exact", "calibrated", "raw"]
_DEG, _G_M_S2 = np.pi / 180.0, 9.80665
_ALIKE = SensorCalibration()
_ADDRESSES = {"HMC5883L": 0x1E, "DA5883": 0x1E, "QMC5883L": 0x0D, "QMC5883P": 0x2C}


@dataclass(frozen=True, slots=True)
class _Errors:
    """Standard deviations of a board out of the box and, second, after a calibration by hand; noise per sqrt(Hz)."""

    gyro_density: Triple  # rad/s
    accel_density: Triple  # m/s^2
    mag_density: float  # uT
    gyro_bias_deg_s: tuple[float, float] = (3.0, 0.3)
    accel_bias_m_s2: tuple[float, float] = (0.5, 0.03)
    scale: tuple[float, float] = (0.02, 0.002)
    mag_scale: tuple[float, float] = (0.02, 0.002)
    mag_skew_rad: tuple[float, float] = (0.017, 5e-4)
    gyro_per_c: float = 0.02 * _DEG
    accel_per_c: float = 1e-3

    def drawn(
        self, seed: int, grade: Grade, axes: SensorCalibration, rate_error: float
    ) -> tuple[SensorError, SensorError, SensorError]:
        """Return the errors of gyro, accelerometer and magnetometer of one board."""
        by_axes = (axes.gyro_axes, axes.accel_axes, axes.mag_axes)
        if grade == "exact":
            gyro, accel, mag = (SensorError(one, rate_error=rate_error) for one in by_axes)
            return gyro, accel, mag
        rng, k = np.random.default_rng(seed), 0 if grade == "raw" else 1
        skew_rad = (0.017, 5e-4)[k]
        gyro = SensorError.drawn(
            rng, self.gyro_bias_deg_s[k] * _DEG, self.scale[k], skew_rad, self.gyro_density, 2e-5, self.gyro_per_c,
            by_axes[0], rate_error,
        )  # fmt: skip
        accel = SensorError.drawn(
            rng, self.accel_bias_m_s2[k], self.scale[k], skew_rad, self.accel_density, 2e-4, self.accel_per_c,
            by_axes[1], rate_error,
        )  # fmt: skip
        mag = SensorError.drawn(
            rng, (20.0, 0.5)[k], self.mag_scale[k], self.mag_skew_rad[k], (self.mag_density,) * 3, axes=by_axes[2],
            rate_error=rate_error,
        )  # fmt: skip
        return gyro, accel, mag


_GY85_XY, _GY85_Z = (_G_M_S2 / 256.0 / float(np.sqrt(50.0)) * share for share in (0.75, 1.1))  # LSB rms at 100 Hz
_GY85 = _Errors(
    (0.03 * _DEG,) * 3, (_GY85_XY, _GY85_XY, _GY85_Z), 0.2 / float(np.sqrt(37.5)),  # 2 mGa a measurement
    (5.0, 0.3), (1.0, 0.03), (0.03, 0.002), (0.05, 0.005), (0.03, 0.002), 0.05 * _DEG, 2e-3,
)  # fmt: skip
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


def emulated_gy85(
    truth: Truth,
    now_ns: NowNs,
    seed: int = 0,
    grade: Grade = "calibrated",
    magnetometer: MagnetometerKind = "HMC5883L",
    axes: SensorCalibration = _ALIKE,
    rate_error: float = 0.0,
    **of_bus: Any,
) -> EmulatedBus:
    """Return a bus with the three chips of one board; same seed, same board, same noise.

    Args:
        truth: the motion, see `sensing.Truth`; called about 900 times a second.
        now_ns: the host's clock, `time.monotonic_ns` in real time.
        seed: of errors and noise.
        grade: how good the board is, see `gy85_errors`.
        magnetometer: which of the chips that are sold as HMC5883L.
        axes: how the chips lie; its axes only are used.
        rate_error: of the chips' own clocks, relative; the data sheets allow 0.02.
        of_bus: see `EmulatedBus`.
    """
    gyro, accel, mag = _GY85.drawn(seed, grade, axes, rate_error)
    chips: dict[int, Chip] = {
        0x53: VirtualAdxl345(truth, now_ns, accel, seed + 1),
        0x68: VirtualItg3205(truth, now_ns, gyro, seed + 2),
    }
    if magnetometer in ("HMC5883L", "DA5883"):
        chips[0x1E] = VirtualHmc5883l(truth, now_ns, mag, seed + 3, status_works=magnetometer == "HMC5883L")
    elif magnetometer != "none":
        chips[_ADDRESSES[magnetometer]] = VirtualQmc5883(truth, now_ns, mag, seed + 3, magnetometer[-1])
    return EmulatedBus(chips, **of_bus)


def gy85_errors(
    seed: int, grade: Grade = "calibrated", axes: SensorCalibration = _ALIKE
) -> tuple[SensorError, SensorError, SensorError]:
    """Return the errors of gyro, accelerometer and magnetometer of one board.

    Grade "exact" has quantisation only; "calibrated" what is left after a hand calibration (0.3 deg/s, 0.03 m/s^2) and
    the noise of the data sheets; "raw" a board out of the box (5 deg/s, 1 m/s^2, 3 %, 1 deg).
    """
    return _GY85.drawn(seed, grade, axes, 0.0)


def emulated_board(
    kind: FifoKind,
    truth: Truth,
    now_ns: NowNs,
    seed: int = 0,
    grade: Grade = "calibrated",
    magnetometer: BoardMagnetometer = "inside",
    axes: SensorCalibration = _ALIKE,
    rate_error: float = 0.0,
    address: int | None = None,
    **of_bus: Any,
) -> EmulatedBus:
    """Return a bus with one inertial chip and a magnetometer; what is not named here is as in `emulated_gy85`.

    Args:
        kind: of the chip.
        truth: the motion.
        now_ns: the host's clock.
        seed: of errors and noise.
        grade: as in `gy85_errors`; "raw" has 3 deg/s, 0.5 m/s^2, 2 %, 1 deg.
        magnetometer: "inside": the one that is in the inertial chip, if any; or one beside it.
        axes: how the chips lie.
        rate_error: of the chip's own clock.
        address: None: the chip's usual one.
        of_bus: see `EmulatedBus`.
    """
    make, who_am_i, usual, gyro_density, accel_density = _KINDS[kind]
    errors = _Errors((gyro_density * _DEG,) * 3, (accel_density * 9.80665e-6,) * 3, 0.05)
    gyro, accel, mag = errors.drawn(seed, grade, axes, rate_error)
    mag = replace(mag, rate_error=0.0)
    chip = make(truth, now_ns, gyro, accel, seed + 1, who_am_i)
    chips: dict[int, Chip] = {usual if address is None else address: chip}
    if magnetometer == "LIS3MDL":
        chips[0x1C] = VirtualLis3mdl(truth, now_ns, mag, seed + 3)
    elif magnetometer == "QMC5883P":
        chips[0x2C] = VirtualQmc5883(truth, now_ns, mag, seed + 3, "P")
    elif magnetometer == "inside" and isinstance(chip, VirtualMpu6050 | VirtualIcm20948) and kind in _INSIDE:
        chips[0x0C] = VirtualAkm(truth, now_ns, mag, seed + 3, _INSIDE[kind], chip)
    return EmulatedBus(chips, **of_bus)
