"""Coloured clouds: keyframes fused into one averaged point per voxel, without outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.errors import DataError
from vislam.mapping.blocks import find_slot

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]

_KEY_BITS = 21
_KEY_HALF = 1 << (_KEY_BITS - 1)
_MAX_POINTS = 1 << 26  # 67 million: 5 GB while fusing


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


@njit(cache=True, nogil=True)
def _rehash(table: NDArray[np.int64], rows: NDArray[np.int32], keys: NDArray[np.int64], count: int) -> None:
    for row in range(count):
        slot = find_slot(table, keys[row])
        table[slot], rows[slot] = keys[row], row


@njit(cache=True, nogil=True)
def _accumulate(points: Points, colors: Colors, voxel_m: float, hashed: tuple[NDArray[np.int64], NDArray[np.int32]],
                keys: NDArray[np.int64], sums: NDArray[np.float64], count: int) -> int:  # fmt: skip
    table, rows = hashed
    for i in range(len(points)):
        key = np.int64(0)
        inside = True
        for axis in range(3):
            scaled = np.floor(np.float64(points[i, axis]) / voxel_m)
            inside = inside and abs(scaled) < _KEY_HALF  # false for NaN
            if inside:
                key = (key << _KEY_BITS) | (np.int64(scaled) + _KEY_HALF)
        if not inside:
            continue
        slot = find_slot(table, key)
        if table[slot] < 0:
            table[slot], rows[slot], keys[count] = key, count, key
            sums[count, :] = 0.0
            count += 1
        row = sums[rows[slot]]
        row[6] += 1.0
        for axis in range(3):
            row[axis] += points[i, axis]
            row[3 + axis] += colors[i, axis]
    return count


class VoxelAverage:
    """Averages position and colour of the points in each voxel, over any number of clouds, in bounded memory."""

    def __init__(self, voxel_m: float) -> None:
        self._voxel_m = voxel_m
        self._count = 0
        self._keys = np.empty(1 << 12, np.int64)
        self._sums = np.empty((1 << 12, 7), np.float64)  # position, colour, number of points
        self._table = np.full(1 << 14, -1, np.int64)
        self._rows = np.zeros(1 << 14, np.int32)

    def add(self, cloud: Cloud) -> None:
        """Add a cloud; points that are not finite are left out. Raises DataError when the result gets too large."""
        need = self._count + len(cloud)
        if need > _MAX_POINTS:
            raise DataError(
                f"a cloud of more than {_MAX_POINTS} points at {self._voxel_m} m; use a larger map.cloud_voxel_m"
            )
        if need > len(self._keys):
            grown = max(need, 2 * len(self._keys))
            self._keys = np.resize(self._keys, grown)
            self._sums = np.concatenate([self._sums, np.empty((grown - len(self._sums), 7))])
        if 2 * need > len(self._table):
            size = 1 << int(np.ceil(np.log2(4 * need)))
            self._table, self._rows = np.full(size, -1, np.int64), np.zeros(size, np.int32)
            _rehash(self._table, self._rows, self._keys, self._count)
        self._count = _accumulate(
            cloud.points_m, cloud.colors, self._voxel_m, (self._table, self._rows), self._keys, self._sums, self._count
        )

    def cloud(self, min_points: int = 1) -> Cloud:
        """Return one point per voxel that holds at least `min_points`, in order of first use."""
        sums = self._sums[: self._count]
        sums = sums[sums[:, 6] >= min_points]
        means = sums[:, :6] / sums[:, 6:]
        return Cloud(means[:, :3].astype(np.float32), np.clip(np.round(means[:, 3:]), 0, 255).astype(np.uint8))


def voxel_filter(cloud: Cloud, voxel_m: float) -> Cloud:
    """Return one averaged point per voxel."""
    average = VoxelAverage(voxel_m)
    average.add(cloud)
    return average.cloud()


def without_outliers(cloud: Cloud, neighbours: int, sigma: float) -> Cloud:
    """Return the points whose mean distance to their `neighbours` is not `sigma` deviations above the average.

    Statistical outlier removal, Rusu et al., "Towards 3D point cloud based object maps", 2008.
    """
    if len(cloud) <= neighbours:
        return cloud
    distances, _ = cKDTree(cloud.points_m).query(cloud.points_m, k=neighbours + 1)
    mean = np.asarray(distances, dtype=np.float64)[:, 1:].mean(axis=1)
    return cloud.select(mean <= mean.mean() + sigma * mean.std())
