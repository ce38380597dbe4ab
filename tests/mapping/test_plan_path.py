import importlib.util
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from vislam.config import DriveConfig, MapConfig
from vislam.core.errors import DataError
from vislam.mapping.drive.drive import Drive, drive_grid
from vislam.mapping.octree.columns import MAX_RUNS, NEVER, Columns
from vislam.mapping.pictures.picture import Line
from vislam.mapping.pictures.plan import render_drive

_PATH = Path(__file__).resolve().parents[2] / "experiments" / "plan_path.py"
_SPEC = importlib.util.spec_from_file_location("plan_path", _PATH)
plan_path = importlib.util.module_from_spec(_SPEC)
sys.modules["plan_path"] = plan_path
_SPEC.loader.exec_module(plan_path)

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


def length_m(path):
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def test_a_free_way_is_straight():
    path = plan_path.plan(yard([]), np.array([-0.5, -1.5]), np.array([4.5, 1.5]))
    assert len(path) == 2
    assert length_m(path) == pytest.approx(np.hypot(5.0, 3.0), abs=0.1)


def test_the_way_leads_around_a_wall_and_through_the_wider_gap():
    wall = [(slice(0, 31), slice(20, 22)), (slice(34, 40), slice(20, 22))]  # a gap of 0.3 m: too narrow to turn in
    with pytest.raises(DataError, match="no way"):
        plan_path.plan(yard(wall), np.array([-0.5, -1.5]), np.array([4.5, -1.5]))
    grid = yard([(slice(0, 30), slice(20, 22)), (slice(39, 40), slice(20, 22))])  # and one of 0.9 m
    path = plan_path.plan(grid, np.array([-0.5, -1.5]), np.array([4.5, -1.5]))
    around = 2 * np.hypot(1.5, 2.5 + 0.25) + 0.2
    assert around < length_m(path) < 1.35 * around
    assert np.min(grid.line_clearance_m(path[:-1], path[1:])) >= grid.turning_radius_m - 1e-6
    steps = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in pairwise(path)])
    assert grid.is_traversable(steps).all()


def test_start_and_goal_in_a_wall_move_to_where_the_cart_can_stand_and_unknown_ground_is_avoided():
    grid = yard([(slice(18, 22), slice(0, 4))], [(slice(0, 35), slice(30, 33))])
    path = plan_path.plan(grid, np.array([-0.9, 0.0]), np.array([4.9, -1.9]))
    assert np.linalg.norm(path[0] - [-0.9, 0.0]) < 0.8
    assert (grid.state_at(path) == Drive.FREE).all()
    assert path[:, 1].max() > 1.5  # past the end of what is unknown
    with pytest.raises(DataError, match="no place"):
        plan_path.plan(yard([], [(slice(0, 40), slice(0, 60))]), np.zeros(2), np.ones(2))


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


def test_the_experiment_needs_only_a_run_folder(tmp_path, capsys):
    from vislam.mapping.octree.occupancy import Octree
    from vislam.mapping.octree.octomap_io import encode_bt

    occupancy = Octree(CELL)
    x, y = np.meshgrid(np.arange(0.05, 4.0, CELL), np.arange(0.05, 3.0, CELL))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -0.05)])
    occupancy.insert(floor, np.array([2.0, 1.5, 2.0]))
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "octomap.bt").write_bytes(encode_bt(occupancy.max_likelihood_leaves()))
    poses = [f"{k}.0 {1 + 0.2 * k} 1.5 0.0 0 0 0 1\n" for k in range(8)]
    (tmp_path / "trajectory_graph.tum").write_text("".join(poses))
    plan_path.main([str(tmp_path), "--goal", "0.8,2.2", "--out", str(tmp_path / "plan.png")])
    assert " m with 0 corners" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "plan.png")) is not None
