"""What several worlds are made of: mounted cameras, points on walls, textures, keyframes without images."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vislam.config import MachineConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import transform
from vislam.core.messages import Array, Frame, Keyframe, Observations

MACHINE = MachineConfig()
GRAVITY_M_S2 = MACHINE.gravity_m_s2
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x forward, y left, z up
EUROC_CAMERA = Camera(752, 480, 458.0, 457.0, 367.0, 248.0)


def rig_of(kind: str, camera: Camera, T_body_cam: Array, T_cam0_cam1: Array) -> Rig:
    """Return the rig of a mode: mono, stereo or rgbd."""
    if kind == "stereo":
        return Rig((camera, camera), (T_body_cam, T_body_cam @ T_cam0_cam1))
    return Rig((camera,), (T_body_cam,), has_depth=kind == "rgbd")


def along_x(baseline_m: float) -> Array:
    """Return T_cam0_cam1 of two parallel cameras."""
    return transform(np.eye(3), np.array([baseline_m, 0.0, 0.0]))


def on_walls(rng: np.random.Generator, count: int, half_m: Array) -> Array:
    """Return points [count, 3] on the six sides of a room with these half extents."""
    points = rng.uniform(-1.0, 1.0, (count, 3))
    rows, axis = np.arange(count), rng.integers(0, 3, count)
    points[rows, axis] = np.sign(points[rows, axis])
    return points * half_m


def mixed_noise(rng: np.random.Generator, size_px: int) -> np.ndarray:
    """Return noise [size, size] at three scales, of deviation 1."""
    layers = [rng.standard_normal((size_px, size_px)) for _ in range(3)]
    mixed = sum(cv2.GaussianBlur(layer, (0, 0), s) * s for layer, s in zip(layers, (1.5, 4.0, 12.0), strict=True))
    return mixed / mixed.std()


def texture(rng: np.random.Generator, size_px: int, mean: float, contrast: float) -> np.ndarray:
    """Return a grey texture [size, size] of mixed noise."""
    return np.clip(mean + contrast * mixed_noise(rng, size_px), 0, 255).astype(np.float32)


def bare_keyframe(k: int, t_ns: int) -> Keyframe:
    """Return a keyframe that saw nothing."""
    return Keyframe(k, t_ns, Frame(t_ns, k, ()), np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)


def derivative(function: Callable[[Array], Array], t: Array, h: float) -> Array:
    """Fourth-order central difference; with smooth functions exact to 1e-9."""
    return (8 * (function(t + h) - function(t - h)) - (function(t + 2 * h) - function(t - 2 * h))) / (12 * h)


def ideal_imu(
    position: Callable[[Array], Array], rotation: Callable[[Array], Rotation], t: Array
) -> tuple[Array, Array]:
    """Return body rates [N, 3] and specific forces [N, 3] at times [N] of a motion given as functions of time."""
    R = rotation(t)
    gyro = derivative(lambda s: (R.inv() * rotation(t + s)).as_rotvec(), np.zeros(1), 1e-3)
    acceleration = derivative(lambda s: derivative(position, s, 1e-3), t, 1e-3)
    return gyro, R.inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY_M_S2]))


def with_slips(
    frames: Sequence[Observations], share: float, px_per_frame: float, rng: np.random.Generator
) -> list[Observations]:
    """Return what a camera saw as a tracker followed it of which a share of the corners slips, each its own way."""
    slips: dict[int, tuple[int, Array]] = {}  # of each track, the first frame and its way per frame
    out = []
    for k, seen in enumerate(frames):
        pixels = seen.pixels_px.copy()
        for i, n in enumerate(seen.track_ids.tolist()):
            if n not in slips:
                turn = rng.uniform(0.0, 2.0 * np.pi)
                slips[n] = k, (rng.random() < share) * px_per_frame * np.array([np.cos(turn), np.sin(turn)])
            pixels[i] += (k - slips[n][0]) * slips[n][1]
        out.append(replace(seen, pixels_px=pixels))
    return out
