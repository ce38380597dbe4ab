"""Depth that was taken at another moment than its image."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import se3_exp
from vislam.core.messages import Array, Frame
from vislam.frontend.exposures import DepthLag
from vislam.frontend.view import ImageDepth
from vislam.vision.shutter import Shutter

CAMERA = Camera(width=320, height=240, fx=260.0, fy=260.0, cx=160.0, cy=120.0)
CONFIG = FrontEndConfig()
PLANE = np.array([0.25, 0.1, 0.4])  # 1/z = x, y, 1 on z = 1 times this
IDS = np.arange(200)


def plane_seen_from(T: Array) -> Array:
    """Return the plane [3] in the axes of a camera at T [4, 4]: points p with plane @ p = 1."""
    turned = PLANE @ T[:3, :3]
    return np.asarray(turned / (1.0 - PLANE @ T[:3, 3]))


def learning(image_readout_s: float = 0.0) -> DepthLag:
    return DepthLag(CAMERA, Shutter(CAMERA, image_readout_s), None, None)


def by_both(slope: Array, pixels: Array) -> Array:
    """Return derivatives [N, 2] by delay and by rows, of landmarks that are known."""
    return np.column_stack([slope, slope * (pixels[:, 1] / (CAMERA.height - 1.0) - 0.5)])


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
    read = DepthLag(CAMERA, Shutter(CAMERA, 0.0), 0.0, 0.0).measure(sensor, frame, pixels, xy, true, twist, IDS)
    plainly = sensor.measure(frame, pixels, xy, true, IDS)
    assert np.abs(read.rho - true).max() < 2e-4
    assert np.abs(plainly.rho - true).max() > 5e-3


@pytest.mark.parametrize("delay_s", [0.015, -0.015, 0.0])
def test_a_delay_that_stamps_do_not_tell_is_learnt(delay_s: float) -> None:
    lag, sensor, rng = learning(), ImageDepth(CONFIG), np.random.default_rng(1)
    for k in range(120):
        twist = np.array([0.3, 1.2 * np.sin(0.4 * k), 0.0, 0.1, 0.0, 0.1])
        frame = depth_image(se3_exp((0.005 + delay_s) * twist))
        noisy = frame.depth_m + rng.normal(0.0, 0.003, frame.depth_m.shape)
        frame = replace(frame, depth_m=noisy.astype(np.float32), depth_lag_s=0.005)
        pixels, xy = tracks(k)
        true = plane_seen_from(np.eye(4)) @ np.column_stack([xy, np.ones(len(xy))]).T
        read = lag.measure(sensor, frame, pixels, xy, true, twist, IDS)
        lag.learn(
            read.rho - true, by_both(read.slope, pixels), read.sigma_rho, np.ones(len(xy), dtype=bool), 1.0 / 30.0
        )
    assert lag.delay_estimate_s == pytest.approx(delay_s, abs=0.0015)
    assert lag.delay_s == (0.0 if delay_s == 0.0 else lag.delay_estimate_s)


def rows_of_depth(readout_s: float, twist: Array) -> Array:
    """Return depth [H, W] whose rows are taken one after the other."""
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    rows = []
    for row in range(CAMERA.height):
        late_s = (row / (CAMERA.height - 1.0) - 0.5) * readout_s
        plane = plane_seen_from(se3_exp(late_s * twist))
        rows.append(1.0 / (plane[0] * x + plane[1] * (row - CAMERA.cy) / CAMERA.fy + plane[2]))
    return np.array(rows)


@pytest.mark.parametrize(("image_readout_s", "depth_readout_s"), [(0.03, 0.03), (0.03, 0.0), (0.01, 0.025)])
def test_how_long_rows_of_depth_take_is_learnt_beside_the_image(image_readout_s: float, depth_readout_s: float) -> None:
    lag, sensor, rng = learning(image_readout_s), ImageDepth(CONFIG), np.random.default_rng(2)
    shutter = Shutter(CAMERA, image_readout_s)
    for k in range(150):
        twist = np.array([2.0 * np.sin(0.5 * k), 2.0 * np.cos(0.4 * k), 0.0, 0.1, 0.0, 0.1])
        noisy = rows_of_depth(depth_readout_s, twist) + rng.normal(0.0, 0.003, (CAMERA.height, CAMERA.width))
        frame = Frame(0, 0, (np.zeros((CAMERA.height, CAMERA.width), np.uint8),), None, noisy.astype(np.float32))
        pixels, xy = tracks(k)
        # where the rows of the image see the wall, each at its time
        late = shutter.row(pixels) * image_readout_s
        true = np.array([
            plane_seen_from(se3_exp(s * twist)) @ [x, y, 1.0] for s, (x, y) in zip(late, xy, strict=True)
        ])  # fmt: skip
        read = lag.measure(sensor, frame, pixels, xy, true, twist, IDS)
        lag.learn(read.rho - true, by_both(read.slope, pixels), read.sigma_rho, np.ones(len(xy), bool), 1.0 / 30.0)
    assert lag.rows_estimate_s == pytest.approx(depth_readout_s - image_readout_s, abs=0.003)
    assert lag.readout_s == pytest.approx(depth_readout_s, abs=0.003)
    assert (lag.sweep(frame, twist) is None) == (depth_readout_s == 0.0)


def test_rows_of_depth_are_not_believed_before_many_frames_told_of_them() -> None:
    lag = learning(0.03)
    lag.start_at(None, 0.0)
    assert lag.readout_s == 0.0


def test_landmarks_whose_depth_lagged_alike_tell_nothing_of_the_delay() -> None:
    lag = learning()
    lag.learn(np.full(50, 1e-3), np.zeros((50, 2)), np.full(50, 2e-3), np.ones(50, dtype=bool), 1.0 / 30.0)
    assert lag.delay_estimate_s == 0.0


def test_a_delay_is_not_believed_where_it_is_a_small_part_of_the_time_between_frames() -> None:
    for interval_s, applied_s in ((1.0 / 30.0, 0.012), (0.2, 0.0)):
        lag = learning()
        lag.start_at(0.012, None)
        lag.learn(np.full(50, np.nan), np.zeros((50, 2)), np.full(50, 2e-3), np.ones(50, dtype=bool), interval_s)
        assert lag.delay_s == applied_s


def test_a_delay_that_is_told_is_kept() -> None:
    lag = DepthLag(CAMERA, Shutter(CAMERA, 0.0), -0.01, 0.0)
    lag.start_at(0.03, 0.02)
    slope = by_both(np.ones(50), tracks()[0][:50])
    lag.learn(np.full(50, 1e-3), slope, np.full(50, 2e-3), np.ones(50, dtype=bool), 1.0 / 30.0)
    assert lag.delay_s == -0.01 and lag.delay_estimate_s is None
    assert lag.readout_s == 0.0 and lag.rows_estimate_s is None


def test_a_frame_without_depth_has_none_whenever_it_was_taken() -> None:
    frame = replace(depth_image(np.eye(4)), depth_m=None, depth_lag_s=0.01)
    pixels, xy = tracks()
    read = learning().measure(ImageDepth(CONFIG), frame, pixels, xy, np.full(len(xy), np.nan), np.ones(6), IDS)
    assert np.isnan(read.rho).all()
