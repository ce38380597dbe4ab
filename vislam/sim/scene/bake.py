"""Turns the description of a world into arrays: paints every surface, lights it, and makes its mip maps.

Surfaces are matte and lamps do not move, so light belongs to a point of the world and not to the view: it is computed
once (lamps with soft shadows, plus ambient light dimmed in corners), on a coarse grid per surface, and multiplied into
the texture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.cpu import return_freed_memory
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageU8
from vislam.sim.scene.names import labels_of
from vislam.sim.scene.scene import Scene, SceneBuilder, Surface

_LIGHT_GRID_M = 0.12
_GAMMA = 2.2  # textures hold display values, light is linear
_AMBIENT_RAYS = 12
_AMBIENT_REACH_M = 0.9  # corners darken over about this distance
_SHADOW_RAYS = 4
_OFF_SURFACE_M = 0.004
_FAINT = 0.004  # lamps dimmer than this at a point are left out
_MAX_LEVELS = 14


@dataclass(frozen=True, slots=True, eq=False)
class _Light:
    """Everything the light kernel reads."""

    lamps: Array  # [L, 8]: position, power, blue, green, red, size
    centres: Array  # [S, 3] of the solids
    halves: Array  # [S, 3, 3]
    ambient: float


@njit(cache=True, nogil=True)
def _blocked(
    origin: Array, direction: Array, reach: float, centres: Array, halves: Array, chosen: NDArray[np.int64]
) -> bool:
    """Return whether a chosen solid lies within `reach` along a unit direction; one around the origin is ignored."""
    for s in chosen:
        enter, leave = 0.0, reach
        for k in range(3):
            along, offset, square = 0.0, 0.0, 0.0
            for i in range(3):
                along += halves[s, k, i] * direction[i]
                offset += halves[s, k, i] * (centres[s, i] - origin[i])
                square += halves[s, k, i] * halves[s, k, i]
            if abs(along) < 1e-9:
                if abs(offset) > square:
                    leave = -1.0
                    break
                continue
            near, far = (offset - square) / along, (offset + square) / along
            if near > far:
                near, far = far, near
            enter, leave = max(enter, near), min(leave, far)
            if enter > leave:
                break
        if leave > enter > 0.0:
            return True
    return False


@njit(cache=True, nogil=True)
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _near_segment(
    start: Array, end: Array, width: float, centres: Array, radii: Array, chosen: NDArray[np.int64]
) -> int:
    """List in `chosen` the solids whose bounding sphere comes within `width` of a segment; return how many."""
    count = 0
    delta = end - start
    square = _dot(delta, delta)
    for s in range(centres.shape[0]):
        along = 0.0
        for i in range(3):
            along += (centres[s, i] - start[i]) * delta[i]
        along = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        distance = 0.0
        for i in range(3):
            distance += (centres[s, i] - start[i] - along * delta[i]) ** 2
        if distance < (radii[s] + width) ** 2:
            chosen[count] = s
            count += 1
    return count


@njit(cache=True, nogil=True)
def _shine(
    points: Array,
    normals: Array,
    lamps: Array,
    centres: Array,
    halves: Array,
    ambient: float,
    sphere: Array,
    out: Array,
) -> None:
    """Fill the linear BGR light `out` [N, 3] that falls on points with normals [N, 3]; `sphere` are unit directions."""
    toward = np.empty(3)
    radii = np.empty(centres.shape[0])
    for s in range(centres.shape[0]):
        radii[s] = np.sqrt(np.sum(halves[s] ** 2))
    chosen = np.empty(centres.shape[0], dtype=np.int64)
    for n in range(points.shape[0]):
        normal = normals[n]
        origin = points[n] + _OFF_SURFACE_M * normal
        count = _near_segment(origin, origin, _AMBIENT_REACH_M, centres, radii, chosen)
        open_sky = 0.0
        for k in range(_AMBIENT_RAYS):
            for i in range(3):
                toward[i] = normal[i] + 0.98 * sphere[k, i]  # cosine-weighted around the normal
            toward /= np.sqrt(_dot(toward, toward))
            if not _blocked(origin, toward, _AMBIENT_REACH_M, centres, halves, chosen[:count]):
                open_sky += 1.0 / _AMBIENT_RAYS
        out[n] = ambient * (0.85 + 0.15 * normal[2]) * (0.25 + 0.75 * open_sky)
        for m in range(lamps.shape[0]):
            toward[:] = lamps[m, :3] - origin
            distance = np.sqrt(_dot(toward, toward))
            if _dot(normal, toward) <= -lamps[m, 7] or lamps[m, 3] < _FAINT * distance * distance:
                continue
            count = _near_segment(origin, lamps[m, :3], lamps[m, 7], centres, radii, chosen)
            for k in range(_SHADOW_RAYS):
                for i in range(3):
                    toward[i] = lamps[m, i] + lamps[m, 7] * sphere[_AMBIENT_RAYS + k, i] - origin[i]
                distance = np.sqrt(_dot(toward, toward))
                toward /= distance
                facing = _dot(normal, toward)
                if facing <= 0.0 or _blocked(origin, toward, distance - 0.15, centres, halves, chosen[:count]):
                    continue
                amount = lamps[m, 3] * facing / (distance * distance + 0.3) / _SHADOW_RAYS
                for i in range(3):
                    out[n, i] += amount * lamps[m, 4 + i]


def _sphere_directions() -> Array:
    """Return unit directions [N, 3] spread evenly: a Fibonacci lattice for the sky, another for the lamps."""
    parts = []
    for count in (_AMBIENT_RAYS, _SHADOW_RAYS):
        index = np.arange(count) + 0.5
        z, angle = 1.0 - 2.0 * index / count, np.pi * (1.0 + np.sqrt(5.0)) * index
        r = np.sqrt(1.0 - z * z)
        parts.append(np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1))
    return np.concatenate(parts)


def _lit(surface: Surface, image: ImageU8, light: _Light, sphere: Array) -> ImageU8:
    """Return the painted image with light multiplied into it."""
    rows = max(2, round(surface.size_m[1] / _LIGHT_GRID_M) + 1)
    columns = max(2, round(surface.size_m[0] / _LIGHT_GRID_M) + 1)
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    points, normals = surface.point(u.ravel(), v.ravel())
    amount = np.empty((rows * columns, 3))
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    _shine(points, normals, light.lamps, light.centres, light.halves, light.ambient, sphere, amount)
    encoded = ((amount + surface.glow) ** (1.0 / _GAMMA)).astype(np.float32).reshape(rows, columns, 3)
    encoded = cv2.blur(encoded, (3, 3), borderType=cv2.BORDER_REPLICATE) if min(rows, columns) > 4 else encoded
    smooth = cv2.resize(encoded, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(image, smooth, dtype=cv2.CV_8UC3)


def _levels(image: ImageU8) -> list[ImageU8]:
    """Return the mip maps of an image, each half the size of the one before."""
    levels = [image]
    while min(levels[-1].shape[:2]) > 1 and len(levels) < _MAX_LEVELS:
        height, width = levels[-1].shape[:2]
        size = (max(1, width // 2), max(1, height // 2))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return [cv2.cvtColor(level, cv2.COLOR_BGR2BGRA) for level in levels]


def painted(build: Callable[[np.random.Generator], SceneBuilder], seed: int) -> Scene:
    """Return a world, laid out by `build` and painted; takes seconds, and is the same each time."""
    layout, paint = np.random.SeedSequence(seed).spawn(2)
    scene = bake(build(np.random.default_rng(layout)), paint)
    return_freed_memory()  # of painting: more than the scene itself
    return scene


def bake(builder: SceneBuilder, seed: np.random.SeedSequence, threads: int = 2) -> Scene:
    """Paint, light and pack a world; the same builder and seed give the same bytes for any number of threads."""
    solids = builder.solids or [(np.full(3, 1e6), np.eye(3))]
    light = _Light(
        lamps=np.array([[*lamp.position_m, lamp.power, *lamp.bgr, lamp.size_m] for lamp in builder.lamps]).reshape(
            -1, 8
        ),
        centres=np.stack([centre for centre, _ in solids]),
        halves=np.stack([half for _, half in solids]),
        ambient=builder.ambient,
    )
    sphere = _sphere_directions()

    def finish(job: tuple[Surface, np.random.SeedSequence]) -> list[ImageU8]:
        surface, own_seed = job
        height = max(4, round(surface.size_m[1] * surface.texels_per_m))
        width = max(4, round(surface.size_m[0] * surface.texels_per_m))
        painted = surface.painter(np.random.default_rng(own_seed), height, width, surface.texels_per_m)
        return _levels(_lit(surface, painted, light, sphere))

    # Not `seed.spawn`: it counts its calls, and a second bake would then paint another world.
    streams = [
        np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, index))
        for index in range(len(builder.surfaces))
    ]
    jobs = list(zip(builder.surfaces, streams, strict=True))
    with ThreadPoolExecutor(threads) as pool:
        images = list(pool.map(finish, jobs))
    return _pack(builder.surfaces, images)


def _pack(surfaces: Sequence[Surface], images: list[list[ImageU8]]) -> Scene:
    levels = np.zeros((len(surfaces), _MAX_LEVELS, 3), dtype=np.int64)
    position = 0
    for p, pictures in enumerate(images):
        for k, picture in enumerate(pictures):
            height, width = picture.shape[:2]
            levels[p, k] = position, width, height
            position += height * width
    texels = np.empty(position, dtype=np.uint32)
    for p, pictures in enumerate(images):
        for k, picture in enumerate(pictures):
            offset, width, height = levels[p, k]
            texels[offset : offset + height * width] = picture.reshape(-1, 4).view("<u4")[:, 0]
        pictures.clear()  # memory: the images are as large as the world
    boxes = [surface.bounding_box() for surface in surfaces]
    geometry = np.array(
        [np.concatenate([s.origin, s.axis_u, s.axis_v, s.normal, s.size_m, s.size_m]) for s in surfaces]
    )
    geometry[:, 14:16] = levels[:, 0, 1:3] / geometry[:, 12:14]
    labels, hung = labels_of(surfaces)
    return Scene(
        kind=np.array([surface.kind for surface in surfaces], dtype=np.int64),
        geometry=geometry,
        centre=np.stack([centre for centre, _ in boxes]),
        half=np.stack([half for _, half in boxes]),
        texels=texels,
        levels=levels,
        level_count=np.count_nonzero(levels[:, :, 1], axis=1).astype(np.int64),
        labels=labels,
        hung=hung,
    )
