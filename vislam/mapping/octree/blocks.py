"""Voxels in hashed blocks of 8x8x8: an open-addressing table from block keys to rows of float32 values.

A voxel key is OctoMap's: three integers in [0, 65536), 32768 at the map's origin. A block key packs the three keys
divided by 8, 13 bits each. Values of a block are ordered x fastest, then y, then z; NaN means never seen.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.jit import njit

KEY_ORIGIN = 32768  # the key of the voxel whose lower corner is the map's origin
BLOCK_VOXELS = 512
_KEY_BITS = 13
_KEY_MASK = (1 << _KEY_BITS) - 1
_EMPTY = -1
_T = TypeVar("_T", bound=np.generic)
_MAX_BLOCKS = 1 << 22  # 8 GiB of voxels: beyond any machine this is meant for


@njit(cache=True, nogil=True, inline="always")
def pack_block(bx: int, by: int, bz: int) -> int:
    """Return the key of the block at block coordinates (voxel keys divided by 8)."""
    return bx | (by << _KEY_BITS) | (bz << (2 * _KEY_BITS))


@njit(cache=True, nogil=True, inline="always")
def find_slot(table: NDArray[np.int64], key: int) -> int:
    """Return the slot of a hash table that holds the key, or the empty slot where it belongs (linear probing)."""
    mask = table.shape[0] - 1
    mixed = np.int64(key) * np.int64(-7046029254386353131)  # Fibonacci hashing
    slot = (mixed ^ (mixed >> 31)) & mask
    while table[slot] != _EMPTY and table[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def _rehash(table: NDArray[np.int64], rows: NDArray[np.int32], keys: NDArray[np.int64], count: int) -> None:
    for row in range(count):
        slot = find_slot(table, keys[row])
        table[slot] = keys[row]
        rows[slot] = row


@njit(cache=True, nogil=True)
def _holds_any(table: NDArray[np.int64], keys: NDArray[np.int64]) -> bool:
    found = False
    for key in keys:
        found |= table[find_slot(table, key)] == key
    return found


def keys_at(points_map_m: NDArray[np.floating], resolution_m: float) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return OctoMap's keys [N, 3] of points [N, 3], and which [N] are inside the key range; keys of others are -1.

    OctoMap's points are float32: on the border of a voxel float64 may mean the one before.
    """
    with np.errstate(over="ignore"):
        points = np.asarray(points_map_m).reshape(-1, 3).astype(np.float32).astype(np.float64)
    scaled = np.floor((1.0 / resolution_m) * points)
    inside: NDArray[np.bool_] = np.all((scaled >= -KEY_ORIGIN) & (scaled < KEY_ORIGIN), axis=1)
    keys = np.full(points.shape, -1, np.int64)
    keys[inside] = scaled[inside].astype(np.int64) + KEY_ORIGIN
    return keys, inside


class BlockPool:
    """Growing storage of voxel blocks; `keys[:count]` and `values[:count]` are in order of first use."""

    def __init__(self, capacity: int = 1 << 10) -> None:
        self.count = 0
        self.keys = np.zeros(capacity, np.int64)
        self.values = np.empty((capacity, BLOCK_VOXELS), np.float32)
        self.table = np.full(4 * capacity, _EMPTY, np.int64)
        self.rows = np.zeros(4 * capacity, np.int32)

    @property
    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
        """Hash table, rows and values, as compiled code takes them."""
        return self.table, self.rows, self.values

    @property
    def nbytes(self) -> int:
        """Memory held, in bytes."""
        return self.keys.nbytes + self.values.nbytes + self.table.nbytes + self.rows.nbytes

    def reserve(self, extra: int) -> None:
        """Make room for `extra` more blocks; raises DataError when the map would outgrow any machine."""
        need = self.count + extra
        if need > _MAX_BLOCKS:
            raise DataError(
                f"the map would need {need} blocks of 8x8x8 voxels, at most {_MAX_BLOCKS} are allowed; "
                "use a coarser map.resolution_m or a shorter map.max_range_m"
            )
        if need > len(self.keys):
            capacity = max(need, 2 * len(self.keys))
            self.keys = _grown(self.keys, capacity)
            self.values = _grown(self.values, capacity)
        if 2 * need > len(self.table):
            size = len(self.table)
            while size < 4 * need:
                size *= 2
            self.table = np.full(size, _EMPTY, np.int64)
            self.rows = np.zeros(size, np.int32)
            _rehash(self.table, self.rows, self.keys, self.count)

    def holds_any(self, keys: NDArray[np.int64]) -> bool:
        """Return whether one of the blocks with these keys is here."""
        return bool(_holds_any(self.table, keys))

    @classmethod
    def of(cls, keys: NDArray[np.int64], values: NDArray[np.float32]) -> BlockPool:
        """Return a pool of blocks with different keys [N] and their values [N, 512], which it takes over."""
        out = cls(0)
        out.keys, out.values, out.count = keys, values, len(keys)
        size = 4
        while size < 4 * len(keys):
            size *= 2
        out.table, out.rows = np.full(size, _EMPTY, np.int64), np.zeros(size, np.int32)
        _rehash(out.table, out.rows, out.keys, out.count)
        return out

    def replaced(self, patch: BlockPool) -> BlockPool:
        """Return a pool of these blocks, where `patch` has none, and of those of `patch` that hold anything."""
        keys, values = patch.keys[: patch.count], patch.values[: patch.count]
        kept = ~np.isin(self.keys[: self.count], keys)
        known = ~np.isnan(values).all(axis=1)
        return BlockPool.of(
            np.concatenate([self.keys[: self.count][kept], keys[known]]),
            np.concatenate([self.values[: self.count][kept], values[known]]),
        )

    def copy(self) -> BlockPool:
        """Return a pool of the same blocks, without spare room."""
        out = BlockPool(0)
        out.count = self.count
        out.keys, out.values = self.keys[: self.count].copy(), self.values[: self.count].copy()
        out.table, out.rows = self.table.copy(), self.rows.copy()
        return out

    def block_coordinates(self) -> NDArray[np.int64]:
        """Return the block coordinates [count, 3] (voxel keys divided by 8), in order of first use."""
        keys = self.keys[: self.count]
        return np.stack([keys & _KEY_MASK, (keys >> _KEY_BITS) & _KEY_MASK, keys >> (2 * _KEY_BITS)], axis=1)


def _grown(array: NDArray[_T], capacity: int) -> NDArray[_T]:
    out = np.empty((capacity, *array.shape[1:]), array.dtype)
    out[: len(array)] = array
    return out
