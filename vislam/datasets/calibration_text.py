"""Sensor files as they are written, in our keys; reading them back gives the same bits."""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np

from vislam.core.camera import Camera
from vislam.core.messages import Array
from vislam.datasets.calibration import MODEL_NAMES, NOISE_KEYS, SCALE_KEYS, SIGMA_KEYS, stated_lens
from vislam.datasets.images import DepthFormat
from vislam.imu import ImuNoise


def pose_text(T: Array) -> str:
    """Return the `T_BS` block of a sensor file for a pose [4, 4]."""
    rows = ",\n         ".join(", ".join(repr(float(x)) for x in row) for row in T)
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"


def camera_text(camera: Camera, T_body_cam: Array | None, comment: str) -> str:
    """Return the sensor file of a camera; without a pose it has none."""
    pose = "" if T_body_cam is None else pose_text(T_body_cam)
    kind, intrinsics, distortion, coefficients = stated_lens(camera, MODEL_NAMES)
    return (
        f"sensor_type: camera\ncomment: {json.dumps(comment)}\n{pose}"
        f"resolution: [{camera.width}, {camera.height}]\ncamera_model: {kind}\n"
        f"intrinsics: {list_text(intrinsics)}  # the last four: fu, fv, cu, cv in pixels\n"
        f"skew_px: {float(camera.skew_px)!r}\n"
        f"distortion_model: {distortion}\n"
        f"distortion_coefficients: {list_text(coefficients)}\n"
        + "".join(f"{name}: {float(getattr(camera.sigmas, key))!r}\n" for key, name in SIGMA_KEYS.items())
    )


def imu_text(noise: ImuNoise, comment: str) -> str:
    """Return the sensor file of an IMU that is the body frame."""
    known = [key for key in (*NOISE_KEYS, *SCALE_KEYS) if getattr(noise, key) is not None]
    lines = [f"{key}: {float(getattr(noise, key))!r}\n" for key in known]
    rate = f"rate_hz: {float(noise.rate_hz)!r}\n" if noise.rate_hz > 0.0 else ""
    return f"sensor_type: imu\ncomment: {json.dumps(comment)}\n{pose_text(np.eye(4))}{rate}{''.join(lines)}"


def depth_text(camera: Camera, units_per_m: float) -> str:
    """Return the sensor file of depth images registered to `camera`."""
    return (
        "sensor_type: depth\ncomment: z-depth registered to cam0, 16-bit PNG, 0 where invalid\nregistered_to: cam0\n"
        f"resolution: [{camera.width}, {camera.height}]\ndepth_units_per_m: {float(units_per_m)!r}\n"
    )


def depth_keys_text(how: DepthFormat) -> str:
    """Return the keys of a camera's sensor file that say how depth images are read."""
    invalid = f"depth_invalid: [{', '.join(map(str, how.invalid))}]\n" if how.invalid else ""
    own = ""
    if how.own is not None:
        lens = camera_text(how.own.camera, None, "depth").splitlines(keepends=True)
        place = f"T_color_depth: {list_text(how.own.T_color_depth.ravel())}\n"
        own = "depth_camera:\n" + "".join(f"  {line}" for line in [*lens, place])
    return (
        f"depth_units_per_m: {float(how.units_per_m)!r}\n{invalid}depth_offset_px: {list_text(how.offset_px)}\n"
        f"depth_time_offset_s: {float(how.time_offset_s)!r}\n{own}"
    )


def list_text(values: Iterable[float]) -> str:
    """Return numbers as a YAML list that reads back to the same bits."""
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
