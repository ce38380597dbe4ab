"""What a mesh is given after fusion, so that it is fit to show: small holes are filled, and flat surfaces are flat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.distance import pdist

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.mesh.edges import edges_of

if TYPE_CHECKING:
    from vislam.mapping.cloud.mesh import Mesh

_HOLE_M, _MOST_EDGES = 0.1, 100  # across and around; larger ones may be openings
_SEEN_THROUGH = 0.2  # share of a hole's triangles that lie in free space, by which it is an opening
_SMALLEST_PLANE_M = 0.2  # both sides; what is narrower may be curved
_MOST_PLANE_POINTS = 200_000  # that planes are looked for among
_ROUNDS = 2  # each among what the ones before left: what bends is several planes
_NEIGHBOURS = 20  # of a point, by which they are found
_SLAB = 0.02  # share of a plane's longer side within which vertices belong to it: depth and poses bend large ones
_FACING = 0.8  # cosine between their normals and its: not what stands on it or is cluttered
_CELL_M = 0.05  # of the grid on a plane, in which they are averaged ...
_BLUR_CELLS = 4.0  # ... over as many cells, a Gaussian's sigma: what is wider is a bend of depth and poses
_PASSES = 6
_SIGMA_M, _MOST_SIGMA_M = 0.001, 0.003  # of noise of vertices, that is looked for
_OF_MEAN = 1.46  # sigma by the mean distance under these weights
_MOST_SIGMAS = 1.5  # noise at a place by that of the whole plane; more is relief
_NOISE_SIGMAS, _RELIEF_SIGMAS = 2.5, 5.0  # what is off by less is noise, by more is relief


def filled(mesh: Mesh, is_open: Callable[[NDArray[np.float32]], NDArray[np.bool_]]) -> Mesh:
    """Return the mesh with its holes of up to 10 cm across closed by triangles of least area, the last ones.

    After Barequet and Sharir, "Filling gaps in the boundary of a polyhedron", 1995. Those that pass through free space
    stay: `is_open` returns whether rays passed at places [N, 3].
    """
    loops = [loop for loop in _loops(mesh.triangles) if 3 <= len(loop) <= _MOST_EDGES]
    parts = []
    for loop in loops:
        points = mesh.points_m[loop].astype(np.float64)
        if pdist(points).max() <= _HOLE_M:
            parts.append(np.asarray(loop, np.int32)[_least_area(points)])
    if not parts:
        return mesh
    new = np.concatenate(parts)
    hole = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    free = np.bincount(hole, is_open(mesh.points_m[new].mean(axis=1)))
    new = new[(free <= _SEEN_THROUGH * np.bincount(hole))[hole]]
    return replace(mesh, triangles=np.concatenate([mesh.triangles, new]), filled=len(new))


def _loops(triangles: NDArray[np.int32]) -> list[list[int]]:
    """Return the vertices of each closed border, none of them twice, in the winding of what would close it."""
    there = edges_of(triangles, directed=True)
    back = (there & 0xFFFFFFFF) << 32 | there >> 32
    after: dict[int, list[int]] = {}
    for a, b in (divmod(edge, 1 << 32) for edge in np.sort(back[~np.isin(back, there)]).tolist()):
        after.setdefault(a, []).append(b)
    out = []
    for start in sorted(after):
        path, places = [start], {start: 0}
        while after.get(path[-1]):
            vertex = after[path[-1]].pop(0)
            if vertex in places:  # what came since then is a loop of its own
                first = places[vertex]
                out.append(path[first:])
                for passed in path[first + 1 :]:
                    del places[passed]
                path = path[: first + 1]
            else:
                places[vertex] = len(path)
                path.append(vertex)
    return out


@njit(cache=True, nogil=True)
def _least_area(points: Array) -> NDArray[np.int64]:
    """Return the triangles [N - 2, 3] that close a loop of points [N, 3] with the least area."""
    n = len(points)
    total, middle = np.zeros((n, n)), np.zeros((n, n), np.int64)
    for span in range(2, n):
        for i in range(n - span):
            j = i + span
            total[i, j] = np.inf
            for k in range(i + 1, j):
                ux, uy, uz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
                vx, vy, vz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
                x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                area = total[i, k] + total[k, j] + np.sqrt(x * x + y * y + z * z)
                if area < total[i, j]:
                    total[i, j], middle[i, j] = area, k
    out, count, todo = np.zeros((n - 2, 3), np.int64), 0, [(0, n - 1)]
    while len(todo) > 0:
        i, j = todo.pop()
        if j - i > 1:
            k = middle[i, j]
            out[count, 0], out[count, 1], out[count, 2] = i, k, j
            count += 1
            todo.append((i, k))
            todo.append((k, j))
    return out


def flattened(open3d: Any, mesh: Mesh) -> Mesh:
    """Return the mesh with the noise of vertices near planes removed: each is drawn along the plane's normal.

    Planes are found by Araujo and Oliveira, "A robust statistics approach for plane detection in unorganized point
    clouds", Pattern Recognition 2020, of Open3D. A vertex is drawn to the mean of those of the plane around it, and the
    less so the less its distance is noise.
    """
    points, normals = mesh.points_m.astype(np.float64), _normals(mesh)
    near = open3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS)
    out, is_left = points.copy(), np.ones(len(points), np.bool_)
    for _ in range(_ROUNDS):
        some = np.flatnonzero(is_left)
        some = some[:: 1 + len(some) // _MOST_PLANE_POINTS]
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[some]))
        cloud.normals = open3d.utility.Vector3dVector(normals[some])
        planes = cloud.detect_planar_patches(min_plane_edge_length=_SMALLEST_PLANE_M, search_param=near)
        for plane in sorted(planes, key=lambda box: (-box.extent[0] * box.extent[1], *box.center)):
            R, slab_m = np.asarray(plane.R), _SLAB * max(plane.extent[:2])
            if min(plane.extent[:2]) < _SMALLEST_PLANE_M:
                continue
            local = (points - plane.center) @ R
            inside = (np.abs(local) < np.array([*(0.5 * plane.extent[:2] + _CELL_M), slab_m])).all(axis=1)
            here = np.flatnonzero(is_left & inside & (np.abs(normals @ R[:, 2]) > _FACING))
            if len(here):
                step = _noise(local[here], slab_m)
                out[here] -= step[:, None] * R[:, 2]
                is_left[here[step != 0.0]] = False
    return replace(mesh, points_m=out.astype(np.float32))


def _noise(local: Array, slab_m: float) -> Array:
    """Return what of the heights over a plane [N] is noise, of points [N, 3] in its frame, within `slab_m`."""
    cells = (local[:, :2] - local[:, :2].min(axis=0)) / _CELL_M
    rows, columns = np.floor(cells.max(axis=0)).astype(np.int64) + 1
    index = np.floor(cells).astype(np.int64) @ [columns, 1]

    def around(values: Array, weight: Array) -> Array:
        both = [np.bincount(index, w, rows * columns).reshape(rows, columns) for w in (values * weight, weight)]
        total, often = (cv2.GaussianBlur(grid, (0, 0), _BLUR_CELLS, borderType=cv2.BORDER_CONSTANT) for grid in both)
        mean = total / np.maximum(often, 1e-9)
        return np.asarray(map_coordinates(mean, cells.T - 0.5, order=1, mode="nearest"))

    height, weight = local[:, 2], np.ones(len(local))
    for _ in range(_PASSES):
        off = height - around(height, weight)
        most = np.clip(_MOST_SIGMAS * 1.4826 * float(np.median(np.abs(off))), _SIGMA_M, _MOST_SIGMA_M)
        sigma = np.clip(_OF_MEAN * around(np.abs(off), weight), _SIGMA_M, most)
        weight = 1.0 / (1.0 + (0.5 * off / sigma) ** 2)
    share = (_RELIEF_SIGMAS - np.abs(off) / sigma) / (_RELIEF_SIGMAS - _NOISE_SIGMAS)
    inner = 2.0 - 2.0 * np.abs(height) / slab_m  # what crosses the slab gets no step where it leaves
    return np.asarray(off * np.clip(share, 0.0, 1.0) * np.clip(inner, 0.0, 1.0))


def _normals(mesh: Mesh) -> Array:
    """Return normals [N, 3] of vertices, averaged with their neighbours'."""
    corners = mesh.points_m.astype(np.float64)[mesh.triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for _ in range(2):
        out = np.zeros((len(mesh.points_m), 3))
        for axis in range(3):
            for k in range(3):
                out[:, axis] += np.bincount(mesh.triangles[:, k], area[:, axis], len(out))
        area = out[mesh.triangles].sum(axis=1)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
