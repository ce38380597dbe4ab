"""One scan as marks in a byte grid: the rays of OctoMap's insertion, bit for bit.

OctoMap 1.9 (Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on octrees", Autonomous
Robots 2013) walks each ray with the 3D-DDA of Amanatides and Woo, in float32 directions and float64 crossing
distances. The same arithmetic in the same order gives the same cells. All cells of a scan are marked in a grid that
covers its bounding box first, so that each voxel gets one update per scan and end points win over rays, then packed
into a bit per voxel, and then applied to the blocks of the map: at once, or again when the map is corrected.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.mapping.octree.blocks import KEY_ORIGIN, find_slot, pack_block

FREE_MARK = 1
END_MARK = 2
BESIDE_MARK = 3  # free, and beside an end: the bits of both
_FAR = 1.7976931348623157e308
_Bytes = NDArray[np.uint8]
_F32 = NDArray[np.float32]
_I64 = NDArray[np.int64]
_Point = tuple[Any, Any, Any]  # float32


class Voxels(NamedTuple):
    """The blocks of a map, see `BlockPool`."""

    table: _I64
    rows: NDArray[np.int32]
    keys: _I64
    values: _F32


class LogOdds(NamedTuple):
    """What a mark adds to a voxel, and the limits, float32."""

    hit: Any
    miss: Any
    beside: Any  # a miss of an occupied voxel that touches what the same scan hit
    low: Any
    high: Any


class Rays(NamedTuple):
    """How the rays of a scan are followed."""

    max_range_m: float  # negative: no limit
    resolution: float
    clears_at_range: bool  # a ray that is cut off clears the cell that it is cut off in
    beside: bool  # free cells that touch an end, be it at a corner, have a mark of their own


@njit(cache=True, nogil=True, inline="always")
def voxel_key(inverse_resolution: float, coordinate: float) -> int:
    """Return OctoMap's key of a coordinate along one axis."""
    return int(np.floor(inverse_resolution * np.float64(coordinate))) + KEY_ORIGIN


@njit(cache=True, nogil=True, inline="always")
def _axis(d: Any, origin: Any, key: int, stride: int, resolution: float) -> tuple[int, float, float]:
    """Return grid step, distance to the first cell border and distance between borders along one axis of a ray."""
    half = np.float64(np.float32(resolution * 0.5))
    centre = (np.float64(key - KEY_ORIGIN) + 0.5) * resolution
    if d > 0:
        return stride, (centre + half - np.float64(origin)) / np.float64(d), resolution / np.float64(d)
    if d < 0:
        return -stride, (centre - half - np.float64(origin)) / np.float64(d), resolution / -np.float64(d)
    return 0, _FAR, _FAR


@njit(cache=True, nogil=True, inline="always")
def _cast(origin: _Point, point: _Point, resolution: float, base: _I64, nx: int, nxy: int, grid: _Bytes) -> int:
    """Mark the cells that a ray passes before its end cell; return the index of the end cell."""
    ox, oy, oz = origin
    ex, ey, ez = point
    inverse = 1.0 / resolution
    k0, k1, k2 = voxel_key(inverse, ox), voxel_key(inverse, oy), voxel_key(inverse, oz)
    index = (k0 - base[0]) + (k1 - base[1]) * nx + (k2 - base[2]) * nxy
    e0, e1, e2 = voxel_key(inverse, ex), voxel_key(inverse, ey), voxel_key(inverse, ez)
    end = (e0 - base[0]) + (e1 - base[1]) * nx + (e2 - base[2]) * nxy
    if index == end:
        return end
    grid[index] = FREE_MARK
    dx, dy, dz = ex - ox, ey - oy, ez - oz
    length32 = np.float32(np.sqrt(np.float64(dx * dx + dy * dy + dz * dz)))
    dx, dy, dz = dx / length32, dy / length32, dz / length32
    s0, t0, d0 = _axis(dx, ox, k0, 1, resolution)
    s1, t1, d1 = _axis(dy, oy, k1, nx, resolution)
    s2, t2, d2 = _axis(dz, oz, k2, nxy, resolution)
    length = np.float64(length32)
    while True:  # selects instead of branches: which axis is next is as good as random
        x_before_y = t0 < t1
        nearest = t0 if x_before_y else t1
        take_z = not (nearest < t2)
        take_x = x_before_y and not take_z
        take_y = (not x_before_y) and not take_z
        index += s2 if take_z else (s0 if x_before_y else s1)
        t0 += d0 if take_x else 0.0
        t1 += d1 if take_y else 0.0
        t2 += d2 if take_z else 0.0
        if index == end:
            return end
        if t0 > length and t1 > length and t2 > length:
            return end
        grid[index] = FREE_MARK


