"""Where a cart can drive: ground, steps, slopes, head room and the cart's own size, from the columns of the octree.

A column may hold several surfaces: ground below a table, its top, a reflection below the floor. Which of them is the
ground is found by growing from the floor over steps that the cart can take and under nothing that it would touch, as in
multi-level surface maps (Triebel, Pfaff, Burgard, "Multi-level surface maps for outdoor terrain mapping and loop
closing", IROS 2006). So a ramp is followed, and a table top is an obstacle and no ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.drive.grid import Grid
from vislam.mapping.octree import NEVER, Columns, ColumnStore, Octree

F32 = NDArray[np.float32]
_I16 = NDArray[np.int16]
_I8 = NDArray[np.int8]

_LARGE_SHARE = 0.5  # of the largest level of surfaces: from there on one may be the floor
_MIN_PLANE_CELLS = 6
_FARTHEST_CELLS = 500  # clearance is not asked beyond
_TOLERANCE = 1e-6  # voxels; so that a limit of exactly n voxels is n voxels


class Drive(IntEnum):
    """What a cell is to a cart: free, unknown, or blocked by one of the others."""

    UNKNOWN = -1  # no ground was seen
    FREE = 0
    OBSTACLE = 1  # something that the body would touch
    LOW = 2  # ground without head room
    DROP = 3  # a hole, or the edge above one
    STEEP = 4


@dataclass(frozen=True, slots=True, eq=False)
class DriveGrid:
    """Cells of a horizontal plane and what they are to a cart; row 0 is at the lowest y, frames are the map's."""

    states: _I8  # [rows, columns] `Drive`
    ground_m: F32  # [rows, columns] height of the ground, NaN where none was seen or none can be reached
    slope_rad: F32  # [rows, columns] NaN where there is too little ground around
    clearance_m: F32  # [rows, columns] from the cell's middle to the nearest blocked one; 500 cells at most
    resolution_m: float
    origin_m: tuple[float, float]  # x, y of the lower-left corner
    floor_m: float  # height of the floor that the ground was grown from
    body_m: tuple[float, float]  # length and width of the cart

    @property
    def turning_radius_m(self) -> float:
        """Radius of the circle that the body needs to turn on the spot."""
        return 0.5 * float(np.hypot(*self.body_m))

    def cells_at(self, xy_m: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return row and column [N] of points [N, 2]; -1 where they lie beyond the grid or are not finite."""
        points = np.asarray(xy_m, dtype=np.float64).reshape(-1, 2)
        scaled = np.floor((points - self.origin_m) / self.resolution_m)
        inside = np.all((scaled >= 0.0) & (scaled < self.states.shape[::-1]), axis=1)  # NaN is neither
        cells = np.where(inside[:, None], np.nan_to_num(scaled), -1).astype(np.int64)
        return cells[:, 1], cells[:, 0]

    def state_at(self, xy_m: NDArray[np.floating]) -> _I8:
        """Return the `Drive` [N] of the cells at points [N, 2]; UNKNOWN beyond the grid."""
        rows, columns = self.cells_at(xy_m)
        return np.where(rows >= 0, self.states[rows, columns], np.int8(Drive.UNKNOWN))

    def is_traversable(
        self, xy_m: NDArray[np.floating], yaw_rad: NDArray[np.floating] | float | None = None
    ) -> NDArray[np.bool_]:
        """Return where [N] the cart can stand, of places [N, 2]: on free ground, its body touching nothing.

        With headings [N] or one for all, the body is its rectangle at that heading; without, the circle in which it
        can turn to any. Unknown cells below the body's rim do not matter, one below its middle does.
        """
        points = np.asarray(xy_m, dtype=np.float64).reshape(-1, 2)
        rows, columns = self.cells_at(points)
        free = (rows >= 0) & (self.states[rows, columns] == Drive.FREE)
        clearance = self.clearance_m[rows, columns]
        if yaw_rad is None:
            return np.asarray(free & (clearance >= self.turning_radius_m))
        yaws = np.broadcast_to(np.asarray(yaw_rad, dtype=np.float64), len(points))
        free &= np.isfinite(yaws) & (clearance >= 0.5 * min(self.body_m))  # cheap, and leaves few to look at
        near = np.flatnonzero(free & (clearance < self.turning_radius_m + self.resolution_m))
        cells = (points[near] - self.origin_m) / self.resolution_m
        half = 0.5 * np.array(self.body_m) / self.resolution_m
        free[near] = ~_body_touches(self.states, cells, yaws[near], half)
        return np.asarray(free)

    def line_clearance_m(self, from_xy_m: NDArray[np.floating], to_xy_m: NDArray[np.floating]) -> F32:
        """Return the smallest clearance [N] along straight lines between points [N, 2] and [N, 2] or one of them [2].

        0 where a line meets something the cart cannot drive on, NaN where it does not but leaves what is known.
        """
        start, end = np.broadcast_arrays(
            np.asarray(from_xy_m, dtype=np.float64).reshape(-1, 2), np.asarray(to_xy_m, dtype=np.float64).reshape(-1, 2)
        )
        start, end = (start - self.origin_m) / self.resolution_m, (end - self.origin_m) / self.resolution_m
        return np.asarray(_clearance_along(self.states, self.clearance_m, start, end))

    def navigation_grid(self) -> Grid:
        """Return it as an occupancy grid for nav2: occupied is what cannot be driven on, the body's size left aside."""
        cells = np.where(self.states > 0, np.int8(1), self.states).astype(np.int8)
        return Grid(cells, self.resolution_m, self.origin_m, self.floor_m)


class DriveMap:
    """The drive grid of an occupancy map that changes."""

    def __init__(self, config: MapConfig) -> None:
        self._config = config
        self._store = ColumnStore()
        self._slopes = _Slopes()

    def update(self, occupancy: Octree) -> DriveGrid:
        """Return the grid of the map as it is now; only columns that changed since the last call are read again.

        Raises DataError when the map's extent is larger than any to drive by.
        """
        self._store.update(occupancy)
        return drive_grid(self._store.columns(), occupancy.resolution_m, self._config, self._slopes)


class _Slopes:
    """Slopes of ground that changes; planes are fitted again where the ground within their reach is other than before.

    The result does not depend on what was before.
    """

    def __init__(self) -> None:
        self._ground: _I16 = np.zeros((0, 0), np.int16)
        self._slope: F32 = np.zeros((0, 0), np.float32)
        self._of = (0, 0, 0, 0)  # corner, reach and step

    def update(self, ground: _I16, corner: tuple[int, int], reach: int, step: int) -> F32:
        """Return the tangents of the slopes [rows, columns], as `_fit_slopes` does."""
        before = np.full(ground.shape, NEVER, np.int16)
        slope = np.full(ground.shape, np.nan, np.float32)
        rows, columns = self._ground.shape
        x, y = self._of[0] - corner[0], self._of[1] - corner[1]  # of the old grid in the new one
        covers = min(x, y) >= 0 and y + rows <= ground.shape[0] and x + columns <= ground.shape[1]
        if covers and self._of[2:] == (reach, step):
            before[y : y + rows, x : x + columns] = self._ground
            slope[y : y + rows, x : x + columns] = self._slope
        changed = (ground != before).astype(np.uint8)
        near = cv2.dilate(changed, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        _fit_slopes(ground, reach, step, near, slope)
        self._ground, self._slope, self._of = ground, slope, (*corner, reach, step)
        return slope


def drive_grid(columns: Columns, resolution_m: float, config: MapConfig, slopes: _Slopes | None = None) -> DriveGrid:
    """Return the drive grid of columns; `slopes` of an earlier one save work and change nothing."""
    drive = config.drive
    step = max(1, int(np.floor(drive.max_step_m / resolution_m + _TOLERANCE)))
    head = max(1, int(np.ceil(config.grid_high_m / resolution_m - _TOLERANCE)))
    floor = _floor_voxel(columns, head)
    if config.grid_floor_m is not None:
        floor = int(np.floor(config.grid_floor_m / resolution_m - 0.5))  # the voxel whose top is nearest
    ground, around = _grow(columns.runs, columns.counts, floor, step, head)
    states = _classify(columns.runs, columns.counts, columns.lowest_free, ground, around, step, head)
    reach = max(1, round(0.5 * drive.slope_window_m / resolution_m))
    steepest = float(np.tan(np.deg2rad(drive.max_slope_deg)))
    slope = (_Slopes() if slopes is None else slopes).update(ground, columns.corner, reach, step)
    states[(states == Drive.FREE) & (slope > steepest)] = Drive.STEEP
    height_m = np.where(ground == NEVER, np.nan, (ground.astype(np.float64) + 1.0) * resolution_m)  # a voxel's top
    return DriveGrid(
        states,
        height_m.astype(np.float32),
        np.arctan(slope),
        distance_cells(states > 0) * np.float32(resolution_m),
        resolution_m,
        (columns.corner[0] * resolution_m, columns.corner[1] * resolution_m),
        (floor + 1) * resolution_m,
        (drive.body_length_m, drive.body_width_m),
    )


def _floor_voxel(columns: Columns, head: int) -> int:
    """Return the lowest level at which many columns have a surface with head room: the floor's voxel."""
    tops = columns.runs[..., 1].astype(np.int64)
    number = np.arange(tops.shape[2])
    above = np.concatenate([columns.runs[:, :, 1:, 0], np.zeros((*tops.shape[:2], 1), np.int16)], axis=2)
    open_ = (number < columns.counts[..., None]) & (
        (number == columns.counts[..., None] - 1) | (above - tops - 1 >= head)
    )
    if not open_.any():
        return -1
    lowest = int(tops[open_].min())
    counts = np.asarray(np.bincount(tops[open_] - lowest))
    return lowest + int(np.flatnonzero(counts >= _LARGE_SHARE * counts.max())[0])


@njit(cache=True, nogil=True, inline="always")
def _matching_run(place: _I16, count: int, level: int, step: int, head: int) -> int:
    """Return the run whose top is nearest to a level, no farther than a step and with head room; -1 for none."""
    best, best_gap = -1, step + 1
    for k in range(count):
        gap = abs(place[k, 1] - level)
        if gap < best_gap and (k == count - 1 or place[k + 1, 0] - place[k, 1] - 1 >= head):
            best, best_gap = k, gap
    return best


@njit(cache=True, nogil=True)
def _grow(runs: _I16, counts: _I16, floor: int, step: int, head: int) -> tuple[_I16, _I16]:
    """Return the ground [rows, columns] that is reached from the floor, and the level that cells around it expect.

    Ground comes first; only when no more of it is reached, its level is carried on across what is not ground, where
    more of it may begin.
    """
    rows, columns = counts.shape
    ground, around = np.full((rows, columns), NEVER, np.int16), np.full((rows, columns), NEVER, np.int16)
    queue, waiting = np.empty(rows * columns, np.int64), np.empty(rows * columns, np.int64)
    first, last, next_waiting, last_waiting = 0, 0, 0, 0
    for cell in range(rows * columns):
        y, x = cell // columns, cell % columns
        run = _matching_run(runs[y, x], counts[y, x], floor, step, head)
        if run >= 0:
            ground[y, x] = around[y, x] = runs[y, x, run, 1]
            queue[last] = cell
            last += 1
    while first < last or next_waiting < last_waiting:
        if first < last:
            cell = queue[first]
            first += 1
        else:
            cell = waiting[next_waiting]
            next_waiting += 1
        y, x = cell // columns, cell % columns
        for side in range(4):
            v, u = y + (side == 0) - (side == 1), x + (side == 2) - (side == 3)
            if not (0 <= v < rows and 0 <= u < columns) or ground[v, u] != NEVER:
                continue
            run = _matching_run(runs[v, u], counts[v, u], around[y, x], step, head)
            if run >= 0:
                ground[v, u] = around[v, u] = runs[v, u, run, 1]
                queue[last] = v * columns + u
                last += 1
            elif around[v, u] == NEVER:
                around[v, u] = around[y, x]
                waiting[last_waiting] = v * columns + u
                last_waiting += 1
    return ground, around


@njit(cache=True, nogil=True)
def _classify(runs: _I16, counts: _I16, lowest_free: _I16, ground: _I16, around: _I16, step: int,
              head: int) -> _I8:  # fmt: skip
    rows, columns = counts.shape
    out = np.full((rows, columns), -1, np.int8)
    for y in range(rows):
        for x in range(columns):
            if ground[y, x] != NEVER:
                out[y, x] = 0
                for side in range(4):
                    v, u = y + (side == 0) - (side == 1), x + (side == 2) - (side == 3)
                    beside = ground[v, u] if 0 <= v < rows and 0 <= u < columns else NEVER
                    if beside != NEVER and ground[y, x] - beside > step:
                        out[y, x] = 3
                continue
            if around[y, x] == NEVER:
                continue
            level = int(around[y, x])
            low, touched, below = False, False, lowest_free[y, x] < level - step
            for k in range(counts[y, x]):
                bottom, top = runs[y, x, k, 0], runs[y, x, k, 1]
                low |= abs(top - level) <= step
                touched |= top > level + step and bottom <= level + head
                below |= top < level - step
            if low:
                out[y, x] = 2
            elif touched:
                out[y, x] = 1
            elif below:
                out[y, x] = 3
    return out


@njit(cache=True, nogil=True)
def _fit_slopes(ground: _I16, reach: int, step: int, wanted: NDArray[np.bool_], out: F32) -> None:
    """Set the tangent of the slope of the plane that fits the ground around each wanted cell best; NaN without ground.

    Ground that can only be reached over a larger step, or around by leaving the window, belongs to another plane.
    """
    rows, columns = ground.shape
    size = 2 * reach + 1
    seen, stack = np.zeros(size * size, np.int64), np.empty(size * size, np.int64)
    for cell in range(rows * columns):
        y, x = cell // columns, cell % columns
        if not wanted[y, x]:
            continue
        out[y, x] = np.nan
        if ground[y, x] == NEVER:
            continue
        n = sx = sy = sz = sxx = sxy = syy = sxz = syz = 0.0
        stack[0], waiting = reach * size + reach, 1
        seen[stack[0]] = cell + 1
        while waiting > 0:
            waiting -= 1
            place = stack[waiting]
            j, i = place // size - reach, place % size - reach
            level = ground[y + j, x + i]
            dx, dy, dz = float(i), float(j), float(level - ground[y, x])
            n, sx, sy, sz = n + 1.0, sx + dx, sy + dy, sz + dz
            sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
            sxz, syz = sxz + dx * dz, syz + dy * dz
            for side in range(4):
                v, u = j + (side == 0) - (side == 1), i + (side == 2) - (side == 3)
                if max(abs(v), abs(u)) > reach or not (0 <= y + v < rows and 0 <= x + u < columns):
                    continue
                beside, number = ground[y + v, x + u], (v + reach) * size + u + reach
                if beside != NEVER and seen[number] != cell + 1 and abs(beside - level) <= step:
                    seen[number], stack[waiting] = cell + 1, number
                    waiting += 1
        a, b, c = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
        p, q = sxz - sx * sz / n, syz - sy * sz / n
        determinant = a * c - b * b
        if n >= _MIN_PLANE_CELLS and determinant > 1e-6 * n * n:
            out[y, x] = np.hypot((c * p - b * q) / determinant, (a * q - b * p) / determinant)


def distance_cells(blocked: NDArray[np.bool_]) -> F32:
    """Return the distance [rows, columns] from each cell's middle to the nearest blocked square, in cells.

    A square's nearest point to a middle is a corner of it or the middle of a side: exact on a grid twice as fine.
    """
    rows, columns = blocked.shape
    fine = np.zeros((2 * rows + 1, 2 * columns + 1), np.bool_)
    for dy in range(3):
        for dx in range(3):
            fine[dy : dy + 2 * rows : 2, dx : dx + 2 * columns : 2] |= blocked
    image = (~fine).astype(np.uint8)
    distance = cv2.distanceTransform(image, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1::2, 1::2]
    # squares are whole numbers; what is left of rounding would depend on how OpenCV splits its work
    squared = np.rint(np.minimum(distance.astype(np.float64), 2.0 * _FARTHEST_CELLS) ** 2)
    return (0.5 * np.sqrt(squared)).astype(np.float32)


@njit(cache=True, nogil=True)
def _body_touches(states: _I8, cells: Array, yaws: Array, half: Array) -> NDArray[np.bool_]:
    """Return which bodies [N], rectangles at places and headings, overlap a blocked cell; all lengths in cells."""
    out = np.zeros(len(cells), np.bool_)
    for i in range(len(cells)):
        c, s = np.cos(yaws[i]), np.sin(yaws[i])
        ex, ey = abs(c) * half[0] + abs(s) * half[1], abs(s) * half[0] + abs(c) * half[1]
        spread = 0.5 * (abs(c) + abs(s))  # of a cell along the body's axes
        bottom, top = max(int(np.floor(cells[i, 1] - ey)), 0), min(int(cells[i, 1] + ey), states.shape[0] - 1)
        left, right = max(int(np.floor(cells[i, 0] - ex)), 0), min(int(cells[i, 0] + ex), states.shape[1] - 1)
        for v in range(bottom, top + 1):
            for u in range(left, right + 1):
                if states[v, u] <= 0:
                    continue
                dx, dy = u + 0.5 - cells[i, 0], v + 0.5 - cells[i, 1]
                along, across = abs(c * dx + s * dy), abs(c * dy - s * dx)
                # separating axes: of the grid by the loop's bounds, of the body here
                if along < half[0] + spread and across < half[1] + spread:
                    out[i] = True
    return out


@njit(cache=True, nogil=True)
def _clearance_along(states: _I8, clearance: F32, start: Array, end: Array) -> F32:
    """Return the smallest clearance in the cells of lines; coordinates in cells."""
    out = np.empty(len(start), np.float32)
    for i in range(len(start)):
        dx, dy = end[i, 0] - start[i, 0], end[i, 1] - start[i, 1]
        length = np.hypot(dx, dy)
        smallest, known = np.float32(np.inf), length < np.inf
        steps = int(np.ceil(4.0 * length)) + 1 if known and length < 1e6 else 0
        known &= steps > 0
        for k in range(steps):
            share = k / max(steps - 1, 1)
            u, v = int(np.floor(start[i, 0] + share * dx)), int(np.floor(start[i, 1] + share * dy))
            if not (0 <= v < states.shape[0] and 0 <= u < states.shape[1]):
                known = False
                continue
            known &= states[v, u] != -1
            smallest = min(smallest, clearance[v, u])
        out[i] = smallest if known or smallest == 0.0 else np.nan
    return out
