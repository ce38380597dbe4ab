"""Columns of an occupancy map: runs of occupied voxels one above another, kept up to date block by block.

What is occupied and what is free is remembered as two bits per voxel. An update compares them with the map as it is,
and looks again only at columns of blocks in which a voxel changed its state: after a scan a few, and the result does
not depend on how it was reached.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.mapping.octree.blocks import KEY_ORIGIN
from vislam.mapping.octree.occupancy import Octree

MAX_RUNS = 6  # floor, seat, table, shelf, lamp, ceiling; what is higher is taken for one with the highest
NEVER = np.int16(32767)  # the lowest free voxel of a column without any
_EDGE = 8  # columns along a block
_MAX_COLUMNS = 1 << 25  # 290 x 290 m at 5 cm; 900 MB
_XY_BITS = 26  # of a block's key: its place in the plane
_WORDS = 16  # a layer of 64 voxels is a word: eight of occupied ones, eight of free ones

_I16 = NDArray[np.int16]
_I64 = NDArray[np.int64]
_U64 = NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The columns of the map's bounding box; heights are voxels above the map's origin, row 0 is at the lowest y."""

    runs: _I16  # [rows, columns, MAX_RUNS, 2] lowest and highest voxel of each run, lowest run first
    counts: _I16  # [rows, columns] of runs
    lowest_free: _I16  # [rows, columns] NEVER where no voxel is free
    corner: tuple[int, int]  # x, y of the first column, in voxels from the map's origin


class ColumnStore:
    """The columns of a map that changes."""

    def __init__(self) -> None:
        self._blocks = np.zeros(0, np.int64)  # keys of blocks, ordered by their place in the plane, then by height
        self._bits = np.zeros((0, _WORDS), np.uint64)
        self._tiles = np.zeros(0, np.int64)  # keys of columns of blocks, increasing
        self._runs = np.zeros((0, _EDGE, _EDGE, MAX_RUNS, 2), np.int16)
        self._counts = np.zeros((0, _EDGE, _EDGE), np.int16)
        self._lowest_free = np.zeros((0, _EDGE, _EDGE), np.int16)

    def update(self, occupancy: Octree) -> int:
        """Follow the map; return how many columns of blocks were looked at again."""
        pool = occupancy.pool
        keys = pool.keys[: pool.count]
        ordered = (keys & ((1 << _XY_BITS) - 1)) << 13 | keys >> _XY_BITS
        order = np.argsort(ordered)
        blocks, bits = ordered[order], _state_bits(pool.values[: pool.count], order)
        changed = _changed(self._blocks, self._bits, blocks, bits)
        tiles = np.unique(blocks >> 13)
        dirty = np.intersect1d(tiles, np.unique(changed >> 13), assume_unique=True)
        kept, here, before = np.intersect1d(
            np.setdiff1d(tiles, dirty, assume_unique=True), self._tiles, assume_unique=True, return_indices=True
        )
        here = np.searchsorted(tiles, kept)
        shape = (len(tiles), _EDGE, _EDGE)
        runs, counts = np.zeros((*shape, MAX_RUNS, 2), np.int16), np.zeros(shape, np.int16)
        lowest_free = np.full(shape, NEVER, np.int16)
        for new, old in ((runs, self._runs), (counts, self._counts), (lowest_free, self._lowest_free)):
            new[here] = old[before]
        first = np.searchsorted(blocks >> 13, dirty, side="left")
        last = np.searchsorted(blocks >> 13, dirty, side="right")
        rows = np.searchsorted(tiles, dirty)
        _read_runs(blocks & 0x1FFF, bits, first, last, rows, runs, counts, lowest_free)
        self._blocks, self._bits, self._tiles = blocks, bits, tiles
        self._runs, self._counts, self._lowest_free = runs, counts, lowest_free
        return len(dirty)

    def columns(self) -> Columns:
        """Return the columns as arrays over the map's bounding box; a single empty one for an empty map.

        Raises DataError when the box is larger than any map to drive by.
        """
        x, y = self._tiles & 0x1FFF, self._tiles >> 13
        if len(self._tiles) == 0:
            nothing = np.zeros((1, 1, MAX_RUNS, 2), np.int16)
            return Columns(nothing, np.zeros((1, 1), np.int16), np.full((1, 1), NEVER, np.int16), (0, 0))
        low_x, low_y = int(x.min()), int(y.min())
        shape = (int(y.max()) - low_y + 1, int(x.max()) - low_x + 1)
        if shape[0] * shape[1] * _EDGE**2 > _MAX_COLUMNS:
            raise DataError(
                f"the map spans {shape[1] * _EDGE} x {shape[0] * _EDGE} columns of voxels; at most {_MAX_COLUMNS} "
                "in all make a grid: use a coarser map.resolution_m or a shorter map.max_range_m"
            )
        table = np.full(shape, len(self._tiles), np.int64)
        table[y - low_y, x - low_x] = np.arange(len(self._tiles))
        return Columns(
            _spread(self._runs, table, 0),
            _spread(self._counts, table, 0),
            _spread(self._lowest_free, table, int(NEVER)),
            (low_x * _EDGE - KEY_ORIGIN, low_y * _EDGE - KEY_ORIGIN),
        )


