"""Cameras behind their makers' libraries, by the names that a command line gives them: `picam`, `picam:1`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vislam.config import PicamConfig, SensorsConfig

if TYPE_CHECKING:  # they load OpenCV, which the process that reads the IMU does without
    from vislam.hw.cameras.library_camera import LibraryCamera
    from vislam.hw.source import CapturedImage

KINDS = ("picam",)


def is_library_camera(name: str) -> bool:
    """Return whether a camera's name is that of one behind a library."""
    return name.partition(":")[0] in KINDS


def open_library_camera(name: str, config: SensorsConfig, must_be_there: bool = True) -> LibraryCamera[CapturedImage]:
    """Open a camera that gives single images.

    Raises HardwareError when its package is not installed or, where it must be there, the camera is missing.
    """
    from vislam.hw.cameras.picam import open_picam

    return open_picam(_picam(name, config), must_be_there)


def check_library_camera(name: str, config: SensorsConfig) -> None:
    """Raise HardwareError when a camera's package is not installed or the camera is missing; nothing is started."""
    from vislam.hw.cameras.picam import check_picam

    check_picam(_picam(name, config))


def _picam(name: str, config: SensorsConfig) -> PicamConfig:
    where = name.partition(":")[2]
    return replace(config.picam, device=where) if where else config.picam
