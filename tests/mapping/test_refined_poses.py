"""Keyframes' poses that are fitted to each other's depth: better where depth tells, left alone where it does not."""

from dataclasses import replace

import numpy as np
import pytest

from vislam.core.geometry import invert, se3_exp, transform
from vislam.mapping.dense.pairs import equations, seen_in
from vislam.mapping.dense.refine import refined
from vislam.mapping.mapper import Mapper
from vislam.mapping.mesh.posed import PosedView
from worlds.box import CONFIG, RIG, keyframe, pose

K = np.array([[130.0, 0.0, 80.0], [0.0, 130.0, 60.0], [0.0, 0.0, 1.0]])
SIZE = (120, 160)
LOW, HIGH = np.array([-1.5, -1.2, -1.0]), np.array([1.5, 1.2, 2.0])  # a box around the camera


def depth_of(T, is_wall=False):
    """Exact depth [h, w] of the inside of a box, or of a bare wall at z = 2 m, with some noise."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.column_stack([(u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1], np.ones(u.size)])
    directions = rays @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        t = np.where(directions > 0.0, (HIGH - T[:3, 3]) / directions, (LOW - T[:3, 3]) / directions)
    depth = (t[:, 2] if is_wall else t.min(axis=1)).reshape(SIZE)
    noise = np.random.default_rng(int(1e6 * abs(T[0, 3]))).normal(size=SIZE)
    depth = np.where(np.isfinite(depth), depth, 0.0)
    return (depth + 0.0015 * depth**2 * noise).astype(np.float32)


def true_poses(n, turn_rad):
    """Views in a row that turn about the upright axis."""
    return [se3_exp(np.array([0.0, turn_rad * k, 0.0, 0.04 * k, 0.01 * k, 0.0])) for k in range(n)]


def views_at(true, believed, is_wall=False):
    colors = np.zeros((*SIZE, 3), np.uint8)
    return [PosedView(depth_of(T, is_wall), colors, K, B, 4.0) for T, B in zip(true, believed, strict=True)]


def wrong(true, seed=0):
    rng = np.random.default_rng(seed)
    return [T @ se3_exp(rng.normal(0.0, 1.0, 6) * ([0.01] * 3 + [0.02] * 3)) for T in true]


def errors_m(true, believed):
    """Distances of places 1 m before each camera from where they are, after the best common motion is taken away."""
    off = [B @ invert(T) for T, B in zip(true, believed, strict=True)]
    at = np.array(
        [(E @ T @ [0.0, 0.0, 1.0, 1.0])[:3] - (T @ [0.0, 0.0, 1.0, 1.0])[:3] for T, E in zip(true, off, strict=True)]
    )
    return np.linalg.norm(at - at.mean(axis=0), axis=1)


def test_disturbed_poses_in_a_room_get_better():
    true = true_poses(8, 0.12)
    believed = wrong(true)
    found = refined(views_at(true, believed))
    assert found.cost_after < 0.8 * found.cost_before
    assert np.median(errors_m(true, found.T_map_view)) < 0.4 * np.median(errors_m(true, believed))


def test_views_that_fit_badly_say_less():
    poses = true_poses(2, 0.05)
    clean, blurred = views_at(poses, poses), views_at(poses, poses)
    waves = 0.02 * np.sin(np.arange(SIZE[1]) / 6.0).astype(np.float32)
    blurred[0] = replace(blurred[0], depth_m=blurred[0].depth_m + waves)
    told = []
    for a, b in (clean, blurred):
        seen = [seen_in(view.depth_m, K, 1, 4.0) for view in (a, b)]
        told.append(equations(seen[1], seen[0], invert(poses[0]) @ poses[1], 0.1, 2))
    assert told[1].cost > told[0].cost
    assert np.trace(told[1].H) < 0.2 * np.trace(told[0].H)


def test_true_poses_are_left_alone():
    true = true_poses(8, 0.12)
    np.testing.assert_array_equal(refined(views_at(true, true)).T_map_view, true)


def test_a_bare_wall_does_not_slide():
    true = true_poses(6, 0.0)
    believed = wrong(true)
    found = refined(views_at(true, believed, is_wall=True))
    moved = np.array([invert(B) @ T for B, T in zip(believed, found.T_map_view, strict=True)])
    sideways = np.linalg.norm(moved[:, :2, 3], axis=1)
    assert np.abs(moved[:, 2, 3]).max() > 0.005  # towards the wall they are fitted
    assert sideways.max() < 0.005


def test_twice_is_the_same_to_the_last_bit():
    true = true_poses(5, 0.12)
    views = views_at(true, wrong(true))
    np.testing.assert_array_equal(refined(views).T_map_view, refined(iter(views)).T_map_view)


@pytest.mark.parametrize("filling", [0.0, np.nan, np.inf, -1.0])
def test_views_without_depth_stay_where_they_were(filling):
    true = true_poses(5, 0.12)
    believed = wrong(true)
    views = views_at(true, believed)
    blank = [replace(view, depth_m=np.full(SIZE, filling, np.float32)) for view in views]
    np.testing.assert_array_equal(refined(blank).T_map_view, believed)
    assert np.isfinite(refined([*views[:4], blank[4]]).T_map_view).all()


def test_no_views_and_one_view_have_no_pairs():
    assert refined([]).pairs == 0
    assert refined(views_at([np.eye(4)], [np.eye(4)])).pairs == 0


def test_a_map_with_a_surface_is_made_at_refined_poses_unless_that_is_switched_off():
    shift = transform(np.eye(3), np.array([0.05, 0.0, 0.0]))
    for products, switch, is_asked in (
        (("cloud", "octomap"), True, False), (("cloud", "mesh"), False, False), (("cloud", "mesh"), True, True),
    ):  # fmt: skip
        mapper = Mapper(replace(CONFIG, pixel_step=1, products=products, refine_poses=switch), RIG)
        for k in range(4):
            mapper.add(keyframe(k, pose(0.25 * k)), pose(0.25 * k) @ (shift if k == 2 else np.eye(4)))
        other = mapper.refined()
        assert (other is not mapper) == is_asked
        assert bool(other.refinement) == is_asked
    before, after = (next(v for i, v in enumerate(m.posed_views()) if i == 2).T_map_view for m in (mapper, other))
    wanted = next(mapper.posed_views()).T_map_view  # of the first, to tell the axes
    assert wanted.shape == (4, 4)
    true = before @ invert(RIG.T_body_cams[0]) @ invert(shift) @ RIG.T_body_cams[0]
    assert np.linalg.norm(after[:3, 3] - true[:3, 3]) < 0.5 * np.linalg.norm(before[:3, 3] - true[:3, 3])
