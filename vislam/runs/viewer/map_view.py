"""The map as Rerun shows it: occupied voxels coloured by height, and the navigation grid at the floor.

Both are sparse voxels of 16 bytes each, in a bounded number: larger maps are shown coarser.
"""

from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from vislam.core.messages import Array

_OCCUPIED, _FREE = 0x20242CFF, 0x9AD4ADFF  # RGBA
_GRID_THICKNESS_M = 0.01


def octree_voxels(voxels: NDArray[np.int64], resolution_m: float, up: Array, most: int) -> Any:
    """Return voxels [N, 3], 0 at the map's origin, as at most `most` (of 2, 4, ... times the size), by height."""
    edge_m = resolution_m
    while len(voxels) > most:
        voxels, edge_m = np.unique(voxels >> 1, axis=0), 2.0 * edge_m
    heights = ((voxels + 0.5) * edge_m @ up).astype(np.float32)
    low, high = np.percentile(heights, [1.0, 99.0]) if len(heights) else (0.0, 1.0)
    return rr.VoxelGridMap(
        voxels.astype(np.int32),
        [edge_m] * 3,
        values=heights,
        value_range=[low, max(high, low + edge_m)],
        colormap=rr.components.Colormap.Turbo,
    )


def grid_cells(
    cells: NDArray[np.int8], resolution_m: float, origin_m: tuple[float, float], floor_m: float, most: int
) -> Any:
    """Return the known cells of a grid, row 0 at the lowest y, at most `most`: a coarser one is the worst of four."""
    edge_m = resolution_m
    while np.count_nonzero(cells >= 0) > most:
        rows, columns = cells.shape
        even = np.pad(cells, ((0, rows % 2), (0, columns % 2)), constant_values=-1)
        cells = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).max(axis=(1, 3))
        edge_m *= 2.0
    rows, columns = np.nonzero(cells >= 0)
    return rr.VoxelGridMap(
        np.column_stack([columns, rows, np.zeros_like(rows)]).astype(np.int32),
        [edge_m, edge_m, _GRID_THICKNESS_M],
        colors=np.where(cells[rows, columns] > 0, _OCCUPIED, _FREE).astype(np.uint32),
        translation=[*origin_m, floor_m],
    )
