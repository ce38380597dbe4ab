"""Camera calibrations in the files of others: chains of Kalibr and OpenVINS, ROS's camera_info, ASL's sensor.yaml.

A Kalibr chain of cameras alone has no `T_cam_imu`; ROS files have no pose at all. What a file does not say is None.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.camera import MOST_CAMERAS, Camera
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.lens import Distortion
from vislam.core.messages import Array
from vislam.datasets.calibration import (
    SIGMA_KEYS,
    Keys,
    numbers_in,
    optional_positive,
    parse_camera,
    pose_in,
    stated_lens,
    warn_once,
    warn_readout,
)
from vislam.datasets.calibration_text import list_text
from vislam.datasets.foreign_cameras import CameraCalibration, foreign_cameras, load_keys

_RATIONAL = "rational_polynomial"
_KALIBR_MODELS: dict[Distortion, str] = {
    "radtan": "radtan", "equidistant": "equidistant", "none": "none",
    "rational": _RATIONAL,  # which Kalibr does not have
}  # fmt: skip
_ROS_MODELS: dict[Distortion, str] = {
    "radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob", "rational": _RATIONAL,
}  # fmt: skip
_FARTHEST_S = 1e9  # clocks that begin in 1970 and at boot


def read_cameras(path: Path) -> tuple[CameraCalibration, ...]:
    """Return the calibration of the cameras in a file of any program that docs/formats.md lists.

    Of a chain all are read, of other programs' files the first two.

    Raises DataError naming the key; also for a pose, clock or scale that is not understood. Other keys that are not
    used are warned of.
    """
    data = load_keys(path)
    if isinstance(data.get("cam0"), dict):
        return _chain(data, path)
    if (foreign := foreign_cameras(data, path)) is not None:
        return tuple(foreign)
    if not {"intrinsics", "resolution"} & set(data):
        held = ", ".join(str(key)[:40] for key in list(data)[:8])
        raise DataError(f"{path} holds {held}: no camera calibration that is known; see docs/formats.md")
    found = CameraCalibration(parse_camera(data, path, "distortion_coefficients"), pose_in(data, "T_BS", path))
    data.name_unused(path, "T_BS")
    return (found,)


def _chain(data: Keys, path: Path) -> tuple[CameraCalibration, ...]:
    found: list[CameraCalibration] = []
    names = [name for k in range(MOST_CAMERAS) if isinstance(data.get(name := f"cam{k}"), dict)]
    for name in names:
        entry = Keys(data[name])
        camera = parse_camera(entry, path, "distortion_coeffs")
        T_body_cam, T_cam_before = _place(entry, path), pose_in(entry, "T_cn_cnm1", path)
        T_before_cam = None if T_cam_before is None else invert(T_cam_before)
        before = found[-1].T_body_cam if found else None
        chained = None if before is None or T_before_cam is None else before @ T_before_cam
        if T_body_cam is None:
            T_body_cam = chained
        elif chained is not None and not np.allclose(T_body_cam, chained, 0, 2e-3):
            warn_once(f"{path}: not used: T_cn_cnm1 of {name}, which contradicts the places in the IMU")
        found.append(CameraCalibration(camera, T_body_cam, *_offset(entry, path), T_before_cam))
        line_s = optional_positive(entry, "line_delay", path, allow_zero=True) or 0.0
        warn_readout(path, "line_delay", line_s * camera.height)
        entry.name_unused(path, "T_cam_imu and timeshift_cam_imu")
    data.name_unused(path, "T_cam_imu in each camera's block", known=(f"cam{k}" for k in range(len(names), 16)))
    return tuple(found)


def _place(entry: Keys, path: Path) -> Array | None:
    """Return the pose [4, 4] of a chain's camera in the body: Kalibr writes its inverse, OpenVINS the pose itself."""
    T_cam_body, T_body_cam = (pose_in(entry, key, path) for key in ("T_cam_imu", "T_imu_cam"))
    if (
        T_cam_body is not None
        and T_body_cam is not None
        and not np.allclose(T_cam_body @ T_body_cam, np.eye(4), 0, 1e-3)
    ):
        raise DataError(f"{path}: T_cam_imu and T_imu_cam are not inverse to each other; remove the wrong one")
    return T_body_cam if T_cam_body is None else invert(T_cam_body)


def camchain_text(cameras: Sequence[CameraCalibration], comment: str) -> str:
    """Return Kalibr's camchain.yaml; our keys are `skew_px`, `timeshift_cam_imu_sigma`, `focal_sigma` and its like."""
    return f"# {' '.join(comment.split())}\n" + "".join(_chain_entry(k, found) for k, found in enumerate(cameras))


def camera_info_text(camera: Camera, name: str) -> str:
    """Return ROS's camera calibration file; the lens has no rectification, the projection matrix is K.

    Raises DataError for a lens over spheres, which ROS does not have.
    """
    if camera.model.is_spherical:
        raise DataError(f"ROS has no {camera.distortion} lens; use camchain.yaml, or --model equidistant")
    coefficients = list(camera.coefficients)
    if camera.distortion != "equidistant":
        coefficients += [0.0] * (5 - len(coefficients))
    projection = np.column_stack([camera.K, np.zeros(3)])
    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: {name}\n"
        + _ros_matrix("camera_matrix", camera.K)
        + f"distortion_model: {_ROS_MODELS[camera.distortion]}\n"
        + _ros_matrix("distortion_coefficients", np.array([coefficients]))
        + _ros_matrix("rectification_matrix", np.eye(3))
        + _ros_matrix("projection_matrix", projection)
    )


def _chain_entry(index: int, found: CameraCalibration) -> str:
    camera = found.camera
    lines = [f"cam{index}:"]
    if found.T_body_cam is not None:
        lines += ["  T_cam_imu:", *(f"  - {list_text(row)}" for row in invert(found.T_body_cam))]
    kind, intrinsics, distortion, coefficients = stated_lens(camera, _KALIBR_MODELS)
    lines += [
        f"  camera_model: {kind}",
        f"  intrinsics: {list_text(intrinsics)}",
        f"  distortion_model: {distortion}",
        f"  distortion_coeffs: {list_text(coefficients)}",
        f"  resolution: [{camera.width}, {camera.height}]",
        f"  rostopic: /cam{index}/image_raw",
    ]
    if camera.skew_px != 0.0:
        lines.append(f"  skew_px: {float(camera.skew_px)!r}")
    lines += [f"  {name}: {float(getattr(camera.sigmas, key))!r}" for key, name in SIGMA_KEYS.items()]
    if found.time_offset_s is not None:
        lines.append(f"  timeshift_cam_imu: {float(found.time_offset_s)!r}  # s, t_imu = t_cam + shift")
    if found.time_offset_sigma_s is not None:
        lines.append(f"  timeshift_cam_imu_sigma: {float(found.time_offset_sigma_s)!r}")
    return "\n".join(lines) + "\n"


def _offset(entry: Mapping[str, Any], path: Path) -> tuple[float | None, float | None]:
    keys = ("timeshift_cam_imu", "timeshift_cam_imu_sigma")
    values = [None if entry.get(key) is None else numbers_in({key: [entry[key]]}, key, path, 1)[0] for key in keys]
    if values[0] is not None and abs(values[0]) > _FARTHEST_S:
        raise DataError(f"{path}: timeshift_cam_imu of {values[0]:g} s; it is what two clocks differ by, in seconds")
    return values[0], values[1]


def _ros_matrix(name: str, matrix: Array) -> str:
    rows, columns = matrix.shape
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {list_text(matrix.ravel())}\n"
