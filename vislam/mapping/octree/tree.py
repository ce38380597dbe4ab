"""A pruned octree as a sorted list of its leaves.

Leaves are sorted along the Morton curve, which is the depth-first order of OctoMap's files: the octree needs no nodes
and no pointers, a point is found by binary search, and files are written and read in one pass without recursion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.octree.blocks import BLOCK_VOXELS, KEY_ORIGIN, keys_at

TREE_LEVELS = 16  # OctoMap's depth: a leaf of level 0 is one voxel, the root has level 16
_MAX_VOXELS = 1 << 27  # taken apart: 3 GiB


def log_odds(probability: float) -> np.float32:
    """Return the log-odds of a probability as float32, as OctoMap rounds it."""
    return np.float32(math.log(probability / (1.0 - probability)))


@dataclass(frozen=True, slots=True, eq=False)
class OctreeLeaves:
    """Leaves of a pruned octree, in Morton order; where no leaf is, nothing is known."""

    resolution_m: float
    starts: NDArray[np.int64]  # [N] Morton code of the leaf's lowest voxel, increasing
    levels: NDArray[np.uint8]  # [N] edge length 2**level voxels
    log_odds: NDArray[np.float32]  # [N] occupied from 0 on
    colors: NDArray[np.uint8] | None = None  # [N, 3] RGB; white where there is no colour

    def __len__(self) -> int:
        return len(self.starts)

    def log_odds_at(self, points_map_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the log-odds [N] at points [N, 3]; NaN where unknown, outside the key range or not finite."""
        leaf = self.leaves_at(points_map_m)
        return np.append(self.log_odds, np.float32(np.nan))[leaf]

    def leaves_at(self, points_map_m: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the index [N] of the leaf around each point [N, 3]; -1 where there is none."""
        keys, inside = keys_at(points_map_m, self.resolution_m)
        out = np.full(len(keys), -1, np.int64)
        if len(self) == 0 or not inside.any():
            return out
        codes = morton_encode(keys[inside])
        leaf = np.searchsorted(self.starts, codes, side="right") - 1
        ends = self.starts[leaf] + (np.int64(1) << (3 * self.levels[leaf].astype(np.int64)))
        out[inside] = np.where((leaf >= 0) & (codes < ends), leaf, -1)
        return out

    def with_colors(self, points_map_m: NDArray[np.floating], colors: NDArray[np.uint8]) -> OctreeLeaves:
        """Return the octree whose leaves have the mean RGB colour [N, 3] of the points [N, 3] in them, else white."""
        leaf = self.leaves_at(points_map_m)
        counts = np.bincount(leaf[leaf >= 0], minlength=len(self))
        mean = np.full((len(self), 3), 255, np.uint8)
        for channel in range(3):
            sums = np.bincount(leaf[leaf >= 0], colors[leaf >= 0, channel], len(self))
            mean[counts > 0, channel] = sums[counts > 0] / counts[counts > 0]
        return replace(self, colors=mean)

    def boxes(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return lowest voxel [N, 3] (0 at the map's origin) and edge length in voxels [N] of every leaf."""
        keys = morton_decode(self.starts) - KEY_ORIGIN
        return keys, np.int64(1) << self.levels.astype(np.int64)

    def centres_m(self) -> tuple[Array, Array]:
        """Return centres [N, 3] and edge lengths [N] of every leaf in metres, in the map frame."""
        low, size = self.boxes()
        return (low + 0.5 * size[:, None]) * self.resolution_m, np.asarray(size * self.resolution_m, dtype=np.float64)

    def occupied_voxels(self) -> NDArray[np.int64]:
        """Return the occupied voxels [M, 3] (0 at the map's origin), large leaves taken apart.

        Raises DataError when there are more than fit in memory.
        """
        chosen = self.log_odds >= 0.0
        counts = np.int64(1) << (3 * self.levels[chosen].astype(np.int64))
        if float(counts.astype(np.float64).sum()) > _MAX_VOXELS:
            raise DataError(f"the octree's leaves are more than {_MAX_VOXELS} voxels; use its boxes instead")
        first = np.repeat(self.starts[chosen], counts)
        within = np.arange(int(counts.sum()), dtype=np.int64) - np.repeat(np.cumsum(counts) - counts, counts)
        return np.asarray(morton_decode(first + within) - KEY_ORIGIN)


def octree_from_blocks(
    resolution_m: float, block_coordinates: NDArray[np.int64], values: NDArray[np.float32]
) -> OctreeLeaves:
    """Return the pruned octree of 8x8x8 blocks: coordinates [B, 3], values [B, 512] x fastest, NaN unknown."""
    codes = morton_encode(block_coordinates)
    order = np.argsort(codes, kind="stable")
    ordered = values[order][:, _morton_within_block()]  # [B, 512] along the curve
    known = ~np.isnan(ordered)
    starts = (codes[order, None] * BLOCK_VOXELS + np.arange(BLOCK_VOXELS))[known]
    leaves, levels = ordered[known].astype(np.float32), np.zeros(len(starts), np.uint8)
    for level in range(TREE_LEVELS):
        count = _prune_level(starts, levels, leaves, level)
        if count == len(starts):
            break
        starts, levels, leaves = starts[:count], levels[:count], leaves[:count]
    return OctreeLeaves(resolution_m, starts.copy(), levels.copy(), leaves.copy())


def _morton_within_block() -> NDArray[np.int64]:
    """Return, for each place on the curve through a block, the index of its voxel in x-fastest order."""
    xyz = morton_decode(np.arange(BLOCK_VOXELS, dtype=np.int64))
    return np.asarray(xyz[:, 0] + 8 * xyz[:, 1] + 64 * xyz[:, 2])


@njit(cache=True, nogil=True)
def _prune_level(starts: NDArray[np.int64], levels: NDArray[np.uint8], values: NDArray[np.float32], level: int) -> int:
    """Replace eight equal sibling leaves of a level by their parent, in place; return the new number of leaves."""
    width = np.int64(1) << (3 * level)
    count, i = 0, 0
    while i < len(starts):
        merge = i + 8 <= len(starts) and starts[i] % (8 * width) == 0
        for c in range(8 if merge else 0):
            if starts[i + c] != starts[i] + c * width or levels[i + c] != level or values[i + c] != values[i]:
                merge = False
                break
        starts[count], levels[count], values[count] = starts[i], levels[i], values[i]
        if merge:
            levels[count] = level + 1
        i += 8 if merge else 1
        count += 1
    return count


@njit(cache=True, nogil=True)
def morton_encode(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return Morton codes [N] of keys [N, 3] in [0, 65536): bit 3i is bit i of x, 3i+1 of y, 3i+2 of z."""
    out = np.zeros(len(keys), np.int64)
    for i in range(len(keys)):
        code = np.int64(0)
        for bit in range(TREE_LEVELS):
            code |= ((keys[i, 0] >> bit) & 1) << (3 * bit)
            code |= ((keys[i, 1] >> bit) & 1) << (3 * bit + 1)
            code |= ((keys[i, 2] >> bit) & 1) << (3 * bit + 2)
        out[i] = code
    return out


@njit(cache=True, nogil=True)
def morton_decode(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the keys [N, 3] of Morton codes [N]."""
    out = np.zeros((len(codes), 3), np.int64)
    for i in range(len(codes)):
        for bit in range(TREE_LEVELS):
            out[i, 0] |= ((codes[i] >> (3 * bit)) & 1) << bit
            out[i, 1] |= ((codes[i] >> (3 * bit + 1)) & 1) << bit
            out[i, 2] |= ((codes[i] >> (3 * bit + 2)) & 1) << bit
    return out
