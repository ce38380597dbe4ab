"""A ray caster for baked scenes: colour and exact depth, anti-aliased, for any camera model and any row timing.

Surfaces are first sorted into tiles of the image, nearest first, so that a ray meets only a handful of candidates.
Textures are sampled from mip maps with up to four probes along the long side of a pixel's footprint, and pixels at the
outline of a surface are cast again with four rays each: features move as smoothly as they do in a photograph. One frame
is one single-threaded call without the GIL; frames can be rendered in parallel and never depend on each other.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.camera import Camera
from vislam.errors import UsageError
from vislam.messages import Array, ImageF32
from vislam.sim.scene import CYLINDER, DISC, Scene
from vislam.sim.tiles import NEAR_M, TILE_PX, fill_tiles, tile_bounds

_MAX_PROBES = 4
_FILTER_REUSE = 4  # pixels along a row that share one choice of mip level
_BLEND = 2.0  # how much narrower than the distance between mip levels their blending is
_SAMPLES_AT_EDGES = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))  # rotated grid

Ray = tuple[float, float, float]  # a direction, or a colour
Color = tuple[np.float32, np.float32, np.float32]
Hit = tuple[float, float, float]  # depth, and metres along u and v
Filter = tuple[float, int, float, float]  # mip level, probes, step between them in metres along u and v


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

    def render(self, scene: Scene, T_world_cam: Array) -> tuple[ImageF32, ImageF32]:
        """Render one image.

        Args:
            scene: the world.
            T_world_cam: the camera's pose [4, 4], or one pose per image row [H, 4, 4] for a rolling shutter.

        Returns:
            BGR image [H, W, 3] in display encoding 0..255, not rounded, and exact z-depth [H, W] in metres, 0 where
            nothing is.
        """
        rows = np.broadcast_to(T_world_cam, (self.camera.height, 4, 4))
        poses = np.ascontiguousarray(rows[:, :3, :])
        lists, counts, nearest = fill_tiles(self._tiles, poses, scene.kind, scene.geometry, scene.centre, scene.half)
        color = np.empty((self.camera.height, self.camera.width, 3), dtype=np.float32)
        depth = np.empty((self.camera.height, self.camera.width), dtype=np.float32)
        hit = np.empty((self.camera.height, self.camera.width), dtype=np.int32)
        what = (scene.kind, scene.geometry, scene.texels, scene.levels, scene.level_count)
        where = (self._rays, poses, lists, counts, nearest, self._pixel_rad)
        _cast(*where, *what, color, depth, hit)
        _smooth_edges(*where, *what, np.array(_SAMPLES_AT_EDGES), hit, color)
        return color, depth


@njit(cache=True, nogil=True)
def _meet_cylinder(g: Array, ray: Ray, ex: float, ey: float, ez: float, limit: float) -> Hit:
    """Return depth, u and v in metres where a ray enters a cylinder; `e` is its origin seen from the ray's."""
    dx, dy, dz = ray
    radius = g[12] / (2.0 * np.pi)
    du, dn = g[3] * dx + g[4] * dy + g[5] * dz, g[9] * dx + g[10] * dy + g[11] * dz
    eu, en = g[3] * ex + g[4] * ey + g[5] * ez, g[9] * ex + g[10] * ey + g[11] * ez
    square, linear = du * du + dn * dn, du * eu + dn * en
    rest = eu * eu + en * en - radius * radius
    root = linear * linear - square * rest
    if root <= 0.0 or square <= 0.0 or rest <= 0.0:
        return np.inf, 0.0, 0.0
    t = (linear - np.sqrt(root)) / square
    if t <= NEAR_M or t >= limit:
        return np.inf, 0.0, 0.0
    b = g[6] * (t * dx - ex) + g[7] * (t * dy - ey) + g[8] * (t * dz - ez)
    if b < 0.0 or b > g[13]:
        return np.inf, 0.0, 0.0
    angle = np.arctan2(t * dn - en, t * du - eu)
    return t, radius * (angle if angle >= 0.0 else angle + 2.0 * np.pi), b