@njit(cache=True, nogil=True)
def finite_points(points: _F32) -> tuple[_F32, NDArray[np.float64], NDArray[np.float64]]:
    """Return the finite ones of points [N, 3] and the lowest and highest corner [3] of their bounding box."""
    bits, exponent = points.view(np.uint32), np.uint32(0x7F800000)
    damaged = 0
    for i in range(len(points)):  # the common case first: without branches the loop is vectorised
        for axis in range(3):
            damaged += (bits[i, axis] & exponent) == exponent
    kept = points
    if damaged > 0:
        count = 0
        kept = np.empty((len(points), 3), np.float32)
        for i in range(len(points)):
            if np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2]):
                kept[count] = points[i]
                count += 1
        kept = kept[:count]
    low, high = _bounds(kept)
    return kept, low, high


@njit(cache=True, nogil=True, fastmath={"nnan"})
def _bounds(points: _F32) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = np.full(3, np.float32(np.inf), np.float32), np.full(3, np.float32(-np.inf), np.float32)
    a0, a1, a2, b0, b1, b2 = low[0], low[1], low[2], high[0], high[1], high[2]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a0, a1, a2 = min(a0, x), min(a1, y), min(a2, z)
        b0, b1, b2 = max(b0, x), max(b1, y), max(b2, z)
    low[0], low[1], low[2], high[0], high[1], high[2] = a0, a1, a2, b0, b1, b2
    return low.astype(np.float64), high.astype(np.float64)


@njit(cache=True, nogil=True)
def cast_rays(points: _F32, origin: _F32, rays: Rays, base: _I64, strides: tuple[int, int], grid: _Bytes) -> None:
    """Mark what one scan sees: free along the rays, occupied at ends within the range."""
    nx, nxy = strides
    max_range_m, resolution, clears_at_range, beside = rays
    inverse = 1.0 / resolution
    ox, oy, oz = origin[0], origin[1], origin[2]
    ends = np.full(len(points), -1, np.int64)
    for i in range(len(points)):
        ex, ey, ez = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = ex - ox, ey - oy, ez - oz
        distance = np.sqrt(np.float64(dx * dx + dy * dy + dz * dz))
        if max_range_m < 0.0 or distance <= max_range_m:
            ends[i] = _cast((ox, oy, oz), (ex, ey, ez), resolution, base, nx, nxy, grid)
        else:
            length, reach = np.float32(distance), np.float32(max_range_m)
            dx, dy, dz = dx / length, dy / length, dz / length
            point = ox + dx * reach, oy + dy * reach, oz + dz * reach
            last = _cast((ox, oy, oz), point, resolution, base, nx, nxy, grid)
            if clears_at_range and (
                voxel_key(inverse, point[0]) != voxel_key(inverse, ex)
                or voxel_key(inverse, point[1]) != voxel_key(inverse, ey)
                or voxel_key(inverse, point[2]) != voxel_key(inverse, ez)
            ):
                grid[last] = FREE_MARK
    for i in range(len(points)):
        if ends[i] >= 0 and grid[ends[i]] != END_MARK:
            grid[ends[i]] = END_MARK
            if beside:
                _mark_beside(ends[i], nx, nxy, grid)


@njit(cache=True, nogil=True, inline="always")
def _mark_beside(end: int, nx: int, nxy: int, grid: _Bytes) -> None:
    for z in range(-nxy, nxy + 1, nxy):
        for y in range(-nx, nx + 1, nx):
            for cell in range(end + z + y - 1, end + z + y + 2):
                if grid[cell] == FREE_MARK:
                    grid[cell] = BESIDE_MARK


