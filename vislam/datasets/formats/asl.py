"""EuRoC, TUM-VI and our own recordings: an ASL folder `mav0/{cam0,cam1,...,imu0,mag0,depth0}` with `data.csv` in each.

The body of vislam is the IMU: when the file's body is another frame (an IMU with a `T_BS` of its own), cameras,
magnetometer and truth are re-expressed. TUM-VI brings its calibration as Kalibr files, which are found as well.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vislam.core.camera import MOST_CAMERAS, Rig
from vislam.core.errors import DataError
from vislam.core.findings import Finding
from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.core.recording import Problems, noted
from vislam.datasets import calibration as files
from vislam.datasets.calibration import CAMERA_EXAMPLE, DEPTH_UNITS_PER_M, CameraFile
from vislam.datasets.camera_files import read_cameras
from vislam.datasets.formats.truth import Truth, asl_truth
from vislam.datasets.images import DepthFormat, ImageList
from vislam.datasets.imu_files import calibration_in, read_noise
from vislam.datasets.imu_tables import Pair, pair_in
from vislam.datasets.stream import Survey, image_list, with_depth_format
from vislam.datasets.tables import read_names
from vislam.imu import ImuCalibration, ImuNoise, MagCalibration

LOOKS_FOR = "mav0/cam0/data.csv or mav0/imu0/data.csv"
_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0")  # the first gives the body itself; Leica has no attitude
_KALIBR_FOLDERS = (".", "..", "../dso")  # seen from mav0; TUM-VI keeps them in dso


def recognises(path: Path) -> bool:
    """Return whether a path is an ASL folder, its `mav0`, or something inside that the user may have meant."""
    return _root(path) is not None


def survey(path: Path) -> Survey:
    """Return what an ASL folder holds; what is wrong with it is in `errors`."""
    root = _root(path)
    if root is None:
        return Survey("euroc", path, errors=(DataError(f"{path} is no ASL folder: no {LOOKS_FOR} in it"),))
    problems = Problems()
    errors: list[DataError] = []
    imu_file, imu_noise, T_body_imu, imu_calibration = _imu(root, errors)
    pair = _pair(root, errors) if imu_file is None else None
    if pair is not None:
        _, imu_noise, T_body_imu, imu_calibration = _imu(root, errors, pair[0].rates.path)
    cameras, rig, clocks = _cameras(root, T_body_imu, problems, errors)
    depth, how = _depth(root, rig, problems, errors)
    if rig is not None and depth is not None:
        rig = Rig(rig.cameras, rig.T_body_cams, has_depth=True)
    mag_file, R_imu_mag, mag_calibration = _mag(root, T_body_imu, errors)
    found = Survey(
        format="euroc",
        root=path,
        cameras=cameras,
        depth=depth,
        rig=rig,
        clocks=clocks,
        imu_file=imu_file,
        samples=None if pair is None else pair[0],
        findings=() if pair is None else (pair[1],),
        imu_noise=imu_noise,
        imu_calibration=imu_calibration,
        mag_file=mag_file,
        mag_calibration=mag_calibration,
        R_body_mag=R_imu_mag,
        truth=_truth(root, T_body_imu, errors),
        problems=problems,
        errors=tuple(errors),
    )
    return with_depth_format(found, how)


def _root(path: Path) -> Path | None:
    for root in (path / "mav0", path):
        if (root / "cam0").is_dir() or (root / "imu0").is_dir():
            return root
    return None


def _pair(root: Path, errors: list[DataError]) -> tuple[Pair, Finding] | None:
    """Return the tables of rates and forces where they are apart: in `imu0`, or as `gyro0` and `accel0` beside it."""
    with noted(errors):
        return pair_in(root / "imu0") or pair_in(root)
    return None


def _imu(
    root: Path, errors: list[DataError], pair: Path | None = None
) -> tuple[Path | None, ImuNoise | None, Array, ImuCalibration | None]:
    """Return the IMU's file, its noise, its pose in the file's body frame, and its calibration if samples are raw."""
    data, sensor = pair or root / "imu0" / "data.csv", root / "imu0" / "sensor.yaml"
    if not data.is_file():
        return None, None, np.eye(4), None
    with noted(errors):
        if sensor.is_file():
            noise, T_body_imu = files.read_imu(sensor)
            return data, noise, T_body_imu, calibration_in(files.load_yaml(sensor), sensor, ImuCalibration)
        kalibr = _kalibr(root, "imu_config.yaml")
        if kalibr is None:
            raise DataError(f"{sensor} is missing; write the IMU's noise into it, see docs/formats.md")
        return data, read_noise(kalibr), np.eye(4), None
    return data, None, np.eye(4), None


def _cameras(
    root: Path, T_body_imu: Array, problems: Problems, errors: list[DataError]
) -> tuple[tuple[ImageList, ...], Rig | None, tuple[float | None, ...]]:
    """Return image lists, rig and clocks of cam0, cam1 and so on, as far as there are, in the IMU's frame."""
    lists: list[ImageList] = []
    found: list[CameraFile] = []
    for index in range(MOST_CAMERAS):
        folder = root / f"cam{index}"
        if not folder.is_dir():
            break
        rate_hz = None
        with noted(errors):
            found.append(_camera_file(root, index))
            rate_hz = found[-1].rate_hz
        with noted(errors):
            rows = read_names(folder / "data.csv", problems)
            lists.append(image_list(folder.name, folder / "data", rows, problems, rate_hz))
    if not lists or len(lists) != len(found):
        return tuple(lists), None, ()
    poses = tuple(invert(T_body_imu) @ camera.T_body_cam for camera in found)
    rig = Rig(tuple(camera.camera for camera in found), poses)
    return tuple(lists), rig, tuple(camera.clock_s for camera in found)