@njit(cache=True, nogil=True)
def _trace(
    ray: Ray,
    pose: Array,
    candidates: NDArray[np.int64],
    count: int,
    nearest: Array,
    kind: NDArray[np.int64],
    geometry: Array,
) -> tuple[int, float, float, float]:
    """Return the nearest surface along a ray (or -1), its depth and the hit in metres along the surface's u and v."""
    best, best_t, best_a, best_b = -1, np.inf, 0.0, 0.0
    dx, dy, dz = ray
    for i in range(count):
        p = candidates[i]
        if nearest[p] > best_t:
            break
        g = geometry[p]
        ex, ey, ez = g[0] - pose[0, 3], g[1] - pose[1, 3], g[2] - pose[2, 3]
        if kind[p] == CYLINDER:
            t, a, b = _meet_cylinder(g, ray, ex, ey, ez, best_t)
            if t < best_t:
                best, best_t, best_a, best_b = p, t, a, b
            continue
        slope = g[9] * dx + g[10] * dy + g[11] * dz
        if slope >= 0.0:
            continue
        t = (g[9] * ex + g[10] * ey + g[11] * ez) / slope
        if t <= NEAR_M or t >= best_t:
            continue
        hx, hy, hz = t * dx - ex, t * dy - ey, t * dz - ez
        a = g[3] * hx + g[4] * hy + g[5] * hz
        b = g[6] * hx + g[7] * hy + g[8] * hz
        if a < 0.0 or a > g[12] or b < 0.0 or b > g[13]:
            continue
        if kind[p] == DISC and (a - 0.5 * g[12]) ** 2 + (b - 0.5 * g[12]) ** 2 > 0.25 * g[12] * g[12]:
            continue
        best, best_t, best_a, best_b = p, t, a, b
    return best, best_t, best_a, best_b


@njit(cache=True, nogil=True)
def _bilinear(texels: NDArray[np.uint32], offset: int, width: int, height: int, x: float, y: float) -> Color:
    """Return the colour (b, g, r) of a mip level at texel coordinates; borders are held."""
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    x0, y0 = int(x), int(y)
    fx, fy = np.float32(x - x0), np.float32(y - y0)
    right = 1 if x0 + 1 < width else 0
    first = offset + y0 * width + x0
    second = first + width if y0 + 1 < height else first
    p00, p01 = np.int32(texels[first]), np.int32(texels[first + right])
    p10, p11 = np.int32(texels[second]), np.int32(texels[second + right])
    w11 = fx * fy
    w10, w01 = fy - w11, fx - w11
    w00 = np.float32(1.0) - fx - w10
    b = w00 * np.float32(p00 & 255) + w01 * np.float32(p01 & 255)
    b += w10 * np.float32(p10 & 255) + w11 * np.float32(p11 & 255)
    g = w00 * np.float32((p00 >> 8) & 255) + w01 * np.float32((p01 >> 8) & 255)
    g += w10 * np.float32((p10 >> 8) & 255) + w11 * np.float32((p11 >> 8) & 255)
    r = w00 * np.float32((p00 >> 16) & 255) + w01 * np.float32((p01 >> 16) & 255)
    r += w10 * np.float32((p10 >> 16) & 255) + w11 * np.float32((p11 >> 16) & 255)
    return b, g, r


@njit(cache=True, nogil=True)
def _filter(ray: Ray, t: float, a: float, cylinder: bool, g: Array, level_count: int, pixel_rad: float) -> Filter:
    """Return how to sample a surface under a pixel: mip level, probes along its long side, the step between them."""
    dx, dy, dz = ray
    along_u = g[3] * dx + g[4] * dy + g[5] * dz
    along_v = g[6] * dx + g[7] * dy + g[8] * dz
    along_n = g[9] * dx + g[10] * dy + g[11] * dz
    if cylinder:
        angle = 2.0 * np.pi * a / g[12]
        sine, cosine = np.sin(angle), np.cos(angle)
        along_u, along_n = cosine * along_n - sine * along_u, cosine * along_u + sine * along_n
    in_plane = along_u * along_u + along_v * along_v
    ratio = min(np.sqrt(1.0 + in_plane / (along_n * along_n + 1e-9)), 50.0)
    probes = min(_MAX_PROBES, int(ratio + 0.5))
    step_m = t * pixel_rad * ratio / probes
    level = min(max(np.log2(np.float32(step_m * g[14])), 0.0), level_count - 1.0)
    norm = step_m / np.sqrt(in_plane + 1e-12)
    return level, probes, norm * along_u, norm * along_v


@njit(cache=True, nogil=True)
def _sample(
    filtered: Filter, a: float, b: float, g: Array, texels: NDArray[np.uint32], levels: NDArray[np.int64]
) -> Ray:
    """Return the colour (b, g, r) of a surface at `a`, `b` metres along its u and v."""
    level, probes, step_u_m, step_v_m = filtered
    low = int(level)
    # Sharp between levels, blended only around the middle: most pixels then read one level instead of two.
    fraction = min(max(_BLEND * (level - low - 0.5) + 0.5, 0.0), 1.0)
    blue, green, red = 0.0, 0.0, 0.0
    for m in range(2):
        weight = (fraction if m == 1 else 1.0 - fraction) / probes
        if weight == 0.0:
            continue
        offset, width, height = levels[low + m, 0], levels[low + m, 1], levels[low + m, 2]
        scale_u, scale_v = width / g[12], height / g[13]
        step_u, step_v = step_u_m * scale_u, step_v_m * scale_v
        x = a * scale_u - 0.5 - 0.5 * (probes - 1) * step_u
        y = b * scale_v - 0.5 - 0.5 * (probes - 1) * step_v
        for _ in range(probes):
            part = _bilinear(texels, offset, width, height, x, y)
            blue, green, red = blue + weight * part[0], green + weight * part[1], red + weight * part[2]
            x, y = x + step_u, y + step_v
    return blue, green, red


