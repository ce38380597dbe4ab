"""Pictures of maps for reports: a coloured cloud, a mesh or an octree from above, with trajectories drawn in.

Numpy, numba and OpenCV only, so that a report needs no viewer and no graphics driver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.geometry import level_rotation
from vislam.core.messages import Array, ImageU8
from vislam.mapping.cloud.cloud import Cloud, cells_of
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.octree import Octree
from vislam.mapping.pictures.raster import fill_triangles, light_onto, project_points, splat_colors, splat_depth

F32 = NDArray[np.float32]

_SUPERSAMPLING = 2
_FIELD_OF_VIEW = np.deg2rad(38.0)
_MARGIN = 0.05  # of the picture's size, left free on each side
_NEAR_M = 0.02
_FARTHEST_M = 1e6  # a point beyond is damage, and no picture could show it beside the others
_LOOK_AHEAD_VOXELS = (3.0, 6.0)  # from a surface towards the eye: past its own voxels, also at a grazing angle
_HIDDEN_ALPHA = 0.3  # of a line behind a surface
_EDL_STRENGTH = 60.0
_BLENDED_M = 0.025  # depth noise of one surface seen from several keyframes
_CEILING_ABOVE_PATH_M = 0.5
_WALL_HEIGHT_M = 1.8  # of walls that are left standing at least
_PALENESS = 0.15  # of the colours of height, so that shading and lines stand out
_PAPER = {"white": (255, 255, 255), "dark": (18, 20, 26)}
_GRID_LINE = {"white": (226, 229, 233), "dark": (44, 48, 58)}


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A path drawn into a picture, in the map frame."""

    points_m: Array  # [N, 3]
    color: tuple[int, int, int]  # RGB
    width_px: float = 2.5
    marks_ends: bool = True  # a ring at the start, a dot at the end


@dataclass(frozen=True, slots=True)
class Style:
    """How a picture is made; heights and directions are in the map frame."""

    size: tuple[int, int] = (1600, 900)  # width, height
    background: Literal["white", "dark"] = "white"
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # opposite to gravity, where the map is not levelled
    ceiling_m: float | None = None  # cut away what is higher along up; None: above the lines and at 1.8 m or more
    azimuth_deg: float | None = None  # where the eye stands, seen from the middle; None: where it sees the lines best
    elevation_deg: float = 42.0
    floor_grid: bool = True  # lines every metre at the height of the lowest points


