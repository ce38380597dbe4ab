"""Cameras behind their makers' libraries, as a command line names them: `picam:1`, `realsense,depth`, `oak`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vislam.config import DepthCameraConfig, OakConfig, PicamConfig, RealsenseConfig, SensorsConfig
from vislam.core.errors import UsageError

if TYPE_CHECKING:  # they load OpenCV, which the process that reads the IMU does without
    from vislam.core.camera import Rig
    from vislam.core.messages import Frame
    from vislam.hw.cameras.library_camera import LibraryCamera
    from vislam.hw.source import CapturedImage

KINDS = ("picam", "realsense", "oak")
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
    if kind == "oak" and options:
        raise UsageError(f"'{name}' is no camera; an OAK gives its stereo pair: write oak")
    if options not in ([], [_DEPTH]):
        raise UsageError(
            f"'{name}' is no camera; write {kind} for the stereo pair, {kind},{_DEPTH} for colour and depth"
        )
    return bool(options)


def open_image_camera(name: str, config: SensorsConfig, must_be_there: bool = True) -> LibraryCamera[CapturedImage]:
    """Open a camera that gives single images.

    Raises HardwareError when its package is not installed or, where it must be there, the camera is missing.
    """
    from vislam.hw.cameras.picam import open_picam

    return open_picam(_picam(name, config), must_be_there)


def open_frame_camera(name: str, config: SensorsConfig, must_be_there: bool = True) -> LibraryCamera[Frame]:
    """Open a camera that gives frames; raises as `open_image_camera` does, and UsageError for a wrong option."""
    with_depth = has_depth(name)
    if _kind(name) == "oak":
        from vislam.hw.cameras.oak import open_oak

        return open_oak(_oak(name, config), must_be_there)
    from vislam.hw.cameras.realsense import open_realsense

    return open_realsense(_realsense(name, config), with_depth, must_be_there)


def factory_rig(name: str, config: SensorsConfig) -> Rig:
    """Return the rig of a camera that gives frames, by the calibration in the device.

    Raises HardwareError when it or its package is missing, DataError when its calibration cannot be used.
    """
    with_depth = has_depth(name)
    if _kind(name) == "oak":
        from vislam.hw.cameras.oak import oak_rig

        return oak_rig(_oak(name, config))
    from vislam.hw.cameras.realsense import realsense_rig

    return realsense_rig(_realsense(name, config), with_depth)


def frame_config(name: str, config: SensorsConfig) -> DepthCameraConfig:
    """Return the settings of a camera that gives frames, with what its name says."""
    return _oak(name, config) if _kind(name) == "oak" else _realsense(name, config)


def check_library_camera(name: str, config: SensorsConfig) -> None:
    """Raise HardwareError when a camera's package is not installed or the camera is missing; nothing is started."""
    if _kind(name) == "oak":
        from vislam.hw.cameras.oak import check_oak

        check_oak(_oak(name, config))
        return
    if gives_frames(name):
        factory_rig(name, config)
        return
    from vislam.hw.cameras.picam import check_picam

    check_picam(_picam(name, config))


def _kind(name: str) -> str:
    return name.partition(",")[0].partition(":")[0]


def _device(name: str) -> str:
    return name.partition(",")[0].partition(":")[2]


def _picam(name: str, config: SensorsConfig) -> PicamConfig:
    return replace(config.picam, device=_device(name) or config.picam.device)


def _realsense(name: str, config: SensorsConfig) -> RealsenseConfig:
    return replace(config.realsense, device=_device(name) or config.realsense.device)


def _oak(name: str, config: SensorsConfig) -> OakConfig:
    return replace(config.oak, device=_device(name) or config.oak.device)
