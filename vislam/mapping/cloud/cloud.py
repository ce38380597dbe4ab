"""Coloured clouds: keyframes fused into one averaged point per voxel, without outliers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.jit import njit
from vislam.mapping.octree import find_slot

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]

_KEY_BITS = 21
_KEY_HALF = 1 << (_KEY_BITS - 1)
_COLUMNS = 8  # weighted sums of position and colour, sum of weights, number of points
_FAINT_SHARE = 0.15  # of the usual weight of a voxel in its cell; what has less is the blur around a surface
_NEIGHBOURS = 12  # of a point, whose mean distance shows whether it is alone
_AT_ONCE = 1 << 16  # points that are averaged at a time, which bounds memory
_COARSER = 1.5  # a cloud that gets too large gets voxels larger by this


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points with colours."""

    points_m: Points  # [N, 3]
    colors: Colors  # [N, 3] RGB

    def __len__(self) -> int:
        return len(self.points_m)

    def select(self, chosen: NDArray[np.bool_]) -> Cloud:
        """Return the points where `chosen` [N] is true."""
        return Cloud(self.points_m[chosen], self.colors[chosen])


class _Voxels(NamedTuple):
    """A hash table of voxels and what is summed up in each."""

    table: NDArray[np.int64]
    rows: NDArray[np.int32]  # of a slot's voxel in what follows
    keys: NDArray[np.int64]
    sums: NDArray[np.float64]  # [N, 8]


@njit(cache=True, nogil=True)
def _rehash(table: NDArray[np.int64], rows: NDArray[np.int32], keys: NDArray[np.int64], count: int) -> None:
    for row in range(count):
        slot = find_slot(table, keys[row])
        table[slot], rows[slot] = keys[row], row


@njit(cache=True, nogil=True)
def voxel_key(x: float, y: float, z: float, voxel_m: float) -> int:
    """Return the packed key of a point's voxel, or -1 when it is not finite or absurdly far."""
    a, b, c = np.floor(x / voxel_m), np.floor(y / voxel_m), np.floor(z / voxel_m)
    if not (abs(a) < _KEY_HALF and abs(b) < _KEY_HALF and abs(c) < _KEY_HALF):
        return -1
    return ((int(a) + _KEY_HALF) << _KEY_BITS | (int(b) + _KEY_HALF)) << _KEY_BITS | (int(c) + _KEY_HALF)


@njit(cache=True, nogil=True)
def _accumulate(
    points: Points, colors: Colors, weights: NDArray[np.float32], voxel_m: float, voxels: _Voxels, count: int
) -> int:
    table, rows, keys, sums = voxels
    for i in range(len(points)):
        key = voxel_key(np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2]), voxel_m)
        if key < 0:
            continue
        slot = find_slot(table, key)
        if table[slot] < 0:
            table[slot], rows[slot], keys[count] = key, count, key
            sums[count, :] = 0.0
            count += 1
        row = sums[rows[slot]]
        row[6] += weights[i]
        row[7] += 1.0
        for axis in range(3):
            row[axis] += weights[i] * points[i, axis]
            row[3 + axis] += weights[i] * colors[i, axis]
    return count


@njit(cache=True, nogil=True)
def _coarsen(old: NDArray[np.float64], voxel_m: float, table: NDArray[np.int64], rows: NDArray[np.int32],
             keys: NDArray[np.int64], sums: NDArray[np.float64]) -> int:  # fmt: skip
    count = 0
    for i in range(len(old)):
        weight = old[i, 6]
        key = voxel_key(old[i, 0] / weight, old[i, 1] / weight, old[i, 2] / weight, voxel_m)
        slot = find_slot(table, key)
        if table[slot] < 0:
            table[slot], rows[slot], keys[count] = key, count, key
            sums[count, :] = 0.0
            count += 1
        sums[rows[slot]] += old[i]
    return count


