"""The loops behind `vislam.mapping.octree.query`, compiled. Lengths inside are in voxels, counted from key 0."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.octree.blocks import KEY_ORIGIN, find_slot, pack_block

_F32 = NDArray[np.float32]
_I64 = NDArray[np.int64]
_I32 = NDArray[np.int32]
_KEYS = 2 * KEY_ORIGIN
_FREE, _OCCUPIED, _UNKNOWN = 0, 1, -1  # `Occupancy`


@njit(cache=True, nogil=True, inline="always")
def _state(x: int, y: int, z: int, table: _I64, rows: _I32, values: _F32) -> int:
    """Return the state of the voxel at a key."""
    if min(x, y, z) < 0 or max(x, y, z) >= _KEYS:
        return _UNKNOWN
    slot = find_slot(table, pack_block(x >> 3, y >> 3, z >> 3))
    if table[slot] < 0:
        return _UNKNOWN
    value = values[rows[slot], (x & 7) | (y & 7) << 3 | (z & 7) << 6]
    return _UNKNOWN if np.isnan(value) else (_OCCUPIED if value >= 0.0 else _FREE)


@njit(cache=True, nogil=True)
def cast(origins: Array, directions: Array, max_range_m: float, stop: bool, resolution: float, table: _I64, rows: _I32,
         values: _F32) -> tuple[NDArray[np.int8], Array, Array]:  # fmt: skip
    """Return outcome [N], range [N] and voxel centre [N, 3] of rays along unit directions."""
    count = len(origins)
    outcome, ranges = np.zeros(count, np.int8), np.full(count, max_range_m)
    centres = np.full((count, 3), np.nan)
    reach = max_range_m / resolution
    key, step = np.zeros(3, np.int64), np.zeros(3, np.int64)
    border, between = np.empty(3), np.empty(3)
    for n in range(count):
        for a in range(3):
            start, way = origins[n, a] * (1.0 / resolution), directions[n, a]
            key[a] = np.int64(np.floor(min(max(start, -1e9), 1e9))) + KEY_ORIGIN
            step[a] = 1 if way > 0.0 else (-1 if way < 0.0 else 0)
            between[a] = 1.0 / abs(way) if way != 0.0 else np.inf
            inside = start - np.floor(start)
            border[a] = (1.0 - inside if way > 0.0 else inside) * between[a] if way != 0.0 else np.inf
        travelled = 0.0
        while travelled <= reach:
            state = _state(key[0], key[1], key[2], table, rows, values)
            if state == _OCCUPIED or (stop and state == _UNKNOWN):
                outcome[n], ranges[n] = state, travelled * resolution
                for a in range(3):
                    centres[n, a] = (key[a] - KEY_ORIGIN + 0.5) * resolution
                break
            a = 0 if border[0] <= min(border[1], border[2]) else (1 if border[1] <= border[2] else 2)
            travelled = border[a]
            key[a] += step[a]
            border[a] += between[a]
            if (step[a] > 0 and key[a] >= _KEYS) or (step[a] < 0 and key[a] < 0):
                break  # leaves the key range for good
    return outcome, ranges, centres


@njit(cache=True, nogil=True)
def spheres(centres: Array, radius_m: float, resolution: float, table: _I64, rows: _I32,
            values: _F32) -> NDArray[np.int8]:  # fmt: skip
    """Return the state [N] of spheres."""
    out = np.zeros(len(centres), np.int8)
    radius = radius_m / resolution
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    c = np.empty(3)
    for n in range(len(centres)):
        for a in range(3):
            c[a] = centres[n, a] / resolution + KEY_ORIGIN
            low[a], high[a] = _cells(c[a] - radius, c[a] + radius)
        out[n] = _UNKNOWN if (low == high).any() else _FREE
        for z in range(low[2], high[2]):
            for y in range(low[1], high[1]):
                flat = _outside(c[1], y) ** 2 + _outside(c[2], z) ** 2
                for x in range(low[0], high[0]):
                    if _outside(c[0], x) ** 2 + flat >= radius * radius:
                        continue
                    state = _state(x, y, z, table, rows, values)
                    if state != _FREE:
                        out[n] = state
                        if state == _OCCUPIED:
                            break
                if out[n] == _OCCUPIED:
                    break
            if out[n] == _OCCUPIED:
                break
    return out


@njit(cache=True, nogil=True, inline="always")
def _outside(coordinate: float, cell: int) -> float:
    """Return the distance from a coordinate to a cell along one axis, 0 inside."""
    return max(cell - coordinate, coordinate - (cell + 1), 0.0)


@njit(cache=True, nogil=True, inline="always")
def _cells(low: float, high: float) -> tuple[int, int]:
    """Return the first and the one-past-last cell of an interval: one beyond the key range, none far outside."""
    if high < -1.0 or low > _KEYS + 1.0:
        return 0, 0
    return int(np.floor(max(low, -1.0))), int(np.ceil(min(high, _KEYS + 1.0)))


@njit(cache=True, nogil=True)
def _apart(d: Array, half: Array, R: Array) -> bool:
    """Return whether a box and the unit cube at offset `d` from its centre have a separating axis."""
    for i in range(3):
        along = abs(R[0, i] * d[0] + R[1, i] * d[1] + R[2, i] * d[2])
        if along >= half[i] + 0.5 * (abs(R[0, i]) + abs(R[1, i]) + abs(R[2, i])):
            return True
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for b in range(3):  # the axis e_i x R_b has the components -R[k, b] along j and R[j, b] along k
            length = abs(R[j, b]) + abs(R[k, b])
            if length < 1e-9:
                continue
            reach = 0.5 * length
            for c in range(3):
                reach += half[c] * abs(R[j, b] * R[k, c] - R[k, b] * R[j, c])
            if abs(R[j, b] * d[k] - R[k, b] * d[j]) >= reach:
                return True
    return False


@njit(cache=True, nogil=True)
def boxes(centres: Array, half_m: Array, R: Array, resolution: float, table: _I64, rows: _I32,
          values: _F32) -> NDArray[np.int8]:  # fmt: skip
    """Return the state [N] of turned boxes."""
    out = np.zeros(len(centres), np.int8)
    half = half_m / resolution
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    c, d = np.empty(3), np.empty(3)
    for n in range(len(centres)):
        for a in range(3):
            c[a] = centres[n, a] / resolution + KEY_ORIGIN
            reach = abs(R[n, a, 0]) * half[0] + abs(R[n, a, 1]) * half[1] + abs(R[n, a, 2]) * half[2]
            low[a], high[a] = _cells(c[a] - reach, c[a] + reach)
        out[n] = _UNKNOWN if (low == high).any() else _FREE
        for z in range(low[2], high[2]):
            for y in range(low[1], high[1]):
                for x in range(low[0], high[0]):
                    state = _state(x, y, z, table, rows, values)
                    if state == _FREE or state == out[n]:
                        continue
                    d[0], d[1], d[2] = x + 0.5 - c[0], y + 0.5 - c[1], z + 0.5 - c[2]
                    if not _apart(d, half, R[n]):
                        out[n] = state
                        if state == _OCCUPIED:
                            break
                if out[n] == _OCCUPIED:
                    break
            if out[n] == _OCCUPIED:
                break
    return out


@njit(cache=True, nogil=True)
def _square_apart(corners: Array, x: int, y: int) -> bool:
    """Return whether a convex polygon and the unit square at a cell are separated by one of the polygon's edges."""
    for i in range(len(corners)):
        j = (i + 1) % len(corners)
        nx, ny = corners[j, 1] - corners[i, 1], corners[i, 0] - corners[j, 0]
        least, most = np.inf, -np.inf
        for k in range(len(corners)):
            along = nx * (corners[k, 0] - x) + ny * (corners[k, 1] - y)
            least, most = min(least, along), max(most, along)
        if max(nx, 0.0) + max(ny, 0.0) <= least or min(nx, 0.0) + min(ny, 0.0) >= most:
            return True
    return False


