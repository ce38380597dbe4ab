"""A box-shaped room seen by a small RGB-D camera, with exact depth: what the mapping tests look at."""

from dataclasses import replace

import numpy as np

from vislam.config import MapConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Frame, Keyframe
from worlds.parts import R_BODY_CAM

CAMERA = Camera(160, 120, 130.0, 131.0, 80.3, 59.1, 0.0, "radtan", (-0.08, 0.03, 0.0006, -0.0004))
T_BODY_CAM0 = transform(R_BODY_CAM, np.array([0.05, 0.02, 0.1]))
RIG = Rig((CAMERA,), (T_BODY_CAM0,), has_depth=True)
ROOM_LOW, ROOM_HIGH = np.array([-2.5, -2.0, 0.0]), np.array([2.5, 2.0, 2.4])
CONFIG = replace(MapConfig(), speckle_pixels=10, cloud_voxel_m=0.03)


def pose(k):
    """T_map_body of the k-th keyframe: turning on the spot while walking a little circle."""
    yaw = 0.4 * k
    return transform(so3_exp(np.array([0.0, 0.0, yaw])), np.array([0.6 * np.cos(0.3 * k), 0.6 * np.sin(0.3 * k), 1.2]))


def depth_image(T_map_body, camera=CAMERA):
    """Exact z-depth [H, W] of the room's walls, floor and ceiling."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    T_map_cam = T_map_body @ T_BODY_CAM0
    directions, origin = rays @ T_map_cam[:3, :3].T, T_map_cam[:3, 3]
    with np.errstate(divide="ignore"):
        walls = np.where(directions > 0, (ROOM_HIGH - origin) / directions, (ROOM_LOW - origin) / directions)
    return walls.min(axis=1).reshape(camera.height, camera.width).astype(np.float32)


def keyframe(k, T_map_body=None, depth_m=None):
    T = pose(k) if T_map_body is None else T_map_body
    depth = depth_image(T) if depth_m is None else depth_m
    color = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    color[..., 2] = 200  # BGR: red
    frame = Frame(1_000_000_000 + 100_000_000 * k, k, (color[..., 2],), color, depth)
    return Keyframe(k, frame.t_ns, frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)
