import numpy as np
import pyoctomap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.mapping.octree.occupancy import Occupancy, Octree
from vislam.mapping.octree.octomap_io import encode_ot, read_octree
from vislam.mapping.octree.query import (
    box_state,
    footprint_state,
    nearest_frontier,
    nearest_obstacle,
    ray_cast,
    sphere_state,
)

RESOLUTION = 0.1
HALF_VOXELS = 15  # of the window that the slow answers look at: 3 m, beyond all that the maps hold
SEEDS = st.integers(0, 2**32 - 1)


def random_map(seed, rays=120):
    rng = np.random.default_rng(seed)
    grid = Octree(RESOLUTION)
    for _ in range(3):
        origin = rng.uniform(-0.3, 0.3, 3)
        grid.insert(origin + rng.uniform(-1.1, 1.1, (rays, 3)), origin, 1.0)
    return grid, rng


def window(grid):
    """Lower corners [N, 3] and states [N] of all voxels of the window, one by one."""
    axis = np.arange(-HALF_VOXELS, HALF_VOXELS)
    voxels = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return voxels * RESOLUTION, grid.state_at((voxels + 0.5) * RESOLUTION)


def worst(states):
    if (states == Occupancy.OCCUPIED).any():
        return Occupancy.OCCUPIED
    return Occupancy.UNKNOWN if (states == Occupancy.UNKNOWN).any() else Occupancy.FREE


def distances_to(corners, point):
    return np.linalg.norm(np.maximum(np.maximum(corners - point, point - corners - RESOLUTION), 0.0), axis=1)


@settings(max_examples=5)
@given(SEEDS)
def test_levels_are_those_of_octomaps_search(seed):
    grid, rng = random_map(seed)
    theirs = pyoctomap.OcTree(RESOLUTION)
    octree = grid.leaves()
    for centre, size, value in zip(*octree.centres_m(), octree.log_odds, strict=True):
        for offset in np.ndindex(*[round(size / RESOLUTION)] * 3):
            theirs.updateNode(centre + (np.array(offset) + 0.5) * RESOLUTION - 0.5 * size, float(value))
    theirs.updateInnerOccupancy()
    points = rng.uniform(-2.0, 2.0, (60, 3))
    for level in range(16):  # to OctoMap a depth of 0 means the voxels
        nodes = [theirs.search(point, 16 - level) for point in points]
        expected = [np.nan if node is None else node.getLogOdds() for node in nodes]
        np.testing.assert_array_equal(grid.log_odds_at(points, level), np.array(expected, np.float32))


def test_a_map_from_an_octree_is_the_map(tmp_path):
    grid, rng = random_map(3, rays=4000)
    octree = grid.leaves()
    assert (octree.levels > 0).any()
    back = Octree.from_leaves(octree)
    assert encode_ot(back.leaves()) == encode_ot(octree)
    more = rng.uniform(-1, 1, (50, 3))
    grid.insert(more, np.zeros(3))
    back.insert(more, np.zeros(3))
    assert encode_ot(back.leaves()) == encode_ot(grid.leaves())


def test_a_map_of_octomap_itself_can_be_asked(data_root):
    octree = read_octree(data_root / "octomap" / "geb079.bt")
    grid = Octree.from_leaves(octree)
    centres, size = octree.centres_m()
    np.testing.assert_array_equal(grid.log_odds_at(centres[::53]), octree.log_odds[::53])
    large = np.flatnonzero(size > octree.resolution_m)[:20]
    corners = centres[large] + 0.49 * size[large, None]
    np.testing.assert_array_equal(grid.log_odds_at(corners), octree.log_odds[large])


def test_an_octree_too_large_to_take_apart_is_refused(tmp_path):
    path = tmp_path / "huge.bt"
    path.write_bytes(b"# Octomap OcTree binary file\nid OcTree\nsize 9\nres 0.1\ndata\n\xaa\xaa")
    with pytest.raises(DataError, match="blocks"):
        Octree.from_leaves(read_octree(path))


@settings(max_examples=12)
@given(SEEDS, st.sampled_from(["pass", "stop"]))
def test_rays_end_where_a_slow_search_of_all_voxels_says(seed, unknown):
    grid, rng = random_map(seed)
    corners, states = window(grid)
    ends = corners[(states == Occupancy.OCCUPIED) | ((states == Occupancy.UNKNOWN) & (unknown == "stop"))]
    origins, directions = rng.uniform(-0.6, 0.6, (20, 3)).astype(np.float32), rng.normal(size=(20, 3))
    directions[:3] = np.eye(3)  # along an axis
    max_range_m = float(rng.uniform(0.2, 0.8))
    hits = ray_cast(grid, origins, directions, max_range_m, unknown)
    units = directions / np.linalg.norm(directions, axis=1)[:, None]
    for n in range(20):
        with np.errstate(divide="ignore"):
            a, b = (ends - origins[n]) / units[n], (ends + RESOLUTION - origins[n]) / units[n]
        entry, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        met = (entry < leave) & (leave > 0.0)
        nearest = np.maximum(entry[met], 0.0).min(initial=np.inf)
        if nearest > max_range_m:
            assert hits.outcome[n] == Occupancy.FREE
            assert hits.range_m[n] == max_range_m
            assert np.isnan(hits.voxel_m[n]).all()
        else:
            assert abs(hits.range_m[n] - nearest) < 1e-9
            assert hits.outcome[n] == grid.state_at(hits.voxel_m[n])[0] != Occupancy.FREE
            inside = origins[n] + (nearest + 1e-7) * units[n]
            assert np.abs(inside - hits.voxel_m[n]).max() < 0.5 * RESOLUTION + 1e-6


