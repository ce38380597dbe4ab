import math

import numpy as np
import pyoctomap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import MapConfig
from vislam.core.errors import DataError
from vislam.mapping.octree import CorrectedOccupancy
from vislam.mapping.octree.occupancy import Occupancy, Octree
from vislam.mapping.octree.octomap_io import encode_bt, encode_ot
from vislam.mapping.octree.query import ray_cast
from vislam.mapping.semantic.votes import voxel_centres, voxel_keys


class SlowOctoMap:
    """OctoMap's insertion written from its paper and headers with sets and a dictionary, one voxel at a time."""

    def __init__(self, resolution, miss_beside=None):
        self.resolution = resolution
        self.miss_beside = miss_beside
        self.cells = {}

    def key(self, point):
        return tuple(math.floor((1.0 / self.resolution) * float(c)) for c in point)

    def centre(self, key):
        return np.array([np.float32((k + 0.5) * self.resolution) for k in key])

    def ray(self, origin, end):
        key, last = list(self.key(origin)), self.key(end)
        if tuple(key) == last:
            return []
        passed = [tuple(key)]
        direction = end - origin
        length = np.float32(math.sqrt(float(direction[0] * direction[0] + direction[1] * direction[1]
                                            + direction[2] * direction[2])))  # fmt: skip
        direction = direction / length
        half = float(np.float32(0.5 * self.resolution))
        step = [int(np.sign(d)) for d in direction]
        far = [math.inf] * 3
        delta = [math.inf] * 3
        for a in range(3):
            if step[a]:
                border = (key[a] + 0.5) * self.resolution + step[a] * half
                far[a] = (border - float(origin[a])) / float(direction[a])
                delta[a] = self.resolution / abs(float(direction[a]))
        while True:
            a = 0 if far[0] < far[1] and far[0] < far[2] else (1 if far[1] <= far[0] and far[1] < far[2] else 2)
            key[a] += step[a]
            far[a] += delta[a]
            if tuple(key) == last or min(far) > float(length):
                return passed
            passed.append(tuple(key))

    def insert(self, points, origin, max_range, discretised):
        free, hit = set(), set()
        ends = [self.centre(k) for k in dict.fromkeys(map(self.key, points))] if discretised else points
        for end in ends:
            offset = end - origin
            distance = math.sqrt(float(offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]))
            if max_range >= 0 and distance > max_range:
                end = origin + offset / np.float32(distance) * np.float32(max_range)  # noqa: PLW2901
                free.update(self.ray(origin, end))
            else:
                free.update(self.ray(origin, end))
                hit.add(self.key(end))
        offsets = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]
        beside = {tuple(np.add(cell, d).tolist()) for cell in hit for d in offsets} if self.miss_beside else set()
        for cell in free - hit:
            grazed = cell in beside and self.cells.get(cell, np.float32(-1)) >= 0
            self.change(cell, self.miss_beside if grazed else 0.4)
        for cell in hit:
            self.change(cell, 0.7)

    def change(self, cell, probability):
        value = self.cells.get(cell, np.float32(0)) + np.float32(math.log(probability / (1 - probability)))
        low, high = (np.float32(math.log(p / (1 - p))) for p in (0.1192, 0.971))
        self.cells[cell] = min(max(value, low), high)


def random_scan(rng, count, reach):
    origin = rng.uniform(-0.5, 0.5, 3).astype(np.float32)
    return (origin + rng.uniform(-reach, reach, (count, 3))).astype(np.float32), origin


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.05, 0.1, 0.13]),
    st.sampled_from([-1.0, 0.7]),
    st.sampled_from(["discretised", "full"]),
    st.sampled_from([None, 0.46]),
)
def test_equals_a_slow_octomap_voxel_by_voxel(seed, resolution, max_range, insertion, miss_beside):
    rng = np.random.default_rng(seed)
    fast = Octree(resolution, miss_beside_probability=miss_beside)
    slow = SlowOctoMap(resolution, miss_beside)
    for _ in range(3):
        points, origin = random_scan(rng, 15, 1.0)
        fast.insert(points, origin, max_range, insertion)
        slow.insert(points, origin, max_range, insertion == "discretised")
    octree = fast.leaves()
    assert int((np.int64(1) << (3 * octree.levels.astype(np.int64))).sum()) == len(slow.cells)
    centres = np.array([slow.centre(k) for k in slow.cells], dtype=np.float64)
    np.testing.assert_array_equal(fast.log_odds_at(centres), np.array(list(slow.cells.values()), dtype=np.float32))
    np.testing.assert_array_equal(octree.log_odds_at(centres), fast.log_odds_at(centres))


