"""The kinds of calibration that `vislam calibrate` knows: one row each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from vislam.calibration import options as o

if TYPE_CHECKING:
    from vislam.calibration.outcome import Outcome
    from vislam.calibration.watching import Watch


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of calibration."""

    options: type[Any]
    home: str  # of its function, below this package
    summary: str
    watched_by: str | None = None  # what does it step by step, if anything does

    @property
    def calibrate(self) -> Callable[[Any], Outcome]:
        """What does it, imported now: --help needs none of it."""
        return _loaded(self.home)

    @property
    def watch(self) -> type[Watch] | None:
        """What does it step by step, before a person; None: nothing does."""
        return None if self.watched_by is None else _loaded(self.watched_by)


def _loaded(home: str) -> Any:
    module, _, name = home.rpartition(".")
    return getattr(import_module(f"vislam.calibration.{module}"), name)


KINDS = {
    "board": Kind(o.BoardFile, "cameras.board.print_board", "draw a calibration board to print"),
    "camera": Kind(
        o.CameraOptions,
        "cameras.camera.calibrate_camera",
        "focal length, centre and distortion, from views of a board",
        "cameras.board_watch.BoardWatch",
    ),
    "camera-imu": Kind(
        o.CameraImuOptions,
        "extrinsics.camera_imu.calibrate_camera_imu",
        "rotation of the camera against the IMU and offset of their clocks",
    ),
    "floor": Kind(
        o.FloorOptions, "cameras.floor.calibrate_floor", "tilt and height of a cart's camera, from a short drive"
    ),
    "imu": Kind(
        o.ImuOptions,
        "inertial.imu.calibrate_imu",
        "scale, axes and bias of an IMU, from poses held by hand",
        "inertial.sample_watches.PoseWatch",
    ),
    "mag": Kind(
        o.MagOptions,
        "inertial.mag.calibrate_mag",
        "hard and soft iron of a magnetometer, on the cart or by hand",
        "inertial.sample_watches.TurnWatch",
    ),
    "noise": Kind(
        o.NoiseOptions,
        "inertial.noise.calibrate_noise",
        "white noise and bias walk of an IMU that stands still",
        "inertial.sample_watches.StillWatch",
    ),
    "rgbd": Kind(
        o.RgbdOptions,
        "cameras.rgbd.calibrate_rgbd",
        "place and lag of depth against colour, focal length, values that mean no depth",
    ),
    "self": Kind(
        o.SelfOptions,
        "self_calibration.waving.calibrate_self",
        "focal length, centre, distortion and readout without a board, from waving the camera about",
    ),
    "sensors": Kind(
        o.SensorsOptions,
        "extrinsics.run_sensors.calibrate_sensors",
        "wheel scales, track width, lever arms: what a run found of its further sensors",
    ),
}
