"""Sensor files: ASL `sensor.yaml` (read and written, with our few extra keys) and Kalibr's `camchain.yaml` (read).

docs/formats.md lists every key. Poses are `T_BS`: the sensor's pose in the body frame of the file.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.camera import Camera, CameraSigmas
from vislam.core.errors import DataError
from vislam.core.geometry import are_rotations
from vislam.core.lens import MODELS as LENS_MODELS
from vislam.core.lens import Distortion
from vislam.core.messages import Array
from vislam.core.reading import MAX_YAML_BYTES, parse_yaml, read_text, readable
from vislam.datasets.images import DepthFormat
from vislam.datasets.tables import check_size
from vislam.imu import ImuNoise
from vislam.vision.depth_registration import DepthCamera

_LOG = logging.getLogger(__name__)
DEPTH_UNITS_PER_M = 1000.0  # millimetres, as ROS and most depth cameras write them: 65.5 m in 16 bits
_MOST_OFFSET_PX = 1000.0  # more is no camera's: a file that was damaged
_MOST_TIME_OFFSET_S = 10.0
_MOST_APART_M = 1.0  # of colour and depth: more is no device's, but millimetres
MODELS: dict[str, Distortion] = {
    "radial-tangential": "radtan", "radtan": "radtan", "plumb_bob": "radtan",
    "equidistant": "equidistant", "fisheye": "equidistant", "none": "none", "rational_polynomial": "rational",
}  # fmt: skip
MODEL_NAMES: dict[Distortion, str] = {
    "radtan": "radial-tangential", "equidistant": "equidistant", "none": "none", "rational": "rational_polynomial",
}  # fmt: skip
_CAMERA_MODELS: dict[str, tuple[Distortion, int, tuple[Distortion, ...]]] = {  # numbers before the focal lengths
    "pinhole": ("none", 0, tuple(MODEL_NAMES)), "eucm": ("eucm", 2, ("none",)), "ds": ("ds", 2, ("none",)),
    "omni": ("omni", 1, ("none", "radtan")),
}  # fmt: skip
NOISE_KEYS = (  # of Kalibr, and the names in `ImuNoise`
    "gyroscope_noise_density", "accelerometer_noise_density", "gyroscope_random_walk", "accelerometer_random_walk",
)  # fmt: skip
SIGMA_KEYS = {"focal": "focal_sigma", "metres": "metres_sigma", "turn_rad": "turn_sigma_rad"}  # ours, of a camera
SCALE_KEYS = ("gyroscope_scale_sigma", "accelerometer_scale_sigma")  # ours
CAMERA_EXAMPLE = (
    "T_BS: {rows: 4, cols: 4, data: [16 numbers]}, resolution: [640, 480], intrinsics: [fx, fy, cx, cy], "
    "distortion_model: radial-tangential, distortion_coefficients: [k1, k2, p1, p2]"
)
DEPTH_CAMERA_KEYS = "resolution, intrinsics, distortion_model, distortion_coefficients and T_color_depth (4 x 4)"
_SAME_LENS_PX = 0.5  # registered depth may repeat cam0's intrinsics, rounded
_SILENT = frozenset({  # keys that say nothing that an estimate could miss, or that other readers of the file ask for
    "sensor_type", "comment", "rostopic", "cam_overlaps", "camera_name", "camera_id", "rate_hz", "update_rate",
    "registered_to", "rectification_matrix", "projection_matrix", "depth_units_per_m", "depth_invalid",
    "depth_offset_px", "depth_time_offset_s", "depth_camera",
    "gyro_bias_rad_s", "gyro_matrix", "accel_bias_m_s2", "accel_matrix",
})  # fmt: skip
_OF_DEPTH = ("T_BS", "camera_model", "distortion_model", "distortion_coefficients", "intrinsics", "resolution")
_DEPTH_UNITS = ("depth_units_per_m", "RGBD.DepthMapFactor", "DepthMapFactor")  # ours and ORB-SLAM's
# a pose (T_cam_body, body_T_cam0, T_i_c, Tbc, R_BC, extrinsicRotation), a clock (timeshift_imu_cam, td) or a scale (Tw)
WEIGHTY = re.compile(
    r"(^|_|\.)[TRpqt]_|^[TRpqt][A-Z]{2}$|^T[a-z]{1,2}$|extrinsic|^gyroscopes$|^accelerometers$|(?i:(time|stamp|clock|cam|camera|image|imu)_?(shift|offset|delay|lag))|^td$|scale",
    re.A,
)
_MOST_NAMED = 12


class Keys(dict[str, Any]):
    """The mapping of a calibration file, which knows what was asked of it.

    Attributes:
        asked: keys that a reader looked at, whether they are there or not.
    """

    def __init__(self, data: Mapping[str, Any]) -> None:
        """Take a mapping over."""
        super().__init__(data)
        self.asked: set[str] = set()

    def get(self, key: str, default: Any = None) -> Any:
        """Return what a key holds, or the default."""
        self.asked.add(key)
        return super().get(key, default)

    def __getitem__(self, key: str) -> Any:
        self.asked.add(key)
        return super().__getitem__(key)

    def name_unused(self, path: Path, instead: str = "", known: Iterable[str] = ()) -> None:
        """Warn of keys that nothing was asked for.

        Args:
            path: the file.
            instead: keys of poses that are read; where given, a pose, clock or scale that was not used is refused.
            known: further keys that need no word.

        Raises:
            DataError: a key was not used without which an estimate would be wrong.
        """
        needless = self.asked | _SILENT | set(known)
        rest = {str(key): value for key, value in self.items() if key not in needless and value is not None}
        # an identity is a pose, too: where none is read, the recording's own stands
        weighty = [k for k, v in rest.items() if instead and WEIGHTY.search(k) and (isinstance(v, list | dict) or v)]
        if weighty:
            raise DataError(
                f"{path}: not read: {_listed(weighty)}; without it a place, clock or scale would be wrong: write "
                f"{instead}, or remove it"
            )
        if unused := [key for key, value in rest.items() if not is_neutral(value)]:
            warn_once(f"{path}: not used: {_listed(unused)}")


@dataclass(frozen=True, slots=True)
class DepthFile:
    """What a sensor file states of depth images; None where it states nothing."""

    units_per_m: float | None = None
    invalid: tuple[int, ...] | None = None
    offset_px: tuple[float, float] | None = None
    time_offset_s: float | None = None
    own: DepthCamera | None = None  # of depth that is not registered

    def over(self, how: DepthFormat) -> DepthFormat:
        """Return `how`, with what the file states in its place."""
        said = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(how, **{name: value for name, value in said.items() if value is not None})


@dataclass(frozen=True, slots=True, eq=False)
class CameraFile:
    """What a camera's sensor file states."""

    camera: Camera
    T_body_cam: Array  # [4, 4]
    rate_hz: float | None = None
    depth: DepthFile = field(default_factory=DepthFile)  # where depth images share the camera's file
    clock_s: float | None = None  # to be added to its stamps to get the IMU's time


