"""Calibrations of other programs, recognised by their content: VINS, ORB-SLAM, Basalt, OKVIS, maplab, ROS, OpenCV.

Every pose that they write is the camera's in the IMU (`body_T_cam0`, `Tbc`, `T_imu_cam`), or the right camera's in the
left one's.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import invert, rotation_from_quaternion_xyzw, transform
from vislam.core.lens import MODELS, Distortion
from vislam.core.messages import Array
from vislam.core.reading import MAX_YAML_BYTES, read_text, readable
from vislam.datasets.calibration import (
    WEIGHTY,
    Keys,
    load_yaml,
    numbers_in,
    optional_positive,
    pose_in,
    stated_camera,
    warn_readout,
)
from vislam.datasets.tables import check_size

_RATIONAL = "rational_polynomial"
_RADTAN = ("k1", "k2", "p1", "p2")
_FULL = (*_RADTAN, "k3", "k4", "k5", "k6")
_OPENCV = {  # what its programs and ROS's messages call the same, in small letters without underscores
    "cameramatrix": "camera_matrix", "k": "camera_matrix", "distortioncoefficients": "distortion_coefficients",
    "distcoeffs": "distortion_coefficients", "d": "distortion_coefficients", "imagewidth": "image_width",
    "width": "image_width", "imageheight": "image_height", "height": "image_height", "mtx": "camera_matrix",
    "dist": "distortion_coefficients", "distcoeff": "distortion_coefficients", "imagesize": "image_size",
    "distortionmodel": "distortion_model", "fisheyemodel": "fisheye_model",
}  # fmt: skip
_OPENCV_SILENT = (  # of a message, and of the program that calibrates
    "header", "R", "r", "P", "p", "calibration_time", "calibration_Time", "nframes", "nrOfFrames", "flags",
    "board_width", "board_height", "square_size", "avg_reprojection_error", "per_view_reprojection_errors",
    "extrinsic_parameters", "image_points", "grid_points",
)  # fmt: skip
_RESULTS = {  # what is no mapping, by how it begins
    "Calibration results": "Kalibr's report; give its camchain.yaml",
    "# oST version": "ROS's ost.txt; give its ost.yaml",
    "# Camera list": "COLMAP's cameras.txt; write a sensor.yaml, see docs/formats.md",
    "sensors:": "maplab's file of all sensors; give the block of its NCAMERA, cameras: ..., as a file of its own",
    "[LEFT_CAM": "the settings of a ZED; write a sensor.yaml, see docs/formats.md",
}
_LISTED = {  # how OKVIS and maplab name distortions, as ROS does
    "radialtangential": "plumb_bob", "radial-tangential": "plumb_bob", "radialtangential8": _RATIONAL,
    "equidistant": "equidistant", "none": "none",
}  # fmt: skip
_PAIR = (("m", "k", "cameramatrix"), ("d", "distcoeffs", "distortioncoefficients"))  # of OpenCV, before 1 and 2
_OKVIS_SILENT = ("camera_type", "cam_model", "slam_use", "mapping", "mapping_rectification")
_MAPLAB_SILENT = ("label", "id", "description", "topic", "sensor_type", "compressed")
_MOST_BASELINE_M = 10.0  # more are millimetres


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """What a file states of one camera."""

    camera: Camera
    T_body_cam: Array | None = None  # [4, 4], body is the IMU
    time_offset_s: float | None = None  # to be added to the camera's stamps to get the IMU's time
    time_offset_sigma_s: float | None = None
    T_before_cam: Array | None = None  # [4, 4], in the camera before it


def load_keys(path: Path) -> Keys:
    """Return the mapping in a file of YAML, JSON or OpenCV's XML; raises DataError when it holds none."""
    check_size(path, MAX_YAML_BYTES)
    try:
        with readable(path):
            text = read_text(path, MAX_YAML_BYTES).lstrip("\ufeff \t\r\n")
        for begin, what in _RESULTS.items():
            if text.startswith(begin):
                raise DataError(f"{path} is {what}")
        if not text.startswith(("{", "<")):
            return Keys(load_yaml(path))
        data = json.loads(text) if text.startswith("{") else _xml(text)
    except (ValueError, RecursionError, ElementTree.ParseError) as error:
        raise DataError(f"{path} cannot be read as JSON or XML: {' '.join(str(error).split())[:200]}") from error
    return Keys(data)


