"""Signed distances in blocks of voxels, to which every view of a surface adds its own by how well it knows it.

Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996. Blocks and the
extraction of triangles are Open3D's (Dong et al., "ASH: a modern framework for parallel spatial hashing", 2021). What
is added is ours: Open3D gives all views the same weight, whatever their range and angle, takes a distance along the
ray for one from the surface, and reads depth at the nearest pixel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array, ImageU8

F32 = NDArray[np.float32]

_BLOCK = 8  # voxels along each side
_FIRST_BLOCKS = 4096  # grows by itself
_TRUNCATION_VOXELS = 4.0
_TRUNCATION_SIGMAS = 3.0  # of depth; a wall that is measured twice, so far apart, is one surface
_MOST_TRUNCATION_VOXELS = 8.0  # more, and what is behind thin things is lost, and memory grows
_SIGMA_1M = 0.0025  # of depth from structured light at one metre; it grows with the square of depth
_MIN_FACING = 0.15  # cosine between ray and surface; a more grazing ray is taken for this
_SIDES_RATIO = 0.02  # neighbouring pixels of one surface differ by less than this share of depth
_BEHIND_SHARE = 0.5  # of the weight, behind the surface at the end of the truncation: what is there is unseen
_MAX_WEIGHT = 1e4
_FREE_VOXELS = 2.0  # before the nearest surface that was seen


class _Image(NamedTuple):
    """One view."""

    depth_m: F32  # [h, w], 0 where none
    facing: F32  # [h, w] cosine between ray and surface, 0 where there is no depth
    colors: ImageU8  # [h, w, 3]


class _Camera(NamedTuple):
    """Where it looks."""

    K: Array  # [3, 3]
    T_view_map: Array  # [4, 4]
    max_range_m: float


class _Grid(NamedTuple):
    """Voxels of the blocks that may change, flat: x fastest."""

    keys: NDArray[np.int32]  # [M, 3]
    rows: NDArray[np.int32]  # [M] of the arrays below
    distance_m: F32  # [N, 512]
    weight: F32  # [N, 512]
    color: F32  # [N, 512, 3] from 0 to 255
    views: F32  # [N, 512]


class Volume:
    """The voxels near the surfaces that were seen."""

    def __init__(self, open3d: Any, voxel_m: float) -> None:
        """Prepare an empty volume of voxels with edges of `voxel_m`; `open3d` is the loaded module."""
        self.voxel_m = voxel_m
        self._open3d, self._core = open3d, open3d.core
        one = self._core.float32
        self._grid = open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color", "views"), (one, one, one, one), ((1), (1), (3), (1)),
            voxel_m, _BLOCK, _FIRST_BLOCKS, self._core.Device("CPU:0"),
        )  # fmt: skip

    @property
    def blocks(self) -> int:
        """Blocks in use, of 12 kB each."""
        return int(self._grid.hashmap().size())

    def add(self, depth_m: F32, colors: ImageU8, K: Array, T_view_map: Array, max_range_m: float) -> None:
        """Take in a view: depth [h, w], 0 where none, and colours [h, w, 3], of a pinhole camera."""
        if not depth_m.any():
            return
        depth_m, T = np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(T_view_map, dtype=np.float64)
        K = np.ascontiguousarray(K, dtype=np.float64)
        keys = self._touched(depth_m, K, T, max_range_m)
        if len(keys) == 0:
            return
        hashmap, tensor = self._grid.hashmap(), self._core.Tensor(keys)
        hashmap.activate(tensor)
        rows = hashmap.find(tensor)[0].numpy()
        image = _Image(depth_m, facing(depth_m, K), np.ascontiguousarray(colors))
        _add(image, _Camera(K, T, max_range_m), _Grid(keys, rows, *self._arrays()), self.voxel_m)

    def _touched(self, depth_m: F32, K: Array, T_view_map: Array, max_range_m: float) -> NDArray[np.int32]:
        """Return the blocks [M, 3] that a view changes, in order."""
        tensor = self._core.Tensor
        reach = _reach_m(min(float(depth_m.max()), max_range_m), self.voxel_m) / self.voxel_m
        keys = self._grid.compute_unique_block_coordinates(
            self._open3d.t.geometry.Image(tensor(depth_m)), tensor(K), tensor(T_view_map), 1.0, max_range_m, reach
        ).numpy()
        return np.ascontiguousarray(keys[np.lexsort(keys.T[::-1])])

    def triangles(self) -> tuple[F32, F32, NDArray[np.int64]] | None:
        """Return vertices [N, 3], colours [N, 3] from 0 to 1 and triangles [M, 3], None where there are none.

        Their order is left to chance.
        """
        mesh = self._grid.extract_triangle_mesh(weight_threshold=0.0)
        if "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
            return None
        return mesh.vertex.positions.numpy(), mesh.vertex.colors.numpy(), mesh.triangle.indices.numpy()

    def views_of(self, points_m: F32) -> NDArray[np.int64]:
        """Return how many views [N] the voxels nearest to points [N, 3] have, 0 outside of all blocks."""
        return self._nearest(points_m, self._arrays()[3]).astype(np.int64)

    def is_free(self, points_m: F32) -> NDArray[np.bool_]:
        """Return whether views saw the voxels nearest to points [N, 3] well before any surface."""
        return self._nearest(points_m, self._arrays()[0]) > _FREE_VOXELS * self.voxel_m

    def _nearest(self, points_m: F32, values: F32) -> F32:
        """Return the value [N] of the voxels [M, 512] nearest to points [N, 3], 0 outside of all blocks."""
        voxels = np.round(points_m.astype(np.float64) / self.voxel_m).astype(np.int64)
        block, inside = voxels // _BLOCK, voxels % _BLOCK
        keys, of_key = np.unique(block, axis=0, return_inverse=True)
        rows, found = self._grid.hashmap().find(self._core.Tensor(np.ascontiguousarray(keys, np.int32)))
        is_known = found.numpy()[of_key.ravel()]
        row = np.where(is_known, rows.numpy()[of_key.ravel()], 0)
        index = inside @ np.array([1, _BLOCK, _BLOCK * _BLOCK])
        return np.where(is_known, values[row, index], np.float32(0.0))

    def _arrays(self) -> tuple[F32, F32, F32, F32]:
        shared = {name: self._grid.attribute(name).numpy() for name in ("tsdf", "weight", "color", "views")}
        flat = {name: array.reshape(len(array), _BLOCK**3, -1) for name, array in shared.items()}
        return flat["tsdf"][..., 0], flat["weight"][..., 0], flat["color"], flat["views"][..., 0]


@njit(cache=True, nogil=True)
def _reach_m(depth_m: float, voxel_m: float) -> float:
    """Return how far from a measured surface a voxel learns something."""
    noise_m = _TRUNCATION_SIGMAS * _SIGMA_1M * depth_m * depth_m
    return min(max(_TRUNCATION_VOXELS * voxel_m, noise_m), _MOST_TRUNCATION_VOXELS * voxel_m)


@njit(cache=True, nogil=True)
def facing(depth_m: F32, K: Array) -> F32:
    """Return the cosine [h, w] between ray and surface; where it is not known, the least that is used."""
    rows, columns = depth_m.shape
    out = np.zeros((rows, columns), np.float32)
    for v in range(rows):
        for u in range(columns):
            z = depth_m[v, u]
            if z <= 0.0:
                continue
            out[v, u] = _MIN_FACING
            left, right, up, down = max(u - 1, 0), min(u + 1, columns - 1), max(v - 1, 0), min(v + 1, rows - 1)
            west, east, north, south = depth_m[v, left], depth_m[v, right], depth_m[up, u], depth_m[down, u]
            if min(west, east, north, south) <= 0.0:
                continue
            # of a plane ix X + iy Y + iz Z = 1: inverse depth is linear in the pixel
            ix = (1.0 / east - 1.0 / west) / max(right - left, 1) * K[0, 0]
            iy = (1.0 / south - 1.0 / north) / max(down - up, 1) * K[1, 1]
            x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
            iz = 1.0 / z - ix * x - iy * y
            length = np.sqrt(ix * ix + iy * iy + iz * iz) * np.sqrt(x * x + y * y + 1.0)
            out[v, u] = max(min(1.0 / z / length, 1.0), _MIN_FACING)
    return out


@njit(cache=True, nogil=True, inline="always")
def _between(image: F32, u: float, v: float, nearest: float) -> float:
    """Return depth between four pixels that lie on one surface, else that of the nearest."""
    i, j = int(np.floor(v)), int(np.floor(u))
    if i < 0 or j < 0 or i + 1 >= image.shape[0] or j + 1 >= image.shape[1]:
        return nearest
    a, b, c, d = image[i, j], image[i, j + 1], image[i + 1, j], image[i + 1, j + 1]
    low = min(a, b, c, d)
    if low <= 0.0 or max(a, b, c, d) - low > _SIDES_RATIO * 2.0 * nearest:
        return nearest
    s, t = u - j, v - i
    return (1.0 - t) * ((1.0 - s) * a + s * b) + t * ((1.0 - s) * c + s * d)


@njit(cache=True, nogil=True)
def _add(image: _Image, camera: _Camera, grid: _Grid, voxel_m: float) -> None:
    K, T, max_range = camera
    rows, columns = image.depth_m.shape
    for block in range(len(grid.keys)):
        row = grid.rows[block]
        for index in range(_BLOCK**3):
            x = (grid.keys[block, 0] * _BLOCK + index % _BLOCK) * voxel_m
            y = (grid.keys[block, 1] * _BLOCK + (index // _BLOCK) % _BLOCK) * voxel_m
            z = (grid.keys[block, 2] * _BLOCK + index // (_BLOCK * _BLOCK)) * voxel_m
            view_z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if view_z <= 0.0:
                continue
            u = K[0, 0] * (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / view_z + K[0, 2]
            v = K[1, 1] * (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / view_z + K[1, 2]
            i, j = int(np.floor(v + 0.5)), int(np.floor(u + 0.5))
            if i < 0 or j < 0 or i >= rows or j >= columns:
                continue
            depth = image.depth_m[i, j]
            if depth <= 0.0 or depth > max_range:
                continue
            depth = _between(image.depth_m, u, v, depth)
            ray_x, ray_y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
            # along the ray, and from there to the plane of the surface
            distance = (depth - view_z) * np.sqrt(ray_x * ray_x + ray_y * ray_y + 1.0) * image.facing[i, j]
            reach = _reach_m(depth, voxel_m)
            if distance < -reach:
                continue
            weight = image.facing[i, j] / max(depth, 0.5) ** 4
            if distance < 0.0:
                weight *= 1.0 + (1.0 - _BEHIND_SHARE) * distance / reach
            distance = min(distance, reach)
            old = grid.weight[row, index]
            share = weight / (old + weight)
            grid.distance_m[row, index] += share * (distance - grid.distance_m[row, index])
            for c in range(3):
                grid.color[row, index, c] += share * (image.colors[i, j, c] - grid.color[row, index, c])
            grid.weight[row, index] = min(old + weight, _MAX_WEIGHT)
            grid.views[row, index] += 1.0
