"""A person who crosses leaves no ghost in the map, and takes nothing away that stays."""

from dataclasses import replace

import numpy as np
import pytest
from people.figure import figure_depth

from vislam.mapping.mapper import Mapper
from vislam.mapping.octree.occupancy import Occupancy
from worlds.box import CAMERA, CONFIG, RIG, T_BODY_CAM0, depth_image, keyframe, pose

SPEED_M_S = 1.0
STANDS_S = 2.0
WALK_S = 1.6  # from one side of the view to its middle
PERSON_X_M = 1.7
V, U = np.mgrid[: CAMERA.height, : CAMERA.width]
RAYS = CAMERA.unproject(np.column_stack([U.ravel(), V.ravel()]).astype(float)).reshape(*U.shape, 3)
T_MAP_CAM = pose(0) @ T_BODY_CAM0
BACKGROUND = depth_image(pose(0))


def depth_with_person(t_s):
    """The view at a time: the person comes at 0, stands before the camera for two seconds and goes."""
    walked = SPEED_M_S * (np.clip(t_s, 0.0, WALK_S) + np.clip(t_s - WALK_S - STANDS_S, 0.0, None))
    feet = np.array([PERSON_X_M, SPEED_M_S * WALK_S - walked, 0.0])
    return np.minimum(BACKGROUND, figure_depth(RAYS, T_MAP_CAM, feet, -0.5 * np.pi, walked))


def person_points(depth):
    mask = depth < BACKGROUND - 0.01
    return (RAYS[mask] * depth[mask][:, None]) @ T_MAP_CAM[:3, :3].T + T_MAP_CAM[:3, 3]


def ghosts_and_kept(config, rate_hz):
    """Occupied voxels of the person 1 s after the view is clear, points in such at most, share of the walls kept."""
    mapper, empty, seen = Mapper(config, RIG), Mapper(config, RIG), []
    gone_s = 2.0 * WALK_S + STANDS_S
    times_s = np.arange(-2.0, gone_s + 1.0 + 1e-6, 1.0 / rate_hz)
    clear_s = None
    at_most = 0
    for k, t_s in enumerate(times_s):
        depth = depth_with_person(t_s) if t_s > 0.0 else BACKGROUND
        seen.append(person_points(depth))
        is_clear = len(seen[-1]) == 0
        clear_s = t_s if is_clear and clear_s is None and t_s > 1.0 else clear_s
        if clear_s is not None and t_s > clear_s + 1.0 + 1e-6:
            break
        mapper.add(keyframe(k, pose(0), depth), pose(0))
        empty.add(keyframe(k, pose(0), BACKGROUND), pose(0))
        places = np.vstack(seen)
        at_most = max(at_most, int((mapper.occupancy.state_at(places) == Occupancy.OCCUPIED).sum()))
    walls = (empty.occupancy.max_likelihood_leaves().occupied_voxels() + 0.5) * config.resolution_m
    left = int((mapper.occupancy.state_at(in_view(places, config)) == Occupancy.OCCUPIED).sum())
    return left, at_most, (mapper.occupancy.state_at(walls) == Occupancy.OCCUPIED).mean()


def in_view(points, config):
    """The centres of the voxels of points, of those that lie in the image and not beside the floor."""
    r = config.resolution_m
    centres = (np.unique(np.floor(points / r).astype(int), axis=0) + 0.5) * r
    centres = centres[centres[:, 2] > 2 * r]
    pixels = CAMERA.project((centres - T_MAP_CAM[:3, 3]) @ T_MAP_CAM[:3, :3])
    return centres[(pixels > 2).all(axis=1) & (pixels < [CAMERA.width - 3, CAMERA.height - 3]).all(axis=1)]


@pytest.mark.parametrize("rate_hz", [2.0, 3.0, 4.0, 6.0, 10.0])
def test_a_person_who_crossed_is_gone_within_a_second_and_the_walls_stay(rate_hz):
    left, at_most, kept = ghosts_and_kept(CONFIG, rate_hz)
    assert at_most > 200  # the person was in the map
    assert left == 0
    assert kept >= 0.99


def test_with_octomaps_own_model_a_ghost_stays_at_the_rate_of_keyframes():
    octomap = replace(CONFIG, miss_probability=0.4, clamp_max_probability=0.971)
    assert ghosts_and_kept(octomap, 3.0)[0] > 20


def test_the_figure_is_a_person_of_its_size_where_it_stands():
    depth = figure_depth(RAYS, T_MAP_CAM, np.array([2.0, 0.1, 0.0]), 0.3, 1.0)
    mask = np.isfinite(depth)
    points = (RAYS[mask] * depth[mask][:, None]) @ T_MAP_CAM[:3, :3].T + T_MAP_CAM[:3, 3]
    assert mask.sum() > 1000
    assert 1.6 < points[:, 2].max() <= 1.75
    assert np.linalg.norm(points[:, :2] - [2.0, 0.1], axis=1).max() < 0.45
    trunk = points[points[:, 2] > 0.9]
    np.testing.assert_allclose(np.linalg.norm(trunk[:, :2] - [2.0, 0.1], axis=1), 0.2, atol=1e-5)
    assert np.isinf(figure_depth(RAYS, T_MAP_CAM, np.array([-2.0, 0.0, 0.0]), 0.0, 0.0)).all()
