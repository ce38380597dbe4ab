"""A recording seen with the calibration files that the user names instead of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vislam.config import CalibrationConfig, Config
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.datasets.camera_files import read_cameras
from vislam.datasets.imu_files import read_imu_calibration, read_mag_calibration, read_noise
from vislam.datasets.stream import Survey

_OFFSET_WIDER = 3.0  # sigmas of a calibrated time offset that a later day may be off
_LEAST_OFFSET_SIGMA_S = 0.001


def calibrated(found: Survey, files: CalibrationConfig) -> Survey:
    """Return what a recording holds, with its calibration replaced where a file is named.

    Raises DataError when a file cannot be used, or has another number of cameras or another image size.
    """
    if files.camera is not None and found.rig is not None:
        found = replace(found, rig=_rig(found.rig, Path(files.camera)))
    if files.imu is not None:
        found = replace(found, imu_calibration=read_imu_calibration(Path(files.imu)))
    if files.imu_noise is not None and found.imu_noise is not None:
        noise = read_noise(Path(files.imu_noise))
        found = replace(found, imu_noise=replace(noise, rate_hz=found.imu_noise.rate_hz or noise.rate_hz))
    if files.mag is not None:
        found = replace(found, mag_calibration=read_mag_calibration(Path(files.mag)))
    return found


def with_clock(config: Config) -> Config:
    """Return the settings with the time offset that the camera's calibration file tells, unless they have their own."""
    if config.calibration.camera is None or config.init.time_offset_s != 0.0:
        return config
    first = read_cameras(Path(config.calibration.camera))[0]
    if first.time_offset_s is None:
        return config
    init = replace(config.init, time_offset_s=first.time_offset_s)
    if first.time_offset_sigma_s is not None:
        sigma_s = max(_OFFSET_WIDER * first.time_offset_sigma_s, _LEAST_OFFSET_SIGMA_S)
        init = replace(init, time_offset_sigma_s=min(sigma_s, init.time_offset_sigma_s))
    return replace(config, init=init)


def _rig(recorded: Rig, path: Path) -> Rig:
    found = read_cameras(path)
    if len(found) < len(recorded.cameras):
        raise DataError(f"{path} has {len(found)} camera, the recording has {len(recorded.cameras)}; calibrate both")
    found = found[: len(recorded.cameras)]
    for index, (new, old) in enumerate(zip(found, recorded.cameras, strict=True)):
        if (new.camera.width, new.camera.height) != (old.width, old.height):
            raise DataError(
                f"{path}: cam{index} is for {new.camera.width}x{new.camera.height}, "
                f"the recording has {old.width}x{old.height}; calibrate at the size that is recorded"
            )
    poses = tuple(
        old if new.T_body_cam is None else np.asarray(new.T_body_cam)
        for new, old in zip(found, recorded.T_body_cams, strict=True)
    )
    return Rig(tuple(new.camera for new in found), poses, recorded.has_depth)