@dataclass(frozen=True, slots=True, eq=False)
class _Eye:
    """A pinhole camera: p_eye = R @ p + t; z forward."""

    R: Array
    t: Array
    focal_px: float
    centre_px: Array  # [2]

    def see(self, points: NDArray[np.floating]) -> tuple[F32, F32]:
        """Return pixels [N, 2] and depth [N] of points [N, 3]; meaningless where depth is not positive."""
        rows = np.ascontiguousarray(points, dtype=np.float64)
        pixels, z = project_points(rows, self.R, self.t, self.focal_px, self.centre_px, _NEAR_M)
        return pixels, z

    def scaled(self, factor: float) -> _Eye:
        """Return the eye for the picture resized by a factor."""
        return _Eye(self.R, self.t, self.focal_px * factor, (self.centre_px + 0.5) * factor - 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What a picture shows, turned so that up is z."""

    points: NDArray[np.floating]  # [N, 3]
    lines: list[Line]
    style: Style
    R_up: Array  # [3, 3] from the map frame
    octree: Octree | None  # in the map frame

    def seen_from(self, eye: _Eye, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which points [N, 3] have known space in front of them, on their way to the eye."""
        if self.octree is None:
            return np.ones(len(points), np.bool_)
        towards = -eye.R.T @ eye.t - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        known = np.zeros(len(points), np.bool_)
        for voxels in _LOOK_AHEAD_VOXELS:
            before = points + towards * (voxels * self.octree.resolution_m)
            known |= ~np.isnan(self.octree.log_odds_at(before @ self.R_up))
        return known


@dataclass(eq=False)
class _Canvas:
    """What is drawn so far, at the supersampled size."""

    eye: _Eye
    depth: F32  # [H, W] infinite where nothing is
    noise_m: float  # of the surface's depth
    surface: F32  # [H, W, 4] colour, and 1 where anything is


def render_cloud(
    cloud: Cloud, lines: Sequence[Line] = (), style: Style | None = None, octree: Octree | None = None
) -> ImageU8:
    """Return the picture [H, W, 3] RGB of a coloured cloud, seen from above at an angle.

    With the octree of the same map, surfaces that no keyframe saw from the picture's side are left out: near walls
    open the view into their rooms.
    """
    style = style or Style()
    R_up = level_rotation(np.array(style.up, dtype=np.float64))
    cloud = cloud.select(np.all(np.abs(cloud.points_m) < _FARTHEST_M, axis=1))  # NaN is not
    points, lines = cloud.points_m @ R_up.T, _turned(lines, R_up)
    below = points[:, 2] <= _ceiling_m(style, lines, points)
    points, colors = points[below], cloud.colors[below].astype(np.float32)
    spacing_m = _spacing_m(points)
    scene = _Scene(points, lines, style, R_up, octree)
    canvas = _canvas(scene)
    pixels, z = canvas.eye.see(points)
    ahead = (z > _NEAR_M) & scene.seen_from(canvas.eye, points)
    pixels, z, colors = pixels[ahead], z[ahead], colors[ahead]
    # discs close the surface; wider ones blend into each other and smooth the noise of depth
    radius = np.clip(canvas.eye.focal_px * spacing_m[ahead] / z, 1.0, 40.0).astype(np.float32)
    splat_depth(pixels, z, np.float32(0.8) * radius, canvas.depth)
    canvas.noise_m = _BLENDED_M
    canvas.surface = splat_colors(pixels, z, np.float32(1.25) * radius, colors, canvas.depth, _BLENDED_M)
    return _finish(canvas, scene)


def render_mesh(
    mesh: Mesh, lines: Sequence[Line] = (), style: Style | None = None, octree: Octree | None = None
) -> ImageU8:
    """Return the picture [H, W, 3] RGB of a coloured mesh, seen from above at an angle; the octree as for a cloud."""
    style = style or Style()
    R_up = level_rotation(np.array(style.up, dtype=np.float64))
    points, lines = mesh.points_m @ R_up.T, _turned(lines, R_up)
    below = points[:, 2] <= _ceiling_m(style, lines, points)
    triangles = mesh.triangles[below[mesh.triangles].all(axis=1)]
    scene = _Scene(points[np.unique(triangles)], lines, style, R_up, octree)
    canvas = _canvas(scene)
    triangles = triangles[scene.seen_from(canvas.eye, points)[triangles].all(axis=1)]
    _draw_triangles(canvas, points, mesh.colors.astype(np.float32), triangles)
    return _finish(canvas, scene)


def render_octree(octree: Octree, lines: Sequence[Line] = (), style: Style | None = None) -> ImageU8:
    """Return the picture [H, W, 3] RGB of an octree's occupied voxels as cubes coloured by height.

    Only sides that border on free space are drawn: what was never seen from a side does not hide what was.
    """
    style = style or Style()
    R_up = level_rotation(np.array(style.up, dtype=np.float64))
    lines = _turned(lines, R_up)
    voxels = octree.occupied_voxels()
    open_sides = _open_sides(voxels, octree)
    centres = (voxels + 0.5) * octree.resolution_m @ R_up.T
    below = centres[:, 2] <= _ceiling_m(style, lines, centres)
    voxels, centres, open_sides = voxels[below], centres[below], open_sides[below]
    scene = _Scene(centres, lines, style, R_up, octree)
    canvas = _canvas(scene)
    eye_voxels = (R_up.T @ (-canvas.eye.R.T @ canvas.eye.t)) / octree.resolution_m
    corners, faces, owner, normals = _visible_faces(voxels, open_sides, eye_voxels)
    colors = _height_colors(centres[:, 2])[owner] * (0.80 + 0.20 * (normals @ R_up.T)[:, 2:])
    colors *= 1.0 - 0.10 * np.abs((normals @ R_up.T)[:, :1])  # the two kinds of walls differ
    vertices = (corners * octree.resolution_m @ R_up.T).reshape(-1, 3)
    _draw_triangles(canvas, vertices, np.repeat(colors, 4, axis=0).astype(np.float32), faces)
    return _finish(canvas, scene)


def _open_sides(voxels: NDArray[np.int64], octree: Octree) -> NDArray[np.bool_]:
    """Return which of the six sides [N, 6] of voxels (-x, +x, -y, +y, -z, +z) border on free space."""
    out = np.zeros((len(voxels), 6), np.bool_)
    for side in range(6):
        step = np.zeros(3)
        step[side // 2] = 2 * (side % 2) - 1
        out[:, side] = octree.log_odds_at((voxels + 0.5 + step) * octree.resolution_m) < 0.0
    return out


def _visible_faces(
    voxels: NDArray[np.int64], open_sides: NDArray[np.bool_], eye: Array
) -> tuple[Array, NDArray[np.int32], NDArray[np.int64], Array]:
    """Return the open faces that look at the eye: corners [F, 4, 3], triangles [2F, 3], voxel [F], normal [F, 3]."""
    corners, owners, normals = [], [], []
    for face in range(6):
        axis, side = face // 2, face % 2
        faces_eye = (eye[axis] - (voxels[:, axis] + side)) * (2 * side - 1) > 0.0
        chosen = np.flatnonzero(open_sides[:, face] & faces_eye)
        square = np.zeros((4, 3))
        square[:, axis] = side
        square[:, (axis + 1) % 3] = [0, 1, 1, 0]
        square[:, (axis + 2) % 3] = [0, 0, 1, 1]
        normal = np.zeros(3)
        normal[axis] = 2 * side - 1
        corners.append(voxels[chosen][:, None, :] + square)
        owners.append(chosen)
        normals.append(np.tile(normal, (len(chosen), 1)))
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]).astype(np.int32)
    return quads, triangles, np.concatenate(owners), np.concatenate(normals)


