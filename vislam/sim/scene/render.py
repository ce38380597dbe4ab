"""A ray caster for baked scenes: colour and exact depth, anti-aliased, for any camera model and any row timing.

Surfaces are first sorted into tiles of the image, nearest first, so that a ray meets only a handful of candidates. What
a pixel shows is decided once per frame; its texture is sampled from mip maps with up to four probes along the long side
of the footprint and, where the image moves while the shutter is open, at as many places along the motion as it is
pixels long. Only pixels that an outline touches or sweeps over are cast again, with several rays each, from where the
camera is over the exposure: features move as smoothly as they do in a photograph. One frame is one single-threaded call
without the GIL; frames can be rendered in parallel and never depend on each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.errors import UsageError
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32
from vislam.sim.scene.scene import CYLINDER, DISC, Scene
from vislam.sim.scene.texture import Color, Motion, footprint, sample
from vislam.sim.scene.tiles import NEAR_M, TILE_PX, fill_tiles, tile_bounds

_FILTER_REUSE = 4  # pixels along a row that share one footprint
_AT_EDGES = np.array([(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)])  # rotated grid, px
_STILL, _SWEPT = 1, 2  # an outline at a pixel: it moves by less than half a pixel, or by more
Hit = tuple[float, float, float]  # depth, and metres along u and v


@njit(cache=True, nogil=True)
def turn_to(pose: Array, geometry: Array, visible: NDArray[np.int64], seen: Array) -> None:
    """Fill `seen` [P, 16] with the geometry of the visible surfaces as a camera at `pose` [3, 4] has it.

    A row holds, instead of the origin, how far it is from the camera along u, v and normal [0:3], then u [3:6],
    v [6:9] and normal [9:12] in the camera's frame, and [12:16] as it was; see `Scene`.
    """
    for p in visible:
        g, s = geometry[p], seen[p]
        ex, ey, ez = g[0] - pose[0, 3], g[1] - pose[1, 3], g[2] - pose[2, 3]
        for axis in range(3):
            x, y, z = g[3 + 3 * axis], g[4 + 3 * axis], g[5 + 3 * axis]
            s[axis] = x * ex + y * ey + z * ez
            for j in range(3):
                s[3 + 3 * axis + j] = x * pose[0, j] + y * pose[1, j] + z * pose[2, j]
        for j in range(12, 16):
            s[j] = g[j]


@njit(cache=True, nogil=True)
def _meet_cylinder(s: Array, x: float, y: float, limit: float) -> Hit:
    """Return depth, u and v in metres where the ray (x, y, 1) enters a cylinder; infinite depth where it does not."""
    radius = s[12] / (2.0 * np.pi)
    du, dn = s[3] * x + s[4] * y + s[5], s[9] * x + s[10] * y + s[11]
    square, linear = du * du + dn * dn, du * s[0] + dn * s[2]
    rest = s[0] * s[0] + s[2] * s[2] - radius * radius
    root = linear * linear - square * rest
    if root <= 0.0 or square <= 0.0 or rest <= 0.0:
        return np.inf, 0.0, 0.0
    t = (linear - np.sqrt(root)) / square
    if t <= NEAR_M or t >= limit:
        return np.inf, 0.0, 0.0
    b = t * (s[6] * x + s[7] * y + s[8]) - s[1]
    if b < 0.0 or b > s[13]:
        return np.inf, 0.0, 0.0
    angle = np.arctan2(t * dn - s[2], t * du - s[0])
    return t, radius * (angle if angle >= 0.0 else angle + 2.0 * np.pi), b


@njit(cache=True, nogil=True)
def trace(
    x: float,
    y: float,
    candidates: NDArray[np.int64],
    count: int,
    nearest: Array,
    kind: NDArray[np.int64],
    seen: Array,
) -> tuple[int, float, float, float]:
    """Return the first surface on the ray (x, y, 1), or -1, its depth and the hit in metres along its u and v."""
    best, best_t, best_a, best_b = -1, np.inf, 0.0, 0.0
    for i in range(count):
        p = candidates[i]
        if nearest[p] > best_t:
            break
        s = seen[p]
        if kind[p] == CYLINDER:
            t, a, b = _meet_cylinder(s, x, y, best_t)
            if t < best_t:
                best, best_t, best_a, best_b = p, t, a, b
            continue
        slope = s[9] * x + s[10] * y + s[11]
        if slope >= 0.0:
            continue
        t = s[2] / slope
        if t <= NEAR_M or t >= best_t:
            continue
        a = t * (s[3] * x + s[4] * y + s[5]) - s[0]
        b = t * (s[6] * x + s[7] * y + s[8]) - s[1]
        if a < 0.0 or a > s[12] or b < 0.0 or b > s[13]:
            continue
        if kind[p] == DISC and (a - 0.5 * s[12]) ** 2 + (b - 0.5 * s[12]) ** 2 > 0.25 * s[12] * s[12]:
            continue
        best, best_t, best_a, best_b = p, t, a, b
    return best, best_t, best_a, best_b


class _View(NamedTuple):
    """Rays of an image, and which surfaces each tile of it may see."""

    rays: Array  # [H + 2, W + 2, 2]
    poses: Array  # [1 + K, 1 or H, 3, 4] of the camera: at the stamp, and at K moments of the exposure
    visible: NDArray[np.int64]  # [n] surfaces
    lists: NDArray[np.int64]  # [rows, columns, n] of tiles: surfaces, nearest first
    counts: NDArray[np.int64]  # [rows, columns]
    nearest: Array  # [P] least depth of each surface
    pixel_rad: float


class _Surfaces(NamedTuple):
    """What a scene consists of; see `Scene`."""

    kind: NDArray[np.int64]
    geometry: Array
    texels: NDArray[np.uint32]
    levels: NDArray[np.int64]
    level_count: NDArray[np.int64]


class _Met(NamedTuple):
    """What the ray through the centre of each pixel meets at the stamp."""

    surface: NDArray[np.int32]  # [H, W], -1: nothing
    depth: ImageF32  # [H, W] in metres, 0: nothing
    at: ImageF32  # [H, W, 2] metres along the surface's u and v


class Renderer:
    """Renders scenes as one camera sees them; keeps only constant tables, so threads may share it."""

    def __init__(self, camera: Camera) -> None:
        """Prepare the rays of a camera.

        Raises UsageError when the distortion of the camera cannot be inverted at its borders.
        """
        self.camera = camera
        columns, rows = np.meshgrid(np.arange(-1, camera.width + 1), np.arange(-1, camera.height + 1))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
        rays = camera.normalise(pixels).reshape(camera.height + 2, camera.width + 2, 2)
        if not np.all(np.isfinite(rays)):
            raise UsageError(
                "the simulated camera's distortion cannot be inverted over the whole image; make it milder"
            )
        self._rays = np.ascontiguousarray(rays)
        self._tiles = tile_bounds(self._rays)
        self._pixel_rad = 1.0 / np.sqrt(camera.fx * camera.fy)

    def render(self, scene: Scene, T_world_cam: Array, shutter: Array | None = None) -> tuple[ImageF32, ImageF32]:
        """Render one image.

        Args:
            scene: the world.
            T_world_cam: the camera's pose [4, 4], or one pose per image row [H, 4, 4] for a rolling shutter.
            shutter: its poses [K, 4, 4] or [K, H, 4, 4] in the middles of K >= 2 equal parts of the exposure, over
                which light is averaged; None: the image is sharp.

        Returns:
            BGR image [H, W, 3] in display encoding 0..255, not rounded, and exact z-depth [H, W] in metres at
            `T_world_cam`, 0 where nothing is.
        """
        view, surfaces, met = self._meet(scene, T_world_cam, shutter)
        shape = met.depth.shape
        color = np.empty((*shape, 3), dtype=np.float32)
        outline = np.zeros(shape, dtype=np.uint8)
        _find_outlines(view, met, outline)
        _shade(view, surfaces, met, outline, color)
        _shade_outlines(view, surfaces, _AT_EDGES, outline, color)
        return color, met.depth

    def labels(self, scene: Scene, T_world_cam: Array) -> NDArray[np.uint8]:
        """Return what the middle of each pixel [H, W] shows: 1 + its place in `names.NAMES`, 0 where nothing is.

        `T_world_cam` as for `render`.
        """
        _, _, (surface, _, at) = self._meet(scene, T_world_cam, None)
        out = np.where(surface >= 0, scene.labels[surface], 0).astype(np.uint8)
        seen = np.unique(surface)
        for p, u0, v0, u1, v1, label in scene.hung[np.isin(scene.hung[:, 0], seen)]:
            u, v = at[..., 0], at[..., 1]
            out[(surface == p) & (u >= u0) & (u < u1) & (v >= v0) & (v < v1)] = label
        return out

    def _meet(self, scene: Scene, T_world_cam: Array, shutter: Array | None) -> tuple[_View, _Surfaces, _Met]:
        """Return what rays are cast, and what they meet at the stamp."""
        moments = T_world_cam[None] if shutter is None else np.concatenate([T_world_cam[None], shutter])
        poses = np.ascontiguousarray(moments.reshape(len(moments), -1, 4, 4)[:, :, :3, :])
        visible, lists, counts, nearest = fill_tiles(
            self._tiles, poses, scene.kind, scene.geometry, scene.centre, scene.half
        )
        shape = (self.camera.height, self.camera.width)
        met = _Met(np.empty(shape, np.int32), np.empty(shape, np.float32), np.empty((*shape, 2), np.float32))
        view = _View(self._rays, poses, visible, lists, counts, nearest, self._pixel_rad)
        surfaces = _Surfaces(scene.kind, scene.geometry, scene.texels, scene.levels, scene.level_count)
        _cast(view, surfaces, met)
        return view, surfaces, met


@njit(cache=True, nogil=True)
def _cast(view: _View, surfaces: _Surfaces, met: _Met) -> None:
    """Cast one ray through the centre of every pixel at the stamp."""
    surface, depth, at = met
    rays, poses, visible, lists, counts, nearest, _ = view
    kind, geometry, _, _, _ = surfaces
    seen = np.empty_like(geometry)
    for v in range(depth.shape[0]):
        if v < poses.shape[1]:
            turn_to(poses[0, v], geometry, visible, seen)
        for u in range(depth.shape[1]):
            row, column = v // TILE_PX, u // TILE_PX
            x, y = rays[v + 1, u + 1, 0], rays[v + 1, u + 1, 1]
            p, t, a, b = trace(x, y, lists[row, column], counts[row, column], nearest, kind, seen)
            surface[v, u], at[v, u, 0], at[v, u, 1] = p, a, b
            depth[v, u] = t if p >= 0 else 0.0


@njit(cache=True, nogil=True)
def _carry(poses: Array, row: int, out: Array) -> None:
    """Fill `out` [2, 3, 4] with the transforms from the camera at the stamp to its first and last moment."""
    for end in range(2):
        k = 1 if end == 0 else poses.shape[0] - 1
        for i in range(3):
            out[end, i, 3] = 0.0
            for j in range(3):
                out[end, i, j] = 0.0
                out[end, i, 3] += poses[k, row, j, i] * (poses[0, row, j, 3] - poses[k, row, j, 3])
                for m in range(3):
                    out[end, i, j] += poses[k, row, m, i] * poses[0, row, m, j]


@njit(cache=True, nogil=True)
def _motion(carried: Array, moments: int, x: float, y: float, t: float) -> Motion:
    """Return how far the image of the point at depth `t` on the ray (x, y, 1) moves over the whole exposure."""
    if moments == 0 or t == 0.0:
        return 0.0, 0.0
    whole = moments / (moments - 1.0)
    first, last = carried[0], carried[1]
    z0 = (first[2, 0] * x + first[2, 1] * y + first[2, 2]) * t + first[2, 3]
    z1 = (last[2, 0] * x + last[2, 1] * y + last[2, 2]) * t + last[2, 3]
    scale0, scale1 = whole / max(z0, 0.1 * t), whole / max(z1, 0.1 * t)
    dx = ((last[0, 0] * x + last[0, 1] * y + last[0, 2]) * t + last[0, 3]) * scale1
    dx -= ((first[0, 0] * x + first[0, 1] * y + first[0, 2]) * t + first[0, 3]) * scale0
    dy = ((last[1, 0] * x + last[1, 1] * y + last[1, 2]) * t + last[1, 3]) * scale1
    dy -= ((first[1, 0] * x + first[1, 1] * y + first[1, 2]) * t + first[1, 3]) * scale0
    return dx, dy


@njit(cache=True, nogil=True)
def _nearest_at_edge(met: _Met, v: int, u: int) -> float:
    """Return the least depth at a pixel and those of its neighbours that see another surface; -1 if none does."""
    surface, depth, _ = met
    p, found = surface[v, u], -1.0
    for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        i, j = v + dv, u + du
        if 0 <= i < surface.shape[0] and 0 <= j < surface.shape[1] and surface[i, j] != p:
            own = depth[v, u] if found < 0.0 else found
            found = own if surface[i, j] < 0 or 0.0 < own < depth[i, j] else depth[i, j]
    return found


@njit(cache=True, nogil=True)
def _find_outlines(view: _View, met: _Met, outline: NDArray[np.uint8]) -> None:
    """Mark the pixels [H, W] that the outline of a surface touches or sweeps over while the shutter is open."""
    height, width = outline.shape
    moments, carried = view.poses.shape[0] - 1, np.zeros((2, 3, 4))
    for v in range(height):
        if moments > 0 and v < view.poses.shape[1]:
            _carry(view.poses, v, carried)
        for u in range(width):
            t = _nearest_at_edge(met, v, u)
            if t < 0.0:
                continue
            dx, dy = _motion(carried, moments, view.rays[v + 1, u + 1, 0], view.rays[v + 1, u + 1, 1], t)
            dx, dy = dx / view.pixel_rad, dy / view.pixel_rad
            length = np.sqrt(dx * dx + dy * dy)
            if length < 0.5:
                outline[v, u] = max(outline[v, u], _STILL)
                continue
            steps = int(np.ceil(length))
            for k in range(steps + 1):
                part = k / steps - 0.5
                i, j = int(np.floor(v + part * dy + 0.5)), int(np.floor(u + part * dx + 0.5))
                if 0 <= i < height and 0 <= j < width:
                    outline[i, j] = _SWEPT


@njit(cache=True, nogil=True)
def _shade(view: _View, surfaces: _Surfaces, met: _Met, outline: NDArray[np.uint8], color: ImageF32) -> None:
    """Colour the pixels that no outline touches."""
    surface, depth, at = met
    rays, poses, visible, _, _, _, pixel_rad = view
    kind, geometry, texels, levels, level_count = surfaces
    moments, carried, seen = poses.shape[0] - 1, np.zeros((2, 3, 4)), np.empty_like(geometry)
    for v in range(outline.shape[0]):
        if v < poses.shape[1]:
            turn_to(poses[0, v], geometry, visible, seen)
            if moments > 0:
                _carry(poses, v, carried)
        filtered, of, age = (0.0, 1, 0.0, 0.0, 1, 0.0, 0.0), -1, 0
        for u in range(outline.shape[1]):
            p, a, b = surface[v, u], at[v, u, 0], at[v, u, 1]
            if p < 0:
                color[v, u, 0], color[v, u, 1], color[v, u, 2] = 0.0, 0.0, 0.0
                continue
            s = seen[p]
            if p != of or age == _FILTER_REUSE:  # the footprint changes slowly along a row
                x, y, t = rays[v + 1, u + 1, 0], rays[v + 1, u + 1, 1], depth[v, u]
                moves = _motion(carried, moments, x, y, t)
                filtered = footprint((x, y), (t, a), moves, kind[p] == CYLINDER, s, level_count[p], pixel_rad, moments)
                of, age = p, 0
            age += 1
            if outline[v, u] != 0:
                continue
            color[v, u, 0], color[v, u, 1], color[v, u, 2] = sample(filtered, a, b, s, texels, levels[p])


@njit(cache=True, nogil=True)
def _look(view: _View, surfaces: _Surfaces, seen: Array, v: int, u: int, offsets: Array) -> Color:
    """Return the mean colour that rays beside the centre of a pixel meet, by offsets [n, 2] in pixels."""
    rays, _, _, lists, counts, nearest, pixel_rad = view
    kind, _, texels, levels, level_count = surfaces
    row, column = v // TILE_PX, u // TILE_PX
    across = 0.5 * (rays[v + 1, u + 2, 0] - rays[v + 1, u, 0])
    down = 0.5 * (rays[v + 2, u + 1, 1] - rays[v, u + 1, 1])
    filtered, of = (0.0, 1, 0.0, 0.0, 1, 0.0, 0.0), -1
    blue, green, red = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(offsets.shape[0]):
        x, y = rays[v + 1, u + 1, 0] + offsets[k, 0] * across, rays[v + 1, u + 1, 1] + offsets[k, 1] * down
        p, t, a, b = trace(x, y, lists[row, column], counts[row, column], nearest, kind, seen)
        if p < 0:
            continue
        s = seen[p]
        if p != of:
            filtered = footprint((x, y), (t, a), (0.0, 0.0), kind[p] == CYLINDER, s, level_count[p], pixel_rad, 1)
            of = p
        one = sample(filtered, a, b, s, texels, levels[p])
        blue, green, red = blue + one[0], green + one[1], red + one[2]
    scale = np.float32(1.0 / offsets.shape[0])
    return scale * blue, scale * green, scale * red


@njit(cache=True, nogil=True)
def _shade_outlines(
    view: _View, surfaces: _Surfaces, offsets: Array, outline: NDArray[np.uint8], color: ImageF32
) -> None:
    """Colour the pixels at outlines: four rays, and where the outline moves, two for each moment of the exposure."""
    poses, visible, geometry = view.poses, view.visible, surfaces.geometry
    seen = np.empty((poses.shape[0], *geometry.shape))
    scale = np.float32(1.0 / max(poses.shape[0] - 1, 1))
    for v in range(outline.shape[0]):
        if v < poses.shape[1]:
            for k in range(poses.shape[0]):
                turn_to(poses[k, v], geometry, visible, seen[k])
        for u in range(outline.shape[1]):
            if outline[v, u] == _STILL:
                color[v, u, 0], color[v, u, 1], color[v, u, 2] = _look(view, surfaces, seen[0], v, u, offsets)
            elif outline[v, u] == _SWEPT:
                blue, green, red = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for k in range(1, poses.shape[0]):
                    one = _look(view, surfaces, seen[k], v, u, offsets[k % 2 :: 2])
                    blue, green, red = blue + one[0] * one[0], green + one[1] * one[1], red + one[2] * one[2]
                color[v, u, 0], color[v, u, 1] = np.sqrt(scale * blue), np.sqrt(scale * green)
                color[v, u, 2] = np.sqrt(scale * red)
