"""RGB-D recordings of textured boards before a wall, rendered exactly; spoilt on request."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp
from vislam.datasets.calibration import camera_text

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
UNITS_PER_M = 5000.0
_RATE_HZ = 30.0
_BEGIN_S = 1000.0


@dataclass(frozen=True)
class Board:
    """A rectangle at z = z_m, upright; its texture is stretched over it."""

    z_m: float
    left_m: float
    top_m: float
    width_m: float
    height_m: float
    texture: np.ndarray


def boards(seed: int = 3) -> list[Board]:
    """A wall at 4 m with texture, and boards of other greys before it."""
    generator = np.random.default_rng(seed)
    out = []
    for i in range(22):
        z = 4.0 if i == 0 else float(generator.uniform(1.2, 3.2))
        size = (8.0, 6.0) if i == 0 else tuple(generator.uniform(0.15, 0.45, 2) * z)
        left, top = (
            (-4.0, -3.0) if i == 0 else ((generator.uniform(-0.75, 0.75, 2) * [1.0, 0.7] * z) - np.array(size) / 2)
        )
        grey = 70 if i == 0 else int(generator.choice([130, 160, 190, 220]))
        cells = (120, 160) if i == 0 else (12, 12)
        texture = np.clip(grey + generator.normal(0.0, 16.0, cells), 0, 255).astype(np.float32)
        out.append(Board(z, float(left), float(top), float(size[0]), float(size[1]), texture))
    return sorted(out, key=lambda board: -board.z_m)


def pose(t_s: float, speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation [3, 3] and place [3] of the camera: swung to all sides."""
    a = speed * t_s
    turn = np.array([0.16 * np.sin(2.9 * a), 0.24 * np.sin(2.1 * a), 0.1 * np.sin(1.7 * a)])
    return so3_exp(turn), np.array([0.25 * np.sin(1.9 * a), 0.18 * np.sin(2.5 * a), 0.2 * np.sin(1.3 * a)])


def render(world: list[Board], R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey image and the depth [m] that the camera sees, the nearest board in front."""
    grid = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([(grid - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(grid))]) @ R.T
    shape = (CAMERA.height, CAMERA.width)
    grey, depth = np.zeros(len(grid), np.float32), np.zeros(len(grid))
    for board in world:
        z = (board.z_m - t[2]) / rays[:, 2]
        at = t[:2] + z[:, None] * rays[:, :2]
        x, y = (at[:, 0] - board.left_m) / board.width_m, (at[:, 1] - board.top_m) / board.height_m
        on = (x >= 0.0) & (x <= 1.0) & (y >= 0.0) & (y <= 1.0) & (z > 0.0)
        rows, columns = board.texture.shape
        u, v = ((a * (n - 1)).reshape(shape).astype(np.float32) for a, n in ((x, columns), (y, rows)))
        shade = cv2.remap(board.texture, u, v, cv2.INTER_LINEAR)
        grey[on], depth[on] = shade.ravel()[on], z[on]
    return cv2.GaussianBlur(grey.reshape(shape), (0, 0), 0.7).astype(np.uint8), depth.reshape(shape)


def write_planes(
    folder: Path, frames: int = 90, focal: float = 1.0, shift_px: tuple[int, int] = (0, 0), late_s: float = 0.0,
    nothing: int = 0, speed: float = 1.0,
) -> Path:  # fmt: skip
    """Write a TUM folder: told focal length over the true one, depth shifted and late, a hole filled with `nothing`."""
    world, generator = boards(), np.random.default_rng(5)
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rgb, depths = [], []
    for i in range(frames):
        t_s = i / _RATE_HZ
        grey, _ = render(world, *pose(t_s, speed))
        _, depth = render(world, *pose(t_s - late_s, speed))
        depth = 1.0 / (1.0 / depth + generator.normal(0.0, 0.002, depth.shape))
        raw = np.rint(depth * UNITS_PER_M).astype(np.uint16)
        raw = cv2.warpAffine(
            raw, np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]]), raw.shape[::-1], flags=0
        )
        raw[200:, :40] = nothing
        cv2.imwrite(str(folder / "rgb" / f"{i:04d}.png"), grey)
        cv2.imwrite(str(folder / "depth" / f"{i:04d}.png"), raw)
        rgb.append(f"{_BEGIN_S + t_s:.6f} rgb/{i:04d}.png\n")
        depths.append(f"{_BEGIN_S + t_s:.6f} depth/{i:04d}.png\n")
    (folder / "rgb.txt").write_text("".join(rgb))
    (folder / "depth.txt").write_text("".join(depths))
    told = Camera(CAMERA.width, CAMERA.height, CAMERA.fx * focal, CAMERA.fy * focal, CAMERA.cx, CAMERA.cy)
    text = camera_text(told, None, "boards") + f"depth_units_per_m: {UNITS_PER_M}\n"
    (folder / "sensor.yaml").write_text(text)
    return folder
