"""The kinds of calibration that `vislam calibrate` knows: one row each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vislam.calibration import options as o
from vislam.calibration.board import print_board
from vislam.calibration.camera import calibrate_camera
from vislam.calibration.camera_imu import calibrate_camera_imu
from vislam.calibration.floor import calibrate_floor
from vislam.calibration.imu import calibrate_imu
from vislam.calibration.mag import calibrate_mag
from vislam.calibration.noise import calibrate_noise
from vislam.calibration.outcome import Outcome


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of calibration."""

    options: type[Any]
    calibrate: Callable[[Any], Outcome]
    summary: str


KINDS = {
    "board": Kind(o.BoardFile, print_board, "draw a calibration board to print"),
    "camera": Kind(o.CameraOptions, calibrate_camera, "focal length, centre and distortion, from views of a board"),
    "camera-imu": Kind(
        o.CameraImuOptions, calibrate_camera_imu, "rotation of the camera against the IMU and offset of their clocks"
    ),
    "floor": Kind(o.FloorOptions, calibrate_floor, "tilt and height of a cart's camera, from a short drive"),
    "imu": Kind(o.ImuOptions, calibrate_imu, "scale, axes and bias of an IMU, from poses held by hand"),
    "mag": Kind(o.MagOptions, calibrate_mag, "hard and soft iron of a magnetometer, on the cart or by hand"),
    "noise": Kind(o.NoiseOptions, calibrate_noise, "white noise and bias walk of an IMU that stands still"),
}