@settings(max_examples=5)
@given(SEEDS)
def test_rays_end_where_octomaps_do(seed):
    rng = np.random.default_rng(seed)
    ours, theirs = Octree(RESOLUTION), pyoctomap.OcTree(RESOLUTION)
    points = rng.uniform(-1.0, 1.0, (400, 3)).astype(np.float32)
    ours.insert(points, np.zeros(3))
    theirs.insertPointCloud(points.astype(np.float64), np.zeros(3), discretize=True)
    origin = rng.uniform(-0.05, 0.05, 3)
    directions = rng.normal(size=(50, 3))
    for stop in (False, True):
        hits = ray_cast(ours, origin, directions, 5.0, "stop" if stop else "pass")
        for direction, outcome, voxel in zip(directions, hits.outcome, hits.voxel_m, strict=True):
            end = np.zeros(3)
            is_hit = theirs.castRay(origin, direction, end, not stop, 5.0)
            assert is_hit == (outcome == Occupancy.OCCUPIED)
            if is_hit:
                np.testing.assert_allclose(voxel, end, atol=1e-6)


@settings(max_examples=12)
@given(SEEDS, st.floats(0.02, 0.35))
def test_spheres_meet_the_voxels_that_reach_into_them(seed, radius_m):
    grid, rng = random_map(seed)
    corners, states = window(grid)
    centres = rng.uniform(-0.7, 0.7, (30, 3))
    expected = [worst(states[distances_to(corners, centre) < radius_m]) for centre in centres]
    np.testing.assert_array_equal(sphere_state(grid, centres, radius_m), expected)


def overlap(A, b, low, high):
    """Whether the polytope A x <= b has inner points in the box [low, high]: the radius of the largest ball in both."""
    dim = len(low)
    rows = np.vstack([A, np.eye(dim), -np.eye(dim)])
    limits = np.concatenate([b, high, -low])
    with_radius = np.hstack([rows, np.linalg.norm(rows, axis=1)[:, None]])
    best = linprog(np.r_[np.zeros(dim), -1.0], with_radius, limits, bounds=[(None, None)] * (dim + 1))
    return -best.fun > 1e-9


@settings(max_examples=4)
@given(SEEDS)
def test_boxes_meet_the_voxels_that_reach_into_them(seed):
    grid, rng = random_map(seed)
    corners, states = window(grid)
    size = rng.uniform(0.03, 0.3, 3)
    centres, turns = rng.uniform(-0.6, 0.6, (4, 3)), Rotation.random(4, rng).as_matrix()
    found = box_state(grid, centres, size, turns)
    for centre, R, state in zip(centres, turns, found, strict=True):
        A = np.vstack([R.T, -R.T])
        b = np.concatenate([R.T @ centre + 0.5 * size, 0.5 * size - R.T @ centre])
        near = (distances_to(corners, centre) < np.linalg.norm(size)) & (states != Occupancy.FREE)
        met = [overlap(A, b, corner, corner + RESOLUTION) for corner in corners[near]]
        assert state == worst(states[near][np.array(met, bool)])
    upright = box_state(grid, centres, size)
    for centre, state in zip(centres, upright, strict=True):
        inside = (corners < centre + 0.5 * size) & (corners + RESOLUTION > centre - 0.5 * size)
        assert state == worst(states[inside.all(axis=1)])


@settings(max_examples=4)
@given(SEEDS, st.booleans())
def test_footprints_meet_the_voxels_that_reach_into_them(seed, is_clockwise):
    grid, rng = random_map(seed)
    corners, states = window(grid)
    angles = np.array([0.1, 1.3, 2.9, 4.4]) + rng.uniform(-0.1, 0.1, 4)
    polygon = rng.uniform(0.1, 0.3) * np.column_stack([np.cos(angles), np.sin(angles)])
    low_m, high_m = np.sort(rng.uniform(-0.4, 0.4, 2))
    poses = np.column_stack([rng.uniform(-0.5, 0.5, (5, 2)), rng.uniform(-np.pi, np.pi, 5)])
    found = footprint_state(grid, poses, polygon[::-1] if is_clockwise else polygon, low_m, high_m)
    band = (corners[:, 2] < high_m) & (corners[:, 2] + RESOLUTION > low_m) & (states != Occupancy.FREE)
    for (x, y, yaw), state in zip(poses, found, strict=True):
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        ring = polygon @ R.T + [x, y]
        edges = np.roll(ring, -1, axis=0) - ring
        A = np.column_stack([edges[:, 1], -edges[:, 0]])  # outward, for the ring runs counter-clockwise
        b = (A * ring).sum(axis=1)
        near = band & (np.abs(corners[:, :2] - [x, y]) < 0.5).all(axis=1)
        columns, column_of = np.unique(corners[near][:, :2], axis=0, return_inverse=True)
        met = np.array([overlap(A, b, corner, corner + RESOLUTION) for corner in columns], bool)
        assert state == worst(states[near][met[column_of.ravel()]] if len(columns) else states[:0])


