"""Pictures of maps for reports: a cloud, a mesh or an octree from above at an angle, with trajectories drawn in.

A parallel projection of points as discs into a depth buffer, shaded by eye-dome lighting (Boucheny 2009), which needs
depth alone and makes shapes readable. A report needs no viewer and no graphics driver.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.jit import njit
from vislam.core.messages import Array, ImageU8
from vislam.mapping.cloud.cloud import Cloud
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.octree import OctreeLeaves

SIZE = (1600, 900)  # width, height
_ELEVATION_RAD = np.deg2rad(50.0)
_MARGIN = 0.05  # of the picture's size, left free on each side
_FARTHEST_M = 1e6  # a point beyond is damage, and no picture could show it beside the others
_CEILING_ABOVE_PATH_M = 0.5
_WALL_HEIGHT_M = 1.8  # of walls that are left standing at least
_LARGEST_DISC_PX = 12
_SHADOW = 12.0  # strength per share of the scene's depth
_NOISE_M = 0.03  # steps of depth below it cast no shadow
_PALENESS = 0.15  # of the colours of height, so that shading and lines stand out
_HIDDEN_ALPHA = 0.3  # of a line behind a surface


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A path drawn into a picture, in the map frame."""

    points_m: Array  # [N, 3]
    color: tuple[int, int, int]  # RGB
    width_px: float = 2.5
    marks_ends: bool = True  # a ring at the start, a dot at the end


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A parallel projection: pixels are scale * (R @ p)[:2] + offset, depth is (R @ p)[2], larger farther away."""

    R: Array  # [3, 3]
    scale: float  # px per metre
    offset_px: Array  # [2]

    def see(self, points: NDArray[np.floating]) -> tuple[Array, Array]:
        """Return pixels [N, 2] and depth [N] in metres of points [N, 3]."""
        turned = np.asarray(points, dtype=np.float64) @ self.R.T
        return turned[:, :2] * self.scale + self.offset_px, turned[:, 2]


def render_cloud(cloud: Cloud, lines: Sequence[Line] = (), size: tuple[int, int] = SIZE) -> ImageU8:
    """Return the picture [H, W, 3] RGB of a coloured cloud; what is above the paths is cut away."""
    cloud = cloud.select(np.all(np.abs(cloud.points_m) < _FARTHEST_M, axis=1))  # NaN is not
    return _render(cloud.points_m, cloud.colors, _spacing_m(cloud.points_m), lines, size)


def render_mesh(mesh: Mesh, lines: Sequence[Line] = (), size: tuple[int, int] = SIZE) -> ImageU8:
    """Return the picture [H, W, 3] RGB of a coloured mesh, by its vertices; what is above the paths is cut away."""
    return render_cloud(Cloud(mesh.points_m, mesh.colors), lines, size)


def render_octree(octree: OctreeLeaves, lines: Sequence[Line] = (), size: tuple[int, int] = SIZE) -> ImageU8:
    """Return the picture [H, W, 3] RGB of an octree's occupied voxels, coloured by height."""
    centres = (octree.occupied_voxels() + 0.5) * octree.resolution_m
    return _render(centres, None, octree.resolution_m, lines, size)


def _render(
    points: NDArray[np.floating], colors: NDArray[np.uint8] | None, spacing_m: float, lines: Sequence[Line],
    size: tuple[int, int],
) -> ImageU8:  # fmt: skip
    paths = [line.points_m[np.isfinite(line.points_m).all(axis=1)] for line in lines]
    below = points[:, 2] <= _ceiling_m(paths, points)
    points = points[below]
    shown = _height_colors(points[:, 2]) if colors is None else colors[below]
    view = _framed(points, paths, size)
    pixels, depth_m = view.see(points)
    radius_px = min(max(0.75 * spacing_m * view.scale, 1.0), _LARGEST_DISC_PX)
    image, buffer_m = _splat(np.round(pixels).astype(np.int64), depth_m, shown, radius_px, size)
    image = _shaded(image, buffer_m)
    for line, path in zip(lines, paths, strict=True):
        image = _with_line(image, view, buffer_m, line, path)
    return image


