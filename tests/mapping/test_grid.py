from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from vislam.mapping.drive.grid import floor_height_m, navigation_grid, write_grid
from vislam.mapping.octree.occupancy import Octree


def room():
    """A floor 3 m by 2 m with a box at its far right corner, seen from above the middle; x from 1, y from -1."""
    grid = Octree(0.1)
    x, y = np.meshgrid(np.arange(1.05, 4.0, 0.05), np.arange(-0.95, 1.0, 0.05))
    floor = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.25)])
    bx, by, bz = np.meshgrid(np.arange(3.55, 3.8, 0.1), np.arange(0.55, 0.8, 0.1), np.arange(0.35, 0.8, 0.1))
    box = np.column_stack([bx.ravel(), by.ravel(), bz.ravel()])
    shelf = box + np.array([-2.0, 0.0, 2.5])  # hangs high up
    for _ in range(3):
        for part in (floor, box, shelf):
            grid.insert(part, np.array([2.5, 0.0, 1.5]))
    grid.insert(np.array([[6.05, 1.05, 0.45]]), np.array([5.55, 1.05, 0.45]))  # seen from elsewhere: unknown between
    return grid


def test_bands_above_the_floor():
    octree = room().leaves()
    floor = floor_height_m(octree)
    assert floor == pytest.approx(0.2)
    grid = navigation_grid(octree, floor, 0.1, 1.5)
    state = cell_reader(grid)
    assert state(3.65, 0.65) == 1  # the box
    assert state(2.5, 0.5) == 0  # seen through
    assert state(1.65, 0.65) == 0  # below the shelf
    assert state(5.75, 1.05) == 0
    assert state(6.05, 1.05) == 1
    assert state(5.05, 0.05) == -1
    assert cell_reader(navigation_grid(octree, floor, 0.1, 4.0))(1.65, 0.65) == 1


def cell_reader(grid):
    def state(x, y):
        column = int(np.floor((x - grid.origin_m[0]) / grid.resolution_m))
        row = int(np.floor((y - grid.origin_m[1]) / grid.resolution_m))
        return int(grid.cells[row, column])

    return state


def test_map_server_reads_back_what_was_meant(tmp_path):
    octree = room().leaves()
    grid = navigation_grid(octree, floor_height_m(octree), 0.1, 1.5)
    image_path, yaml_path = write_grid(tmp_path, grid)
    meta = yaml.safe_load(yaml_path.read_text())
    shades = cv2.imread(str(tmp_path / meta["image"]), cv2.IMREAD_UNCHANGED)
    assert image_path.name == meta["image"]
    assert (meta["mode"], meta["negate"], meta["resolution"]) == ("trinary", 0, 0.1)
    # nav2_map_server, map_io.cpp: trinary mode
    share = (255 - shades.astype(float)) / 255
    cells = np.where(share > meta["occupied_thresh"], 1, np.where(share < meta["free_thresh"], 0, -1))
    np.testing.assert_array_equal(cells[::-1], grid.cells)  # the image's first row is the highest y
    np.testing.assert_allclose(meta["origin"], [*grid.origin_m, 0.0], atol=1e-6)
    assert set(np.unique(grid.cells)) == {-1, 0, 1}


def test_large_leaves_fill_all_their_cells():
    octree = room().leaves()
    assert octree.levels.max() >= 1  # pruned
    grid = navigation_grid(octree, 0.2, 0.1, 1.5)
    free = replace(octree, log_odds=-octree.log_odds).occupied_voxels()
    z = (free[:, 2] + 0.5) * 0.1
    band = free[(z >= 0.3) & (z <= 1.7)]
    rows, columns = (band[:, 1] - round(grid.origin_m[1] / 0.1)), (band[:, 0] - round(grid.origin_m[0] / 0.1))
    assert (grid.cells[rows, columns] != -1).all()
    assert (grid.cells == 0).sum() <= len({(int(r), int(c)) for r, c in zip(rows, columns, strict=True)})


def test_an_empty_map_gives_one_unknown_cell(tmp_path):
    octree = Octree(0.05).leaves()
    assert floor_height_m(octree) == 0.0
    grid = navigation_grid(octree, 0.0, 0.1, 1.5)
    assert grid.cells.tolist() == [[-1]]
    image, _ = write_grid(tmp_path, grid)
    assert cv2.imread(str(image), cv2.IMREAD_UNCHANGED).tolist() == [[205]]