class VoxelAverage:
    """Averages position and colour of the points in each voxel, over any number of clouds, in bounded memory.

    When more than `max_points` voxels are in use, they are merged into larger ones.
    """

    def __init__(self, voxel_m: float, max_points: int = 1 << 22) -> None:
        self.voxel_m = voxel_m
        self._max_points = max_points
        self._count = 0
        self._keys = np.empty(1 << 12, np.int64)
        self._sums = np.empty((1 << 12, _COLUMNS), np.float64)
        self._table = np.full(1 << 14, -1, np.int64)
        self._rows = np.zeros(1 << 14, np.int32)

    def add(self, cloud: Cloud, weights: NDArray[np.float32] | None = None) -> None:
        """Add a cloud with positive weights [N] (all 1 unless given); points that are not finite are left out."""
        self._reserve(len(cloud))
        weights = np.ones(len(cloud), np.float32) if weights is None else weights
        self._count = _accumulate(
            cloud.points_m,
            cloud.colors,
            weights,
            self.voxel_m,
            _Voxels(self._table, self._rows, self._keys, self._sums),
            self._count,
        )
        while self._count > self._max_points:
            old = self._sums[: self._count].copy()
            self.voxel_m *= _COARSER
            self._table[:] = -1
            self._count = _coarsen(old, self.voxel_m, self._table, self._rows, self._keys, self._sums)

    def _reserve(self, extra: int) -> None:
        need = self._count + extra
        if need > len(self._keys):
            grown = max(need, 2 * len(self._keys))
            keys, sums = np.empty(grown, np.int64), np.empty((grown, _COLUMNS))  # memory that none uses is not there
            keys[: self._count], sums[: self._count] = self._keys[: self._count], self._sums[: self._count]
            self._keys, self._sums = keys, sums
        if 2 * need > len(self._table):
            size = 1 << int(np.ceil(np.log2(2 * need)))
            self._table, self._rows = np.full(size, -1, np.int64), np.zeros(size, np.int32)
            _rehash(self._table, self._rows, self._keys, self._count)

    def cloud(self, min_points: int = 1, cell_m: float = 0.0) -> Cloud:
        """Return one point per voxel, in order of first use.

        With `cell_m`, only where a cell of that size holds at least `min_points`, and without its faintest voxels.
        """
        sums, chosen = self._sums[: self._count], np.arange(self._count)
        if cell_m > 0.0 and len(sums):
            cell_of = cells_of(sums[:, :3] / sums[:, 6:7], cell_m)
            usual = np.bincount(cell_of, weights=sums[:, 6]) / np.bincount(cell_of)
            enough = np.bincount(cell_of, weights=sums[:, 7]) >= min_points
            chosen = np.flatnonzero(enough[cell_of] & (sums[:, 6] >= _FAINT_SHARE * usual[cell_of]))
        points, colors = np.empty((len(chosen), 3), np.float32), np.empty((len(chosen), 3), np.uint8)
        for first in range(0, len(chosen), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            means = sums[chosen[part], :6] / sums[chosen[part], 6:7]
            points[part], colors[part] = means[:, :3], np.clip(np.round(means[:, 3:]), 0, 255)
        return Cloud(points, colors)


def cells_of(points_m: NDArray[np.floating], cell_m: float) -> NDArray[np.int64]:
    """Return the number [N], from 0 on and dense, of the cubic cell that each of the points [N, 3] lies in."""
    if len(points_m) == 0:
        return np.zeros(0, np.int64)
    cells = np.floor(points_m.astype(np.float64) / cell_m).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    _, numbers = np.unique((cells[:, 2] * extent[1] + cells[:, 1]) * extent[0] + cells[:, 0], return_inverse=True)
    return np.asarray(numbers, dtype=np.int64)


def voxel_filter(cloud: Cloud, voxel_m: float) -> Cloud:
    """Return one averaged point per voxel."""
    average = VoxelAverage(voxel_m)
    average.add(cloud)
    return average.cloud()


def without_outliers(cloud: Cloud, sigma: float, cell_m: float) -> Cloud:
    """Return the points of cells whose mean distance to 12 neighbours is not `sigma` deviations above the average.

    Statistical outlier removal (Rusu et al., "Towards 3D point cloud based object maps", 2008) on one point per cell of
    `cell_m`: as good at finding stray points, and its cost does not depend on how fine the cloud is.
    """
    cell_of = cells_of(cloud.points_m, cell_m)
    counts = np.bincount(cell_of)
    if len(counts) <= _NEIGHBOURS:
        return cloud
    centres = np.stack([np.bincount(cell_of, weights=cloud.points_m[:, axis]) / counts for axis in range(3)], axis=1)
    distances, _ = cKDTree(centres).query(centres, k=_NEIGHBOURS + 1)
    mean = np.asarray(distances, dtype=np.float64)[:, 1:].mean(axis=1)
    return cloud.select((mean <= mean.mean() + sigma * mean.std())[cell_of])
