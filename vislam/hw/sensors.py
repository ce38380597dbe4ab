"""The sensors that a command line names: `gy85`, `serial:PORT`, a camera's index or path, a video file."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vislam.config import SensorCalibration, SensorsConfig
from vislam.core.errors import HardwareError, UsageError

if TYPE_CHECKING:
    from vislam.hw.bridge.bridge import SerialBridge
    from vislam.hw.cameras.video import VideoCamera
    from vislam.hw.cameras.webcam import Webcam
    from vislam.hw.gy85 import Gy85


def open_inertial(name: str, config: SensorsConfig, must_be_there: bool = True) -> Gy85 | SerialBridge:
    """Open `gy85[:BUS]` or `serial[:PORT]`; what is not named comes from the settings.

    Raises:
        UsageError: there is no such kind of sensor.
        HardwareError: the sensor is missing and must be there.
    """
    kind, _, where = name.partition(":")
    if kind == "gy85":
        from vislam.hw.gy85 import Gy85

        board = replace(config.gy85, bus=where) if where else config.gy85
        return Gy85(board, must_be_there=must_be_there)
    if kind == "serial":
        from vislam.hw.bridge.bridge import SerialBridge

        bridge = replace(config.serial, port=where) if where else config.serial
        return SerialBridge(bridge, must_be_there)
    raise UsageError(f"no IMU called '{name}'; there are: gy85, gy85:/dev/i2c-1, serial, serial:/dev/ttyUSB0")


def open_camera(
    name: str,
    config: SensorsConfig,
    must_be_there: bool = True,
    stamps_ns: Sequence[int] | None = None,
    in_real_time: bool = True,
) -> Webcam | VideoCamera:
    """Open a camera by its index or device file, `webcam` as in the settings, or a video in its place (`VideoCamera`).

    Raises HardwareError when it is missing and must be there.
    """
    if is_video(name):
        from vislam.hw.cameras.video import VideoCamera

        return VideoCamera(Path(name), stamps_ns, in_real_time)
    from vislam.hw.cameras.webcam import Webcam

    return Webcam(config.webcam if name == "webcam" else replace(config.webcam, device=name), must_be_there)


def check_devices(inertial: str, camera: str, config: SensorsConfig) -> None:
    """Look for the device files of an IMU and a camera (`none`: there is none); nothing is set up.

    Raises HardwareError where one is missing or may not be opened.
    """
    kind, _, where = inertial.partition(":")
    if kind == "gy85":
        from vislam.hw.chips import I2cBus

        I2cBus(where or config.gy85.bus, config.gy85.bus_timeout_s).close()
    elif kind == "serial":
        from vislam.hw.bridge.bridge import why_not_open

        bridge = replace(config.serial, port=where) if where else config.serial
        if not os.access(bridge.port, os.R_OK | os.W_OK):  # opening it would reset the board
            code = errno.EACCES if Path(bridge.port).exists() else errno.ENOENT
            raise HardwareError(why_not_open(bridge, OSError(code, os.strerror(code))))
    if camera != "none" and not is_video(camera):
        from vislam.hw.cameras.webcam import device_path, why_not_there

        problem = why_not_there(device_path(config.webcam.device if camera == "webcam" else camera))
        if problem is not None:
            raise HardwareError(problem)


def is_video(name: str) -> bool:
    """Return whether a camera's name is that of a video file."""
    return not name.startswith("/dev/") and Path(name).suffix != ""


def with_raw_samples(config: SensorsConfig) -> SensorsConfig:
    """Return the settings with which sensors give raw samples: turned into body axes and nothing else."""

    def raw(calibration: SensorCalibration) -> SensorCalibration:
        c = calibration
        return SensorCalibration(gyro_axes=c.gyro_axes, accel_axes=c.accel_axes, mag_axes=c.mag_axes)

    gy85 = replace(config.gy85, calibration=raw(config.gy85.calibration))
    serial = replace(config.serial, calibration=raw(config.serial.calibration))
    return replace(config, gy85=gy85, serial=serial)


def calibration_of(name: str, config: SensorsConfig) -> SensorCalibration:
    """Return the calibration in the settings of an inertial sensor."""
    return config.serial.calibration if name.startswith("serial") else config.gy85.calibration
