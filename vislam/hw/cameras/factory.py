"""What a depth camera's maker measured: the calibration in the device, and where it sits on the body."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vislam.config import DepthCameraConfig
from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError, HardwareError
from vislam.core.geometry import are_rigid, invert
from vislam.core.messages import Array

# x forward, y left, z up of the body, for a camera that looks ahead: x right, y down, z forward
_R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_NO_FILE = "calibrate it (`vislam calibrate camera`) and give --calibration.camera FILE"


def factory_camera(
    size: tuple[int, int], pinhole: tuple[float, float, float, float], model: str, coefficients: Sequence[float]
) -> Camera:
    """Return a camera of fx, fy, cx, cy [px] with a maker's distortion.

    Args:
        size: width and height, px.
        pinhole: fx, fy, cx, cy, px.
        model: `none`, `radtan` (k1, k2, p1, p2, k3; with k4 to k6 that are not 0 `rational`; more have to be 0),
            `equidistant` (k1 to k4), or the maker's name of another, which is refused unless its coefficients are 0.
        coefficients: of it.

    Raises:
        DataError: a model, or coefficients, that vislam does not have; or numbers that are none of a camera.
    """
    given = [float(value) for value in coefficients]
    taken = {"radtan": 8, "equidistant": 4}.get(model, 0)
    if any(given[taken:]):
        raise DataError(
            f"the camera's factory calibration has distortion '{model}' with coefficients {given}, of which vislam "
            f"has the first {taken}; {_NO_FILE}"
        )
    kept = tuple(given[:taken])
    if not any(kept):
        return Camera(*size, *pinhole)
    if model == "equidistant":
        return Camera(*size, *pinhole, distortion="equidistant", coefficients=kept)
    if any(kept[5:]):
        return Camera(*size, *pinhole, distortion="rational", coefficients=(*kept, *[0.0] * (8 - len(kept))))
    return Camera(*size, *pinhole, distortion="radtan", coefficients=kept[:5])


def mounted(cameras: Sequence[Camera], T_cam0_cams: Sequence[Array], has_depth: bool, config: DepthCameraConfig) -> Rig:
    """Return the rig of cameras at poses [4, 4] in the first, which sits on the body as the settings say.

    Without `config.position_m` it looks ahead from the IMU's place.
    """
    T_body_cam0 = np.eye(4)
    T_body_cam0[:3, :3] = looking_ahead(config)
    T_body_cam0[:3, 3] = config.position_m or (0.0, 0.0, 0.0)
    return Rig(tuple(cameras), tuple(T_body_cam0 @ T for T in T_cam0_cams), has_depth)


def mounted_on_imu(
    cameras: Sequence[Camera],
    T_cam0_cams: Sequence[Array],
    has_depth: bool,
    config: DepthCameraConfig,
    T_cam0_imu: Array,
) -> Rig:
    """Return the rig of cameras beside an IMU in the same housing: the body is at the IMU, and the camera looks ahead.

    Args:
        cameras: of the rig.
        T_cam0_cams: poses [4, 4] of each in the first.
        has_depth: of the first.
        config: by how much it is tilted; its position is the factory's.
        T_cam0_imu: [4, 4] of the factory.
    """
    T_body_cam0 = np.eye(4)
    T_body_cam0[:3, :3] = looking_ahead(config)
    T_body_cam0[:3, 3] = -T_body_cam0[:3, :3] @ T_cam0_imu[:3, 3]
    return Rig(tuple(cameras), tuple(T_body_cam0 @ T for T in T_cam0_cams), has_depth)


def looking_ahead(config: DepthCameraConfig) -> Array:
    """Return the rotation [3, 3] of the first camera in the body: it looks ahead, nose down by `tilt_deg`."""
    tilt = np.deg2rad(config.tilt_deg)  # nose down is a turn about y, which points left
    R_tilt = np.array([[np.cos(tilt), 0.0, np.sin(tilt)], [0.0, 1.0, 0.0], [-np.sin(tilt), 0.0, np.cos(tilt)]])
    R_body_cam: Array = R_tilt @ _R_BODY_CAM
    return R_body_cam


def rigid(rotation: Array, translation_m: Array) -> Array:
    """Return the pose [4, 4] of cam1 in cam0 from what takes points of cam0 into cam1; HardwareError if it is none."""
    T_cam1_cam0 = np.eye(4)
    T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3] = rotation, translation_m
    if not are_rigid(T_cam1_cam0, 1e-3):
        raise HardwareError(
            f"the camera's factory extrinsics are no rigid transform: {T_cam1_cam0.tolist()}; {_NO_FILE}"
        )
    return invert(T_cam1_cam0)


def grey(color: Any) -> Any:
    """Return the grey image [H, W] of a BGR image [H, W, 3]."""
    import cv2

    return cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
