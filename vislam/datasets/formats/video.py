"""A plain video file with the stamps of its frames beside it, and optionally an IMU.

For `ride.mp4`: `ride.csv` (one row a frame, stamp in ns), `ride.yaml` (a camera's sensor file), and, if there is an
IMU, `ride.imu.csv` and `ride.imu.yaml` in the ASL layout. Every stamp must be from the clock that stamps the IMU.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.datasets.calibration import CAMERA_EXAMPLE, read_camera, read_imu
from vislam.datasets.images import ImageList, check_size_px
from vislam.datasets.loaders import video_facts
from vislam.datasets.stream import Survey, image_list
from vislam.datasets.tables import Problems, read_frame_stamps
from vislam.imu import ImuNoise

SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm")
LOOKS_FOR = f"a video file ({', '.join(SUFFIXES)})"


def recognises(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def survey(path: Path) -> Survey:
    """Return what a video and the files beside it hold; what is wrong with them is in `errors`."""
    problems = Problems()
    errors: list[DataError] = []
    imu_file, imu_noise, T_body_imu = None, None, np.eye(4)
    cameras: tuple[ImageList, ...] = ()
    rig = None
    try:
        if path.with_suffix(".imu.csv").is_file():
            imu_file = path.with_suffix(".imu.csv")
            imu_noise, T_body_imu = _imu(path)
        if not path.with_suffix(".yaml").is_file():
            raise DataError(f"{path.with_suffix('.yaml')} is missing; write the calibration into it: {CAMERA_EXAMPLE}")
        file = read_camera(path.with_suffix(".yaml"))
        rig = Rig((file.camera,), (invert(T_body_imu) @ file.T_body_cam,))
    except DataError as error:
        errors.append(error)
    try:
        cameras = (_frames(path, problems),)
        size, frames = video_facts(path)
        if frames > 0:  # some containers do not know
            last = int(cameras[0].files[-1]) + 1 if cameras[0].files else 0
            problems.count("video frame without a stamp", times=max(0, frames - last))
        if rig is not None:
            check_size_px(size, rig.cameras[0], path)
    except DataError as error:
        errors.append(error)
    return Survey(
        format="video",
        root=path,
        cameras=cameras,
        video=path,
        rig=rig,
        imu_file=imu_file,
        imu_noise=imu_noise,
        problems=problems,
        errors=tuple(errors),
    )


def _imu(path: Path) -> tuple[ImuNoise, NDArray[np.float64]]:
    sensor = path.with_suffix(".imu.yaml")
    if not sensor.is_file():
        raise DataError(f"{sensor} is missing; write the IMU's noise into it, see docs/formats.md")
    return read_imu(sensor)


def _frames(path: Path, problems: Problems) -> ImageList:
    stamps = path.with_suffix(".csv")
    if not stamps.is_file():
        raise DataError(f"{stamps} is missing; write one row a frame into it: the time of its exposure in ns")
    return image_list("cam0", path.parent, read_frame_stamps(stamps, problems), problems)
