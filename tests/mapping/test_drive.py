from dataclasses import replace

import numpy as np
import pytest

from vislam.config import DriveConfig, MapConfig
from vislam.core.errors import DataError
from vislam.mapping.drive.drive_grid import Drive, DriveMap
from vislam.mapping.octree import ColumnStore
from vislam.mapping.octree.occupancy import Octree

CELL = 0.1
DRIVE = DriveConfig(body_length_m=0.6, body_width_m=0.4, max_step_m=0.1, max_slope_deg=15.0, slope_window_m=1.0)
CONFIG = replace(MapConfig(), drive=DRIVE, grid_high_m=1.0)


class Yard:
    """A small world of columns, written into an occupancy map as scans from above and from the side would see it."""

    def __init__(self, columns=60, rows=40):
        self.ground = np.zeros((rows, columns))  # top of the ground in voxels; NaN: nothing was ever seen there
        self.things = []  # rows, columns, lowest and highest voxel

    def occupancy(self, parts=1):
        grid = Octree(CELL)
        scans = [[] for _ in range(parts)]
        for (row, column), top in np.ndenumerate(self.ground):
            if np.isnan(top):
                continue
            voxels = [int(top) - 1] + [z for r, c, low, high in self.things if row in r and column in c
                                       for z in range(low, high + 1)]  # fmt: skip
            scans[column * parts // self.ground.shape[1]] += [(column, row, z) for z in voxels]
        for scan in scans:
            grid = see(grid, np.array(scan))
        return grid


def see(grid, voxels):
    """One ray from just above each of the voxels [N, 3], highest last, so that every one is occupied, free above."""
    for z in np.unique(voxels[:, 2]):
        at_z = voxels[voxels[:, 2] == z]
        for x, y, _ in at_z:
            centre = (np.array([x, y, z]) + 0.5) * CELL
            for _ in range(2):
                grid.insert(centre[None], centre + np.array([0.0, 0.0, CELL]))
    return grid


def cells(grid, name):
    return np.asarray(grid.states == Drive[name])


def test_flat_ground_is_free_and_the_rest_unknown():
    yard = Yard(20, 10)
    yard.ground[:, :5] = np.nan
    grid = DriveMap(CONFIG).update(yard.occupancy())
    assert grid.floor_m == pytest.approx(0.0)
    free = grid.state_at(np.array([[0.55, 0.05], [1.95, 0.95]]))
    assert free.tolist() == [Drive.FREE, Drive.FREE]
    assert grid.state_at(np.array([[0.45, 0.5], [np.nan, 0.5], [50.0, 0.0], [np.inf, 1.0]])).tolist() == [-1] * 4
    assert cells(grid, "FREE").sum() == 15 * 10
    assert np.nanmax(np.abs(grid.ground_m)) < 1e-6
    assert np.nanmax(grid.slope_rad) == 0.0
    assert (grid.clearance_m == 500 * CELL).all()  # nothing is in the way


@pytest.fixture(scope="module")
def world():
    """Floor with: a table to the right, a ramp to a platform, a steep ramp, a hole, a wall, a beam high up."""
    yard = Yard()
    yard.things.append((range(2, 8), range(48, 56), 7, 7))  # a table top, its underside 0.7 m above the floor
    yard.things.append((range(2, 8), range(30, 40), 12, 12))  # a beam 1.2 m above the floor
    yard.things.append((range(12, 14), range(0, 25), 0, 14))  # a wall
    for column in range(30):
        yard.ground[30:40, column] = np.floor(0.2 * (np.clip(column - 4, 0, 20)) + 1e-9)  # 20 %: 11.3 degrees, 0.4 m up
        yard.ground[15:28, column] = np.floor(0.5 * (np.clip(column - 6, 0, 14)) + 1e-9)  # 50 %: 27 degrees
    yard.ground[16:26, 44:52] = -5  # a hole with a bottom
    yard.ground[30:36, 44:50] = np.nan  # one without: seen into below
    occupancy = yard.occupancy()
    into = np.array([[x, y, -4] for x in range(44, 50) for y in range(30, 36)])
    for x, y, z in into:
        end, start = (np.array([x, y, z]) + 0.5) * CELL, (np.array([x, y, 3]) + 0.5) * CELL
        occupancy.insert(end[None], start, 0.75)  # clears the way, hits nothing
    return yard, occupancy, DriveMap(CONFIG).update(occupancy)


def test_table_beam_and_wall(world):
    _, _, grid = world
    states = at(grid)
    assert (states(range(2, 8), range(48, 56)) == Drive.LOW).all()
    assert (states(range(2, 8), range(30, 40)) == Drive.FREE).all()  # the beam is driven under
    assert (states(range(12, 14), range(25)) == Drive.OBSTACLE).all()
    assert (states(range(8, 12), range(60)) == Drive.FREE).all()
    lower = DriveMap(replace(CONFIG, grid_high_m=0.6)).update(world[1])
    assert (at(lower)(range(2, 8), range(48, 56)) == Drive.FREE).all()  # a low cart drives under the table
    assert np.abs(at(lower, "ground_m")(range(2, 8), range(48, 56))).max() < 1e-6
    higher = DriveMap(replace(CONFIG, grid_high_m=1.3)).update(world[1])
    assert (at(higher)(range(2, 8), range(30, 40)) == Drive.LOW).all()


def test_ramps_lead_up_and_steep_ones_do_not(world):
    yard, _, grid = world
    ground = at(grid, "ground_m")(range(30, 40), range(30))
    np.testing.assert_allclose(ground, yard.ground[30:40, :30] * CELL, atol=1e-6)
    slope = np.rad2deg(at(grid, "slope_rad")(range(34, 36), range(9, 20)))
    assert np.abs(slope - np.rad2deg(np.arctan(0.2))).max() < 2.0  # of voxels of a tenth of a metre
    states = at(grid)
    assert (states(range(36, 40), range(0, 29)) == Drive.FREE).all()
    assert (states(range(31, 36), range(20, 29)) == Drive.FREE).all()
    assert (states(range(20, 23), range(11, 16)) == Drive.STEEP).all()
    # the platform falls by 0.4 m to the floor beside it: its rim is a drop, the floor below it is free
    assert (states(range(30, 40), range(29, 30)) == Drive.DROP).all()
    assert (states(range(30, 31), range(16, 30)) == Drive.DROP).all()
    assert (states(range(30, 40), range(30, 40)) == Drive.FREE).all()


def test_holes_are_drops_with_and_without_a_bottom(world):
    _, _, grid = world
    states = at(grid)
    assert (states(range(16, 26), range(44, 52)) == Drive.DROP).all()
    assert (states(range(30, 36), range(44, 50)) == Drive.DROP).all()
    assert (states(range(26, 30), range(41, 60)) == Drive.FREE).all()


def at(grid, layer="states"):
    """Look a layer up by the yard's rows and columns, wherever the grid's corner is."""
    row, column = round(-grid.origin_m[1] / CELL), round(-grid.origin_m[0] / CELL)

    def look(rows, columns):
        return getattr(grid, layer)[rows.start + row : rows.stop + row, columns.start + column : columns.stop + column]

    return look


def test_the_body_needs_room(world):
    _, _, grid = world
    assert grid.turning_radius_m == pytest.approx(np.hypot(0.3, 0.2))
    beside = np.array([[1.25, 1.2 - gap] for gap in (0.15, 0.25, 0.35, 0.45)])  # from the wall's side at y = 1.2
    np.testing.assert_allclose(grid.clearance_m[grid.cells_at(beside)], [0.15, 0.25, 0.35, 0.45], atol=1e-5)
    assert grid.is_traversable(beside).tolist() == [False, False, False, True]
    assert grid.is_traversable(beside, 0.0).tolist() == [False, True, True, True]  # half a width off, along the wall
    assert grid.is_traversable(beside, np.pi / 2).tolist() == [False, False, True, True]  # half a length
    assert grid.is_traversable(beside, [0.0, 0.0, np.pi / 2, np.nan]).tolist() == [False, True, True, False]
    assert not grid.is_traversable(np.array([[1.25, 1.25], [4.6, 3.3], [-3.0, 0.0], [np.nan, 0.0]])).any()


def test_a_turned_body_touches_what_its_corners_reach():
    yard = Yard(30, 30)
    yard.things.append((range(15, 16), range(20, 21), 0, 5))  # a post: the cell from (2.0, 1.5) to (2.1, 1.6)
    grid = DriveMap(CONFIG).update(yard.occupancy())
    rng = np.random.default_rng(3)
    places, yaws = rng.uniform(1.2, 2.8, (400, 2)), rng.uniform(-4.0, 4.0, 400)
    corner = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 61), np.linspace(-0.2, 0.2, 41)), axis=-1).reshape(-1, 2)
    got = grid.is_traversable(places, yaws)
    for (x, y), yaw, fits in zip(places, yaws, got, strict=True):
        c, s = np.cos(yaw), np.sin(yaw)
        body = corner @ np.array([[c, s], [-s, c]]) + [x, y]
        inside = (body > [1.999, 1.499]).all(axis=1) & (body < [2.101, 1.601]).all(axis=1)
        deep = (body > [2.01, 1.51]).all(axis=1) & (body < [2.09, 1.59]).all(axis=1)
        assert not (fits and deep.any())
        if not fits:  # conservative by no more than a cell
            near = (body > [1.9, 1.4]).all(axis=1) & (body < [2.2, 1.7]).all(axis=1)
            assert inside.any() or near.any()
    assert 20 < (~got).sum() < 300


