"""Moving least squares take the noise out of a cloud and leave its shape."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.smooth import smoothed
from vislam.mapping.mapper import Mapper
from worlds.box import CONFIG, RIG, keyframe, pose

SIGMA_M = 0.004


def noisy(surface, seed=0):
    """A cloud of a surface [N, 3] with noise in all directions."""
    rng = np.random.default_rng(seed)
    points = (surface + SIGMA_M * rng.standard_normal(surface.shape)).astype(np.float32)
    return Cloud(points, rng.integers(0, 256, (len(points), 3), dtype=np.uint8))


def patch(count=6000, seed=1):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2))


def test_a_plane_gets_thin_and_keeps_order_and_colours():
    xy = patch()
    cloud = noisy(np.column_stack([xy, 0.3 * xy[:, 0]]))
    normal = np.array([-0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0)
    smooth = smoothed(cloud, 0.06)
    inner = (abs(xy) < 0.44).all(axis=1)
    assert (cloud.points_m @ normal)[inner].std() > 0.9 * SIGMA_M
    assert (smooth.points_m @ normal)[inner].std() < 0.4 * SIGMA_M
    assert np.linalg.norm(smooth.points_m - cloud.points_m, axis=1).max() < 0.03
    np.testing.assert_array_equal(smooth.colors, cloud.colors)


def test_a_ball_does_not_shrink():
    directions = np.random.default_rng(2).standard_normal((9000, 3))
    cloud = noisy(0.25 * directions / np.linalg.norm(directions, axis=1)[:, None])
    radii = np.linalg.norm(smoothed(cloud, 0.05).points_m, axis=1)
    assert abs(np.median(radii) - 0.25) < 0.0005
    assert radii.std() < 0.6 * SIGMA_M


def test_the_edge_of_a_box_stays_sharp():
    xy = patch(12000)
    roof = np.column_stack([xy[:, 0], -abs(xy[:, 0]), xy[:, 1]])  # a ridge of 90 degrees along z
    cloud = noisy(roof)

    def off(points):
        return abs(points[:, 1] + abs(points[:, 0])) / np.sqrt(2.0)

    near = (abs(roof[:, 0]) < 0.03) & (abs(roof[:, 2]) < 0.44)
    assert np.median(off(smoothed(cloud, 0.06).points_m)[near]) < np.median(off(cloud.points_m)[near])


def test_points_that_lie_alone_and_wild_ones_stay():
    xy = patch()
    alone = np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 1.0], [2.0, 2.0, 2.0]])
    cloud = noisy(np.vstack([np.column_stack([xy, np.zeros(len(xy))]), alone]))
    np.testing.assert_array_equal(smoothed(cloud, 0.06).points_m[-3:], cloud.points_m[-3:])


@pytest.mark.parametrize("count", [0, 1, 9, 40])
def test_few_points_and_points_in_one_place_give_finite_points(count):
    cloud = Cloud(np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint8))
    np.testing.assert_array_equal(smoothed(cloud, 0.05).points_m, cloud.points_m)
    line = Cloud(
        np.linspace([0, 0, 0], [0.1, 0, 0], max(count, 2)).astype(np.float32), np.zeros((max(count, 2), 3), np.uint8)
    )
    assert np.isfinite(smoothed(line, 0.05).points_m).all()


def test_no_radius_changes_nothing_and_twice_is_the_same_bytes():
    cloud = noisy(np.column_stack([patch(20000), np.zeros(20000)]))
    assert smoothed(cloud, 0.0) is cloud
    assert smoothed(cloud, 0.03).points_m.tobytes() == smoothed(cloud, 0.03).points_m.tobytes()


def test_memory_is_that_of_a_chunk_not_of_the_cloud():
    cloud = noisy(np.column_stack([4.0 * patch(60000), np.zeros(60000)]))

    def peak_bytes(points):
        tracemalloc.start()
        smoothed(points, 0.06)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    few, all_of_them = peak_bytes(cloud.select(np.arange(60000) < 10000)), peak_bytes(cloud)
    assert few < 100e6
    assert all_of_them - few < 50000 * 120  # coordinates and normals in double precision, the answer; no neighbourhoods


def test_a_map_smooths_its_cloud_when_asked():
    measured, asked = (Mapper(replace(CONFIG, cloud_smooth_m=radius_m), RIG) for radius_m in (0.0, 0.1))
    for k in range(4):
        measured.add(keyframe(k), pose(k))
        asked.add(keyframe(k), pose(k))
    assert asked.cloud().points_m.tobytes() == smoothed(measured.cloud(), 0.1).points_m.tobytes()
    assert asked.cloud().points_m.tobytes() != measured.cloud().points_m.tobytes()
