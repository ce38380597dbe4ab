"""A corner of a room, drawn with exact truth: two walls and a floor, textured with smoothed noise."""

from dataclasses import dataclass

import cv2
import numpy as np

from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, se3_exp, transform
from vislam.core.messages import Array, Frame
from worlds.parts import R_BODY_CAM, along_x, rig_of, texture

T_BODY_CAM = transform(R_BODY_CAM, np.array([0.05, 0.02, -0.03]))
BASELINE_M = 0.12
FRAME_NS = 50_000_000
_PLANES = (  # normal and distance in the world, which is cam0 of pose 0: back wall, right wall, floor
    (np.array([0.0, 0.0, 1.0]), 3.5),
    (np.array([0.8, 0.0, 0.6]), 2.4),
    (np.array([0.0, 1.0, 0.0]), 1.1),
)
_TEXTURE_PX, _TEXELS_PER_M = 1024, 100.0


def camera() -> Camera:
    """A small camera with the lens of a webcam."""
    return Camera(320, 240, 260.0, 258.0, 161.0, 118.5, distortion="radtan", coefficients=(-0.1, 0.03, 5e-4, -3e-4))


def rig(kind: str) -> Rig:
    """The rig of a mode: mono, stereo or rgbd."""
    return rig_of(kind, camera(), T_BODY_CAM, along_x(BASELINE_M))


def path(count: int, speed: float = 1.8) -> Array:
    """Body poses [count, 4, 4] of a gentle hand-held motion, in the frame of the first."""
    t = np.arange(count) * FRAME_NS * 1e-9 * speed
    twists = np.column_stack(
        [0.10 * np.sin(1.1 * t), 0.12 * np.sin(0.9 * t), 0.15 * np.sin(0.7 * t),
         0.20 * np.sin(0.8 * t), 0.25 * np.sin(1.0 * t), 0.12 * np.sin(1.3 * t)]
    )  # fmt: skip
    return np.stack([se3_exp(twist) for twist in twists])


@dataclass
class World:
    """Draws frames of a rig along a path."""

    kind: str
    noise_grey: float = 2.0
    depth_sigma_rho: float = 1.4e-3
    seed: int = 7

    def __post_init__(self) -> None:
        self.rig = rig(self.kind)
        self.rng = np.random.default_rng(self.seed)
        self._textures = [texture(self.rng, _TEXTURE_PX, 128, 55) for _ in _PLANES]
        self._rays = []
        for cam in self.rig.cameras:
            u, v = np.meshgrid(np.arange(cam.width, dtype=float), np.arange(cam.height, dtype=float))
            self._rays.append(cam.unproject(np.column_stack([u.ravel(), v.ravel()])))

    def draw(self, index: int, T_world_cam: Array) -> tuple[np.ndarray, np.ndarray]:
        cam = self.rig.cameras[index]
        directions = self._rays[index] @ T_world_cam[:3, :3].T
        nearest, grey = np.full(len(directions), np.inf), np.zeros(len(directions), np.float32)
        for (normal, distance), painted in zip(_PLANES, self._textures, strict=True):
            along = directions @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                z = (distance - T_world_cam[:3, 3] @ normal) / along
            hit = (along > 1e-6) & (z > 0.05) & (z < nearest)
            points = T_world_cam[:3, 3] + directions * np.where(hit, z, 1.0)[:, None]
            axis = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.5 else np.array([1.0, 0.0, 0.0])
            e1 = np.cross(normal, axis) / np.linalg.norm(np.cross(normal, axis))
            uv = (points @ np.column_stack([e1, np.cross(normal, e1)])) * _TEXELS_PER_M + _TEXTURE_PX / 2
            maps = uv.astype(np.float32).reshape(cam.height, cam.width, 2)
            sampled = cv2.remap(painted, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).ravel()
            grey[hit], nearest[hit] = sampled[hit], z[hit]
        grey += self.rng.normal(0.0, self.noise_grey, len(grey)).astype(np.float32)
        image = np.clip(np.round(grey), 0, 255).astype(np.uint8).reshape(cam.height, cam.width)
        return image, nearest.reshape(cam.height, cam.width)

    def frame(self, index: int, T_world_body: Array, t_ns: int | None = None) -> Frame:
        """Draw one frame; the world is cam0 of the identity pose."""
        drawn = [
            self.draw(i, invert(T_BODY_CAM) @ T_world_body @ T_body_cam)
            for i, T_body_cam in enumerate(self.rig.T_body_cams)
        ]
        depth = None
        if self.rig.has_depth:
            rho = 1.0 / drawn[0][1] + self.rng.normal(0.0, self.depth_sigma_rho, drawn[0][1].shape)
            depth = np.where(drawn[0][1] < 8.0, 1.0 / rho, 0.0).astype(np.float32)
        stamp = index * FRAME_NS + 1_000_000_000 if t_ns is None else t_ns
        return Frame(stamp, index, tuple(image for image, _ in drawn), None, depth)

    def frames(self, poses: Array) -> list[Frame]:
        """Draw one frame per pose."""
        return [self.frame(i, T) for i, T in enumerate(poses)]