@settings(max_examples=12)
@given(SEEDS, st.floats(0.05, 1.5))
def test_the_nearest_is_the_nearest_of_all(seed, window_m):
    grid, rng = random_map(seed, rays=40)
    corners, states = window(grid)
    cube = states.reshape([2 * HALF_VOXELS] * 3)
    unknown = np.pad(cube == Occupancy.UNKNOWN, 1, constant_values=True)
    beside = np.zeros(cube.shape, bool)
    for axis in range(3):
        for shift in (-1, 1):
            beside |= np.roll(unknown, shift, axis)[1:-1, 1:-1, 1:-1]
    points = rng.uniform(-1.2, 1.2, (20, 3))
    for ask, wanted in (
        (nearest_obstacle, states == Occupancy.OCCUPIED),
        (nearest_frontier, (states == Occupancy.FREE) & beside.ravel()),
    ):
        answer = ask(grid, points, window_m)
        for n, point in enumerate(points):
            away = distances_to(corners[wanted], point)
            if away.min(initial=np.inf) > window_m:
                assert answer.distance_m[n] == np.inf
                assert np.isnan(answer.voxel_m[n]).all()
            else:
                assert abs(answer.distance_m[n] - away.min()) < 1e-9
                own = distances_to(answer.voxel_m[n : n + 1] - 0.5 * RESOLUTION, point)
                assert abs(own[0] - away.min()) < 1e-9


def test_far_places_are_unknown_and_rays_to_nowhere_end():
    grid, _ = random_map(1)
    far = np.array([[1e6, 0.0, 0.0], [0.0, -3276.79, 0.0], [0.0, 0.0, 3276.85]])
    assert (sphere_state(grid, far, 0.2) == Occupancy.UNKNOWN).all()
    assert (box_state(grid, far, [0.2, 0.2, 0.2]) == Occupancy.UNKNOWN).all()
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    assert footprint_state(grid, [1e6, 0.0, 0.0], square, 0.0, 0.2) == Occupancy.UNKNOWN
    assert footprint_state(grid, [0.0, 0.0, 0.0], square, 1e6, 1e6 + 1.0) == Occupancy.UNKNOWN
    assert (nearest_obstacle(grid, far, 10.0).distance_m == np.inf).all()
    hits = ray_cast(grid, far, np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [1e-300, 0.0, 1.0]]), 1e12)
    assert (hits.outcome == Occupancy.FREE).all()
    back = ray_cast(grid, [3000.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 4000.0)
    assert back.outcome[0] == ray_cast(grid, [5.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 10.0).outcome[0]
    empty = Octree(0.1)
    assert nearest_frontier(empty, np.zeros((1, 3)), 5.0).distance_m[0] == np.inf
    assert np.isnan(empty.log_odds_at(np.zeros((1, 3)), 9)).all()
    assert len(sphere_state(grid, np.zeros((0, 3)), 0.1)) == 0


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda grid: ray_cast(grid, [0, 0, np.nan], [1, 0, 0], 1.0), "finite"),
        (lambda grid: ray_cast(grid, [0, 0, 0], [[1, 0, 0], [0, 0, 0]], 1.0), "ray 1 has length zero"),
        (lambda grid: ray_cast(grid, [0, 0, 0], [1, 0, 0], np.inf), "range"),
        (lambda grid: sphere_state(grid, [[0, 0]], 1.0), "shape"),
        (lambda grid: sphere_state(grid, [0, 0, 0], -1.0), "radius"),
        (lambda grid: sphere_state(grid, [0, 0, 0], 1e5), "parts"),
        (lambda grid: box_state(grid, [0, 0, 0], [1, 1, 0]), "size"),
        (lambda grid: box_state(grid, [0, 0, 0], [1, 1, 1], 2.0 * np.eye(3)), "no rotation"),
        (lambda grid: box_state(grid, [0, 0, 0], [1, 1, 1], np.eye(4)), "rotations"),
        (lambda grid: footprint_state(grid, [0, 0, 0], [[0, 0], [1, 0]], 0.0, 1.0), "convex"),
        (lambda grid: footprint_state(grid, [0, 0, 0], [[0, 0], [2, 0], [0.5, 0.5], [0, 2]], 0.0, 1.0), "convex"),
        (lambda grid: footprint_state(grid, [0, 0, 0], [[0, 0], [1, 0], [0, 1]], 1.0, 1.0), "height"),
        (lambda grid: nearest_obstacle(grid, [0, 0, 0], 0.0), "window"),
        (lambda grid: grid.state_at(np.zeros((1, 3)), 17), "levels"),
    ],
)
def test_impossible_questions_are_refused(ask, words):
    with pytest.raises(DataError, match=words):
        ask(random_map(0)[0])