@njit(cache=True, nogil=True)
def _turn(pose: Array, x: float, y: float) -> Ray:
    """Return the world direction of the ray (x, y, 1) of the camera."""
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2],
    )


@njit(cache=True, nogil=True)
def _cast(
    rays: Array,
    poses: Array,
    lists: NDArray[np.int64],
    counts: NDArray[np.int64],
    nearest: Array,
    pixel_rad: float,
    kind: NDArray[np.int64],
    geometry: Array,
    texels: NDArray[np.uint32],
    levels: NDArray[np.int64],
    level_count: NDArray[np.int64],
    color: ImageF32,
    depth: ImageF32,
    hit: NDArray[np.int32],
) -> None:
    """Cast one ray through the centre of every pixel."""
    for v in range(hit.shape[0]):
        pose = poses[v]
        filtered, of, age = (0.0, 1, 0.0, 0.0), -1, 0
        for u in range(hit.shape[1]):
            ray = _turn(pose, rays[v + 1, u + 1, 0], rays[v + 1, u + 1, 1])
            row, column = v // TILE_PX, u // TILE_PX
            p, t, a, b = _trace(ray, pose, lists[row, column], counts[row, column], nearest, kind, geometry)
            hit[v, u] = p
            if p < 0:
                depth[v, u] = 0.0
                color[v, u, 0], color[v, u, 1], color[v, u, 2] = 0.0, 0.0, 0.0
                continue
            depth[v, u] = t
            if p != of or age == _FILTER_REUSE:  # the footprint changes slowly along a row
                filtered = _filter(ray, t, a, kind[p] == CYLINDER, geometry[p], level_count[p], pixel_rad)
                of, age = p, 0
            age += 1
            color[v, u, 0], color[v, u, 1], color[v, u, 2] = _sample(filtered, a, b, geometry[p], texels, levels[p])


@njit(cache=True, nogil=True)
def _at_edge(hit: NDArray[np.int32], v: int, u: int) -> bool:
    """Tell whether one of the four neighbours of a pixel sees another surface."""
    p = hit[v, u]
    return (
        (u > 0 and hit[v, u - 1] != p)
        or (u < hit.shape[1] - 1 and hit[v, u + 1] != p)
        or (v > 0 and hit[v - 1, u] != p)
        or (v < hit.shape[0] - 1 and hit[v + 1, u] != p)
    )


@njit(cache=True, nogil=True)
def _smooth_edges(
    rays: Array,
    poses: Array,
    lists: NDArray[np.int64],
    counts: NDArray[np.int64],
    nearest: Array,
    pixel_rad: float,
    kind: NDArray[np.int64],
    geometry: Array,
    texels: NDArray[np.uint32],
    levels: NDArray[np.int64],
    level_count: NDArray[np.int64],
    offsets: Array,
    hit: NDArray[np.int32],
    color: ImageF32,
) -> None:
    """Replace pixels at the outline of a surface by the mean of several rays within the pixel."""
    scale = 1.0 / offsets.shape[0]
    for v in range(hit.shape[0]):
        pose = poses[v]
        for u in range(hit.shape[1]):
            if not _at_edge(hit, v, u):
                continue
            row, column = v // TILE_PX, u // TILE_PX
            blue, green, red = 0.0, 0.0, 0.0
            for k in range(offsets.shape[0]):
                x = rays[v + 1, u + 1, 0] + 0.5 * offsets[k, 0] * (rays[v + 1, u + 2, 0] - rays[v + 1, u, 0])
                y = rays[v + 1, u + 1, 1] + 0.5 * offsets[k, 1] * (rays[v + 2, u + 1, 1] - rays[v, u + 1, 1])
                ray = _turn(pose, x, y)
                p, t, a, b = _trace(ray, pose, lists[row, column], counts[row, column], nearest, kind, geometry)
                if p >= 0:
                    filtered = _filter(ray, t, a, kind[p] == CYLINDER, geometry[p], level_count[p], pixel_rad)
                    sample = _sample(filtered, a, b, geometry[p], texels, levels[p])
                    blue, green, red = blue + sample[0], green + sample[1], red + sample[2]
            color[v, u, 0], color[v, u, 1], color[v, u, 2] = scale * blue, scale * green, scale * red
