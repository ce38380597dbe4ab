from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from vislam.config import DriveConfig, MapConfig
from vislam.mapping.drive.drive_grid import Drive, drive_grid
from vislam.mapping.drive.route import ground, plan
from vislam.mapping.octree.columns import MAX_RUNS, NEVER, Columns
from vislam.mapping.pictures.of_map import render_drive
from vislam.mapping.pictures.picture import Line

CELL = 0.1
CONFIG = replace(MapConfig(), drive=DriveConfig(body_length_m=0.4, body_width_m=0.3))


def yard(walls, unknown=()):
    """Flat ground of 6 x 4 m with walls and unknown places, each a range of rows and one of columns."""
    runs, counts = np.zeros((40, 60, MAX_RUNS, 2), np.int16), np.ones((40, 60), np.int16)
    runs[:, :, 0] = -1
    for rows, columns in walls:
        runs[rows, columns, 0, 1] = 20
    for rows, columns in unknown:
        counts[rows, columns] = 0
    return drive_grid(Columns(runs, counts, np.full((40, 60), NEVER, np.int16), (-10, -20)), CELL, CONFIG)


def test_a_free_way_is_straight_and_keeps_its_ends():
    start, goal = np.array([-0.03, -1.51]), np.array([4.48, 1.52])
    route = plan(yard([]), start, goal)
    np.testing.assert_array_equal(route.corners_m, [start, goal])
    assert route.length_m == pytest.approx(np.linalg.norm(goal - start))


def test_the_way_leads_around_a_wall_and_through_the_wider_gap():
    wall = [(slice(0, 31), slice(20, 22)), (slice(34, 40), slice(20, 22))]  # a gap of 0.3 m: too narrow to turn in
    start, goal = np.array([-0.5, -1.5]), np.array([4.5, -1.5])
    assert "no way leads there" in plan(yard(wall), start, goal)
    grid = yard([(slice(0, 29), slice(20, 22)), (slice(39, 40), slice(20, 22))])  # and one of 1 m
    route = plan(grid, start, goal)
    around = 2 * np.hypot(1.5, 2.4 + 0.25) + 0.2
    assert around < route.length_m < 1.4 * around
    path = route.corners_m
    assert np.min(grid.line_clearance_m(path[:-1], path[1:])) >= grid.turning_radius_m - 1e-6
    steps = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in pairwise(path)])
    assert grid.is_traversable(steps).all()


def test_more_room_is_worth_a_detour_but_not_any():
    middle = (slice(18, 22), slice(20, 40))
    narrow = yard([middle, (slice(0, 12), slice(20, 40)), (slice(34, 40), slice(20, 40))])
    route = plan(narrow, np.array([0.0, -0.3]), np.array([4.0, -0.3]))  # gaps of 0.6 m here and of 1.2 m beyond
    assert route.corners_m[:, 1].max() > 0.4
    wide = plan(yard([middle]), np.array([0.0, -0.3]), np.array([4.0, -0.3]))
    assert wide.corners_m[:, 1].max() < 0.1


def test_unseen_ground_is_a_way_only_for_who_explores():
    grid = yard([], [(slice(0, 40), slice(30, 33))])
    start, goal = np.array([-0.5, 0.0]), np.array([4.5, 0.0])
    assert "was seen" in plan(grid, start, goal)
    assert plan(grid, start, goal, explores=True).length_m == pytest.approx(5.0, abs=0.1)
    around = plan(yard([], [(slice(0, 30), slice(30, 33))]), start, goal, explores=True)
    assert around.corners_m[:, 1].max() < 1.0  # what is seen is dearer than it is worth here
    assert "not seen" in plan(grid, start, np.array([2.1, 0.0]))


def test_what_is_wrong_with_an_end_is_said():
    grid = yard([(slice(18, 22), slice(50, 54))])
    here = np.array([0.0, 0.0])
    assert "0.00 m from the goal" in plan(grid, here, np.array([4.2, 0.0]))
    assert "0.15 m from the goal, and the cart needs 0.25 m" in plan(grid, here, np.array([3.85, 0.0]))
    assert "the goal lies beyond the map" in plan(grid, here, np.array([9.0, 0.0]))
    assert "the cart is beyond the map" in plan(grid, np.array([np.nan, 0.0]), here)
    beside = plan(grid, np.array([3.78, 0.0]), here)  # it may leave where it could not turn
    np.testing.assert_array_equal(beside.corners_m[0], [3.78, 0.0])
    walled = yard([(slice(10, 30), slice(30, 50))])
    assert "too near" in plan(walled, np.array([3.0, 0.0]), here)


def test_the_ground_to_drive_on_holds_its_ends_and_has_no_small_holes():
    grid = yard([(slice(30, 40), slice(0, 60))], [(slice(10, 12), slice(20, 22)), (slice(10, 20), slice(40, 50))])
    ends = np.array([[-3.0, 0.0], [8.0, 1.0]])
    wider = ground(grid, ends, np.array([[3.5, -0.5, 0.2]]))
    assert (wider.cells_at(ends)[0] >= 0).all()
    assert wider.state_at(np.array([[1.1, -0.95], [3.55, -0.5], [3.9, -0.5], [-3.0, 0.0]])).tolist() == [
        Drive.FREE, Drive.FREE, Drive.UNKNOWN, Drive.UNKNOWN,
    ]  # fmt: skip
    inside = np.random.default_rng(0).uniform([-0.9, -1.9], [4.9, 1.9], (500, 2))
    for of in (grid, wider):
        assert of.ground_m.shape == of.slope_rad.shape == of.clearance_m.shape == of.states.shape
    np.testing.assert_array_equal(wider.state_at(inside) > 0, grid.state_at(inside) > 0)
    rows, columns = wider.cells_at(inside)
    before = grid.clearance_m[grid.cells_at(inside)]
    np.testing.assert_allclose(wider.clearance_m[rows, columns], before, atol=1e-6)


def test_the_picture_shows_the_grid_with_north_up():
    grid = yard([(slice(30, 40), slice(0, 10))], [(slice(0, 10), slice(50, 60))])
    line = Line(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]), (37, 99, 235), 3.0)
    image = render_drive(grid, [line], 600)
    dark = np.abs(image.astype(int) - (52, 58, 70)).max(axis=2) < 5
    rows, columns = np.nonzero(dark[:400])
    assert (rows.max(), columns.max()) < (130, 130)  # high y is up, low x is left
    assert (image[200, 110:390].astype(int) - (37, 99, 235) == 0).all(axis=1).sum() > 200
    np.testing.assert_array_equal(image, render_drive(grid, [line], 600))
    empty = replace(grid, states=np.full((1, 1), -1, np.int8), clearance_m=np.zeros((1, 1), np.float32))
    assert render_drive(empty, [line, Line(np.zeros((0, 3)), (0, 0, 0))]).shape[2] == 3