def _height_colors(heights: Array) -> Array:
    """Return RGB [N, 3] of heights [N]: Google's turbo map over the inner 98 % of them."""
    if len(heights) == 0:
        return np.zeros((0, 3))
    low, high = np.percentile(heights, [1.0, 99.0])
    level = np.clip((heights - low) / max(high - low, 1e-6), 0.0, 1.0)
    shades = np.round(25 + 205 * level).astype(np.uint8)  # the map's ends are too dark to shade
    turbo = np.asarray(cv2.applyColorMap(shades[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1], dtype=np.float64)
    return turbo + _PALENESS * (255.0 - turbo)


def _turned(lines: Sequence[Line], R: Array) -> list[Line]:
    return [replace(line, points_m=line.points_m[np.isfinite(line.points_m).all(axis=1)] @ R.T) for line in lines]


def _ceiling_m(style: Style, lines: Sequence[Line], points: NDArray[np.floating]) -> float:
    if style.ceiling_m is not None:
        return style.ceiling_m
    heights = [float(line.points_m[:, 2].max()) for line in lines if len(line.points_m)]
    if not heights or len(points) == 0:
        return np.inf
    floor = float(np.percentile(points[:: max(1, len(points) // 20000), 2], 1.0))
    return max(max(heights) + _CEILING_ABOVE_PATH_M, floor + _WALL_HEIGHT_M)


def _spacing_m(points: NDArray[np.floating]) -> Array:
    """Return the usual distance [N] from each point to its neighbours, from how many share a cell with it."""
    if len(points) < 2:
        return np.full(len(points), 0.02)
    some = points[:: max(1, len(points) // 2000)]
    distances, _ = cKDTree(points).query(some, k=min(5, len(points)))
    usual = max(float(np.median(np.asarray(distances)[:, -1])), 1e-3)
    cell_m = 6.0 * usual
    cell_of = cells_of(points, cell_m)
    in_cell = np.bincount(cell_of)[cell_of]
    return np.clip(cell_m / np.sqrt(in_cell), usual, 1.7 * usual)


def _canvas(scene: _Scene) -> _Canvas:
    style = scene.style
    size = (style.size[0] * _SUPERSAMPLING, style.size[1] * _SUPERSAMPLING)
    subject = _subject(scene.points, scene.lines)
    azimuth_rad = _best_azimuth_rad(scene, subject) if style.azimuth_deg is None else np.deg2rad(style.azimuth_deg)
    eye = _framed(subject, azimuth_rad, np.deg2rad(style.elevation_deg), size)
    return _Canvas(eye, np.full(size[::-1], np.inf, np.float32), 0.0, np.zeros((*size[::-1], 4), np.float32))


def _subject(points: NDArray[np.floating], lines: Sequence[Line]) -> Array:
    """Return the points [M, 3] that the picture must hold: a sample without stray ones, and the lines."""
    parts = [np.asarray(line.points_m, dtype=np.float64) for line in lines]
    if len(points):
        some = np.asarray(points[:: max(1, len(points) // 5000)], dtype=np.float64)
        low, high = np.percentile(some, [0.1, 99.9], axis=0)
        parts.append(some[((some >= low) & (some <= high)).all(axis=1)])
    subject = np.concatenate(parts) if parts else np.zeros((0, 3))
    return subject if len(subject) else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])


def _framed(subject: Array, azimuth_rad: float, elevation_rad: float, size: tuple[int, int]) -> _Eye:
    """Return the eye in a direction from the subject, as near as the picture's borders allow."""
    ca, sa, ce, se = np.cos(azimuth_rad), np.sin(azimuth_rad), np.cos(elevation_rad), np.sin(elevation_rad)
    forward = -np.array([ca * ce, sa * ce, se])
    right = np.array([-sa, ca, 0.0])
    R = np.stack([right, np.cross(forward, right), forward])
    focal = 0.5 * size[1] / np.tan(0.5 * _FIELD_OF_VIEW)
    half = (0.5 - _MARGIN) * np.array(size) / focal
    local = subject @ R.T
    t = -np.append(0.5 * (local[:, :2].min(axis=0) + local[:, :2].max(axis=0)), 0.0)
    for _ in range(4):  # perspective: centring and distance depend on each other
        shifted = local + np.append(t[:2], 0.0)
        t[2] = float((np.abs(shifted[:, :2]) / half - shifted[:, 2:]).max()) + _NEAR_M
        seen = shifted[:, :2] / (shifted[:, 2:] + t[2])
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
        t[:2] -= middle * float(np.median(shifted[:, 2] + t[2]))
    shifted = local + np.append(t[:2], 0.0)
    t[2] = float((np.abs(shifted[:, :2]) / half - shifted[:, 2:]).max()) + _NEAR_M
    return _Eye(R, t, focal, 0.5 * np.array(size) - 0.5)


def _best_azimuth_rad(scene: _Scene, subject: Array) -> float:
    """Return where to stand, of sixteen places around the subject: near to it, seeing much of map and lines."""
    small = (scene.style.size[0] // 8, scene.style.size[1] // 8)
    path = np.concatenate([line.points_m for line in scene.lines]) if scene.lines else subject
    some = np.asarray(scene.points[:: max(1, len(scene.points) // 20000)], dtype=np.float64)
    extent = float(np.linalg.norm(subject.max(axis=0) - subject.min(axis=0)))
    best, best_score = 0.0, -np.inf
    for azimuth in np.arange(16) * np.pi / 8.0 + np.deg2rad(5.0):
        eye = _framed(subject, azimuth, np.deg2rad(scene.style.elevation_deg), small)
        shown = scene.seen_from(eye, some)
        depth = np.full(small[::-1], np.inf, np.float32)
        pixels, z = eye.see(some[shown])
        splat_depth(pixels, z, np.full(len(z), 1.0, np.float32), depth)
        visible = float(_is_visible(path, eye, depth).mean()) if len(path) else 0.0
        score = visible + extent / eye.t[2] + 3.0 * float(shown.mean() if len(shown) else 0.0)
        if score > best_score + 1e-9:
            best, best_score = float(azimuth), score
    return best


def _is_visible(points: Array, eye: _Eye, depth: F32) -> NDArray[np.bool_]:
    pixels, z = eye.see(points)
    rounded = np.round(pixels).astype(np.int64)
    x, y = np.clip(rounded[:, 0], 0, depth.shape[1] - 1), np.clip(rounded[:, 1], 0, depth.shape[0] - 1)
    return np.asarray(z <= depth[y, x] + 0.02 * z)


def _draw_triangles(canvas: _Canvas, points: NDArray[np.floating], colors: F32, triangles: NDArray[np.int32]) -> None:
    pixels, z = canvas.eye.see(points)
    ahead = (z[triangles] > _NEAR_M).all(axis=1)
    fill_triangles(pixels, z, colors, np.ascontiguousarray(triangles[ahead]), canvas.depth, canvas.surface)


def _finish(canvas: _Canvas, scene: _Scene) -> ImageU8:
    """Light the surface, put it on paper, draw the lines and reduce to the asked size."""
    style, points = scene.style, scene.points
    paper = np.full((*canvas.depth.shape, 3), _PAPER[style.background], np.uint8)
    if style.floor_grid and len(points):
        _draw_floor_grid(paper, canvas.eye, points, _GRID_LINE[style.background])
    light_onto(paper, canvas.surface, canvas.depth, _SUPERSAMPLING, _EDL_STRENGTH, canvas.noise_m)
    image = np.asarray(cv2.resize(paper, style.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    eye = canvas.eye.scaled(1.0 / _SUPERSAMPLING)
    for line in scene.lines:
        visible = _is_visible(line.points_m, canvas.eye, canvas.depth)
        image = _with_line(image, eye, line, visible)
    return image


def _draw_floor_grid(image: ImageU8, eye: _Eye, points: NDArray[np.floating], color: tuple[int, int, int]) -> None:
    """Draw a line every metre (every 5 or 25 in large maps) a little below the points."""
    some = points[:: max(1, len(points) // 20000)]
    low, high = np.percentile(some, [0.5, 99.5], axis=0)
    step = next(s for s in (1.0, 5.0, 25.0, 1e9) if (high - low)[:2].max() / s <= 40.0)
    first, last = np.floor(low[:2] / step) * step - step, np.ceil(high[:2] / step) * step + step
    height = float(low[2])
    for axis in (0, 1):
        for value in np.arange(first[axis], last[axis] + 0.5 * step, step):
            along = np.linspace(first[1 - axis], last[1 - axis], 64)
            path = np.full((64, 3), height)
            path[:, axis], path[:, 1 - axis] = value, along
            _polyline(image, eye, path, color, 1.0 * _SUPERSAMPLING)


def _with_line(image: ImageU8, eye: _Eye, line: Line, visible: NDArray[np.bool_]) -> ImageU8:
    """Return the image with a line that has a light border; what is behind a surface shines through."""
    if len(line.points_m) == 0:
        return image
    behind = image.copy()
    _polyline(behind, eye, line.points_m, line.color, line.width_px)
    image = np.asarray(cv2.addWeighted(behind, _HIDDEN_ALPHA, image, 1.0 - _HIDDEN_ALPHA, 0.0), dtype=np.uint8)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], visible, [False]]).astype(np.int8)))
    for color, extra in (((255, 255, 255), 2.0), (line.color, 0.0)):
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            _polyline(image, eye, line.points_m[start:stop], color, line.width_px + extra)
    if line.marks_ends:
        pixels, z = eye.see(line.points_m[[0, -1]])
        for pixel, fill in zip(pixels[z > _NEAR_M], ((255, 255, 255), line.color), strict=False):
            _disc(image, pixel, 2.4 * line.width_px, (255, 255, 255))
            _disc(image, pixel, 1.9 * line.width_px, line.color)
            _disc(image, pixel, 1.0 * line.width_px, fill)
    return image


def _polyline(image: ImageU8, eye: _Eye, path: Array, color: tuple[int, int, int], width: float) -> None:
    pixels, z = eye.see(path)
    limit = 4.0 * max(image.shape)  # OpenCV's fixed-point coordinates
    good = (z > _NEAR_M) & (np.abs(pixels) < limit).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        fixed = np.round(pixels[start:stop] * 16.0).astype(np.int32)
        cv2.polylines(image, [fixed], False, color, max(1, round(width)), cv2.LINE_AA, 4)


def _disc(image: ImageU8, pixel: F32, radius: float, color: tuple[int, int, int]) -> None:
    centre = (round(float(pixel[0]) * 16), round(float(pixel[1]) * 16))
    if max(map(abs, centre)) < 64 * max(image.shape):
        cv2.circle(image, centre, round(radius * 16), color, -1, cv2.LINE_AA, 4)