def foreign_cameras(data: Keys, path: Path) -> list[CameraCalibration] | None:
    """Return what a file of another program states of its first two cameras, None where it is none of those.

    Raises DataError naming the program and what it lacks, or the camera model that vislam does not have.
    """
    for name, is_one, read in _PROGRAMS:
        if is_one(data):
            try:
                return read(data, path)
            except (KeyError, TypeError, IndexError, ValueError, AttributeError, OverflowError) as error:
                what = f"no {error}" if isinstance(error, KeyError) else str(error)
                raise DataError(f"{path} looks like a file of {name}, but it cannot be used: {what[:120]}") from error
    return None


def ros_camera(size_px: tuple[int, int], K: Array, name: str, coefficients: list[float], where: str) -> Camera:
    """Return the camera that ROS describes by K [3, 3], its distortion's name and coefficients.

    Raises DataError for a lens that vislam does not have.
    """
    width, height = size_px
    if name in ("equidistant", "fisheye", "kannala_brandt") and len(coefficients) >= 4 and not any(coefficients[4:]):
        model: Distortion = "equidistant"
        coefficients = coefficients[:4]
    elif name in ("plumb_bob", _RATIONAL, "none", "") and not any(coefficients):
        model = "none"
    elif name in ("plumb_bob", _RATIONAL) and not any(coefficients[5:]):
        model = "radtan"
        coefficients = (coefficients + [0.0] * 4)[: 5 if len(coefficients) > 4 and coefficients[4] != 0.0 else 4]
    elif name == _RATIONAL and not any(coefficients[8:]):  # thin prisms and tilted sensors are behind the eighth
        model = "rational"
        coefficients = (coefficients + [0.0] * 8)[:8]
    else:
        raise DataError(
            f"{where}: '{name}' with {len(coefficients)} coefficients is not supported; use plumb_bob, "
            f"{_RATIONAL} with 8, or equidistant with 4"
        )
    try:
        return Camera(
            width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], model,
            () if model == "none" else tuple(coefficients),
        )  # fmt: skip
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def _ros_or_opencv(data: Keys, path: Path) -> list[CameraCalibration]:
    named = {_OPENCV.get(str(key).lower().replace("_", ""), str(key)): value for key, value in data.items()}
    keys = Keys(named)
    K = np.array(numbers_in(keys, "camera_matrix", path, 9)).reshape(3, 3)
    key, sides = "image_size", keys.get("image_size")
    if sides is None:
        key, sides = "image_width, image_height", [keys.get("image_width"), keys.get("image_height")]
    if isinstance(sides, list) and None in sides:
        raise DataError(f"{path}: a calibration of OpenCV without image size; add image_width and image_height")
    width, height = map(int, numbers_in({key: sides}, key, path, 2))
    coefficients = numbers_in(keys, "distortion_coefficients", path)
    # a message names its model; OpenCV's program writes whether it is a fisheye, else the number of coefficients does
    usual = "plumb_bob" if len(coefficients) <= 5 else _RATIONAL
    is_fisheye = str(keys.get("fisheye_model", 0)) not in ("0", "False", "None")
    name = "fisheye" if is_fisheye else str(keys.get("distortion_model", usual))
    pose = pose_in(keys, "T_BS", path)
    if keys.get("xi") is None:
        camera = ros_camera((width, height), K, name, coefficients, str(path))
    else:  # of OpenCV's module omnidir
        xi = numbers_in(keys, "xi", path, 1)
        camera = stated_camera((width, height), K, "omni", [*xi, *coefficients], str(path))
    roi = found if isinstance(found := keys.get("roi"), dict) else {}
    if roi.get("x_offset") or roi.get("y_offset") or any(keys.get(f"binning_{axis}", 0) not in (0, 1) for axis in "xy"):
        raise DataError(f"{path}: binning and parts of an image are not read; calibrate at the size that is recorded")
    keys.name_unused(path, "T_BS", known=_OPENCV_SILENT)
    return [CameraCalibration(camera, pose)]