@njit(cache=True, nogil=True)
def footprints(poses: Array, polygon: Array, low_m: float, high_m: float, resolution: float, table: _I64, rows: _I32,
               values: _F32) -> NDArray[np.int8]:  # fmt: skip
    """Return the state [N] of an upright prism at planar poses."""
    out = np.zeros(len(poses), np.int8)
    corners = np.empty_like(polygon)
    bottom, top = _cells(low_m / resolution + KEY_ORIGIN, high_m / resolution + KEY_ORIGIN)
    for n in range(len(poses)):
        cosine, sine = np.cos(poses[n, 2]), np.sin(poses[n, 2])
        for k in range(len(polygon)):
            corners[k, 0] = (cosine * polygon[k, 0] - sine * polygon[k, 1] + poses[n, 0]) / resolution + KEY_ORIGIN
            corners[k, 1] = (sine * polygon[k, 0] + cosine * polygon[k, 1] + poses[n, 1]) / resolution + KEY_ORIGIN
        left, right = _cells(corners[:, 0].min(), corners[:, 0].max())
        near, far = _cells(corners[:, 1].min(), corners[:, 1].max())
        out[n] = _UNKNOWN if bottom == top or left == right or near == far else _FREE
        for y in range(near, far):
            for x in range(left, right):
                if _square_apart(corners, x, y):
                    continue
                for z in range(bottom, top):
                    state = _state(x, y, z, table, rows, values)
                    if state != _FREE:
                        out[n] = state
                        if state == _OCCUPIED:
                            break
                if out[n] == _OCCUPIED:
                    break
            if out[n] == _OCCUPIED:
                break
    return out


