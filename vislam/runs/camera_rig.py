"""The rig of a camera that knows its own calibration: from a file that the user names, or else from the device."""

from pathlib import Path

from vislam.config import SensorsConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.datasets.camera_files import read_cameras
from vislam.hw.library_cameras import factory_rig, frame_config, has_depth


def rig_of(
    name: str, sensors: SensorsConfig, calibration: str | None, with_imu: bool = False
) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig of a camera that gives frames, and what is guessed in it.

    Args:
        name: as a command line has it, such as `realsense,depth`.
        sensors: settings, with the camera's place on the body.
        calibration: file of all its cameras; None: its maker's calibration, read from the device.
        with_imu: the IMU is its own.

    Raises:
        UsageError: the file is of another size, or of another number of cameras.
        DataError: the file, or the calibration in the device, cannot be used.
        HardwareError: the device or its package is missing.
    """
    config = frame_config(name, sensors)
    if calibration is None:
        return factory_rig(name, sensors, with_imu)
    found, count = read_cameras(Path(calibration)), 1 if has_depth(name) else 2
    if len(found) != count:
        raise UsageError(f"{calibration} has {len(found)} cameras, {name} has {count}; calibrate all of them together")
    poses = [camera.T_body_cam for camera in found if camera.T_body_cam is not None]
    if len(poses) < count:
        raise DataError(
            f"{calibration} does not say where each camera is on the body (T_cam_imu, T_BS); add it, "
            "or run `vislam calibrate camera-imu`"
        )
    for camera in (one.camera for one in found):
        if (camera.width, camera.height) != (config.width_px, config.height_px):
            raise UsageError(
                f"{calibration} is for {camera.width}x{camera.height}, {name} is asked for {config.width_px}x"
                f"{config.height_px}; calibrate at the size that is used, or set the camera's width-px and height-px"
            )
    return Rig(tuple(one.camera for one in found), tuple(poses), has_depth(name)), ()