def load_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file (OpenCV's `%YAML:1.0` header and matrix tags are tolerated).

    Raises DataError when it is missing, too large, no YAML, or no mapping.
    """
    check_size(path, MAX_YAML_BYTES)
    try:
        with readable(path):
            text = read_text(path, MAX_YAML_BYTES)
        lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
        if len(lines) < len(text.splitlines()):  # OpenCV wants no space behind a colon
            lines = [re.sub(r"^(\s*[A-Za-z_][\w.]*):(?=[\w\[\"+-])", r"\1: ", line) for line in lines]
        body = next((k for k, line in enumerate(lines) if line[:1].isalpha()), 0)
        end = next((k for k in range(body, len(lines)) if lines[k].rstrip() == "---"), len(lines))  # rostopic echo
        if any(lines[end + 1 :]):
            warn_once(f"{path}: of several documents the first is taken")
        data = parse_yaml("\n".join(lines[:end]).replace("!!opencv-matrix", ""))
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"{path} cannot be read as YAML: {reason}") from error
    if not isinstance(data, dict):
        raise DataError(f"{path} must hold `key: value` lines, got {type(data).__name__}")
    return data


def read_camera(path: Path) -> CameraFile:
    """Return the camera of an ASL sensor file; raises DataError naming the key, what was got and what is wanted."""
    data = Keys(load_yaml(path))
    try:
        found = CameraFile(
            camera=parse_camera(data, path, "distortion_coefficients"),
            T_body_cam=read_pose(data, path),
            rate_hz=optional_positive(data, "rate_hz", path),
            depth=parse_depth(data, path),
        )
        data.name_unused(path, "T_BS")
        return found
    except DataError as error:
        raise DataError(f"{error}; a camera's file holds: {CAMERA_EXAMPLE}") from error


def read_imu(path: Path) -> tuple[ImuNoise, Array]:
    """Return noise and pose `T_BS` [4, 4] of an ASL IMU file; raises DataError naming the key."""
    data = Keys(load_yaml(path))
    # `vislam calibrate noise` writes Kalibr's key, and its file is put in the place of this one
    key = "update_rate" if "update_rate" in data and "rate_hz" not in data else "rate_hz"
    noise, T_body_imu = parse_noise(data, key, path), read_pose(data, path)
    data.name_unused(path, "T_BS")
    return noise, T_body_imu


def read_pose(data: Mapping[str, Any], path: Path) -> Array:
    """Return `T_BS` [4, 4] of a sensor file, identity when it has none; raises DataError unless it is rigid."""
    T = pose_in(data, "T_BS", path)
    return np.eye(4) if T is None else T


def pose_in(data: Mapping[str, Any], key: str, path: Path) -> Array | None:
    """Return a pose [4, 4] of a file, also of three rows; None where it has none. DataError unless it is rigid."""
    if data.get(key) is None:
        return None
    value = data[key].get("data") if isinstance(data[key], dict) else data[key]
    rows = 3 if len(_flat(value)) == 3 * 4 else 4
    T = np.eye(4)
    T[:rows] = np.reshape(numbers_in(data, key, path, 4 * rows), (rows, 4))
    if not are_rotations(T[:3, :3], 1e-3) or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise DataError(f"{path}: {key} is not a rigid transform: {T.tolist()}")
    return T


def parse_depth(data: Mapping[str, Any], path: Path) -> DepthFile:
    """Return what a sensor file states of depth images; raises DataError naming the key."""
    invalid = offset_px = time_offset_s = None
    if data.get("depth_invalid") is not None:
        invalid = tuple(int(value) for value in numbers_in(data, "depth_invalid", path))
    if data.get("depth_offset_px") is not None:
        dx, dy = numbers_in(data, "depth_offset_px", path, 2)
        offset_px = (dx, dy)
        if max(abs(dx), abs(dy)) > _MOST_OFFSET_PX:
            raise DataError(f"{path}: depth_offset_px must be within {_MOST_OFFSET_PX:.0f} px, got {[dx, dy]}")
    if data.get("depth_time_offset_s") is not None:
        [time_offset_s] = numbers_in({"s": [data["depth_time_offset_s"]]}, "s", path, 1)
        if abs(time_offset_s) > _MOST_TIME_OFFSET_S:
            raise DataError(f"{path}: depth_time_offset_s must be within {_MOST_TIME_OFFSET_S} s, got {time_offset_s}")
    nested = data.get("depth_camera")
    if nested is not None and not isinstance(nested, dict):
        raise DataError(f"{path}: depth_camera must hold {DEPTH_CAMERA_KEYS}, got {str(nested)[:80]}")
    own = None if nested is None else parse_depth_camera(keys := Keys(nested), path)
    if nested is not None:
        keys.name_unused(path, "T_color_depth", _OF_DEPTH)
    units = next((key for key in _DEPTH_UNITS if data.get(key) is not None), _DEPTH_UNITS[0])
    return DepthFile(optional_positive(data, units, path), invalid, offset_px, time_offset_s, own)


def parse_depth_camera(data: Mapping[str, Any], path: Path) -> DepthCamera:
    """Return lens and place of depth that is not registered; raises DataError naming the key."""
    for key in ("T_color_depth", "intrinsics", "resolution"):
        if data.get(key) is None:
            raise DataError(f"{path}: depth with a lens of its own has no {key}; write {DEPTH_CAMERA_KEYS}")
    T = pose_in(data, "T_color_depth", path)
    assert T is not None
    if not np.linalg.norm(T[:3, 3]) <= _MOST_APART_M:
        raise DataError(f"{path}: T_color_depth puts depth {np.linalg.norm(T[:3, 3]):.3g} m from colour; write metres")
    return DepthCamera(parse_camera(data, path, "distortion_coefficients"), T)


def depth_format(path: Path, camera: Camera, usual: DepthFormat) -> DepthFormat:
    """Return how to read a depth folder by its sensor file, beside images of `camera`; else as `usual`.

    Depth is registered unless the file states `T_color_depth`. Raises DataError where it contradicts itself.
    """
    data = Keys(load_yaml(path))
    how = parse_depth(data, path).over(usual)
    data.name_unused(path, "depth_units_per_m and T_color_depth", ("T_color_depth", *_OF_DEPTH))
    if data.get("T_color_depth") is not None:
        if data.get("registered_to") is not None:
            raise DataError(f"{path}: depth is registered_to a camera or has a T_color_depth; remove one of them")
        return replace(how, own=parse_depth_camera(data, path))
    resolution = [int(x) for x in numbers_in(data, "resolution", path, 2)] if "resolution" in data else None
    if resolution is not None and resolution != [camera.width, camera.height]:
        raise DataError(
            f"{path}: depth of {resolution} does not match cam0's {camera.width}x{camera.height}; register it to cam0, "
            f"pixel by pixel, or write {DEPTH_CAMERA_KEYS}"
        )
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    stated = pinhole if data.get("intrinsics") is None else numbers_in(data, "intrinsics", path, 4)
    if not np.allclose(stated, pinhole, rtol=0.0, atol=_SAME_LENS_PX):
        raise DataError(f"{path}: intrinsics differ from cam0's, but there is no T_color_depth; write it, too")
    return how


def parse_camera(data: Mapping[str, Any], path: Path, coefficients_key: str) -> Camera:
    """Return the camera in the keys that ASL and Kalibr share; raises DataError naming the key."""
    name = str(data.get("distortion_model", "none")).lower()
    model, kind = MODELS.get(name), str(data.get("camera_model", "pinhole")).lower()
    lens, before, distortions = _CAMERA_MODELS.get(kind, ("none", 0, ()))
    if model is None or model not in distortions:
        raise DataError(
            f"{path}: '{data.get('camera_model')}', '{name}' is not supported; use pinhole with {[*MODELS]}, eucm or "
            "ds with none, or omni with radtan or none"
        )
    width, height = numbers_in(data, "resolution", path, 2)
    *shape, fx, fy, cx, cy = numbers_in(data, "intrinsics", path, before + 4)
    coefficients = numbers_in(data, coefficients_key, path) if model != "none" else []
    if kind != "pinhole":
        model, coefficients = lens, [*shape, *(coefficients or [0.0] * (4 * (lens == "omni")))]
    if lens == "eucm" and shape[1] == 1.0:
        model, coefficients = "ucm", shape[:1]
    skew = numbers_in({"skew_px": [data.get("skew_px", 0.0)]}, "skew_px", path, 1)[0]
    stated = {key: optional_positive(data, name, path, allow_zero=True) for key, name in SIGMA_KEYS.items()}
    sigmas = CameraSigmas(**{key: value for key, value in stated.items() if value is not None})
    K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return replace(stated_camera((int(width), int(height)), K, model, coefficients, str(path)), sigmas=sigmas)


def stated_camera(
    size_px: tuple[int, int], K: Array, model: Distortion, coefficients: Sequence[float], where: str
) -> Camera:
    """Return the camera of a file that states K [3, 3] with focal lengths as Kalibr and Basalt have them.

    Raises DataError naming the file.
    """
    values = tuple(coefficients)
    try:
        camera = Camera(*size_px, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], model, values)
        return camera.with_focal(1.0 / LENS_MODELS[model].focal_in_files(values))
    except DataError as error:
        raise DataError(f"{where}: {error}") from error


def stated_lens(camera: Camera, names: Mapping[Distortion, str]) -> tuple[str, list[float], str, tuple[float, ...]]:
    """Return what a file states of a lens: model, intrinsics, distortion's name by `names`, and its coefficients."""
    model, k = camera.distortion, camera.coefficients
    factor = camera.model.focal_in_files(k)
    pinhole = [camera.fx * factor, camera.fy * factor, camera.cx, camera.cy]
    if not camera.model.is_spherical:
        return "pinhole", pinhole, names[model], k
    if model == "omni":
        return "omni", [k[0], *pinhole], names["radtan"], k[1:]
    return ("eucm", [*k, 1.0, *pinhole], "none", ()) if model == "ucm" else (model, [*k, *pinhole], "none", ())


def parse_noise(data: Mapping[str, Any], rate_key: str, path: Path) -> ImuNoise:
    """Return the noise model in the keys that ASL and Kalibr share; raises DataError naming the key."""
    values: dict[str, float] = {}
    for key in NOISE_KEYS:
        value = optional_positive(data, key, path, allow_zero=key.endswith("walk"))
        if value is None:
            raise DataError(f"{path}: no '{key}'; an IMU's file holds {', '.join(NOISE_KEYS)} and {rate_key}")
        values[key] = value
    gyro, accel = (optional_positive(data, key, path, allow_zero=True) for key in SCALE_KEYS)
    rate_hz = optional_positive(data, rate_key, path) or 0.0
    return ImuNoise(**values, rate_hz=rate_hz, gyroscope_scale_sigma=gyro, accelerometer_scale_sigma=accel)


def optional_positive(data: Mapping[str, Any], key: str, path: Path, allow_zero: bool = False) -> float | None:
    """Return a number, None where the key is absent; raises DataError unless it is positive."""
    if data.get(key) is None:
        return None
    value = numbers_in({key: [data[key]]}, key, path, 1)[0]
    if value < 0.0 or (value == 0.0 and not allow_zero):
        raise DataError(f"{path}: {key} must be positive, got {value}")
    return value


def numbers_in(data: Mapping[str, Any], key: str, path: Path, count: int | None = None) -> list[float]:
    """Return a list (nested lists are joined, OpenCV's matrices opened) of finite numbers.

    YAML reads 5e-6 as text, so text is converted.
    """
    value = data.get(key)
    value = value.get("data") if isinstance(value, dict) else value
    flat = _flat(value)
    try:
        numbers = [float(x) for x in flat]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != (len(flat) if count is None else count) or not np.all(np.isfinite(numbers)):
        raise DataError(f"{path}: {key} must be {count or 'a list of'} finite numbers, got {str(value)[:80]}")
    return numbers


def is_neutral(value: Any) -> bool:
    """Return whether a value is none, zero, one or an identity: not to use it changes nothing."""
    try:
        flat = np.array(_flat(value["data"] if isinstance(value, dict) else value), dtype=np.float64)
    except (TypeError, ValueError, KeyError, OverflowError):
        return value is None
    side = round(np.sqrt(flat.size))
    return not flat.any() or bool((flat == 1.0).all()) or np.array_equal(flat, np.eye(side).ravel())


def _flat(value: Any) -> list[Any]:
    """Return the elements of a list, and of lists in it."""
    rows = value if isinstance(value, list) else [value]
    return [x for row in rows for x in (row if isinstance(row, list) else [row])]


def _listed(keys: list[str]) -> str:
    more = f" and {len(keys) - _MOST_NAMED} more" if len(keys) > _MOST_NAMED else ""
    return ", ".join(key[:40] for key in keys[:_MOST_NAMED]) + more


def warn_readout(path: Path, key: str, readout_s: float) -> None:
    """Warn of a rolling shutter that a file states, and name the setting for it."""
    if readout_s:
        warn_once(f"{path}: not used: {key}: give --frontend.readout-s {readout_s:.4g}")


@lru_cache(maxsize=256)  # a file is read several times on the way to a run
def warn_once(text: str) -> None:
    """Warn of something about a file, which is opened several times."""
    _LOG.warning("%s", text)
