"""A world of landmarks with descriptors, seen by a camera with exact truth: keyframes without images."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, transform, transform_points
from vislam.core.messages import Array, Frame, Keyframe
from worlds.parts import R_BODY_CAM

BLANK = np.zeros((480, 640), dtype=np.uint8)


def make_rig() -> Rig:
    """A camera with distortion, mounted 10 cm ahead on a body with x forward, y left, z up."""
    camera = Camera(640, 480, 450.0, 452.0, 322.0, 238.0, 0.0, "radtan", (-0.2, 0.05, 0.001, -0.001))
    return Rig((camera,), (transform(R_BODY_CAM, np.array([0.10, 0.02, 0.05])),), has_depth=True)


def body_pose(
    position: tuple[float, float, float], yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    T[:3, 3] = position
    return T


@dataclass(frozen=True)
class LandmarkWorld:
    """Landmarks [L, 3] with descriptors [L, 32]."""

    points: Array
    descriptors: np.ndarray
    rig: Rig

    def see(
        self, keyframe_id: int, T_world_body: Array, rng: np.random.Generator, *, noise_px: float = 0.7,
        flips: int = 12, inverse_depth_noise: float = 0.005, clutter: int = 60, known: float = 1.0, depth: bool = True,
        count: int = 500,
    ) -> Keyframe:  # fmt: skip
        """Return a keyframe: noisy pixels, flipped bits, `clutter` features of nothing, `known` share with depth."""
        camera = self.rig.cameras[0]
        inside = transform_points(invert(T_world_body @ self.rig.T_body_cams[0]), self.points)
        pixels = camera.project(inside)
        seen = np.flatnonzero(camera.contains(pixels, 5.0) & (inside[:, 2] < 15.0))
        seen = np.sort(rng.permutation(seen)[:count])
        pixels = pixels[seen] + rng.normal(size=(len(seen), 2)) * noise_px
        z = 1.0 / (1.0 / inside[seen, 2] + rng.normal(size=len(seen)) * inverse_depth_noise)
        bits = np.unpackbits(self.descriptors[seen], axis=1)
        bits ^= (rng.random(bits.shape) < flips / 256.0).astype(np.uint8)
        points = transform_points(self.rig.T_body_cams[0], camera.unproject(pixels) * z[:, None])
        points[rng.random(len(points)) >= known] = np.nan
        noise = rng.uniform((20.0, 20.0), (620.0, 460.0), (clutter, 2))
        return Keyframe(
            keyframe_id,
            keyframe_id * 200_000_000,
            Frame(keyframe_id * 200_000_000, keyframe_id, (BLANK,)),
            np.concatenate([pixels, noise]),
            np.concatenate([np.packbits(bits, axis=1), rng.integers(0, 256, (clutter, 32), dtype=np.uint8)]),
            np.concatenate([points, np.full((clutter, 3), np.nan)]) if depth else None,
        )


def room(seed: int, count: int = 6000, half_size_m: float = 6.0, clutter_depth_m: float = 2.0) -> LandmarkWorld:
    """A square room of landmarks that stand up to `clutter_depth_m` off its four walls."""
    rng = np.random.default_rng(seed)
    side = rng.integers(0, 4, count)
    along = rng.uniform(-half_size_m, half_size_m, count)
    off = half_size_m - rng.uniform(0.0, clutter_depth_m, count)
    height = rng.uniform(-1.5, 2.0, count)
    x = np.select([side == 0, side == 1, side == 2], [off, -off, along], along)
    y = np.select([side == 0, side == 1, side == 2], [along, along, off], -off)
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    return LandmarkWorld(np.column_stack([x, y, height]), descriptors, make_rig())


def lap_poses(laps: float, per_lap: int, radius_m: float = 2.5) -> list[Array]:
    """Poses on a circle, looking ahead and outwards."""
    poses = []
    for i in range(int(laps * per_lap)):
        angle = 2.0 * np.pi * i / per_lap
        position = (radius_m * np.cos(angle), radius_m * np.sin(angle), 0.1 * np.sin(3.0 * angle))
        poses.append(body_pose(position, float(np.rad2deg(angle)) + 45.0, 2.0 * float(np.sin(5.0 * angle))))
    return poses
