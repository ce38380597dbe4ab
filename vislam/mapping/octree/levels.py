"""Voxels seen coarsely, as OctoMap's search at a depth does: a cube has the largest log-odds of what is known in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.mapping.octree.blocks import KEY_ORIGIN, BlockPool, find_slot, pack_block
from vislam.mapping.octree.tree import OctreeLeaves, morton_decode, morton_encode

_BLOCK_LEVEL = 3  # a block is one cube of this level
_F32 = NDArray[np.float32]
_I64 = NDArray[np.int64]


def largest_log_odds(pool: BlockPool, keys: _I64, level: int) -> _F32:
    """Return the largest log-odds [N] in the cubes of edge 2**level voxels around voxel keys [N, 3]; NaN: none known.

    Keys outside [0, 65536) give NaN.
    """
    if level <= _BLOCK_LEVEL:
        return np.asarray(_within_blocks(keys, level, *pool.arrays))
    shift = 3 * (level - _BLOCK_LEVEL)
    codes = morton_encode(pool.block_coordinates()) >> shift
    inside = ((keys >= 0) & (keys < 2 * KEY_ORIGIN)).all(axis=1)
    out = np.full(len(keys), np.nan, np.float32)
    if pool.count == 0 or not inside.any():
        return out
    order = np.argsort(codes, kind="stable")
    cubes, first = np.unique(codes[order], return_index=True)
    largest = np.maximum.reduceat(np.nanmax(pool.values[: pool.count], axis=1)[order], first)
    wanted = morton_encode(np.ascontiguousarray(keys[inside] >> _BLOCK_LEVEL)) >> shift
    place = np.minimum(np.searchsorted(cubes, wanted), len(cubes) - 1)
    out[inside] = np.where(cubes[place] == wanted, largest[place], np.float32(np.nan))
    return out


@njit(cache=True, nogil=True)
def _within_blocks(keys: _I64, level: int, table: _I64, rows: NDArray[np.int32], values: _F32) -> _F32:
    out = np.full(len(keys), np.float32(np.nan), np.float32)
    edge = 1 << level
    for i in range(len(keys)):
        x, y, z = keys[i, 0], keys[i, 1], keys[i, 2]
        if min(x, y, z) < 0 or max(x, y, z) >= 2 * KEY_ORIGIN:
            continue
        slot = find_slot(table, pack_block(x >> 3, y >> 3, z >> 3))
        if table[slot] < 0:
            continue
        x, y, z = (x & 7) >> level << level, (y & 7) >> level << level, (z & 7) >> level << level
        for k in range(z, z + edge):
            for j in range(y, y + edge):
                for m in range(x, x + edge):
                    value = values[rows[slot], m | j << 3 | k << 6]
                    if not np.isnan(value) and not out[i] >= value:
                        out[i] = value
    return out


def fill_from_octree(pool: BlockPool, octree: OctreeLeaves) -> None:
    """Put the leaves of an octree into an empty pool, large ones taken apart; DataError when they are too many."""
    large = octree.levels >= _BLOCK_LEVEL
    whole = float(np.sum(8.0 ** (octree.levels[large].astype(np.float64) - _BLOCK_LEVEL)))
    codes = octree.starts[~large] >> (3 * _BLOCK_LEVEL)
    pool.reserve(int(min(whole, 2.0**40)) + int((np.diff(codes) != 0).sum()) + int(len(codes) > 0))
    corners = morton_decode(octree.starts)
    pool.count = _fill(corners, octree.levels, octree.log_odds, pool.table, pool.rows, pool.keys, pool.values)


@njit(cache=True, nogil=True)
def _fill(
    corners: _I64, levels: NDArray[np.uint8], log_odds: _F32, table: _I64, rows: NDArray[np.int32], keys: _I64,
    values: _F32,
) -> int:  # fmt: skip
    count = 0
    for i in range(len(corners)):
        edge = 1 << min(int(levels[i]), 3)
        blocks = 1 << max(int(levels[i]) - 3, 0)
        x, y, z = corners[i, 0] & 7, corners[i, 1] & 7, corners[i, 2] & 7
        for bz in range(corners[i, 2] >> 3, (corners[i, 2] >> 3) + blocks):
            for by in range(corners[i, 1] >> 3, (corners[i, 1] >> 3) + blocks):
                for bx in range(corners[i, 0] >> 3, (corners[i, 0] >> 3) + blocks):
                    key = pack_block(bx, by, bz)
                    slot = find_slot(table, key)
                    if table[slot] < 0:
                        table[slot], rows[slot], keys[count] = key, count, key
                        values[count, :] = np.float32(np.nan)
                        count += 1
                    voxels = values[rows[slot]]
                    for k in range(z, z + edge):
                        for j in range(y, y + edge):
                            for m in range(x, x + edge):
                                voxels[m | j << 3 | k << 6] = log_odds[i]
    return count