def test_clearance_along_lines(world):
    _, _, grid = world
    start = np.array([[0.25, 0.95], [0.25, 0.95], [0.25, 1.05], [0.25, 0.95], [0.25, 0.95], [np.nan, 0.0]])
    end = np.array([[2.25, 0.95], [2.25, 1.65], [2.25, 1.05], [0.25, 0.95], [-4.0, 0.95], [1.0, 1.0]])
    got = grid.line_clearance_m(start, end)
    np.testing.assert_allclose(got[:4], [0.25, 0.0, 0.15, 0.25], atol=1e-5)
    assert np.isnan(got[4:]).all()
    assert grid.line_clearance_m(start[0], end).shape == (6,)
    # never more than that of any place on the way
    rng = np.random.default_rng(5)
    a, b = rng.uniform(0.2, 3.8, (50, 2)), rng.uniform(0.2, 3.8, (50, 2))
    for share in np.linspace(0.0, 1.0, 11):
        there = grid.clearance_m[grid.cells_at(a + share * (b - a))]
        along = grid.line_clearance_m(a, b)
        assert (np.isnan(along) | (along <= there + 0.5 * CELL)).all()


def layers(grid):
    return [getattr(grid, name) for name in ("states", "ground_m", "slope_rad", "clearance_m")]