def _vins(data: Keys, path: Path) -> list[CameraCalibration]:
    td = data.get("td")
    offset_s = None if td is None else float(td)
    found = []
    if "model_type" in data:
        T = pose_in(data, "body_T_cam0", path)
        if "extrinsicRotation" in data and "extrinsicTranslation" in data:  # one alone is refused
            T = _of_two(data, "extrinsicRotation", "extrinsicTranslation", path)
        found.append(CameraCalibration(_vins_lens(data, path), T, time_offset_s=offset_s))
    else:
        for k in range(2):
            if data.get(f"cam{k}_calib") is not None:
                named = Path(str(data[f"cam{k}_calib"]))  # relative to this file, but to no other folder than its own
                is_inside = not named.is_absolute() and ".." not in named.parts
                beside = path.parent / named if is_inside else path.with_name(named.name)
                T = pose_in(data, f"body_T_cam{k}", path)
                found.append(CameraCalibration(_vins_lens(load_keys(beside), beside), T, time_offset_s=offset_s))
    if str(data.get("estimate_extrinsic", 0)) == "2":  # by which the poses are placeholders
        found = [CameraCalibration(one.camera, time_offset_s=offset_s) for one in found]
    if str(data.get("rolling_shutter", 0)) == "1":
        warn_readout(path, "rolling_shutter_tr", numbers_in(data, "rolling_shutter_tr", path, 1)[0])
    _refuse_weighty(data, path, "body_T_cam0 and td")
    return found


def _vins_lens(data: Keys, path: Path) -> Camera:
    kind = str(data["model_type"])
    if kind not in ("PINHOLE", "PINHOLE_FULL", "KANNALA_BRANDT", "MEI"):
        raise DataError(f"{path}: VINS's camera model {kind} is not supported; use PINHOLE, KANNALA_BRANDT or MEI")
    projection, size = data["projection_parameters"], [int(data[f"image_{side}"]) for side in ("width", "height")]
    if kind in ("PINHOLE", "PINHOLE_FULL"):
        K = _intrinsics(*(float(projection[name]) for name in ("fx", "fy", "cx", "cy")))
        k = [float(data["distortion_parameters"].get(name, 0.0)) for name in _FULL[: 4 if kind == "PINHOLE" else 8]]
        return ros_camera((size[0], size[1]), K, _RATIONAL, k, str(path))
    if kind == "KANNALA_BRANDT":
        K = _intrinsics(*(float(projection[name]) for name in ("mu", "mv", "u0", "v0")))
        k = [float(projection[name]) for name in ("k2", "k3", "k4", "k5")]
        return ros_camera((size[0], size[1]), K, "equidistant", k, str(path))
    K = _intrinsics(*(float(projection[name]) for name in ("gamma1", "gamma2", "u0", "v0")))
    k = [data["mirror_parameters"]["xi"], *(data["distortion_parameters"].get(name, 0.0) for name in _RADTAN)]
    return stated_camera((size[0], size[1]), K, "omni", [float(value) for value in k], str(path))