def _camera_file(root: Path, index: int) -> CameraFile:
    sensor = root / f"cam{index}" / "sensor.yaml"
    if sensor.is_file():
        return files.read_camera(sensor)
    kalibr = _kalibr(root, "camchain.yaml")
    if kalibr is None:
        raise DataError(f"{sensor} is missing; write the calibration into it: {CAMERA_EXAMPLE}")
    chain = read_cameras(kalibr)
    if index >= len(chain) or chain[index].T_body_cam is None:
        raise DataError(f"{kalibr} has no cam{index} with T_cam_imu; add it, or write {sensor}: {CAMERA_EXAMPLE}")
    return CameraFile(chain[index].camera, np.asarray(chain[index].T_body_cam), clock_s=chain[index].time_offset_s)


def _kalibr(root: Path, name: str) -> Path | None:
    paths = (root / folder / name for folder in _KALIBR_FOLDERS)
    return next((path for path in paths if path.is_file()), None)


def _depth(
    root: Path, rig: Rig | None, problems: Problems, errors: list[DataError]
) -> tuple[ImageList | None, DepthFormat]:
    """Return the depth images, with their stamps as written, and how they are read."""
    folder = root / "depth0"
    usual = DepthFormat(DEPTH_UNITS_PER_M)
    if rig is None or not folder.is_dir():
        return None, usual
    with noted(errors):
        how = files.depth_format(folder / "sensor.yaml", rig.cameras[0], usual)
        return image_list("depth0", folder / "data", read_names(folder / "data.csv", problems), problems), how
    return None, usual


def _mag(root: Path, T_body_imu: Array, errors: list[DataError]) -> tuple[Path | None, Array, MagCalibration | None]:
    """Return the magnetometer's file, its rotation to the IMU, and its calibration if samples are raw."""
    data, sensor = root / "mag0" / "data.csv", root / "mag0" / "sensor.yaml"
    if not data.is_file():
        return None, np.eye(3), None
    T_body_mag, calibration = T_body_imu, None
    try:
        if sensor.is_file():
            keys = files.Keys(files.load_yaml(sensor))
            T_body_mag, calibration = files.read_pose(keys, sensor), calibration_in(keys, sensor, MagCalibration)
            keys.name_unused(sensor, "T_BS")
    except DataError as error:
        errors.append(error)
        return None, np.eye(3), None
    return data, (invert(T_body_imu) @ T_body_mag)[:3, :3], calibration


def _truth(root: Path, T_body_imu: Array, errors: list[DataError]) -> Truth | None:
    """Return a reader of the true poses of the IMU, from whichever layout is there."""
    for name in _TRUTH_FOLDERS:
        data, sensor = root / name / "data.csv", root / name / "sensor.yaml"
        if data.is_file():
            try:
                keys = files.Keys(files.load_yaml(sensor) if sensor.is_file() else {})
                T_body_sensor = files.read_pose(keys, sensor) if keys else T_body_imu
                keys.name_unused(sensor, "T_BS")
            except DataError as error:
                errors.append(error)
                return None
            return asl_truth(data, invert(T_body_sensor) @ T_body_imu)
    return None
