"""Which surfaces a tile of the image may show: a conservative sort of the scene before rays are cast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.sim.scene.scene import CYLINDER

TILE_PX = 16
NEAR_M = 0.02  # what is nearer than this is not seen


def tile_bounds(rays: Array) -> Array:
    """Return [rows, columns, 4]: x min, x max, y min, y max of the normalised rays of each tile, one pixel wider."""
    height, width = rays.shape[0] - 2, rays.shape[1] - 2
    bounds = np.empty((-(-height // TILE_PX), -(-width // TILE_PX), 4))
    for row in range(bounds.shape[0]):
        for column in range(bounds.shape[1]):
            part = rays[row * TILE_PX : (row + 1) * TILE_PX + 2, column * TILE_PX : (column + 1) * TILE_PX + 2]
            low, high = part.min(axis=(0, 1)), part.max(axis=(0, 1))
            bounds[row, column] = low[0], high[0], low[1], high[1]
    return bounds


@njit(cache=True, nogil=True)
def _outside(box: Array, bounds: Array, slack: float) -> bool:
    """Return whether a box (centre and half axes [4, 3], camera frame) misses a frustum of x/z and y/z bounds."""
    for side in range(4):
        axis = side // 2
        sign = 1.0 if side % 2 == 0 else -1.0
        bound = bounds[side]
        reach = sign * (box[0, axis] - bound * box[0, 2])
        for k in range(1, 4):
            reach += abs(box[k, axis] - bound * box[k, 2])
        if reach < -slack * (1.0 + abs(bound)):
            return True
    return False


@njit(cache=True, nogil=True)
def _to_camera(pose: Array, centre: Array, half: Array, box: Array) -> float:
    """Fill `box` [4, 3] with a bounding box in the camera frame; return the greatest distance of its points."""
    far = 0.0
    for i in range(3):
        box[0, i] = 0.0
        for j in range(3):
            box[0, i] += pose[j, i] * (centre[j] - pose[j, 3])
        far += abs(box[0, i])
        for k in range(3):
            box[k + 1, i] = pose[0, i] * half[k, 0] + pose[1, i] * half[k, 1] + pose[2, i] * half[k, 2]
            far += abs(box[k + 1, i])
    return far


@njit(cache=True, nogil=True)
def _sway(poses: Array, first: int, last: int) -> tuple[float, float]:
    """Return bounds of how far the camera turns (rad) and moves (m) from the stamp's pose in the middle of some rows.

    `poses` [1 + K, rows, 3, 4] are the stamp's and those of the exposure.
    """
    middle = poses[0, (first + last) // 2]
    angle, shift = 0.0, 0.0
    for k in range(poses.shape[0]):
        for row in (first, last):
            trace, square = 0.0, 0.0
            for i in range(3):
                square += (poses[k, row, i, 3] - middle[i, 3]) ** 2
                for j in range(3):
                    trace += poses[k, row, i, j] * middle[i, j]
            angle = max(angle, np.sqrt(max(0.0, 3.0 - trace)))  # 3 - trace = 2 - 2 cos(angle), about angle squared
            shift = max(shift, np.sqrt(square))
    return 1.5 * angle, 1.5 * shift


@njit(cache=True, nogil=True)
def _visible(
    poses: Array, bounds: Array, kind: NDArray[np.int64], geometry: Array, centre: Array, half: Array, nearest: Array
) -> NDArray[np.int64]:
    """Return the surfaces that may be in the image, nearest first; fills their least depth, infinite for the others."""
    last = poses.shape[1] - 1
    angle, shift = _sway(poses, 0, last)
    pose = poses[0, last // 2]
    box = np.empty((4, 3))
    nearest[:] = np.inf
    count = 0
    for p in range(kind.shape[0]):
        if kind[p] != CYLINDER:
            facing = 0.0
            for k in range(3):
                facing += geometry[p, 9 + k] * (pose[k, 3] - centre[p, k])
            if facing < -shift:
                continue
        slack = shift + angle * _to_camera(pose, centre[p], half[p], box)
        depth_radius = abs(box[1, 2]) + abs(box[2, 2]) + abs(box[3, 2]) + slack
        if box[0, 2] + depth_radius > NEAR_M and not _outside(box, bounds, slack):
            nearest[p] = box[0, 2] - depth_radius
            count += 1
    return np.argsort(nearest)[:count]


@njit(cache=True, nogil=True)
def fill_tiles(
    tiles: Array, poses: Array, kind: NDArray[np.int64], geometry: Array, centre: Array, half: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    """Return the visible surfaces; per tile its candidates, nearest first, and their number; each one's least depth.

    Conservative: poses [1 + K, 1 or H, 3, 4] are the stamp's and those of the exposure, of the image or of each row;
    each row of tiles uses the stamp's pose in its middle and a slack for how far its rows move and all of them sway.
    """
    last_row, rows, columns = poses.shape[1] - 1, tiles.shape[0], tiles.shape[1]
    bounds = np.array([tiles[:, :, 0].min(), tiles[:, :, 1].max(), tiles[:, :, 2].min(), tiles[:, :, 3].max()])
    nearest = np.empty(kind.shape[0])
    visible = _visible(poses, bounds, kind, geometry, centre, half, nearest)
    lists = np.empty((rows, columns, max(len(visible), 1)), dtype=np.int64)
    counts = np.zeros((rows, columns), dtype=np.int64)
    box = np.empty((4, 3))
    for row in range(rows):
        first, last = min(last_row, row * TILE_PX), min(last_row, (row + 1) * TILE_PX - 1)
        angle, shift = _sway(poses, first, last)
        bounds[0], bounds[1] = tiles[row, :, 0].min(), tiles[row, :, 1].max()
        bounds[2], bounds[3] = tiles[row, :, 2].min(), tiles[row, :, 3].max()
        for p in visible:
            slack = shift + angle * _to_camera(poses[0, (first + last) // 2], centre[p], half[p], box)
            if _outside(box, bounds, slack):
                continue
            for column in range(columns):
                if not _outside(box, tiles[row, column], slack):
                    lists[row, column, counts[row, column]] = p
                    counts[row, column] += 1
    return visible, lists, counts, nearest