def _orb_slam(data: Keys, path: Path) -> list[CameraCalibration]:
    if "LEFT.K" in data:
        raise DataError(
            f"{path}: ORB-SLAM's older settings with LEFT.K and RIGHT.K are not supported; write Camera1.fx ..., "
            "Camera2.fx ... and Stereo.T_c1_c2, as since its version 1.0"
        )
    first = "Camera1" if "Camera1.fx" in data else "Camera"
    T_body_cam = pose_in(data, "IMU.T_b_c1", path)
    T_body_cam = pose_in(data, "Tbc", path) if T_body_cam is None else T_body_cam
    T_c1_c2 = pose_in(data, "Stereo.T_c1_c2", path)
    T_c1_c2 = pose_in(data, "Tlr", path) if T_c1_c2 is None else T_c1_c2
    found = [CameraCalibration(_orb_lens(data, first, path), T_body_cam)]
    b_m = data.get("Stereo.b", data.get("Camera.bf"))
    is_depth = "DepthMapFactor" in data or "RGBD.DepthMapFactor" in data  # whose baseline is made up
    if "Camera2.fx" in data and data.get("Camera.type") != "Rectified":
        T = None if T_body_cam is None or T_c1_c2 is None else T_body_cam @ T_c1_c2
        found.append(CameraCalibration(_orb_lens(data, "Camera2", path), T, T_before_cam=T_c1_c2))
    elif b_m is not None and not is_depth:
        b_m = float(b_m) if "Stereo.b" in data else float(b_m) / found[0].camera.fx
        T = transform(np.eye(3), np.array([b_m, 0.0, 0.0]))
        found.append(CameraCalibration(found[0].camera, None if T_body_cam is None else T_body_cam @ T, T_before_cam=T))
    _refuse_weighty(data, path, "IMU.T_b_c1 and Stereo.T_c1_c2")
    return found


def _orb_lens(data: Keys, name: str, path: Path) -> Camera:
    kind = str(data.get("Camera.type", "PinHole"))
    width, height = (int(data[f"Camera.{side}"]) for side in ("width", "height"))
    K = _intrinsics(*(float(data[f"{name}.{of}"]) for of in ("fx", "fy", "cx", "cy")))
    if kind == "KannalaBrandt8":
        k = [float(data[f"{name}.k{i}"]) for i in range(1, 5)]
        return ros_camera((width, height), K, "equidistant", k, str(path))
    if kind not in ("PinHole", "Rectified"):
        raise DataError(f"{path}: ORB-SLAM's camera model {kind} is not supported; use PinHole or KannalaBrandt8")
    k = [float(data.get(f"{name}.{of}", 0.0)) for of in _FULL[:5]]
    return ros_camera((width, height), K, "none" if kind == "Rectified" else "plumb_bob", k, str(path))


def _basalt(data: Keys, path: Path) -> list[CameraCalibration]:
    keys = Keys(data["value0"])
    offset_s = float(keys.get("cam_time_offset_ns") or 0.0) * 1e-9
    lists = (keys["intrinsics"], keys["resolution"], keys["T_imu_cam"])
    found = []
    for lens, size, pose in list(zip(*lists, strict=False))[:2]:
        kind, values = str(lens["camera_type"]), lens["intrinsics"]
        models = {"pinhole": ("none", ()), "kb4": ("equidistant", ("k1", "k2", "k3", "k4"))}
        models["pinhole-radtan8"] = (_RATIONAL, _FULL)
        spheres: dict[str, Distortion] = {"ucm": "ucm", "eucm": "eucm", "ds": "ds"}
        if kind not in models and kind not in spheres:
            raise DataError(
                f"{path}: Basalt's camera model {kind} is not supported; calibrate with kb4, ds, eucm, or with Kalibr"
            )
        name, of = models.get(kind) or ("", MODELS[spheres[kind]].names)
        K, k = _intrinsics(*(float(values[part]) for part in ("fx", "fy", "cx", "cy"))), [float(values[k]) for k in of]
        size_px = (int(size[0]), int(size[1]))
        if kind in spheres:
            camera = stated_camera(size_px, K, spheres[kind], k, str(path))
        else:
            camera = ros_camera(size_px, K, name, k, str(path))
        q = np.array([float(pose[f"q{axis}"]) for axis in "xyzw"])
        if not abs(np.linalg.norm(q) - 1.0) < 1e-3:
            raise DataError(f"{path}: a quaternion of T_imu_cam is not of length 1: {q.tolist()}")
        R = rotation_from_quaternion_xyzw(q[None] / np.linalg.norm(q))[0]
        T = transform(R, np.array([float(pose[f"p{axis}"]) for axis in "xyz"]))
        found.append(CameraCalibration(camera, T, time_offset_s=offset_s))
    keys.name_unused(
        path,
        "T_imu_cam and cam_time_offset_ns",
        known=[key for key in keys if key.endswith(("_noise_std", "_bias_std", "_update_rate"))],
    )
    return found