def _ceiling_m(paths: Sequence[Array], points: NDArray[np.floating]) -> float:
    heights = [float(path[:, 2].max()) for path in paths if len(path)]
    if not heights or len(points) == 0:
        return np.inf
    floor = float(np.percentile(points[:: max(1, len(points) // 20000), 2], 1.0))
    return max(max(heights) + _CEILING_ABOVE_PATH_M, floor + _WALL_HEIGHT_M)


def _spacing_m(points: NDArray[np.floating]) -> float:
    """Return the usual distance from a point to its fourth neighbour."""
    if len(points) < 2:
        return 0.02
    distances, _ = cKDTree(points).query(points[:: max(1, len(points) // 2000)], k=min(5, len(points)))
    return max(float(np.median(np.asarray(distances)[:, -1])), 1e-3)


def _height_colors(heights: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return RGB [N, 3] of heights [N]: Google's turbo map over the inner 98 % of them."""
    if len(heights) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(heights, [1.0, 99.0])
    level = np.clip((heights - low) / max(high - low, 1e-6), 0.0, 1.0)
    shades = np.round(25 + 205 * level).astype(np.uint8)  # the map's ends are too dark to shade
    turbo = np.asarray(cv2.applyColorMap(shades[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1], dtype=np.float64)
    return (turbo + _PALENESS * (255.0 - turbo)).astype(np.uint8)


def _framed(points: NDArray[np.floating], paths: Sequence[Array], size: tuple[int, int]) -> _View:
    """Return the view in which the longer side of a map lies across the picture, as large as its borders allow."""
    parts = [np.asarray(path, dtype=np.float64) for path in paths]
    if len(points):
        some = np.asarray(points[:: max(1, len(points) // 5000)], dtype=np.float64)
        low, high = np.percentile(some, [0.1, 99.9], axis=0)
        parts.append(some[((some >= low) & (some <= high)).all(axis=1)])
    subject = np.concatenate(parts) if parts else np.zeros((0, 3))
    if len(subject) == 0:
        subject = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    flat = subject[:, :2] - subject[:, :2].mean(axis=0)
    axis = np.linalg.eigh(flat.T @ flat)[1][:, 1]
    right = np.append(axis if axis[0] > 0.0 else -axis, 0.0)
    ahead = np.array([-right[1], right[0], 0.0])
    forward = np.cos(_ELEVATION_RAD) * ahead - np.sin(_ELEVATION_RAD) * np.array([0.0, 0.0, 1.0])
    R = np.stack([right, np.cross(forward, right), forward])
    local = subject @ R.T[:, :2]
    low, high = local.min(axis=0), local.max(axis=0)
    scale = float(((1.0 - 2.0 * _MARGIN) * np.array(size) / np.maximum(high - low, 0.1)).min())
    return _View(R, scale, 0.5 * (np.array(size) - 1.0) - 0.5 * scale * (low + high))


def _splat(
    pixels: NDArray[np.int64], depth_m: Array, colors: NDArray[np.uint8], radius_px: float, size: tuple[int, int]
) -> tuple[ImageU8, Array]:
    """Return the picture and depth [H, W] of points drawn as discs, the nearest on top; depth is infinite elsewhere."""
    reach = int(radius_px)
    offsets = np.argwhere(np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= radius_px) - reach
    inside = ((pixels >= reach) & (pixels < np.array(size) - reach)).all(axis=1)
    image, buffer_m = np.full((*size[::-1], 3), 255, np.uint8), np.full(size[::-1], np.inf)
    _draw_discs(np.ascontiguousarray(pixels[inside]), offsets, depth_m[inside], colors[inside], image, buffer_m)
    return image, buffer_m


@njit(cache=True, nogil=True)
def _draw_discs(
    pixels: NDArray[np.int64], offsets: NDArray[np.int64], depth_m: Array, colors: NDArray[np.uint8], image: ImageU8,
    buffer_m: Array,
) -> None:  # fmt: skip
    """Draw points [N] as discs of `offsets` [n, 2], down and across, into depth first, then where each is nearest."""
    for k in range(len(offsets)):
        for i in range(len(pixels)):
            y, x = pixels[i, 1] + offsets[k, 0], pixels[i, 0] + offsets[k, 1]
            buffer_m[y, x] = min(buffer_m[y, x], depth_m[i])
    for k in range(len(offsets)):
        for i in range(len(pixels)):
            y, x = pixels[i, 1] + offsets[k, 0], pixels[i, 0] + offsets[k, 1]
            if depth_m[i] <= buffer_m[y, x]:
                image[y, x] = colors[i]


def _shaded(image: ImageU8, buffer_m: Array) -> ImageU8:
    """Return the picture, darker where neighbours in eight directions, at two distances, are nearer to the eye."""
    drawn = np.isfinite(buffer_m)
    if not drawn.any():
        return image
    low, high = np.percentile(buffer_m[drawn], [1.0, 99.0])
    hidden = _hidden(buffer_m, 0.04 * (high - low))[drawn]
    light = np.exp(-_SHADOW / 8.0 * hidden / max(high - low, 0.1))
    image[drawn] = (image[drawn] * light[:, None]).astype(np.uint8)
    return image


@njit(cache=True, nogil=True)
def _hidden(depth_m: Array, most_m: float) -> Array:
    """Return by how much neighbours are nearer [H, W], each by `most_m` at most."""
    height, width = depth_m.shape
    hidden = np.zeros((height, width))
    for v in range(height):
        for u in range(width):
            if depth_m[v, u] == np.inf:
                continue
            for reach, share in ((2, 1.0), (6, 0.5)):
                for y in (v - reach, v, v + reach):
                    for x in (u - reach, u, u + reach):
                        if 0 <= y < height and 0 <= x < width:
                            hidden[v, u] += share * min(max(depth_m[v, u] - depth_m[y, x] - _NOISE_M, 0.0), most_m)
    return hidden


def _with_line(image: ImageU8, view: _View, buffer_m: Array, line: Line, path: Array) -> ImageU8:
    """Return the picture with a path that has a light border; what is behind a surface shines through."""
    if len(path) == 0:
        return image
    pixels, depth_m = view.see(path)
    pixels = np.clip(pixels, -1e4, 1e4)
    columns, rows = np.clip(np.round(pixels), 0, np.array(buffer_m.shape[::-1]) - 1).astype(np.int64).T
    visible = depth_m <= buffer_m[rows, columns] + _NOISE_M
    behind = image.copy()
    _polyline(behind, pixels, line.color, line.width_px)
    image = np.asarray(cv2.addWeighted(behind, _HIDDEN_ALPHA, image, 1.0 - _HIDDEN_ALPHA, 0.0), dtype=np.uint8)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], visible, [False]]).astype(np.int8)))
    for color, extra in (((255, 255, 255), 2.0), (line.color, 0.0)):
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            _polyline(image, pixels[start:stop], color, line.width_px + extra)
    if line.marks_ends:
        draw_ends(image, pixels, line)
    return image


def draw_ends(image: ImageU8, pixels: Array, line: Line) -> None:
    """Draw a ring at the first and a dot at the last of the pixels [N, 2] of a path."""
    for pixel, fill in ((pixels[0], (255, 255, 255)), (pixels[-1], line.color)):
        centre = (round(float(pixel[0]) * 16), round(float(pixel[1]) * 16))
        for color, radius in (((255, 255, 255), 2.6), (line.color, 2.0), (fill, 1.1)):
            cv2.circle(image, centre, round(radius * line.width_px * 16), color, -1, cv2.LINE_AA, 4)


def _polyline(image: ImageU8, pixels: Array, color: tuple[int, int, int], width: float) -> None:
    fixed = np.round(pixels * 16.0).astype(np.int32)  # OpenCV's fixed-point coordinates
    cv2.polylines(image, [fixed], False, color, max(1, round(width)), cv2.LINE_AA, 4)
