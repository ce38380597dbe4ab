"""From a depth image to the points worth mapping: range limits, object borders, speckles, subsampling.

What survives is kept as a small 16-bit depth image on a fixed grid of rays, so that it can be stored in little space
and put anywhere later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig, MonoDepthConfig
from vislam.core.camera import Camera, Rig, StereoRectification
from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32

_EDGE_RATIO = 0.03  # a step to a neighbour pixel of more than this share of depth is an object's border


ImageU16 = NDArray[np.uint16]

_FINEST_UNIT_M = 0.0002  # that of TUM's depth images, which are kept exactly; 13 m in 16 bits
_CLEARING_VOXELS = 2  # a far point is pulled in to this far beyond the range limit: still beyond, and the box small


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """The rays along which stored depth images look, and how far their depth is trusted."""

    rays_body: ImageF32  # [h, w, 3] directions in the body frame, of z-depth 1; NaN where the camera model ends
    T_body_view: Array  # [4, 4] of the ideal camera that looks along the optical axis
    K: Array  # [3, 3] of that ideal camera
    to_pinhole: tuple[ImageF32, ImageF32] | None  # maps [h, w] for cv2.remap into it; None: the rays are a pinhole's
    unit_m: float  # of stored depth
    max_range_m: float  # along the ray; farther points only clear the way

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of stored depth images."""
        return self.rays_body.shape[1], self.rays_body.shape[0]


def rgbd_view(rig: Rig, config: MapConfig) -> DepthView:
    """Return the rays of every n-th pixel of cam0, distortion included."""
    camera, step = rig.cameras[0], config.pixel_step
    u, v = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    K = camera.K.copy()
    K[:2] /= step  # kept pixel i is pixel i * step of the camera
    maps = None
    if camera.distortion != "none":
        pixels = np.nan_to_num(camera.project(_pinhole_rays(K, (u.shape[1], u.shape[0]))) / step, nan=-1.0)
        grid = pixels.astype(np.float32).reshape(*u.shape, 2)
        maps = (np.ascontiguousarray(grid[..., 0]), np.ascontiguousarray(grid[..., 1]))
    T = np.array(rig.T_body_cams[0], dtype=np.float64)
    return DepthView(_turned(rays, T, u.shape), T, K, maps, _unit_m(config.max_range_m), config.max_range_m)


def stereo_view(rectification: StereoRectification, rig: Rig, config: MapConfig) -> DepthView:
    """Return the rays of the rectified left image; the range ends where the error of depth gets too large."""
    width, height = rectification.size
    T = np.array(rig.T_body_cams[0], dtype=np.float64)
    T[:3, :3] = T[:3, :3] @ rectification.R_rect_cam0.T
    # sigma_z = z^2 sigma_d / (f b)
    focal_baseline = rectification.K[0, 0] * rectification.baseline_m
    reach_m = float(np.sqrt(config.stereo_max_sigma_m * focal_baseline / config.stereo_disparity_sigma_px))
    max_range_m = min(reach_m, config.stereo_max_range_m)
    rays = _turned(_pinhole_rays(rectification.K, (width, height)), T, (height, width))
    return DepthView(rays, T, rectification.K, None, _unit_m(max_range_m), max_range_m)


def mono_camera(rig: Rig, config: MonoDepthConfig) -> Camera:
    """Return the camera without distortion whose images monocular depth is made of: cam0's at `config.scale`."""
    return replace(rig.cameras[0].scaled(config.scale), distortion="none", coefficients=(), skew_px=0.0)


def mono_view(rig: Rig, config: MonoDepthConfig) -> DepthView:
    """Return the rays of `mono_camera`."""
    camera = mono_camera(rig, config)
    T = np.array(rig.T_body_cams[0], dtype=np.float64)
    rays = _turned(_pinhole_rays(camera.K, (camera.width, camera.height)), T, (camera.height, camera.width))
    return DepthView(rays, T, camera.K, None, _unit_m(config.max_range_m), config.max_range_m)


def _pinhole_rays(K: Array, size: tuple[int, int]) -> Array:
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ np.linalg.inv(K).T


def _turned(rays: Array, T_body_view: Array, shape: tuple[int, ...]) -> ImageF32:
    return (rays @ T_body_view[:3, :3].T).astype(np.float32).reshape(*shape, 3)


def _unit_m(max_range_m: float) -> float:
    return max(_FINEST_UNIT_M, 1.25 * max_range_m / 65535.0)