def _okvis(data: Keys, path: Path) -> list[CameraCalibration]:
    found = []
    delays = (dict(data.get("camera_parameters") or {}).get("image_delay"), data.get("imageDelay"))
    offset_s = next((-float(delay) for delay in delays if delay is not None), None)
    # okvis_ros/src/Subscriber.cpp: t -= imageDelay; OKVIS 2: correct stamp = stamp - image_delay
    for entry in data["cameras"][:2]:
        keys = Keys(entry)
        width, height = numbers_in(keys, "image_dimension", path, 2)
        K = _intrinsics(*numbers_in(keys, "focal_length", path, 2), *numbers_in(keys, "principal_point", path, 2))
        name, k = _LISTED.get(str(keys["distortion_type"]), ""), numbers_in(keys, "distortion_coefficients", path)
        if not name:
            raise DataError(f"{path}: OKVIS's distortion {keys['distortion_type']} is not supported; use {[*_LISTED]}")
        camera = ros_camera((int(width), int(height)), K, name, k, str(path))
        found.append(CameraCalibration(camera, pose_in(keys, "T_SC", path), offset_s))
        keys.name_unused(path, "T_SC", _OKVIS_SILENT)
    _refuse_weighty(data, path, "T_SC in each camera's block")
    return found


def _maplab(data: Keys, path: Path) -> list[CameraCalibration]:
    found = []
    for entry in data["cameras"][:2]:
        keys, lens = Keys(entry), Keys(entry["camera"])
        distortion = dict(lens.get("distortion") or {"type": "none"})
        name, kind = _LISTED.get(str(distortion["type"]), ""), str(lens["type"])
        if kind != "pinhole" or not name:
            raise DataError(
                f"{path}: maplab's {kind} with {distortion['type']} is not supported; use pinhole, {[*_LISTED]}"
            )
        K = _intrinsics(*numbers_in(lens, "intrinsics", path, 4))
        k = numbers_in(distortion, "parameters", path) if "parameters" in distortion else []
        camera = ros_camera((int(lens["image_width"]), int(lens["image_height"])), K, name, k, str(path))
        found.append(CameraCalibration(camera, pose_in(keys, "T_B_C", path)))
        delay_ns = optional_positive(lens, "line-delay-nanoseconds", path, allow_zero=True) or 0.0
        warn_readout(path, "line-delay-nanoseconds", delay_ns * 1e-9 * camera.height)
        for part in (keys, lens):
            part.name_unused(path, "T_B_C in each camera's block", known=("camera", *_MAPLAB_SILENT))
    data.name_unused(path, "T_B_C in each camera's block", known=_MAPLAB_SILENT)
    return found