@njit(cache=True, nogil=True)
def end_voxels(points: _F32, resolution: float, base: _I64, nx: int, nxy: int, grid: _Bytes) -> _F32:
    """Return the centres [M, 3] of the voxels that points fall into, once each; the grid is all zero before, after."""
    inverse = 1.0 / resolution
    out = np.empty((len(points), 3), np.float32)
    cells = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        a, b, c = (voxel_key(inverse, points[i, 0]), voxel_key(inverse, points[i, 1]), voxel_key(inverse, points[i, 2]))
        cell = (a - base[0]) + (b - base[1]) * nx + (c - base[2]) * nxy
        if grid[cell] == 0:
            grid[cell] = END_MARK
            cells[count] = cell
            out[count, 0] = np.float32((np.float64(a - KEY_ORIGIN) + 0.5) * resolution)
            out[count, 1] = np.float32((np.float64(b - KEY_ORIGIN) + 0.5) * resolution)
            out[count, 2] = np.float32((np.float64(c - KEY_ORIGIN) + 0.5) * resolution)
            count += 1
    for i in range(count):
        grid[cells[i]] = 0
    return out[:count]


@njit(cache=True, nogil=True)
def marked_blocks(words: NDArray[np.uint64], blocks: _I64) -> _I64:
    """Return the flat indices of the 8x8x8 blocks of the scan's grid that hold a mark; a row of 8 cells is one word."""
    nbx, nby, nbz = blocks[0], blocks[1], blocks[2]
    out = np.empty(nbx * nby * nbz, np.int64)
    flags = np.zeros(nbx, np.uint64)
    count = 0
    for bz in range(nbz):
        for by in range(nby):
            flags[:] = 0
            for z in range(8):
                for y in range(8):
                    row = (((bz * 8 + z) * nby + by) * 8 + y) * nbx
                    for bx in range(nbx):
                        flags[bx] |= words[row + bx]
            for bx in range(nbx):
                if flags[bx] != 0:
                    out[count] = bx + nbx * (by + nby * bz)
                    count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def pack_marks(marked: _I64, words: NDArray[np.uint64], blocks: _I64, base: _I64) -> tuple[_I64, _Bytes]:
    """Return keys [B] and bits [B, 2, 64] of a scan's blocks, and clear its grid.

    A byte is a row of 8 voxels along x, rows in order of y, then z; first those that rays passed, then those hit. A
    voxel in both was passed beside one that was hit.
    """
    nbx, nby = blocks[0], blocks[1]
    keys, bits = np.empty(len(marked), np.int64), np.empty((len(marked), 2, 64), np.uint8)
    lowest, gather, top = np.uint64(0x0101010101010101), np.uint64(0x0102040810204080), np.uint64(56)
    for i in range(len(marked)):
        bx, by, bz = marked[i] % nbx, (marked[i] // nbx) % nby, marked[i] // (nbx * nby)
        keys[i] = pack_block(base[0] // 8 + bx, base[1] // 8 + by, base[2] // 8 + bz)
        for z in range(8):
            for y in range(8):
                place = (((bz * 8 + z) * nby + by) * 8 + y) * nbx + bx
                word = words[place]
                # the lowest bit of each byte, side by side in the highest byte
                bits[i, 0, z * 8 + y] = ((word & lowest) * gather) >> top
                bits[i, 1, z * 8 + y] = (((word >> np.uint64(1)) & lowest) * gather) >> top
                words[place] = 0
    return keys, bits


@njit(cache=True, nogil=True)
def apply_marks(block_keys: _I64, bits: _Bytes, only_known: bool, known: Voxels, count: int, odds: LogOdds) -> int:
    """Update the map's blocks by a scan's marks, and return the new number of blocks; `only_known` adds none."""
    table, rows, keys, values = known
    hit, miss, miss_beside, low, high = odds
    for i in range(len(block_keys)):
        slot = find_slot(table, block_keys[i])
        if table[slot] < 0:
            if only_known:
                continue
            table[slot], rows[slot], keys[count] = block_keys[i], count, block_keys[i]
            values[count, :] = np.float32(np.nan)
            count += 1
        voxels = values[rows[slot]]
        for row in range(64):
            ends = bits[i, 1, row]
            beside = bits[i, 0, row] & ends
            seen = bits[i, 0, row] | ends
            ends ^= beside
            if seen == 0:
                continue
            for x in range(8):
                old = voxels[row * 8 + x]
                missed = miss_beside if (beside >> x) & 1 and old >= 0.0 else miss
                new = (np.float32(0.0) if np.isnan(old) else old) + (hit if (ends >> x) & 1 else missed)
                voxels[row * 8 + x] = min(max(new, low), high) if (seen >> x) & 1 else old
    return count
