"""A route for the cart over the drive grid: A* (Hart, Nilsson, Raphael 1968), its needless corners taken away.

Ground that was not seen yet may be asked for: it is taken for passable, only dear, so that a route leads there when no
other does. The route has to be looked at again when the map has grown.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.drive.drive_grid import Drive, DriveGrid, distance_cells

_I64 = NDArray[np.int64]

MARGIN_M = 0.06  # beyond the circle in which the cart turns: poses and pursuit are not exact
_COMFORT_M = 0.25  # of room beyond that is worth a detour ...
_DETOUR = 1.0  # ... of this times the way without it
_UNSEEN = 2.0  # ways more that one over ground not seen yet may be longer
_ENDS_M = 0.6  # around both ends the room there is enough: the cart stands there, or is to
_BEYOND_M = 3.0  # around what is known and the ends, for ways that were not seen
_HOLE_CELLS = 2  # unseen cells across within seen ones: rays miss some


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A way through the map."""

    corners_m: Array  # [N, 2] of a line in the map frame; first and last are the ends

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.linalg.norm(np.diff(self.corners_m, axis=0), axis=1).sum())


def ground(grid: DriveGrid, ends_m: Array, stood_m: Array) -> DriveGrid:
    """Return a grid that holds places [N, 2] and room around them, without small holes.

    Cells not seen within circles [M, 3] (x, y, radius) where the cart stood are free: it was there, or was put there.
    """
    size, cell_m = np.array(grid.states.shape[::-1]), grid.resolution_m
    points = np.vstack([np.asarray(ends_m).reshape(-1, 2), grid.origin_m])
    low = np.floor((points.min(axis=0) - _BEYOND_M - grid.origin_m) / cell_m).astype(int)
    high = np.ceil((points.max(axis=0) + _BEYOND_M - grid.origin_m) / cell_m).astype(int)
    left, below = np.maximum(-low, 0).tolist()
    right, above = np.maximum(high - size, int(_BEYOND_M / cell_m)).tolist()
    widths = ((below, above), (left, right))
    states = np.pad(grid.states, widths, constant_values=np.int8(Drive.UNKNOWN))
    kernel = np.ones((_HOLE_CELLS + 1, _HOLE_CELLS + 1), np.uint8)
    seen = cv2.morphologyEx((states == Drive.FREE).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    origin_m = grid.origin_m[0] - left * cell_m, grid.origin_m[1] - below * cell_m
    for x, y, radius_m in np.asarray(stood_m).reshape(-1, 3):
        seen |= _away(states.shape, (y - origin_m[1]) / cell_m, (x - origin_m[0]) / cell_m) <= radius_m / cell_m
    states[(states == Drive.UNKNOWN) & seen] = Drive.FREE
    clearance_m = distance_cells(states > 0) * np.float32(grid.resolution_m)
    return replace(
        grid, states=states, clearance_m=clearance_m, origin_m=origin_m,
        ground_m=np.pad(grid.ground_m, widths, constant_values=np.nan),
        slope_rad=np.pad(grid.slope_rad, widths, constant_values=np.nan),
    )  # fmt: skip


def plan(grid: DriveGrid, start_m: Array, goal_m: Array, explores: bool = False) -> Route | str:
    """Return the cheapest route between two places [2] in the map frame, or why there is none.

    It keeps clear of everything by the circle in which the cart can turn. At the goal that circle has to be free; at
    the start the cart may stand nearer to something. `explores`: over ground that was not seen, too.
    """
    (row, column), (goal_row, goal_column) = (grid.cells_at(np.asarray(p)) for p in (start_m, goal_m))
    start, goal = (int(row[0]), int(column[0])), (int(goal_row[0]), int(goal_column[0]))
    if start[0] < 0 or goal[0] < 0:
        return f"{'the cart is' if start[0] < 0 else 'the goal lies'} beyond the map"
    if grid.states[goal] > 0 or grid.clearance_m[goal] < grid.turning_radius_m:
        return (
            f"something is {float(grid.clearance_m[goal]):.2f} m from the goal, and the cart needs "
            f"{grid.turning_radius_m:.2f} m to turn there"
        )
    if grid.states[goal] == Drive.UNKNOWN and not explores:
        return "the goal lies on ground that was not seen"
    cost = _costs(grid, start, goal, explores)
    if not np.isfinite(cost[start]):
        start = _nearest(cost, start, _ENDS_M / grid.resolution_m)
        if start[0] < 0:
            return "the cart stands too near to something to turn away from it"
    cells, so_far = _search(cost, start[0] * cost.shape[1] + start[1], goal[0] * cost.shape[1] + goal[1])
    if len(cells) == 0:
        return "no way leads there that is wide enough for the cart" + ("" if explores else " and was seen")
    places = np.stack([cells % cost.shape[1], cells // cost.shape[1]], axis=1) + 0.5
    kept = places[_straightened(cost, places, so_far)] * grid.resolution_m + grid.origin_m
    kept[0], kept[-1] = start_m, goal_m
    return Route(kept)


def _costs(grid: DriveGrid, start: tuple[int, int], goal: tuple[int, int], explores: bool) -> Array:
    """Return what crossing each cell costs [rows, columns], in cells; infinite where the cart cannot be."""
    needed_m = np.full(grid.states.shape, grid.turning_radius_m + MARGIN_M, np.float32)
    least_m = 0.5 * min(grid.body_m)
    for row, column in (start, goal):
        near = _away(grid.states.shape, row + 0.5, column + 0.5) * grid.resolution_m <= _ENDS_M
        enough_m = max(float(grid.clearance_m[row, column]), least_m)
        needed_m[near] = np.minimum(needed_m[near], enough_m)
    spare_m = np.clip(grid.clearance_m - grid.turning_radius_m - MARGIN_M, 0.0, _COMFORT_M)
    cost = 1.0 + _DETOUR * (1.0 - spare_m.astype(np.float64) / _COMFORT_M)
    cost[grid.states == Drive.UNKNOWN] += _UNSEEN if explores else math.inf
    cost[(grid.states > 0) | (grid.clearance_m < needed_m)] = math.inf
    return cost


def _away(shape: tuple[int, ...], row: float, column: float) -> Array:
    """Return how far the middles of cells [rows, columns] are from a place, in cells."""
    rows, columns = np.arange(shape[0])[:, None] + 0.5, np.arange(shape[1])[None] + 0.5
    return np.asarray(np.hypot(rows - row, columns - column))


def _nearest(cost: Array, cell: tuple[int, int], reach: float) -> tuple[int, int]:
    """Return the passable cell nearest to one, -1, -1 where there is none within `reach` cells."""
    rows, columns = np.nonzero(np.isfinite(cost))
    away = np.hypot(rows - cell[0], columns - cell[1])
    if len(rows) == 0 or away.min() > reach:
        return -1, -1
    best = int(away.argmin())
    return int(rows[best]), int(columns[best])


@njit(cache=True, nogil=True)
def _search(cost: Array, start: int, goal: int) -> tuple[_I64, Array]:
    """Return the cells [N] of the cheapest way between two and the cost up to each [N]; none where there is no way."""
    rows, columns = cost.shape
    best, came = np.full(rows * columns, np.inf), np.full(rows * columns, -1)
    done = np.zeros(rows * columns, np.bool_)
    goal_y, goal_x = goal // columns, goal % columns
    best[start] = 0.0
    queue = [(0.0, start)]
    while len(queue) > 0:
        here = heapq.heappop(queue)[1]
        if here == goal:
            break
        if done[here]:
            continue
        done[here] = True
        y, x = here // columns, here % columns
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                v, u = y + dy, x + dx
                if (dy == 0 and dx == 0) or not (0 <= v < rows and 0 <= u < columns):
                    continue
                # no cutting of corners: of a slanted step both cells beside it are passable, too
                if not (cost[v, u] < np.inf and cost[y, u] < np.inf and cost[v, x] < np.inf):
                    continue
                so_far = best[here] + np.hypot(dy, dx) * 0.5 * (cost[y, x] + cost[v, u])
                there = v * columns + u
                if so_far < best[there]:
                    best[there], came[there] = so_far, here
                    heapq.heappush(queue, (so_far + np.hypot(v - goal_y, u - goal_x), there))
    count, here = 0, goal if best[goal] < np.inf else -1
    while here >= 0:
        count, here = count + 1, came[here]
    cells = np.empty(count, np.int64)
    here = goal
    for k in range(count - 1, -1, -1):
        cells[k] = here
        here = came[here]
    return cells, best[cells]


@njit(cache=True, nogil=True)
def _straightened(cost: Array, places: Array, so_far: Array) -> _I64:
    """Return which of the places [N, 2] (column, row) stay corners: straight lines between them cost no more."""
    kept = np.empty(len(places), np.int64)
    kept[0], count = 0, 1
    while kept[count - 1] < len(places) - 1:
        here = kept[count - 1]
        best = here + 1
        for there in range(here + 2, len(places)):
            dx, dy = places[there, 0] - places[here, 0], places[there, 1] - places[here, 1]
            length = np.hypot(dx, dy)
            steps = int(np.ceil(4.0 * length))
            total = 0.0
            for k in range(steps + 1):
                share = k / steps
                value = cost[int(places[here, 1] + share * dy), int(places[here, 0] + share * dx)]
                total += value * (0.5 if k in (0, steps) else 1.0)
                if not total < np.inf:
                    break
            if total / steps * length <= so_far[there] - so_far[here] + 1e-6:
                best = there
        kept[count], count = best, count + 1
    return kept[:count]