def _changed(old_blocks: _I64, old_bits: _U64, blocks: _I64, bits: _U64) -> _I64:
    """Return the keys of blocks that are new, gone, or of other states."""
    both, before, here = np.intersect1d(old_blocks, blocks, assume_unique=True, return_indices=True)
    other = both[(old_bits[before] != bits[here]).any(axis=1)]
    return np.concatenate([np.setxor1d(old_blocks, blocks, assume_unique=True), other])


def _spread(tiles: _I16, table: _I64, nothing: int) -> _I16:
    """Return tiles [T, 8, 8, ...] laid out as in the table [rows, columns]; index T is an empty one."""
    padded = np.concatenate([tiles, np.full((1, *tiles.shape[1:]), nothing, tiles.dtype)])
    laid = padded[table].swapaxes(1, 2)
    return np.ascontiguousarray(laid).reshape(table.shape[0] * _EDGE, table.shape[1] * _EDGE, *tiles.shape[3:])


@njit(cache=True, nogil=True)
def _state_bits(values: NDArray[np.float32], order: _I64) -> _U64:
    out = np.zeros((len(order), _WORDS), np.uint64)
    for i in range(len(order)):
        voxels = values[order[i]]
        for z in range(8):
            occupied, free = np.uint64(0), np.uint64(0)
            for k in range(64):
                value, bit = voxels[z * 64 + k], np.uint64(1) << np.uint64(k)
                if value >= 0.0:
                    occupied |= bit
                elif value < 0.0:
                    free |= bit
            out[i, z], out[i, 8 + z] = occupied, free
    return out


@njit(cache=True, nogil=True)
def _read_runs(heights: _I64, bits: _U64, first: _I64, last: _I64, rows: _I64, runs: _I16, counts: _I16,
               lowest_free: _I16) -> None:  # fmt: skip
    for tile in range(len(rows)):
        for k in range(64):
            y, x = k >> 3, k & 7
            place = runs[rows[tile], y, x]
            count, lowest = 0, NEVER
            for block in range(first[tile], last[tile]):
                for z in range(8):
                    voxel = heights[block] * 8 + z - KEY_ORIGIN
                    if (bits[block, z] >> np.uint64(k)) & np.uint64(1):
                        if count > 0 and (place[count - 1, 1] == voxel - 1 or count == MAX_RUNS):
                            place[count - 1, 1] = voxel
                        else:
                            place[count, 0], place[count, 1] = voxel, voxel
                            count += 1
                    elif lowest == NEVER and (bits[block, 8 + z] >> np.uint64(k)) & np.uint64(1):
                        lowest = voxel
            counts[rows[tile], y, x] = count
            lowest_free[rows[tile], y, x] = lowest
