"""Images of a board as a known camera sees it: every pixel's ray is met with the plane of the board."""

import cv2
import numpy as np

from vislam.calibration.cameras.board import Board
from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp, transform
from vislam.core.messages import Array, ImageU8

BOARD = Board("charuco", 9, 6, 0.03, 0.0225, "5X5_100")
CHESSBOARD = Board("chessboard", 9, 6, 0.03, 0.0, "")
WEBCAM = Camera(640, 480, 520.0, 517.0, 322.0, 236.0, 0.0, "radtan", (-0.28, 0.11, 6e-4, -4e-4))
DOUBLE = Camera(640, 480, 200.0, 201.0, 318.0, 243.0, 0.0, "ds", (-0.25, 0.56))  # sees 213 degrees across
FISHEYE = Camera(640, 480, 250.0, 251.0, 318.0, 243.0, 0.0, "equidistant", (-0.02, 0.004, -0.003, 0.0005))


def pose(rng: np.random.Generator, camera: Camera, board: Board, tilt_rad: float = 0.55) -> Array:
    """Return T_cam_board of a board somewhere in the image, slanted to a random side."""
    around = rng.uniform(0.0, 2.0 * np.pi)
    tilt = tilt_rad * rng.uniform(0.6, 1.0)
    R = so3_exp(np.array([0.0, 0.0, rng.uniform(-0.4, 0.4)])) @ so3_exp(
        tilt * np.array([np.cos(around), np.sin(around), 0.0])
    )
    distance = rng.uniform(0.8, 1.5) * board.size_m[0] * camera.fx / camera.width * 1.6
    pixel = np.array([[camera.width * rng.uniform(0.15, 0.85), camera.height * rng.uniform(0.15, 0.85)]])
    middle = camera.unproject(pixel)[0] * distance
    return transform(R, middle - R @ np.array([board.size_m[0] / 2.0, board.size_m[1] / 2.0, 0.0]))


def pose_around(rng: np.random.Generator, camera: Camera, board: Board, half_rad: float) -> Array:
    """Return T_cam_board of a board that roughly faces a ray within an angle of the axis, behind the camera too."""
    ray = np.array([0.0, 0.0, -1.0])
    while not ray[2] > np.cos(half_rad):
        ray = camera.bearings(rng.uniform([[0.0, 0.0]], [[camera.width, camera.height]]))[0]
    axis = np.cross([0.0, 0.0, 1.0], ray)
    around, tilt = rng.uniform(0.0, 2.0 * np.pi), 0.6 * rng.uniform(0.5, 1.0)
    R = so3_exp(axis / np.linalg.norm(axis) * np.arccos(ray[2])) @ so3_exp(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
    R = R @ so3_exp(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
    middle = np.array([*board.size_m, 0.0]) / 2.0
    return transform(R, rng.uniform(0.18, 0.3) * ray - R @ middle)


def see(camera: Camera, board: Board, T_cam_board: Array, rng: np.random.Generator, blur_px: float = 0.7) -> ImageU8:
    """Return the image, with blur and noise."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.bearings(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    direction, origin = rays @ R, -R.T @ t
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = -origin[2] / direction[:, 2]
    points = origin + direction * scale[:, None]
    points[~(scale > 0.0)] = -1e3
    px_per_m = 4000.0
    texture = cv2.copyMakeBorder(board.draw(px_per_m), 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255)
    at = np.clip(np.nan_to_num(points[:, :2], nan=-1e3) * px_per_m - 0.5 + 80.0, -1e4, 3e4).astype(np.float32)
    at = at.reshape(camera.height, camera.width, 2)
    image = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=140)
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px)
    return np.clip(image + rng.normal(0.0, 3.0, image.shape), 0, 255).astype(np.uint8)
