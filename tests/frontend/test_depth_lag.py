"""Depth that was taken at another moment than its image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import se3_exp
from vislam.core.messages import Array, Frame
from vislam.frontend.depth_lag import DepthLag
from vislam.frontend.rgbd import ImageDepth

CAMERA = Camera(width=320, height=240, fx=260.0, fy=260.0, cx=160.0, cy=120.0)
CONFIG = FrontEndConfig()
PLANE = np.array([0.25, 0.1, 0.4])  # 1/z = x, y, 1 on z = 1 times this
IDS = np.arange(200)


def plane_seen_from(T: Array) -> Array:
    """Return the plane [3] in the axes of a camera at T [4, 4]: points p with plane @ p = 1."""
    turned = PLANE @ T[:3, :3]
    return np.asarray(turned / (1.0 - PLANE @ T[:3, 3]))


def depth_image(T: Array) -> Frame:
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    depth = 1.0 / (rays @ plane_seen_from(T))
    return Frame(0, 0, (np.zeros((CAMERA.height, CAMERA.width), np.uint8),), None, depth.astype(np.float32))


def tracks(seed: int = 0) -> tuple[Array, Array]:
    """Return raw pixels [N, 2] and directions [N, 2] on z = 1."""
    pixels = np.random.default_rng(seed).uniform([60.0, 40.0], [260.0, 200.0], (len(IDS), 2))
    return pixels, CAMERA.normalise(pixels)


@pytest.mark.parametrize("lag_s", [0.018, -0.018])
def test_depth_is_read_where_the_camera_saw_the_point_at_that_moment(lag_s: float) -> None:
    twist = np.array([0.3, 1.5, -0.4, 0.2, -0.1, 0.3])
    frame = replace(depth_image(se3_exp(lag_s * twist)), depth_lag_s=lag_s)
    pixels, xy = tracks()
    true = plane_seen_from(np.eye(4)) @ np.column_stack([xy, np.ones(len(xy))]).T
    sensor = ImageDepth(CONFIG)
    read = DepthLag(CAMERA, 0.0).measure(sensor, frame, pixels, xy, true, twist, IDS)
    plainly = sensor.measure(frame, pixels, xy, true, IDS)
    assert np.abs(read.rho - true).max() < 2e-4
    assert np.abs(plainly.rho - true).max() > 5e-3


@pytest.mark.parametrize("delay_s", [0.015, -0.015, 0.0])
def test_a_delay_that_stamps_do_not_tell_is_learnt(delay_s: float) -> None:
    lag, sensor, rng = DepthLag(CAMERA, None), ImageDepth(CONFIG), np.random.default_rng(1)
    for k in range(120):
        twist = np.array([0.3, 1.2 * np.sin(0.4 * k), 0.0, 0.1, 0.0, 0.1])
        frame = depth_image(se3_exp((0.005 + delay_s) * twist))
        noisy = frame.depth_m + rng.normal(0.0, 0.003, frame.depth_m.shape)
        frame = replace(frame, depth_m=noisy.astype(np.float32), depth_lag_s=0.005)
        pixels, xy = tracks(k)
        true = plane_seen_from(np.eye(4)) @ np.column_stack([xy, np.ones(len(xy))]).T
        read = lag.measure(sensor, frame, pixels, xy, true, twist, IDS)
        lag.learn(read.rho - true, read.slope, read.sigma_rho, np.ones(len(xy), dtype=bool), 1.0 / 30.0)
    assert lag.estimate_s == pytest.approx(delay_s, abs=0.0015)
    assert lag.delay_s == (0.0 if delay_s == 0.0 else lag.estimate_s)


def test_landmarks_whose_depth_lagged_alike_tell_nothing_of_the_delay() -> None:
    lag = DepthLag(CAMERA, None)
    lag.learn(np.full(50, 1e-3), np.zeros(50), np.full(50, 2e-3), np.ones(50, dtype=bool), 1.0 / 30.0)
    assert lag.estimate_s == 0.0


def test_a_delay_is_not_believed_where_it_is_a_small_part_of_the_time_between_frames() -> None:
    for interval_s, applied_s in ((1.0 / 30.0, 0.012), (0.2, 0.0)):
        lag = DepthLag(CAMERA, None)
        lag.start_at(0.012)
        lag.learn(np.full(50, np.nan), np.zeros(50), np.full(50, 2e-3), np.ones(50, dtype=bool), interval_s)
        assert lag.delay_s == applied_s


def test_a_delay_that_is_told_is_kept() -> None:
    lag = DepthLag(CAMERA, -0.01)
    lag.start_at(0.03)
    lag.learn(np.full(50, 1e-3), np.ones(50), np.full(50, 2e-3), np.ones(50, dtype=bool), 1.0 / 30.0)
    assert lag.delay_s == -0.01 and not lag.learns


def test_a_frame_without_depth_has_none_whenever_it_was_taken() -> None:
    frame = replace(depth_image(np.eye(4)), depth_m=None, depth_lag_s=0.01)
    pixels, xy = tracks()
    read = DepthLag(CAMERA, None).measure(
        ImageDepth(CONFIG), frame, pixels, xy, np.full(len(xy), np.nan), np.ones(6), IDS
    )
    assert np.isnan(read.rho).all()
