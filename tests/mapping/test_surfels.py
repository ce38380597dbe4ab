from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from vislam.core.geometry import se3_exp, so3_exp, transform
from vislam.core.messages import GraphUpdate
from vislam.mapping.cloud.surfels import SurfelMap
from vislam.mapping.depth.extract import ScanExtractor
from vislam.mapping.mapper import Mapper
from worlds.box import CONFIG, RIG, ROOM_HIGH, ROOM_LOW, keyframe, pose

SPACING = 0.05
EXTRACTOR = ScanExtractor(replace(CONFIG, pixel_step=1), RIG)
TRUE = [pose(k) for k in range(6)]
SCANS = [EXTRACTOR.extract(keyframe(k)) for k in range(6)]
DRIFTED = [T @ se3_exp(np.array([0.0, 0.0, 0.01 * k, 0.03 * k, -0.02 * k, 0.0])) for k, T in enumerate(TRUE)]


def surfel_map():
    out = SurfelMap(SPACING)
    for k, scan in enumerate(SCANS):
        out.add(k, scan, EXTRACTOR.view)
    return out


def at(poses):
    return surfel_map().surfels(dict(enumerate(poses)))


def test_surfels_lie_on_the_walls_and_face_into_the_room():
    surfels = at(TRUE)
    assert 2000 < len(surfels) < 30000
    to_wall = np.minimum(np.abs(surfels.points_m - ROOM_LOW), np.abs(surfels.points_m - ROOM_HIGH))
    assert np.percentile(to_wall.min(axis=1), 99) < 0.005
    nearest = to_wall.argmin(axis=1)
    second = np.sort(to_wall, axis=1)[:, 1]
    flat = second > 0.15  # away from the room's edges
    rows = np.flatnonzero(flat)
    axis = nearest[rows]
    inwards = np.sign(0.5 * (ROOM_LOW + ROOM_HIGH)[axis] - surfels.points_m[rows, axis])
    assert np.percentile(surfels.normals[rows, axis] * inwards, 1) > 0.99
    np.testing.assert_allclose(np.linalg.norm(surfels.normals, axis=1), 1.0, atol=1e-5)
    assert (surfels.radius_m >= SPACING * 0.7).all()
    assert np.abs(np.median(surfels.colors, axis=0) - [200, 0, 0]).max() <= 1
    assert surfels.views.min() == 1
    assert surfels.views.max() >= 3
    assert (surfels.confidence > 0.0).all()


def test_surfels_are_apart():
    points = at(TRUE).points_m.astype(float)
    distance, _ = cKDTree(points).query(points, k=2)
    assert np.median(distance[:, 1]) > 0.7 * SPACING


def close(first, second):
    """Share of the first surfels that have a like one among the second."""
    _, other = cKDTree(second.points_m).query(first.points_m)
    apart = second.points_m[other] - first.points_m
    across = np.abs(np.sum(apart * first.normals, axis=1))
    alike = np.sum(first.normals * second.normals[other], axis=1) > 0.9
    return float(((np.linalg.norm(apart, axis=1) < SPACING) & (across < 0.01) & alike).mean())


def same(first, second):
    for name in ("points_m", "normals", "colors", "radius_m", "confidence", "views", "anchors"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_corrected_surfels_are_those_made_at_the_final_poses():
    surfels, fresh = surfel_map(), at(TRUE)
    before = surfels.surfels(dict(enumerate(DRIFTED)))
    assert close(before, fresh) < 0.7
    after = surfels.surfels(dict(enumerate(TRUE)))
    same(after, fresh)
    np.testing.assert_allclose(after.confidence.astype(float).sum(), before.confidence.astype(float).sum(), rtol=1e-5)


def test_keyframes_come_one_by_one_and_all_at_once_to_the_same():
    surfels, poses = SurfelMap(SPACING), {}
    for k, scan in enumerate(SCANS):
        surfels.add(k, scan, EXTRACTOR.view)
        poses[k] = TRUE[k]
        got = surfels.surfels(poses)
    same(got, at(TRUE))
    assert set(got.anchors.tolist()) == set(range(6))
    few = surfels.surfels({k: TRUE[k] for k in (0, 2)})
    assert set(few.anchors.tolist()) == {0, 2}


def test_a_motion_of_all_together_moves_the_surface():
    G = transform(so3_exp(np.array([0.1, -0.2, 0.7])), np.array([3.0, -2.0, 0.5]))
    before, after = at(TRUE), at([G @ T for T in TRUE])
    assert abs(len(before) - len(after)) < 0.02 * len(before)
    distance, _ = cKDTree(before.points_m @ G[:3, :3].T + G[:3, 3]).query(after.points_m)
    assert np.percentile(distance, 80) < 1e-5  # the rest met others first: cells lie otherwise


def test_the_mapper_follows_with_its_surfels():
    config = replace(CONFIG, surfel_m=SPACING, pixel_step=1)
    mapper, fresh = Mapper(config, RIG), Mapper(config, RIG)
    for k in range(4):
        mapper.add(keyframe(k), DRIFTED[k])
    mapper.surfels()
    for k in range(4, 6):
        mapper.add(keyframe(k), DRIFTED[k])
    for k in range(6):
        fresh.add(keyframe(k), TRUE[k])
    mapper.move(GraphUpdate(1, np.arange(6), np.array(TRUE), np.eye(4), None))
    mapper.finish()
    got, wanted = mapper.surfels(), fresh.surfels()
    same(got, wanted)
    assert got.views.min() >= 2


def test_keyframes_without_depth_and_broken_depth_add_nothing():
    surfels = SurfelMap(SPACING)
    assert len(surfels.surfels({})) == 0
    surfels.add(0, replace(SCANS[0], depth=np.zeros_like(SCANS[0].depth)), EXTRACTOR.view)
    surfels.add(1, replace(SCANS[0], depth=None, points_body_m=np.ones((3, 3), np.float32)), EXTRACTOR.view)
    assert len(surfels.surfels({0: TRUE[3], 1: TRUE[1], 7: TRUE[1]})) == 0
    rays = EXTRACTOR.view.rays_body.copy()
    rays[:, :80] = np.nan  # the camera model ends
    surfels.add(2, SCANS[0], replace(EXTRACTOR.view, rays_body=rays))
    half = surfels.surfels({2: TRUE[0]})
    assert 0 < len(half) < len(surfel_map().surfels({0: TRUE[0]}))
    assert np.isfinite(half.points_m).all()