def filter_depth(depth_m: ImageF32, step: int, view: DepthView, config: MapConfig) -> ImageU16:
    """Return the trusted depth on the view's grid in the view's units [h, w], 0 where there is none.

    Left out: depth that is not finite, nearer than `min_range_m`, within `edge_px` of a jump that is steeper than
    3 % per pixel (sensors smear objects' borders), or in a connected surface of fewer than `speckle_pixels`.
    Raises DataError when the image is not `step` times the view's size.
    """
    expected = tuple(-(-n // step) for n in depth_m.shape)
    if depth_m.ndim != 2 or expected != view.size[::-1]:
        raise DataError(
            f"depth image is {'x'.join(map(str, depth_m.shape[::-1]))} but the camera's is about "
            f"{view.size[0] * step}x{view.size[1] * step}; register depth to cam0 and give its calibration"
        )
    depth = np.ascontiguousarray(depth_m, dtype=np.float32)
    kept = _away_from_edges(depth, step, config.min_range_m, _EDGE_RATIO, config.edge_px, view.unit_m)
    # neighbours on the coarser grid lie `step` pixels apart, so a surface may step by as many times the ratio
    _remove_speckles(kept, _EDGE_RATIO * step, config.speckle_pixels)
    return np.asarray(kept)


@njit(cache=True, nogil=True)
def _away_from_edges(depth: ImageF32, step: int, min_depth: float, ratio: float, reach: int, unit: float) -> ImageU16:
    rows, columns = depth.shape
    out = np.zeros(((rows + step - 1) // step, (columns + step - 1) // step), np.uint16)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            z = depth[i * step, j * step]
            if z >= min_depth and z < np.inf:
                out[i, j] = np.uint16(min(np.floor(z / unit + 0.5), 65535.0))
    for gap in range(1, reach + 1):  # also across holes that are narrower than the border
        limit = np.float32(1.0 + ratio * gap)
        for v in range(rows):
            for u in range(columns):
                z = depth[v, u]
                if not (z > 0.0 and z < np.inf):
                    continue
                if u + gap < columns and _jumps(z, depth[v, u + gap], limit):
                    _blank(out, step, v, v, u + gap - reach, u + reach)
                if v + gap < rows and _jumps(z, depth[v + gap, u], limit):
                    _blank(out, step, v + gap - reach, v + reach, u, u)
    return out


@njit(cache=True, nogil=True, inline="always")
def _jumps(a: float, b: float, limit: float) -> bool:
    return b > 0.0 and b < np.inf and (b > a * limit or a > b * limit)


@njit(cache=True, nogil=True)
def _blank(out: ImageU16, step: int, top: int, bottom: int, left: int, right: int) -> None:
    """Zero the kept pixels in an inclusive box of full-size pixels."""
    for i in range((max(top, 0) + step - 1) // step, min(bottom // step, out.shape[0] - 1) + 1):
        for j in range((max(left, 0) + step - 1) // step, min(right // step, out.shape[1] - 1) + 1):
            out[i, j] = 0


@njit(cache=True, nogil=True)
def _root(parent: NDArray[np.int32], node: int) -> int:
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@njit(cache=True, nogil=True)
def _remove_speckles(depth: ImageU16, ratio: float, min_pixels: int) -> None:
    """Zero connected surfaces (4-neighbours, depth within the ratio) smaller than `min_pixels`, in place."""
    rows, columns = depth.shape
    parent = np.arange(rows * columns).astype(np.int32)
    for i in range(rows):
        for j in range(columns):
            z = float(depth[i, j])
            if z == 0.0:
                continue
            here = i * columns + j
            if j > 0 and depth[i, j - 1] != 0 and abs(float(depth[i, j - 1]) - z) <= ratio * z:
                parent[_root(parent, here)] = _root(parent, here - 1)
            if i > 0 and depth[i - 1, j] != 0 and abs(float(depth[i - 1, j]) - z) <= ratio * z:
                a, b = _root(parent, here), _root(parent, here - columns)
                parent[max(a, b)] = min(a, b)
    count = np.zeros(rows * columns, np.int32)
    for node in range(rows * columns):
        if depth[node // columns, node % columns] != 0:
            count[_root(parent, node)] += 1
    for node in range(rows * columns):
        i, j = node // columns, node % columns
        if depth[i, j] != 0 and count[_root(parent, node)] < min_pixels:
            depth[i, j] = 0


@njit(cache=True, nogil=True)
def _place(
    depth: ImageU16, unit: float, rays: ImageF32, R: Array, t: Array, max_range: float, beyond: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    rows, columns = depth.shape
    points = np.empty((rows * columns, 3), np.float32)
    pixels = np.empty(rows * columns, np.int32)
    count = 0
    for i in range(rows):
        for j in range(columns):
            if depth[i, j] == 0:
                continue
            z = depth[i, j] * unit
            x0, x1, x2 = rays[i, j, 0] * z, rays[i, j, 1] * z, rays[i, j, 2] * z
            distance = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
            if not distance < np.inf:
                continue
            if distance > max_range:
                if beyond <= 0.0:
                    continue
                shrink = beyond / distance
                x0, x1, x2 = x0 * shrink, x1 * shrink, x2 * shrink
            points[count, 0] = R[0, 0] * x0 + R[0, 1] * x1 + R[0, 2] * x2 + t[0]
            points[count, 1] = R[1, 0] * x0 + R[1, 1] * x1 + R[1, 2] * x2 + t[1]
            points[count, 2] = R[2, 0] * x0 + R[2, 1] * x1 + R[2, 2] * x2 + t[2]
            pixels[count] = i * columns + j
            count += 1
    return points[:count].copy(), pixels[:count].copy()


def surface_points(
    depth: ImageU16, view: DepthView, T_frame_body: Array
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return points [N, 3] within the trusted range, in the frame of `T_frame_body`, and their flat pixel [N]."""
    T = np.ascontiguousarray(T_frame_body, dtype=np.float64)
    origin = T[:3, :3] @ view.T_body_view[:3, 3] + T[:3, 3]
    points, pixels = _place(
        depth, view.unit_m, view.rays_body, np.ascontiguousarray(T[:3, :3]), origin, view.max_range_m, 0.0
    )
    return points, pixels


def scan_points(
    depth: ImageU16, view: DepthView, T_frame_body: Array, voxel_m: float
) -> tuple[NDArray[np.float32], Array]:
    """Return points [N, 3] and origin [3] for ray casting; points beyond the range are pulled in to just beyond it."""
    T = np.ascontiguousarray(T_frame_body, dtype=np.float64)
    origin = T[:3, :3] @ view.T_body_view[:3, 3] + T[:3, 3]
    beyond = view.max_range_m + _CLEARING_VOXELS * voxel_m
    points, _ = _place(
        depth, view.unit_m, view.rays_body, np.ascontiguousarray(T[:3, :3]), origin, view.max_range_m, beyond
    )
    return points, origin
