"""A whole virtual GY-85."""

from dataclasses import replace
from typing import Literal

import numpy as np

from vislam.config import SensorCalibration
from vislam.hw.emulator.bus import EmulatedBus
from vislam.hw.emulator.chips import Chip, NowNs, VirtualAdxl345, VirtualItg3205
from vislam.hw.emulator.magnetometers import VirtualHmc5883l, VirtualQmc5883
from vislam.hw.emulator.sensing import SensorError, Truth
from vislam.hw.emulator.stepped_clock import SteppedClock

MagnetometerKind = Literal["HMC5883L", "DA5883", "QMC5883L", "QMC5883P", "none"]
Grade = Literal["exact", "calibrated", "raw"]
_DEG = np.pi / 180.0
_GYRO_DENSITY = 0.03 * _DEG  # rad/s/sqrt(Hz), ITG3205 data sheet
_ACCEL_DENSITY = 9.80665 / 256.0 / np.sqrt(50.0) * np.array([0.75, 0.75, 1.1])  # data sheet: LSB rms at 100 Hz
_MAG_DENSITY = 0.2 / np.sqrt(37.5)  # uT/sqrt(Hz): 2 mGa per measurement
_ALIKE = SensorCalibration()
_ADDRESSES = {"HMC5883L": 0x1E, "DA5883": 0x1E, "QMC5883L": 0x0D, "QMC5883P": 0x2C}


def emulated_gy85(
    truth: Truth,
    now_ns: NowNs,
    seed: int = 0,
    grade: Grade = "calibrated",
    magnetometer: MagnetometerKind = "HMC5883L",
    axes: SensorCalibration = _ALIKE,
    rate_error: float = 0.0,
    path: str = "/dev/i2c-emulated",
    smbus_only: bool = False,
    one_read: bool = False,
    stepped: SteppedClock | None = None,
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
        path: of the device file.
        smbus_only: an adapter that has no combined messages.
        one_read: an adapter that takes one read per call, as a Raspberry Pi's.
        stepped: a clock that transfers move on.
    """
    gyro, accel, mag = gy85_errors(seed, grade, axes)
    chips: dict[int, Chip] = {
        0x53: VirtualAdxl345(truth, now_ns, replace(accel, rate_error=rate_error), seed + 1),
        0x68: VirtualItg3205(truth, now_ns, replace(gyro, rate_error=rate_error), seed + 2),
    }
    mag = replace(mag, rate_error=rate_error)
    if magnetometer in ("HMC5883L", "DA5883"):
        chips[0x1E] = VirtualHmc5883l(truth, now_ns, mag, seed + 3, status_works=magnetometer == "HMC5883L")
    elif magnetometer != "none":
        chips[_ADDRESSES[magnetometer]] = VirtualQmc5883(truth, now_ns, mag, seed + 3, magnetometer[-1])
    return EmulatedBus(chips, path, smbus_only, one_read, stepped)


def gy85_errors(
    seed: int, grade: Grade = "calibrated", axes: SensorCalibration = _ALIKE
) -> tuple[SensorError, SensorError, SensorError]:
    """Return the errors of gyro, accelerometer and magnetometer of one board.

    Grade "exact" has quantisation only; "calibrated" what is left after a hand calibration (0.3 deg/s, 0.03 m/s^2) and
    the noise of the data sheets; "raw" a board out of the box (5 deg/s, 1 m/s^2, 3 %, 1 deg).
    """
    rng = np.random.default_rng(seed)
    if grade == "exact":
        return SensorError(axes.gyro_axes), SensorError(axes.accel_axes), SensorError(axes.mag_axes)
    raw = grade == "raw"
    bx, by, bz = _ACCEL_DENSITY.tolist()
    gyro = SensorError.drawn(
        rng, (5.0 if raw else 0.3) * _DEG, 0.03 if raw else 0.002, 0.017 if raw else 5e-4, (_GYRO_DENSITY,) * 3,
        walk=2e-5, bias_per_c=0.05 * _DEG, axes=axes.gyro_axes,
    )  # fmt: skip
    accel = SensorError.drawn(
        rng, 1.0 if raw else 0.03, 0.03 if raw else 0.002, 0.017 if raw else 5e-4, (bx, by, bz),
        walk=2e-4, bias_per_c=2e-3, axes=axes.accel_axes,
    )  # fmt: skip
    mag = SensorError.drawn(
        rng, 20.0 if raw else 0.5, 0.05 if raw else 0.005, 0.03 if raw else 0.002, (_MAG_DENSITY,) * 3,
        axes=axes.mag_axes,
    )  # fmt: skip
    return gyro, accel, mag