@njit(cache=True, nogil=True)
def _is_frontier(x: int, y: int, z: int, table: _I64, rows: _I32, values: _F32) -> bool:
    return (
        _state(x - 1, y, z, table, rows, values) == _UNKNOWN
        or _state(x + 1, y, z, table, rows, values) == _UNKNOWN
        or _state(x, y - 1, z, table, rows, values) == _UNKNOWN
        or _state(x, y + 1, z, table, rows, values) == _UNKNOWN
        or _state(x, y, z - 1, table, rows, values) == _UNKNOWN
        or _state(x, y, z + 1, table, rows, values) == _UNKNOWN
    )


@njit(cache=True, nogil=True)
def _search_block(block: tuple[int, int, int], p: Array, best: float, frontier: bool, found: _I64, table: _I64,
                  rows: _I32, values: _F32) -> float:  # fmt: skip
    """Return the squared distance of the nearest wanted voxel nearer than `best`, and its key in `found`."""
    bx, by, bz = block
    slot = find_slot(table, pack_block(bx, by, bz))
    if table[slot] < 0:
        return best
    voxels = values[rows[slot]]
    for i in range(512):
        value = voxels[i]
        if np.isnan(value) or (value >= 0.0) == frontier:
            continue
        x, y, z = 8 * bx + (i & 7), 8 * by + ((i >> 3) & 7), 8 * bz + (i >> 6)
        squared = _outside(p[0], x) ** 2 + _outside(p[1], y) ** 2 + _outside(p[2], z) ** 2
        if squared < best and (not frontier or _is_frontier(x, y, z, table, rows, values)):
            best = squared
            found[0], found[1], found[2] = x, y, z
    return best


@njit(cache=True, nogil=True)
def nearest(points: Array, window_m: float, frontier: bool, resolution: float, table: _I64, rows: _I32,
            values: _F32) -> tuple[Array, Array]:  # fmt: skip
    """Return distance [N] and voxel centre [N, 3] of the nearest occupied or frontier voxel, shell by shell."""
    distances, centres = np.full(len(points), np.inf), np.full((len(points), 3), np.nan)
    p, found = np.empty(3), np.zeros(3, np.int64)
    window = window_m / resolution
    shells = int(min(window, 2.0 * _KEYS) / 8.0) + 2
    for n in range(len(points)):
        margin = 8.0  # to the nearest face of the point's own block
        for a in range(3):
            p[a] = points[n, a] / resolution + KEY_ORIGIN
            margin = min(margin, p[a] - 8.0 * np.floor(p[a] / 8.0), 8.0 * np.floor(p[a] / 8.0) + 8.0 - p[a])
        if max(abs(p[0]), abs(p[1]), abs(p[2])) > 4.0 * _KEYS:
            continue
        ox, oy, oz = int(np.floor(p[0] / 8.0)), int(np.floor(p[1] / 8.0)), int(np.floor(p[2] / 8.0))
        best = np.nextafter(window * window, np.inf)  # a voxel at exactly the window's border is within
        found[0] = -1
        for shell in range(shells):
            if shell > 0 and (8.0 * (shell - 1) + margin) ** 2 >= best:
                break
            for bz in range(max(oz - shell, 0), min(oz + shell, _KEYS // 8 - 1) + 1):
                for by in range(max(oy - shell, 0), min(oy + shell, _KEYS // 8 - 1) + 1):
                    face = abs(bz - oz) == shell or abs(by - oy) == shell
                    for bx in range(ox - shell, ox + shell + 1, 1 if face or shell == 0 else 2 * shell):
                        if bx < 0 or bx >= _KEYS // 8:
                            continue
                        away = _block_gap(p[0], bx) ** 2 + _block_gap(p[1], by) ** 2 + _block_gap(p[2], bz) ** 2
                        if away < best:
                            best = _search_block((bx, by, bz), p, best, frontier, found, table, rows, values)
        if found[0] >= 0:
            distances[n] = np.sqrt(best) * resolution
            for a in range(3):
                centres[n, a] = (found[a] - KEY_ORIGIN + 0.5) * resolution
    return distances, centres


@njit(cache=True, nogil=True, inline="always")
def _block_gap(coordinate: float, block: int) -> float:
    return max(8.0 * block - coordinate, coordinate - 8.0 * (block + 1), 0.0)
