"""Depth with a lens and a place of its own, in the colour camera's pixels: against what rays meet in the scene."""

import cv2
import numpy as np
import pytest

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import so3_exp
from vislam.vision.depth_registration import DepthCamera, DepthRegistration

COLOR = Camera(320, 240, 260.0, 258.0, 158.5, 121.0, 0.0, "radtan", (-0.12, 0.03, 0.001, -0.0005))
WALL = np.array([0.2, -0.1, 1.0]), 3.0  # n @ p = d in the colour camera
BOARD = np.array([0.1, 0.05, 1.0]), 1.2
BOARD_REACH_M = 0.3  # to all sides of the axis


def place(turn_rad: tuple[float, float, float], t_m: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(np.array(turn_rad)), t_m
    return T


def met(camera: Camera, T_color_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] of a board before a wall in a camera at `T_color_cam`, and which pixels see the board."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()])) @ T_color_cam[:3, :3].T
    z = []
    for normal, distance in (WALL, BOARD):
        z.append((distance - normal @ T_color_cam[:3, 3]) / (rays @ normal))
    at = rays * z[1][:, None] + T_color_cam[:3, 3]
    is_board = (np.abs(at[:, :2]) < BOARD_REACH_M).all(axis=1)
    depth = np.where(is_board, z[1], z[0]).reshape(u.shape)
    return depth.astype(np.float32), is_board.reshape(u.shape)


def hidden(depth: DepthCamera) -> np.ndarray:
    """Which colour pixels show what the board hides from the depth camera, or what lies beside its image."""
    z, is_board = met(COLOR, np.eye(4))
    u, v = np.meshgrid(np.arange(COLOR.width), np.arange(COLOR.height))
    points = COLOR.unproject(np.column_stack([u.ravel(), v.ravel()])) * z.reshape(-1, 1)
    T = np.linalg.inv(depth.T_color_depth)
    pixels = depth.camera.project(points @ T[:3, :3].T + T[:3, 3])
    begin = depth.T_color_depth[:3, 3]
    at = begin + (points - begin) * ((BOARD[1] - BOARD[0] @ begin) / ((points - begin) @ BOARD[0]))[:, None]
    behind = (np.abs(at[:, :2]) < BOARD_REACH_M).all(axis=1) & ~is_board.ravel()
    return (behind | ~depth.camera.contains(pixels)).reshape(z.shape)


def near_edges(mask: np.ndarray, reach_px: int = 2) -> np.ndarray:
    box = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    return cv2.dilate(mask.astype(np.uint8), box) != cv2.erode(mask.astype(np.uint8), box)


DEPTHS = {
    "as fine": DepthCamera(
        Camera(320, 240, 262.0, 262.0, 160.0, 118.0), place((0.01, -0.015, 0.012), (0.05, -0.01, 0.004))
    ),
    "coarser": DepthCamera(
        Camera(112, 86, 74.0, 75.0, 56.2, 42.1, 0.0, "equidistant", (0.02, -0.01, 0.0, 0.0)),
        place((0.0, 0.02, 0.0), (-0.12, 0.0, 0.01)),
    ),
    "finer": DepthCamera(Camera(640, 400, 480.0, 480.0, 322.0, 199.0), place((-0.01, 0.0, 0.0), (0.015, 0.02, -0.02))),
    "on its side": DepthCamera(
        Camera(240, 320, 262.0, 262.0, 120.0, 158.0), place((0.0, 0.0, np.pi / 2), (0.05, 0.0, 0.0))
    ),
    "askew": DepthCamera(Camera(400, 400, 262.0, 262.0, 200.0, 200.0), place((0.0, 0.0, 0.7), (0.0, 0.04, 0.0))),
}


@pytest.mark.parametrize("name", DEPTHS)
def test_what_both_cameras_see_has_its_depth_and_what_is_hidden_has_none(name: str) -> None:
    depth = DEPTHS[name]
    found = DepthRegistration(depth, COLOR).registered(met(depth.camera, depth.T_color_depth)[0])
    truth, is_board = met(COLOR, np.eye(4))
    is_hidden = hidden(depth)
    coarse = int(np.ceil(COLOR.fx / depth.camera.fx))
    clear = ~near_edges(is_board, 1 + coarse) & ~near_edges(is_hidden, 1 + coarse)
    assert (clear & is_hidden).any() and (clear & is_board).sum() > 5000
    np.testing.assert_allclose(found[clear & ~is_hidden], truth[clear & ~is_hidden], rtol=2e-3)  # so no holes, too
    np.testing.assert_allclose(found[clear & is_board], truth[clear & is_board], rtol=5e-4)
    assert not found[clear & is_hidden].any()


def test_nothing_of_a_wall_shows_through_a_board_before_it() -> None:
    """The depth camera sees wall past the board's edge that lies behind the board in the colour image."""
    depth = DEPTHS["as fine"]
    found = DepthRegistration(depth, COLOR).registered(met(depth.camera, depth.T_color_depth)[0])
    truth, is_board = met(COLOR, np.eye(4))
    inner = cv2.erode(is_board.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (truth[inner] < 1.5).all() and (found[inner] > 1.0).all() and (found[inner] < 1.5).all()


def test_a_camera_that_is_the_colour_camera_changes_nothing() -> None:
    depth_m = np.random.default_rng(1).uniform(0.4, 6.0, (240, 320)).astype(np.float32)
    depth_m[::3] = 0.0
    found = DepthRegistration(DepthCamera(COLOR, np.eye(4)), COLOR).registered(depth_m)
    np.testing.assert_array_equal(found, depth_m)


def test_what_was_not_measured_is_nothing_and_damage_ends() -> None:
    depth = DepthCamera(COLOR, place((0.0, 0.0, 0.0), (0.05, 0.0, -0.01)))
    registration = DepthRegistration(depth, COLOR)
    for value in (0.0, np.nan, np.inf, -1.0, 1e-30, 1e-4, 0.01, 0.010001, 3e38):
        found = registration.registered(np.full((240, 320), value, np.float32))
        assert np.isfinite(found).all() and (found >= 0.0).all()
        assert value == 3e38 or not found.any()
    with pytest.raises(DataError, match="320x200 but its calibration is for 320x240"):
        registration.registered(np.zeros((200, 320), np.float32))