@pytest.mark.parametrize("resolution", [0.05, 0.02])
@pytest.mark.parametrize("insertion", ["discretised", "full"])
def test_files_equal_those_of_octomap_byte_for_byte(tmp_path, resolution, insertion):
    rng = np.random.default_rng(7)
    ours, theirs = Octree(resolution), pyoctomap.OcTree(resolution)
    for _ in range(3):
        points, origin = random_scan(rng, 1500, 1.5)
        ours.insert(points, origin, 2.0, insertion)
        theirs.insertPointCloud(
            points.astype(np.float64), origin.astype(np.float64), max_range=2.0, discretize=insertion == "discretised"
        )
    theirs.write(str(tmp_path / "a.ot"))
    assert encode_ot(ours.leaves()) == (tmp_path / "a.ot").read_bytes()
    theirs.writeBinary(str(tmp_path / "a.bt"))
    assert encode_bt(ours.max_likelihood_leaves()) == (tmp_path / "a.bt").read_bytes()


def test_where_a_miss_beside_a_hit_counts_as_any_files_are_still_octomaps():
    rng = np.random.default_rng(8)
    octomaps, equal, spared = (Octree(0.05, miss_beside_probability=p) for p in (None, 0.4, 0.46))
    for _ in range(3):
        points, origin = random_scan(rng, 1500, 1.5)
        for grid in (octomaps, equal, spared):
            grid.insert(points, origin, 2.0)
    assert encode_ot(equal.leaves()) == encode_ot(octomaps.leaves()) != encode_ot(spared.leaves())


def grazing_scans(grid, count):
    """A floor seen once from above, then again and again from a place just above it: rays to its far end graze it."""
    x, y = np.meshgrid(np.arange(0.3, 4.0, 0.02), np.arange(-0.5, 0.5, 0.02))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.012)])  # low in its voxels
    grid.insert(floor, np.array([2.0, 0.0, 1.5]))
    grid.insert(floor, np.array([2.0, 0.0, 1.5]))
    for k in range(count):
        # the floor of one scan is sparse, as far and grazed ones are: many voxels have no point of their own in it
        grid.insert(floor[k::97], np.array([0.0, 0.0, 0.4]), -1.0, "full")
    return (grid.state_at(floor) == Occupancy.FREE).mean()


def test_a_floor_that_rays_graze_stays_where_a_miss_beside_a_hit_counts_less():
    before = grazing_scans(Octree(0.05, 0.7, 0.32, 0.1192, 0.9), 12)
    now = grazing_scans(Octree(0.05, 0.7, 0.32, 0.1192, 0.9, 0.46), 12)
    assert before > 0.1
    assert now < 0.5 * before


def test_what_lay_on_a_floor_and_is_gone_is_cleared_in_the_end():
    grid = Octree(0.05, 0.7, 0.32, 0.1192, 0.9, 0.46)
    x, y = np.meshgrid(np.arange(1.0, 2.0, 0.02), np.arange(-0.5, 0.5, 0.02))
    floor, origin = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.02)]), np.array([0.0, 0.0, 1.0])
    lying = (abs(floor[:, 0] - 1.5) < 0.2) & (abs(floor[:, 1]) < 0.2)
    thing = floor[lying] + [0.0, 0.0, 0.05]  # in the layer of voxels that touches the floor's
    for _ in range(6):
        grid.insert(np.vstack([floor[~lying], thing]), origin)
    inside = thing[(abs(thing[:, :2] - [1.5, 0.0]) < 0.12).all(axis=1)]
    assert (grid.state_at(inside) == Occupancy.OCCUPIED).all()
    for _ in range(15):
        grid.insert(floor, origin)
    assert (grid.state_at(inside) == Occupancy.FREE).all()
    assert (grid.state_at(floor) == Occupancy.OCCUPIED).all()


