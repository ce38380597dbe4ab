"""Coloured triangle mesh: truncated signed distances fused by Open3D's voxel block grid.

Curless and Levoy, "A volumetric method for building complex models from range images", SIGGRAPH 1996; blocks and
extraction as in Dong et al., "ASH: a modern framework for parallel spatial hashing", 2021. The order of Open3D's
vertices depends on its threads, so they are sorted: same input, same bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.mapping._open3d import load_open3d
from vislam.mapping.cloud.store import Scan
from vislam.mapping.cloud.surfels import Surfels
from vislam.mapping.depth.image import DepthView

_BLOCK_VOXELS = 8
_FIRST_BLOCKS = 4096  # grows by itself
_TRUNCATION_VOXELS = 4.0
_MIN_POISSON_POINTS = 100
_NEAR_RADII = 4.0  # of the nearest surfel; a surface farther from any is a guess


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with coloured vertices in the map frame."""

    points_m: NDArray[np.float32]  # [N, 3]
    colors: NDArray[np.uint8]  # [N, 3] RGB
    triangles: NDArray[np.int32]  # [M, 3] counter-clockwise from outside


def fuse_mesh(
    scans: Iterable[tuple[Scan, Array]], view: DepthView, voxel_m: float, min_views: int
) -> tuple[Mesh | None, str]:
    """Return the mesh of scans with their T_map_body, and an empty string; or None and the reason there is none.

    A surface has to be seen by `min_views` scans.
    """
    open3d, reason = load_open3d()
    if open3d is None:
        return None, reason
    core = open3d.core
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32, core.float32, core.float32), ((1), (1), (3)),
        voxel_m, _BLOCK_VOXELS, _FIRST_BLOCKS, core.Device("CPU:0"),
    )  # fmt: skip
    K = core.Tensor(np.ascontiguousarray(view.K, dtype=np.float64))
    count = 0
    for scan, T_map_body in scans:
        if scan.depth is not None and scan.depth.any():
            _integrate(open3d, grid, K, scan, view, invert(T_map_body @ view.T_body_view))
            count += 1
    if count == 0:
        return None, "no keyframe has dense depth"
    mesh = grid.extract_triangle_mesh(weight_threshold=min_views - 1.0)  # one per scan, and more than that is asked for
    if "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
        return None, f"no surface was seen by enough keyframes ({min_views})"
    colors = np.clip(np.round(mesh.vertex.colors.numpy() * 255.0), 0, 255).astype(np.uint8)
    return _sorted(mesh.vertex.positions.numpy(), colors, mesh.triangle.indices.numpy()), ""


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


def _integrate(open3d: Any, grid: Any, K: Any, scan: Scan, view: DepthView, T_view_map: Array) -> None:
    depth, colors = scan.depth, scan.colors
    if view.to_pinhole is not None:
        depth = cv2.remap(depth, *view.to_pinhole, cv2.INTER_NEAREST)
        colors = cv2.remap(colors, *view.to_pinhole, cv2.INTER_LINEAR)
    depth_image = open3d.t.geometry.Image(open3d.core.Tensor(np.ascontiguousarray(depth, dtype=np.uint16)))
    color_image = open3d.t.geometry.Image(open3d.core.Tensor(np.ascontiguousarray(colors, dtype=np.uint8)))
    extrinsic = open3d.core.Tensor(np.ascontiguousarray(T_view_map, dtype=np.float64))
    scale = 1.0 / view.unit_m
    blocks = grid.compute_unique_block_coordinates(
        depth_image, K, extrinsic, scale, view.max_range_m, _TRUNCATION_VOXELS
    )
    grid.integrate(blocks, depth_image, color_image, K, K, extrinsic, scale, view.max_range_m, _TRUNCATION_VOXELS)


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
