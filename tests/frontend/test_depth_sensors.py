"""Depth images and stereo pairs as sources of inverse depth, and the keyframe policy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config import FrontEndConfig
from vislam.core.messages import Array, Frame
from vislam.frontend.keyframes import Departure, keyframe_reason
from vislam.frontend.view import ImageDepth, StereoDepth, _triangulate
from vislam.vision.features import detect_corners
from worlds.corner import World

CONFIG = FrontEndConfig()


def depth_frame(depth_m: Array) -> Frame:
    return Frame(0, 0, (np.zeros(depth_m.shape, np.uint8),), None, depth_m.astype(np.float32))


@given(st.floats(-2e-4, 2e-4), st.floats(-2e-4, 2e-4), st.floats(0.2, 1.0))
def test_depth_of_a_plane_is_exact_between_pixels(slope_x: float, slope_y: float, rho: float) -> None:
    u, v = np.meshgrid(np.arange(80.0), np.arange(60.0))
    plane = rho + slope_x * u + slope_y * v
    pixels = np.random.default_rng(0).uniform(6, 50, (20, 2))
    reading = ImageDepth(CONFIG).measure(depth_frame(1.0 / plane), pixels, pixels, np.zeros(20))
    assert np.allclose(reading.rho, rho + pixels @ [slope_x, slope_y], atol=1e-6)
    assert np.allclose(reading.depth_m, 1.0 / reading.rho)


def test_depth_edges_holes_and_ranges_are_unknown() -> None:
    depth = np.full((60, 80), 2.0)
    depth[:, 40:] = 1.5
    depth[10:20, 10:20] = 0.0
    depth[30:40, 10:20] = np.nan
    depth[45:, :30] = 9.0
    pixels = np.array([[41.0, 30.0], [14.0, 14.0], [14.0, 34.0], [10.0, 52.0], [1.0, 30.0], [60.0, 30.0], [25.0, 25.0]])
    rho = ImageDepth(CONFIG).measure(depth_frame(depth), pixels, pixels, np.zeros(7)).rho
    assert np.isnan(rho[:5]).all()
    assert rho[5:] == pytest.approx([1.0 / 1.5, 0.5])
    none = replace(depth_frame(depth), depth_m=None)
    assert not ImageDepth(CONFIG).available(none)
    assert np.isnan(ImageDepth(CONFIG).measure(none, pixels, pixels, np.zeros(7)).rho).all()


def test_depth_is_less_certain_where_it_changes() -> None:
    u = np.tile(np.arange(80.0), (60, 1))
    steep, flat = np.full((60, 80), 0.5) + 2e-3 * u, np.full((60, 80), 0.5)
    pixels = np.array([[40.0, 30.0]])
    sigmas = [
        ImageDepth(CONFIG).measure(depth_frame(1.0 / r), pixels, pixels, np.zeros(1)).sigma_rho[0]
        for r in (flat, steep)
    ]
    assert sigmas[0] == pytest.approx(CONFIG.depth_sigma_rho, rel=0.01) and sigmas[1] > 2.0 * sigmas[0]


@given(st.integers(0, 2**32 - 1))
def test_triangulation_is_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), rng.uniform(0.8, 1.2, 30)])
    t = np.array([-0.12, 0.01, 0.005])
    rho = rng.uniform(0.0, 2.0, 30)
    points = rays + rho[:, None] * t
    found, distance = _triangulate(rays, t, points[:, :2] / points[:, 2:])
    assert np.allclose(found, rho, atol=1e-6) and np.allclose(distance, 0.0, atol=1e-9)


@pytest.mark.parametrize("known", [True, False])
def test_stereo_measures_inverse_depth(known: bool) -> None:
    world = World("stereo")
    frame = world.frame(0, np.eye(4))
    z = world.draw(0, np.eye(4))[1]
    pixels = detect_corners(frame.images[0], 200, 40, 8.0, np.empty((0, 2)), 1.0)
    true_rho = 1.0 / z[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    expected = true_rho * 1.2 if known else np.full(len(pixels), np.nan)
    sensor = StereoDepth(world.rig, CONFIG)
    reading = sensor.measure(frame, pixels, world.rig.cameras[0].normalise(pixels), expected)
    seen = np.isfinite(reading.rho)
    assert seen.mean() > 0.8
    error = (reading.rho - true_rho)[seen]
    assert np.median(np.abs(error)) < reading.sigma_rho[0] and (np.abs(error) < 5 * reading.sigma_rho[0]).mean() > 0.9
    assert reading.right_px is not None and np.array_equal(np.isfinite(reading.right_px[:, 0]), seen)


def test_stereo_without_a_right_image_or_with_another_one_measures_nothing() -> None:
    world = World("stereo")
    frame = world.frame(0, np.eye(4))
    sensor = StereoDepth(world.rig, CONFIG)
    pixels = detect_corners(frame.images[0], 100, 40, 8.0, np.empty((0, 2)), 1.0)
    xy = world.rig.cameras[0].normalise(pixels)
    single = replace(frame, images=frame.images[:1])
    assert not sensor.available(single)
    assert np.isnan(sensor.measure(single, pixels, xy, np.full(len(xy), 0.3)).rho).all()
    other = World("stereo", seed=1).frame(0, np.eye(4))
    mixed = replace(frame, images=(frame.images[0], other.images[1]))
    assert np.isfinite(sensor.measure(mixed, pixels, xy, np.full(len(xy), np.nan)).rho).mean() < 0.1
    assert len(sensor.measure(frame, np.empty((0, 2)), np.empty((0, 2)), np.empty(0)).rho) == 0


NEAR = Departure(dt_s=0.5, rotation_rad=0.05, parallax_px=5.0, alive=0.9, inliers=200, fit=True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        ({"parallax_px": 50.0}, "parallax of 50 px"),
        ({"rotation_rad": 0.5}, "turned by 29 deg"),
        ({"dt_s": 2.5}, "2.5 s since"),
        ({"alive": 0.3}, "only 30% of the tracks"),
        ({"alive": 0.3, "dt_s": 0.03}, "only 30% of the tracks"),
        ({"inliers": 20}, "only 20 tracks agree"),
        ({"parallax_px": 50.0, "dt_s": 0.05}, ""),
        ({"parallax_px": 50.0, "fit": False}, ""),
        ({"alive": 0.3, "fit": False}, ""),
        ({"alive": 0.1, "fit": False}, "only 10% of the tracks"),
    ],
)
def test_keyframe_policy(change: dict[str, float | bool], said: str) -> None:
    reason = keyframe_reason(replace(NEAR, **change), CONFIG)
    assert reason.startswith(said) and bool(reason) == bool(said)