def same(first, second):
    assert (first.origin_m, first.floor_m) == (second.origin_m, second.floor_m)
    for a, b in zip(layers(first), layers(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_updated_grid_is_the_one_made_from_scratch():
    yard = Yard(48, 24)
    yard.things.append((range(4, 9), range(10, 20), 3, 7))
    occupancy = yard.occupancy()
    drive, columns = DriveMap(CONFIG), ColumnStore()
    drive.update(occupancy)
    columns.update(occupancy)
    assert columns.update(occupancy) == 0
    rng = np.random.default_rng(1)
    for _ in range(6):
        x, y = rng.integers(-20, 60, 2)
        see(occupancy, np.array([[x, y, z] for z in range(-1, 4)]))
        assert 1 <= columns.update(occupancy) <= 4  # not the 18 and more of the map
        same(drive.update(occupancy), DriveMap(CONFIG).update(occupancy))
    other = Yard(30, 40).occupancy()  # a rebuilt map that takes the place of the old one, and is smaller
    same(drive.update(other), DriveMap(CONFIG).update(other))


def test_a_column_of_many_things_still_stops_the_cart():
    occupancy = Yard(10, 10).occupancy()
    see(occupancy, np.array([[5, 5, z] for z in range(1, 40, 2)]))  # 20 runs in one column
    grid = DriveMap(CONFIG).update(occupancy)
    assert grid.state_at(np.array([[0.55, 0.55]]))[0] in (Drive.LOW, Drive.OBSTACLE)


def test_reflections_below_the_floor_do_not_open_it():
    occupancy = Yard(30, 30).occupancy()
    see(occupancy, np.array([[x, y, -6] for x in range(5, 12) for y in range(5, 12)]))
    see(occupancy, np.array([[x, y, -1] for x in range(5, 12) for y in range(5, 12)]))
    grid = DriveMap(CONFIG).update(occupancy)
    assert (at(grid)(range(30), range(30)) == Drive.FREE).all()


def test_the_floor_is_told_or_found_and_an_empty_map_is_unknown():
    empty = DriveMap(CONFIG).update(Octree(CELL))
    assert empty.states.tolist() == [[Drive.UNKNOWN]]
    assert not empty.is_traversable(np.zeros((1, 2))).any()
    yard = Yard(20, 20)
    yard.ground[:, :12] = 9  # most of what is seen is a table's height above the floor
    occupancy = yard.occupancy()
    assert DriveMap(replace(CONFIG, grid_floor_m=0.9)).update(occupancy).floor_m == pytest.approx(0.9)
    told = DriveMap(replace(CONFIG, grid_floor_m=0.0)).update(occupancy)
    assert (at(told)(range(20), range(12, 20)) == Drive.FREE).all()
    assert (at(told)(range(20), range(12)) == Drive.OBSTACLE).all()


def test_a_map_that_is_too_wide_for_a_grid_is_an_error_before_memory_is_taken():
    occupancy = Yard(4, 4).occupancy()
    far = np.array([[3000.0, -3000.0, 0.0]])
    occupancy.insert(far, far[0] + [0.0, 0.0, 1.0])
    with pytest.raises(DataError, match="coarser"):
        DriveMap(CONFIG).update(occupancy)