def _opencv_pair(data: Keys, path: Path) -> list[CameraCalibration]:
    """Return a pair as OpenCV's program calibrates it: R and T take points of the left camera into the right one."""
    named = {str(key).lower().replace("_", ""): str(key) for key in data}
    size = [named[key] for key in ("imagewidth", "imageheight") if key in named]
    beside = path.with_name(f"extrinsics{path.suffix}")
    place = data if data.get("R") is not None else load_keys(beside)  # its program writes two files
    t = numbers_in(place, "T", path, 3)
    if len(size) < 2:
        raise DataError(f"{path}: a pair of OpenCV; it has no image size: add image_width, image_height")
    if np.linalg.norm(t) > _MOST_BASELINE_M:
        raise DataError(f"{path}: a pair of OpenCV; T of {np.linalg.norm(t):.3g} m is no pair's: write metres")
    cameras = []
    for k in "12":
        K, d = (next((named[of + k] for of in names if of + k in named), names[0].upper() + k) for names in _PAIR)
        cameras.append(ros_camera(
            (int(data[size[0]]), int(data[size[1]])), np.reshape(numbers_in(data, K, path, 9), (3, 3)), _RATIONAL,
            numbers_in(data, d, path), str(path)))  # fmt: skip
    T = invert(_of_two(place, "R", "T", path))
    data.name_unused(path, "R and T in metres", (*_OPENCV_SILENT, "R1", "R2", "P1", "P2", "Q", "E", "F"))
    return [CameraCalibration(cameras[0]), CameraCalibration(cameras[1], T_before_cam=T)]


_PROGRAMS: tuple[tuple[str, Callable[[Keys], bool], Callable[[Keys, Path], list[CameraCalibration]]], ...] = (
    ("Basalt", lambda data: isinstance(data.get("value0"), dict), _basalt),
    ("VINS", lambda data: "model_type" in data or "cam0_calib" in data, _vins),
    ("ORB-SLAM", lambda data: "Camera.fx" in data or "Camera1.fx" in data, _orb_slam),
    ("OKVIS", lambda data: "T_SC" in _first_of(data), _okvis),
    ("maplab", lambda data: "camera" in _first_of(data), _maplab),
    ("OpenCV", lambda data: any({f"{name}1", f"{name}2"} <= {str(key).lower().replace("_", "") for key in data}
                                for name in _PAIR[0] + _PAIR[1][:1]) and "fl_x" not in data, _opencv_pair),
    ("ROS or OpenCV", lambda data: any(
        _OPENCV.get(str(key).lower().replace("_", "")) == "camera_matrix" for key in data), _ros_or_opencv),
)  # fmt: skip


def _of_two(data: Mapping[str, Any], turn: str, place: str, path: Path) -> Array:
    """Return the pose [4, 4] of a rotation and a translation; raises DataError unless it is rigid."""
    R, t = np.reshape(numbers_in(data, turn, path, 9), (3, 3)), numbers_in(data, place, path, 3)
    T = pose_in({turn: np.column_stack((R, t)).tolist()}, turn, path)
    assert T is not None
    return T


def _first_of(data: Keys) -> Mapping[str, Any]:
    """Return the first of a list of cameras, empty without one."""
    cameras = data.get("cameras")
    return cameras[0] if isinstance(cameras, list) and cameras and isinstance(cameras[0], dict) else {}


def _refuse_weighty(data: Keys, path: Path, instead: str) -> None:
    """Refuse poses and times that were not used; the other keys of a settings file are the program's own affair."""
    harmless = [str(key) for key in data if not WEIGHTY.search(str(key)) or str(key).startswith("ORBextractor.")]
    data.name_unused(path, instead, known=harmless)


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Array:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _xml(text: str) -> dict[str, Any]:
    """Return the mapping in OpenCV's XML: matrices as in its YAML, all else as text."""
    if re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise ValueError("OpenCV writes no document type and no entities")
    root = ElementTree.fromstring(text)
    if root.tag != "opencv_storage":
        raise ValueError(f"it holds <{root.tag[:40]}>, not <opencv_storage>")
    found: dict[str, Any] = {}
    for child in root:
        data = child.find("data")
        words = ((child.text if data is None else data.text) or "").split()
        found[child.tag] = {"data": words} if data is not None else " ".join(words).strip('"')
    return found
