"""Coloured triangle meshes: of signed distances that views are fused into, or of surfels.

The order of Open3D's vertices depends on its threads, so they are sorted: same input, same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.geometry import invert
from vislam.mapping._open3d import load_open3d
from vislam.mapping.cloud.surfels import Surfels
from vislam.mapping.mesh.mended import filled, flattened
from vislam.mapping.mesh.posed import PosedView
from vislam.mapping.mesh.volume import Volume

_COARSER = 1.25  # a mesh that gets too large gets voxels larger by this
_MIN_POISSON_POINTS = 100
_NEAR_RADII = 4.0  # of the nearest surfel; a surface farther from any is a guess


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with coloured vertices in the map frame."""

    points_m: NDArray[np.float32]  # [N, 3]
    colors: NDArray[np.uint8]  # [N, 3] RGB
    triangles: NDArray[np.int32]  # [M, 3] counter-clockwise from outside
    filled: int = 0  # of the last triangles, how many close holes, where nothing was seen

    def select(self, chosen: NDArray[np.bool_]) -> Mesh:
        """Return the chosen triangles [M] with the points that they have, in the same order."""
        used, triangles = np.unique(self.triangles[chosen], return_inverse=True)
        left = int(chosen[len(chosen) - self.filled :].sum())
        return Mesh(self.points_m[used], self.colors[used], triangles.reshape(-1, 3).astype(np.int32), left)


def fuse_mesh(
    views: Callable[[], Iterable[PosedView]], voxel_m: float, max_blocks: int,
    is_false: Callable[[Volume, NDArray[np.float32]], NDArray[np.bool_]] | None = None,
) -> tuple[Mesh | None, str]:  # fmt: skip
    """Return the mesh of views, and an empty string; or None and the reason there is none.

    Triangles with a vertex where `is_false`, given the volume and vertices [N, 3], finds no surface, are left out.
    Small holes are filled, and flat surfaces are flat. When the mesh takes more than `max_blocks` of voxels, the views
    are asked for again, and voxels are larger.
    """
    open3d, reason = load_open3d()
    if open3d is None:
        return None, reason
    while (volume := _fused(open3d, views(), voxel_m, max_blocks)) is None:
        voxel_m *= _COARSER
    if volume.blocks == 0:
        return None, "no keyframe has dense depth"
    surface = volume.triangles()
    if surface is None:
        return None, "the depth of keyframes makes no surface"
    points, colors, triangles = surface
    mesh = _sorted(points, np.clip(np.round(colors * 255.0), 0, 255).astype(np.uint8), triangles)
    if is_false is not None:
        mesh = mesh.select(np.asarray(~is_false(volume, mesh.points_m)[mesh.triangles].any(axis=1)))
    if len(mesh.triangles) == 0:
        return None, "later rays passed through every surface that was seen"

    def is_open(places: NDArray[np.float32]) -> NDArray[np.bool_]:
        free = volume.is_free(places)
        return free if is_false is None else free | is_false(volume, places)

    return flattened(open3d, filled(mesh, is_open)), ""


def _fused(open3d: Any, views: Iterable[PosedView], voxel_m: float, max_blocks: int) -> Volume | None:
    """Return the volume of all views, None when it gets too large."""
    volume = Volume(open3d, voxel_m)
    for view in views:
        volume.add(view.depth_m, view.colors, view.K, invert(view.T_map_view), view.max_range_m)
        if volume.blocks > max_blocks:
            return None
    return volume


def poisson_mesh(surfels: Surfels, depth: int) -> tuple[Mesh | None, str]:
    """Return the closed surface that fits surfels best, and an empty string; or None and the reason there is none.

    Screened Poisson reconstruction (Kazhdan and Hoppe, ACM Transactions on Graphics 2013) on an octree of `depth`
    levels, by Open3D, cut away where no surfel is near: there it closes holes by guessing.
    """
    open3d, reason = load_open3d()
    if open3d is None:
        return None, reason
    if len(surfels) < _MIN_POISSON_POINTS:
        return None, f"{len(surfels)} surfels are too few for a surface"
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(surfels.points_m.astype(np.float64)))
    cloud.normals = open3d.utility.Vector3dVector(surfels.normals.astype(np.float64))
    cloud.colors = open3d.utility.Vector3dVector(surfels.colors.astype(np.float64) / 255.0)
    # one thread: its sums depend on how the work is split
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    distance, nearest = cKDTree(surfels.points_m).query(np.asarray(mesh.vertices))
    mesh.remove_vertices_by_mask(np.asarray(distance) > _NEAR_RADII * surfels.radius_m[nearest])
    colors = np.clip(np.round(np.asarray(mesh.vertex_colors) * 255.0), 0, 255).astype(np.uint8)
    return _sorted(np.asarray(mesh.vertices, dtype=np.float32), colors, np.asarray(mesh.triangles, dtype=np.int64)), ""


def _sorted(points: NDArray[np.float32], colors: NDArray[np.uint8], triangles: NDArray[np.int64]) -> Mesh:
    """Return the mesh with vertices in order of x, y, z and triangles in order of their vertices."""
    order = np.lexsort(points.T[::-1])
    place = np.empty(len(points), np.int64)
    place[order] = np.arange(len(points))
    faces = place[triangles]
    turn = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3  # smallest first keeps the winding
    faces = np.take_along_axis(faces, turn, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    return Mesh(points[order].astype(np.float32), colors[order], faces.astype(np.int32))