def test_a_ray_frees_its_way_and_nothing_else():
    grid = Octree(0.1)
    grid.insert(np.array([[1.05, 0.05, 0.05]]), np.array([0.05, 0.05, 0.05]))
    along = np.array([[x, 0.05, 0.05] for x in (0.05, 0.55, 0.95)])
    assert (grid.state_at(along) == Occupancy.FREE).all()
    assert grid.state_at(np.array([[1.05, 0.05, 0.05]])) == Occupancy.OCCUPIED
    beside = np.array([[0.55, 0.15, 0.05], [1.15, 0.05, 0.05], [-0.05, 0.05, 0.05]])
    assert (grid.state_at(beside) == Occupancy.UNKNOWN).all()


@pytest.mark.parametrize("insertion", ["discretised", "full"])
def test_a_point_beyond_the_range_only_clears_the_way(insertion):
    grid = Octree(0.1)
    grid.insert(np.array([[3.05, 0.05, 0.05]]), np.array([0.05, 0.05, 0.05]), 2.0, insertion)
    assert len(grid.leaves().occupied_voxels()) == 0
    states = grid.state_at(np.array([[1.95, 0.05, 0.05], [2.25, 0.05, 0.05], [3.05, 0.05, 0.05]]))
    assert states.tolist() == [Occupancy.FREE, Occupancy.UNKNOWN, Occupancy.UNKNOWN]


@pytest.mark.parametrize("resolution", [0.02, 0.05, 0.07, 0.1, 0.25])
def test_points_on_the_border_of_voxels_read_back_as_occupied_where_octomap_has_them(resolution):
    steps = np.arange(-120, 121) * resolution
    points = np.stack([steps, np.roll(steps, 60), np.roll(steps, 120)], axis=1)
    origin = np.full(3, 0.3 * resolution)
    for point in points[::3]:
        ours, theirs = Octree(resolution), pyoctomap.OcTree(resolution)
        ours.insert(point[None], origin)
        theirs.insertPointCloud(point[None], origin)
        leaves = ours.leaves()
        for asked in (point[None], point[None].astype(np.float32)):
            assert ours.state_at(asked) == Occupancy.OCCUPIED
            assert (leaves.log_odds_at(asked) > 0).all()
            assert ray_cast(ours, asked, np.ones((1, 3)), 0.1).range_m == 0.0
            assert voxel_centres(voxel_keys(asked, resolution), resolution) == pytest.approx(
                resolution * (leaves.occupied_voxels() + 0.5)
            )
        centre = resolution * (leaves.occupied_voxels()[0] + 0.5)
        assert theirs.isNodeOccupied(theirs.search(centre))


@pytest.mark.parametrize("insertion", ["discretised", "full"])
def test_what_was_hit_at_the_maximum_range_stays_as_in_octomap_or_is_cleared_as_asked(insertion):
    origin, wall, far = np.full(3, 0.05), np.array([[2.04, 0.05, 0.05]]), np.array([[5.0, 0.05, 0.05]])
    octomaps, clearing, theirs = Octree(0.1), Octree(0.1, clears_at_range=True), pyoctomap.OcTree(0.1)
    for scan in [wall] * 3 + [far] * 10:
        for grid in (octomaps, clearing):
            grid.insert(scan, origin, 2.0, insertion)
        theirs.insertPointCloud(scan, origin, max_range=2.0, discretize=insertion == "discretised")
    assert theirs.isNodeOccupied(theirs.search(wall[0]))
    assert octomaps.state_at(wall) == Occupancy.OCCUPIED
    assert clearing.state_at(wall) == Occupancy.FREE
    beyond = np.array([[2.15, 0.05, 0.05]])
    assert clearing.state_at(beyond) == Occupancy.UNKNOWN
    both = np.vstack([wall, far])
    for _ in range(10):
        clearing.insert(both, origin, 2.0, insertion)
    assert clearing.state_at(wall) == Occupancy.OCCUPIED, "a point in it wins over the ray"


