"""A path for the cart through the map of a run: A* on the drive grid, straightened, and a picture of it.

    python experiments/plan_path.py RUN [--start X,Y] [--goal X,Y] [--out plan.png]

Start and goal are places in the map frame; without them, the end and the beginning of the run's own way.
"""

from __future__ import annotations

import argparse
import heapq
import math
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.errors import DataError, VislamError
from vislam.mapping.drive.drive import DriveGrid, DriveMap
from vislam.mapping.octree.occupancy import Octree
from vislam.mapping.octree.octomap_io import read_octree
from vislam.mapping.pictures.picture import Line
from vislam.mapping.pictures.plan import render_drive
from vislam.trajectory import read_trajectory

Array = NDArray[np.float64]

_STEPS = [(dy, dx, math.hypot(dy, dx)) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
_COMFORT_M = 0.3  # of room beyond the turning circle that is worth a detour ...
_DETOUR = 1.0  # ... of so many times the way without it
_WAY, _PLAN = (150, 160, 175), (37, 99, 235)


def nearest_free(grid: DriveGrid, xy_m: Array) -> tuple[int, int]:
    """Return row and column of the cell nearest to a place where the cart can stand and turn."""
    rows, columns = np.nonzero((grid.states == 0) & (grid.clearance_m >= grid.turning_radius_m))
    if len(rows) == 0:
        raise DataError("there is no place in this map where the cart can turn; see map.drive in docs/mapping.md")
    centres = np.stack([columns + 0.5, rows + 0.5], axis=1) * grid.resolution_m + grid.origin_m
    best = int(np.argmin(np.linalg.norm(centres - xy_m, axis=1)))
    return int(rows[best]), int(columns[best])


def shortest_path(grid: DriveGrid, start: tuple[int, int], goal: tuple[int, int]) -> Array | None:
    """Return the cells [N, 2] (row, column) of the cheapest way, None if there is none.

    A* (Hart, Nilsson, Raphael 1968) over eight neighbours; a metre costs more where there is little room.
    """
    passable = (grid.states == 0) & (grid.clearance_m >= grid.turning_radius_m)
    spare_m = np.clip(grid.clearance_m - grid.turning_radius_m, 0.0, _COMFORT_M)
    cost = 1.0 + _DETOUR * (1.0 - spare_m / _COMFORT_M)
    best = {start: 0.0}
    came: dict[tuple[int, int], tuple[int, int]] = {}
    queue = [(0.0, start)]
    done: set[tuple[int, int]] = set()
    while queue:
        _, here = heapq.heappop(queue)
        if here == goal:
            cells = [here]
            while cells[-1] != start:
                cells.append(came[cells[-1]])
            return np.array(cells[::-1], dtype=np.float64)
        if here in done:
            continue
        done.add(here)
        for dy, dx, length in _STEPS:
            there = here[0] + dy, here[1] + dx
            if not (0 <= there[0] < passable.shape[0] and 0 <= there[1] < passable.shape[1] and passable[there]):
                continue
            if not (passable[here[0], there[1]] and passable[there[0], here[1]]):
                continue  # no cutting of corners
            so_far = best[here] + length * 0.5 * (cost[here] + cost[there])
            if so_far < best.get(there, math.inf):
                best[there], came[there] = so_far, here
                heapq.heappush(queue, (so_far + math.dist(there, goal), there))
    return None


def straightened(grid: DriveGrid, path_m: Array) -> Array:
    """Return the path [N, 2] with as few corners as straight lines with room for the turning cart allow."""
    kept = [0]
    while kept[-1] < len(path_m) - 1:
        ahead = path_m[kept[-1] + 1 :]
        free = grid.line_clearance_m(path_m[kept[-1]], ahead) >= grid.turning_radius_m  # NaN is not
        straight = np.flatnonzero(free)
        kept.append(kept[-1] + 1 + (int(straight[-1]) if len(straight) else 0))
    return path_m[kept]


def plan(grid: DriveGrid, start_m: Array, goal_m: Array) -> Array:
    """Return the path [N, 2] in the map frame; raises DataError when there is none."""
    cells = shortest_path(grid, nearest_free(grid, start_m), nearest_free(grid, goal_m))
    if cells is None:
        raise DataError(f"no way leads from {start_m.tolist()} to {goal_m.tolist()} for this cart in this map")
    return straightened(grid, (cells[:, ::-1] + 0.5) * grid.resolution_m + grid.origin_m)


def main(arguments: list[str]) -> None:
    """Plan a path in a run's map, say how long it is, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--start", type=_place)
    parser.add_argument("--goal", type=_place)
    parser.add_argument("--out", type=Path, default=Path("plan.png"))
    options = parser.parse_args(arguments)
    occupancy = Octree.from_leaves(read_octree(options.run / "map" / "octomap.bt"))
    grid = DriveMap(MapConfig()).update(occupancy)
    way = read_trajectory(options.run / "trajectory_graph.tum").positions_m
    start = way[-1, :2] if options.start is None else options.start
    goal = way[0, :2] if options.goal is None else options.goal
    path = plan(grid, start, goal)
    length_m = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    room_m = float(np.min(grid.line_clearance_m(path[:-1], path[1:]), initial=np.inf))
    print(f"{length_m:.2f} m with {max(len(path) - 2, 0)} corners, nowhere nearer than {room_m:.2f} m to anything")
    lines = [Line(way, _WAY, 1.5, marks_ends=False), Line(np.column_stack([path, np.zeros(len(path))]), _PLAN, 3.0)]
    cv2.imwrite(str(options.out), render_drive(grid, lines)[..., ::-1])
    print(options.out)


def _place(text: str) -> Array:
    x, y = (float(part) for part in text.split(","))
    return np.array([x, y])


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except VislamError as error:
        sys.exit(f"plan_path: {error}")
