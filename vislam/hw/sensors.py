"""The sensors that a command line names: `gy85`, `board`, `serial:PORT`, a camera's index or path, a video file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vislam.config import ImuChip, SensorCalibration, SensorsConfig
from vislam.core.errors import HardwareError, UsageError
from vislam.hw.library_cameras import (
    WITH_IMU,
    check_library_camera,
    frame_config,
    is_library_camera,
    open_image_camera,
    reads_own_imu,
)
from vislam.hw.link import BUS_TIMEOUT_S

if TYPE_CHECKING:
    import socket

    from vislam.hw.cameras.library_camera import LibraryCamera
    from vislam.hw.cameras.video import VideoCamera
    from vislam.hw.imu_source import InertialSource
    from vislam.hw.source import CapturedImage

# chips with a FIFO as a command line names them, and the family of each as the settings do; board: whichever answers
CHIPS: dict[str, ImuChip | None] = {
    "board": None, "lsm6dsox": "lsm6dsox", "lsm6dso": "lsm6dsox", "ism330dhcx": "lsm6dsox",
    "mpu6050": "mpu6050", "mpu6500": "mpu6050", "mpu9250": "mpu6050", "icm20948": "icm20948", "bmi270": "bmi270",
    "mpu6050-clone": "mpu6050", "lsm6dso32": "lsm6dsox",
}  # fmt: skip
INERTIAL_KINDS = ("gy85", *CHIPS, "bno085", "adafruit", "iio", "serial", *WITH_IMU)


def open_inertial(name: str, config: SensorsConfig, further: socket.socket | None = None) -> InertialSource:
    """Open what a name gives; the rest is in the settings.

    `gy85[:BUS]`, `board[:BUS]` or a chip in its place, `bno085`, `adafruit:MODULE.CLASS`, `iio[:NAME]` for a chip that
    the kernel drives, `serial[:PORT]`.

    What a serial bridge sends of further sensors goes to `further`.

    Raises:
        UsageError: there is no such kind of sensor.
        HardwareError: the sensor is missing.
    """
    kind, _, where = name.partition(":")
    if kind in CHIPS:
        from vislam.hw.fifo_board import FifoBoard

        board = _placed(config.board, bus=where, chip=CHIPS[kind])
        return FifoBoard(board, named=kind)
    if kind in ("bno085", "adafruit"):
        from vislam.hw.adafruit import BNO085, open_adafruit

        return open_adafruit(BNO085 if kind == "bno085" else where, config.board)
    if kind == "iio":
        from vislam.hw.iio_imu import IioImu

        return IioImu(config.board, where)
    if kind == "gy85":
        from vislam.hw.gy85 import Gy85

        return Gy85(_placed(config.gy85, bus=where))
    if kind == "serial":
        from vislam.hw.bridge.bridge import SerialBridge

        return SerialBridge(_placed(config.serial, port=where), further=further)
    reads_own_imu(name, "none")  # raises: its camera has to be opened with it
    raise UsageError(
        f"no IMU called '{name}'; there are: {', '.join(INERTIAL_KINDS)}, with a place such as gy85:/dev/i2c-1, "
        "serial:/dev/ttyUSB0, iio:lsm6dsox, adafruit:adafruit_lsm6ds.lsm6dsox.LSM6DSOX"
    )


def _placed(section: Any, **by_name: str | None) -> Any:
    """Return the settings of a sensor with what its name sets."""
    return replace(section, **{field: value for field, value in by_name.items() if value})


def rate_of(name: str, config: SensorsConfig) -> float:
    """Return the samples per second that are asked of an inertial sensor."""
    if name.partition(":")[0] in WITH_IMU:
        return frame_config(name, config).imu_rate_hz
    return config.board.rate_hz if _is_board(name) else config.gy85.rate_hz


def _is_board(name: str) -> bool:
    """Return whether a sensor's settings are those of `board`."""
    return name.partition(":")[0] not in ("gy85", "serial", *WITH_IMU)


def open_camera(
    name: str, config: SensorsConfig, stamps_ns: Sequence[int] | None = None, in_real_time: bool = True
) -> VideoCamera | LibraryCamera[CapturedImage]:
    """Open a camera by its index or device file, `webcam` as in the settings, `picam`, or a video in its place.

    Raises HardwareError when it is missing.
    """
    if is_library_camera(name):
        return open_image_camera(name, config)
    if is_video(name):
        from vislam.hw.cameras.video import VideoCamera

        return VideoCamera(Path(name), stamps_ns, in_real_time)
    from vislam.hw.cameras.webcam import Webcam

    return Webcam(config.webcam if name == "webcam" else replace(config.webcam, device=name))


def check_devices(inertial: str, camera: str, config: SensorsConfig) -> None:
    """Look for the device files of an IMU and a camera (`none`: there is none); nothing is set up.

    Raises HardwareError where one is missing or may not be opened.
    """
    kind, _, where = inertial.partition(":")
    reads_own_imu(inertial, camera)
    if kind == "gy85" or kind in CHIPS:
        from vislam.hw.chips import I2cBus

        board = config.gy85 if kind == "gy85" else config.board
        I2cBus(where or board.bus, BUS_TIMEOUT_S).close()
    elif kind in ("bno085", "adafruit"):
        from vislam.hw.adafruit import BNO085, check_driver

        check_driver(BNO085 if kind == "bno085" else where)
    elif kind == "iio":
        from vislam.hw.iio_imu import find_devices

        find_devices(Path("/"), where)
    elif kind == "serial":
        from vislam.hw.serial_port import check_port

        check_port(where or config.serial.port, config.serial.baud)
    if is_library_camera(camera):
        check_library_camera(camera, config)
    elif camera != "none" and not is_video(camera):
        from vislam.hw.cameras.webcam import device_path, why_not_there

        problem = why_not_there(device_path(config.webcam.device if camera == "webcam" else camera))
        if problem is not None:
            raise HardwareError(problem)


def is_video(name: str) -> bool:
    """Return whether a camera's name is that of a video file."""
    return not name.startswith("/dev/") and not is_library_camera(name) and Path(name).suffix != ""


def with_raw_samples(config: SensorsConfig) -> SensorsConfig:
    """Return the settings with which sensors give raw samples: turned into body axes and nothing else."""
    raw = {}
    for section in ("gy85", "serial", "board", "realsense", "oak"):
        c = getattr(config, section).calibration
        turned = SensorCalibration(gyro_axes=c.gyro_axes, accel_axes=c.accel_axes, mag_axes=c.mag_axes)
        raw[section] = replace(getattr(config, section), calibration=turned)
    return replace(config, **raw)


def calibration_of(name: str, config: SensorsConfig) -> SensorCalibration:
    """Return the calibration in the settings of an inertial sensor."""
    found: SensorCalibration = getattr(config, _section(name)).calibration
    return found


def with_calibration(name: str, config: SensorsConfig, calibration: SensorCalibration) -> SensorsConfig:
    """Return the settings with another calibration of an inertial sensor."""
    section = _section(name)
    return replace(config, **{section: replace(getattr(config, section), calibration=calibration)})


def _section(name: str) -> str:
    """Return which settings of `SensorsConfig` are those of an inertial sensor."""
    kind = name.partition(":")[0]
    if kind in ("serial", *WITH_IMU):
        return kind
    return "board" if _is_board(name) and name != "none" else "gy85"