@pytest.mark.parametrize(("clears", "state"), [(False, Occupancy.OCCUPIED), (True, Occupancy.FREE)])
def test_a_setting_has_a_run_clear_what_was_hit_at_the_maximum_range(clears, state):
    origin, wall, far = np.full(3, 0.05), np.array([[2.04, 0.05, 0.05]]), np.array([[5.0, 0.05, 0.05]])
    config = MapConfig(resolution_m=0.1, clears_at_range=clears)
    grid = CorrectedOccupancy(config, None, None).occupancy
    for scan in [wall] * 3 + [far] * 10:
        grid.insert(scan, origin, 2.0)
    assert grid.state_at(wall) == state


def test_a_point_beyond_the_range_in_the_voxel_at_the_range_does_not_clear_it():
    grid = Octree(0.1, clears_at_range=True)
    grid.insert(np.array([[2.08, 0.05, 0.05]]), np.full(3, 0.05), 2.0, "full")
    assert grid.state_at(np.array([[2.05, 0.05, 0.05]])) == Occupancy.UNKNOWN


def test_clamping_lets_a_voxel_change_its_mind():
    grid, wall, behind = Octree(0.1), np.array([[1.05, 0.05, 0.05]]), np.array([[2.05, 0.05, 0.05]])
    origin = np.full(3, 0.05)
    for _ in range(1000):
        grid.insert(wall, origin)
    np.testing.assert_allclose(grid.log_odds_at(wall), math.log(0.971 / 0.029), rtol=1e-6)
    misses = 0
    while grid.state_at(wall) == Occupancy.OCCUPIED:
        grid.insert(behind, origin)
        misses += 1
    assert misses == 9  # 3.51 / 0.405: however often it had been seen before


def test_points_that_are_not_finite_are_left_out():
    points = np.array([[1.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]])
    dirty, clean = Octree(0.1), Octree(0.1)
    assert dirty.insert(points, np.zeros(3)) == 1
    clean.insert(points[:1], np.zeros(3))
    assert encode_ot(dirty.leaves()) == encode_ot(clean.leaves())
    assert dirty.insert(np.full((3, 3), np.nan), np.zeros(3)) == 0
    assert dirty.insert(np.zeros((0, 3)), np.zeros(3)) == 0


def test_queries_beyond_the_world_are_unknown():
    grid = Octree(0.1)
    grid.insert(np.ones((1, 3)), np.zeros(3))
    places = np.array([[1e9, 0.0, 0.0], [-1e30, 0.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    assert (grid.state_at(places) == Occupancy.UNKNOWN).all()
    assert np.isnan(grid.leaves().log_odds_at(places)).all()


@pytest.mark.parametrize(
    ("points", "origin", "words"),
    [
        ([[4000.0, 0.0, 0.0]], [0.0, 0.0, 0.0], "16-bit keys"),
        ([[1.0, 0.0, 0.0]], [np.nan, 0.0, 0.0], "origin"),
        ([[1500.0, 1500.0, 1500.0]], [0.0, 0.0, 0.0], "too many cells"),
    ],
)
def test_impossible_scans_are_refused_and_leave_the_map_alone(points, origin, words):
    grid = Octree(0.1)
    grid.insert(np.ones((1, 3)), np.zeros(3))
    before = encode_ot(grid.leaves())
    with pytest.raises(DataError, match=words):
        grid.insert(np.array(points), np.array(origin))
    assert encode_ot(grid.leaves()) == before


@pytest.mark.parametrize("resolution", [0.0, -1.0, np.nan, np.inf])
def test_impossible_resolutions_are_refused(resolution):
    with pytest.raises(DataError, match="resolution"):
        Octree(resolution)


def test_many_blocks_survive_the_growth_of_the_table():
    rng = np.random.default_rng(3)
    grid = Octree(0.1)
    places = rng.uniform(-30, 30, (3000, 3))
    for place in places:
        grid.insert(place[None], place)
    assert (grid.state_at(places.astype(np.float32)) == Occupancy.OCCUPIED).all()
