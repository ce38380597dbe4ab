"""Cameras behind their makers' libraries, as a command line names them: `picam:1`, `realsense,depth`, `oak`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vislam.config import DepthCameraConfig, SensorsConfig
from vislam.core.errors import HardwareError, UsageError

if TYPE_CHECKING:  # they load OpenCV, which the process that reads the IMU does without
    from vislam.core.camera import Rig
    from vislam.core.messages import Frame
    from vislam.hw.cameras.library_camera import LibraryCamera
    from vislam.hw.own_imu import OwnImu
    from vislam.hw.source import CapturedImage

KINDS = ("picam", "realsense", "oak")
WITH_IMU = ("realsense", "oak")  # those that carry an IMU of their own
_DEPTH = "depth"  # the option by which colour and aligned depth are asked for, in place of the stereo pair


def is_library_camera(name: str) -> bool:
    """Return whether a camera's name is that of one behind a library."""
    return _kind(name) in KINDS


def gives_frames(name: str) -> bool:
    """Return whether a camera is a rig: a stereo pair, or colour with depth, with its maker's calibration."""
    return is_library_camera(name) and _kind(name) != "picam"


def has_depth(name: str) -> bool:
    """Return whether depth is asked for; raises UsageError for an option that there is not."""
    options = name.split(",")[1:]
    kind = _kind(name)
    if options not in ([], [_DEPTH]):
        raise UsageError(
            f"'{name}' is no camera; write {kind} for the stereo pair, {kind},{_DEPTH} for colour and depth"
        )
    return bool(options)


def open_image_camera(name: str, config: SensorsConfig) -> LibraryCamera[CapturedImage]:
    """Open a camera that gives single images.

    Raises HardwareError when its package is not installed or the camera is missing.
    """
    from vislam.hw.cameras.library_camera import LibraryCamera
    from vislam.hw.cameras.picam import PicamStream, camera_number, picamera2

    settings = _settings(name, config)
    picamera2()
    return LibraryCamera(f"picam:{camera_number(settings)}", lambda: PicamStream(settings), settings)


def open_frame_camera(name: str, config: SensorsConfig, imu: OwnImu | None = None) -> LibraryCamera[Frame]:
    """Open a camera that gives frames; what its own IMU measures goes to `imu`, where that is given.

    Raises as `open_image_camera` does, and UsageError for a wrong option.
    """
    from vislam.hw.cameras.library_camera import LibraryCamera

    with_depth, kind, settings = has_depth(name), _kind(name), _settings(name, config)
    shown = f"{kind},{_DEPTH}" if with_depth else kind
    if kind == "oak":
        from vislam.hw.cameras.oak import OakStream, depthai

        depthai()
        return LibraryCamera(shown, lambda: OakStream(settings, with_depth, imu), settings)
    from vislam.hw.cameras.realsense import RealsenseStream, pyrealsense2

    pyrealsense2()
    return LibraryCamera(shown, lambda: RealsenseStream(settings, with_depth, imu), settings)


def reads_own_imu(inertial: str, camera: str) -> bool:
    """Return whether an IMU is the one inside a camera; raises UsageError where that camera is not the one beside it.

    A device can be opened once only, so its IMU and its images are read together.
    """
    kind = _kind(inertial)
    if kind not in WITH_IMU:
        return False
    if "," in inertial:
        raise UsageError(f"'{inertial}' is no IMU; write {kind} for it, and {camera} for the camera")
    if _kind(camera) != kind or _device(inertial) not in ("", _device(camera)):
        raise UsageError(
            f"the IMU {inertial} is inside a camera and can be read together with that only; "
            f"ask for the camera {inertial} (or {inertial},{_DEPTH}) too, got {camera}"
        )
    return True


def open_with_imu(name: str, config: SensorsConfig) -> tuple[LibraryCamera[Frame], OwnImu]:
    """Open a camera and the IMU inside it, in this process; closing the camera gives both back.

    Raises HardwareError where either is missing, or its package is not installed.
    """
    from vislam.hw.own_imu import OwnImu

    settings = frame_config(name, config)
    imu = OwnImu(_kind(name), settings)
    camera = open_frame_camera(name, config, imu)
    if not imu.wait(settings.start_s):
        camera.close()
        raise HardwareError(
            f"the {_kind(name)} gives images, but its IMU no samples within {settings.start_s:g} s "
            f"({imu.counters()}); replug it, into a USB 3 port, and update its firmware"
        )
    return camera, imu


def factory_rig(name: str, config: SensorsConfig, with_imu: bool = False) -> tuple[Rig, tuple[str, ...]]:
    """Return the rig of a camera that gives frames, by the calibration in the device, and what is guessed in it.

    With its own IMU the body is there, as the device's extrinsics say.

    Raises HardwareError when it or its package is missing, DataError when its calibration cannot be used.
    """
    with_depth, kind, settings = has_depth(name), _kind(name), _settings(name, config)
    if kind == "oak":
        from vislam.hw.cameras.oak import oak_rig

        rig, is_known = oak_rig(settings, with_depth, with_imu)
    else:
        from vislam.hw.cameras.realsense import realsense_rig

        rig, is_known = realsense_rig(settings, with_depth, with_imu), with_imu
    if is_known or settings.position_m is not None:
        return rig, ()
    unknown = f", and {kind}.calibration with the axes of its IMU: it has no extrinsics in its memory" * with_imu
    return rig, (f"{kind}.position_m is not set{unknown}: the camera looks ahead from the IMU's place",)


def frame_config(name: str, config: SensorsConfig) -> DepthCameraConfig:
    """Return the settings of a camera that gives frames, with what its name sets."""
    found: DepthCameraConfig = _settings(name if _kind(name) in WITH_IMU else "realsense", config)
    return found


def check_library_camera(name: str, config: SensorsConfig) -> None:
    """Raise HardwareError when a camera's package is not installed or the camera is missing; nothing is started."""
    if _kind(name) == "oak":
        from vislam.hw.cameras.oak import check_oak

        check_oak(_settings(name, config))
        return
    if gives_frames(name):
        factory_rig(name, config)
        return
    from vislam.hw.cameras.picam import check_picam

    check_picam(_settings(name, config))


def _kind(name: str) -> str:
    return name.partition(",")[0].partition(":")[0]


def _device(name: str) -> str:
    return name.partition(",")[0].partition(":")[2]


def _settings(name: str, config: SensorsConfig) -> Any:
    """Return the settings of a camera's kind, with the device that its name gives."""
    of_kind = getattr(config, _kind(name))
    return replace(of_kind, device=_device(name) or of_kind.device)
