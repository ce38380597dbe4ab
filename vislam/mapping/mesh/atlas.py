"""Pictures laid on a mesh: each triangle shows what the keyframe that saw it best saw of it.

Views are chosen as in Waechter, Moehrle and Goesele, "Let there be color! Large-scale texturing of 3D reconstructions",
ECCV 2014, but without their graph cut: triangles of one small cube that face the same way vote for one view, and those
that it did not see, or hardly, take the best of their own. What hides a triangle is the view's own depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageU8
from vislam.mapping.cloud.cloud import cells_of
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.mesh.exposure import exposure_gains
from vislam.mapping.mesh.posed import PosedView

I64 = NDArray[np.int64]

_PATCH_M = 0.15  # edge of the cubes whose triangles vote together
_MIN_FACING = 0.2  # cosine to the ray; more grazing pictures are smeared
_HIDDEN_M = 0.03  # behind the view's depth by more than this, and twice the noise of depth: something stands before it
_NOISE_1M = 0.005
_NEAR_M = 0.1  # before the camera; nearer things are not in focus
_WHITE = 250  # of 255, in all channels: overexposed, whatever is there ...
_OVEREXPOSED = 0.1  # ... and worth so much of another picture of it
_MUCH_WORSE = 0.2  # of the score of a triangle's own best view: it takes that instead of what its cube voted for
_PLACES = 20_000  # triangles, evenly over the mesh, by which exposures are compared
_MARGIN_PX = 2  # around a chart, so that filters of viewers find colours of its own
_SMALLER = 0.85  # an atlas that gets too full gets charts smaller by this
_SMALLEST = 0.05  # less is worse than the colours of vertices


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """A mesh whose triangles come in two parts: those with a place in the picture, and those with colours alone."""

    points_m: NDArray[np.float32]  # [N, 3] of textured triangles; a point on the border of charts stands there twice
    uv: NDArray[np.float32]  # [N, 2] from the picture's upper left corner, 0 to 1
    triangles: NDArray[np.int32]  # [M, 3]
    atlas: ImageU8  # [H, W, 3] RGB
    rest: Mesh  # what no view saw well


class _Best(NamedTuple):
    """The best view of each triangle so far."""

    score: NDArray[np.float64]
    view: I64


@njit(cache=True, nogil=True, inline="always")
def _seen_from(T: Array, p: Array) -> tuple[float, float, float]:
    """Return a point [3] in the view's frame."""
    x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
    y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
    z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
    return x, y, z


@njit(cache=True, nogil=True, inline="always")
def _is_clear(depth_m: NDArray[np.float32], K: Array, point: tuple[float, float, float], must_be_known: bool) -> bool:
    """Whether nothing stands before a point of the view's frame in the pixels around it, all of them in the image."""
    x, y, z = point
    rows, columns = depth_m.shape
    if z <= _NEAR_M:
        return False
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    if not (_MARGIN_PX <= u < columns - 1 - _MARGIN_PX and _MARGIN_PX <= v < rows - 1 - _MARGIN_PX):
        return False
    slack = max(_HIDDEN_M, 2.0 * _NOISE_1M * z * z)
    i, j = int(v), int(u)
    for row in range(i, i + 2):
        for column in range(j, j + 2):
            if 0.0 < depth_m[row, column] < z - slack:
                return False
    nearest = depth_m[int(v + 0.5), int(u + 0.5)]
    return nearest < z + slack and (nearest > 0.0 or not must_be_known)


@njit(cache=True, nogil=True)
def _scores(corners: NDArray[np.float64], normals: NDArray[np.float64], depth_m: NDArray[np.float32], colors: ImageU8,
            K: Array, T: Array, out: NDArray[np.float64]) -> None:  # fmt: skip
    """Give each triangle the pixels per square metre that a view has of it, 0 where it does not see it whole.

    Where the picture is overexposed they count less.
    """
    for i in range(len(corners)):
        out[i] = 0.0
        middle = (corners[i, 0] + corners[i, 1] + corners[i, 2]) / 3.0
        x, y, z = _seen_from(T, middle)
        if not _is_clear(depth_m, K, (x, y, z), True):
            continue
        seen = True
        for k in range(3):
            seen = seen and _is_clear(depth_m, K, _seen_from(T, corners[i, k]), False)
        if not seen:
            continue
        nx = T[0, 0] * normals[i, 0] + T[0, 1] * normals[i, 1] + T[0, 2] * normals[i, 2]
        ny = T[1, 0] * normals[i, 0] + T[1, 1] * normals[i, 1] + T[1, 2] * normals[i, 2]
        nz = T[2, 0] * normals[i, 0] + T[2, 1] * normals[i, 1] + T[2, 2] * normals[i, 2]
        cosine = -(nx * x + ny * y + nz * z) / np.sqrt(x * x + y * y + z * z)
        if cosine > _MIN_FACING:
            pixel = colors[int(K[1, 1] * y / z + K[1, 2] + 0.5), int(K[0, 0] * x / z + K[0, 2] + 0.5)]
            counts = _OVEREXPOSED if min(pixel[0], pixel[1], pixel[2]) >= _WHITE else 1.0
            out[i] = counts * cosine * K[0, 0] * K[1, 1] / (z * z)


def textured(mesh: Mesh, views: Callable[[], Iterable[PosedView]], size_px: int) -> TexturedMesh | None:
    """Return the mesh with an atlas of at most `size_px` squared, None where no view sees it or that is far too small.

    Pictures are multiplied so that they agree on what they see together. Views are asked for five times, one at a time;
    the same ones give the same bytes.
    """
    corners = mesh.points_m.astype(np.float64)[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    chosen = _chosen(corners, normals, views)
    chart = _charts(mesh.triangles, chosen)
    seen = chart >= 0
    if not seen.any():
        return None
    keys, corner_at = np.unique(
        chart[seen][:, None].repeat(3, axis=1) * len(mesh.points_m) + mesh.triangles[seen], return_inverse=True
    )
    vertex, chart_of = keys % len(mesh.points_m), keys // len(mesh.points_m)
    points = mesh.points_m[vertex]
    view_of = np.zeros(int(chart.max()) + 1, np.int64)
    view_of[chart[seen]] = chosen[seen]
    pixels = np.zeros((len(points), 2))
    for k, view in enumerate(views()):
        here = view_of[chart_of] == k
        T = invert(view.T_map_view)
        p = points[here].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        pixels[here] = p[:, :2] / p[:, 2:] * [view.K[0, 0], view.K[1, 1]] + view.K[:2, 2]
    low, high = np.full((len(view_of), 2), 1 << 30), np.zeros((len(view_of), 2), np.int64)
    np.minimum.at(low, chart_of, np.floor(pixels).astype(np.int64) - _MARGIN_PX)
    np.maximum.at(high, chart_of, np.ceil(pixels).astype(np.int64) + _MARGIN_PX + 1)
    low = np.maximum(low, 0)
    packed = _packed(high - low, size_px)
    if packed is None:
        return None
    sizes, places, height = packed
    gains = _gains(corners, normals, views)
    atlas = np.zeros((height, size_px, 3), np.uint8)
    for k, view in enumerate(views()):
        for c in np.flatnonzero(view_of == k):
            part = view.colors[low[c, 1] : high[c, 1], low[c, 0] : high[c, 0]]
            (x, y), (w, h) = places[c], sizes[c]
            part = np.clip(part * gains[k] + 0.5, 0.0, 255.0).astype(np.uint8)
            atlas[y : y + h, x : x + w] = cv2.resize(part, (int(w), int(h)), interpolation=cv2.INTER_AREA)
    uv = (pixels + 0.5 - low[chart_of]) * (sizes / (high - low))[chart_of] + places[chart_of]
    rest = mesh.select(~seen)
    uv = (uv / [size_px, height]).astype(np.float32)
    return TexturedMesh(points, uv, corner_at.reshape(-1, 3).astype(np.int32), atlas, rest)


def _chosen(corners: Array, normals: Array, views: Callable[[], Iterable[PosedView]]) -> I64:
    """Return the view of each triangle, -1 for none."""
    middle = corners.mean(axis=1)
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (normals[np.arange(len(normals)), axis] > 0.0)
    patch = cells_of(middle, _PATCH_M) * 6 + side
    patches = int(patch.max(initial=-1)) + 1
    own = _Best(np.zeros(len(corners)), np.full(len(corners), -1, np.int64))
    voted = _Best(np.zeros(patches), np.full(patches, -1, np.int64))
    score = np.zeros(len(corners))
    for k, view in enumerate(views()):
        _score(corners, normals, view, score)
        votes = np.bincount(patch, weights=score, minlength=patches)
        for best, value in ((own, score), (voted, votes)):
            better = value > best.score
            best.score[better], best.view[better] = value[better], k
    out = own.view.copy()
    for k, view in enumerate(views()):
        _score(corners, normals, view, score)
        out[(voted.view[patch] == k) & (score > _MUCH_WORSE * own.score)] = k
    return out


def _score(corners: Array, normals: Array, view: PosedView, out: Array) -> None:
    T = np.ascontiguousarray(invert(view.T_map_view))
    _scores(corners, normals, view.depth_m, view.colors, np.ascontiguousarray(view.K), T, out)


def _gains(corners: Array, normals: Array, views: Callable[[], Iterable[PosedView]]) -> Array:
    """Return what to multiply the pictures by [V, 3], by places that are evenly spread over the mesh."""
    every = -(-len(corners) // _PLACES)
    some, facing = corners[::every], normals[::every]
    return exposure_gains([_colors_seen(some, facing, view) for view in views()], len(some))


def _colors_seen(corners: Array, normals: Array, view: PosedView) -> tuple[I64, ImageU8]:
    """Return which triangles a view sees, and the colours [M, 3] in their middles."""
    score = np.zeros(len(corners))
    _score(corners, normals, view, score)
    seen = np.flatnonzero(score > 0.0)
    T = invert(view.T_map_view)
    p = (corners[seen].mean(axis=1) @ T[:3, :3].T + T[:3, 3]) @ view.K.T
    column, row = np.round(p[:, :2] / p[:, 2:]).astype(np.int64).T
    return seen, view.colors[row, column]


def _charts(triangles: NDArray[np.int32], chosen: I64) -> I64:
    """Return the number of each triangle's chart, -1 where it has no view: neighbours with the same view share one."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1) & (chosen[owner[1:]] == chosen[owner[:-1]])
    a, b = owner[:-1][same], owner[1:][same]
    links = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(len(triangles), len(triangles)))
    _, parts = connected_components(links, directed=False)
    parts = np.asarray(parts, np.int64)
    out = np.full(len(triangles), -1, np.int64)
    seen = chosen >= 0
    _, out[seen] = np.unique(parts[seen], return_inverse=True)
    return out


def _packed(extent: I64, size_px: int) -> tuple[I64, I64, int] | None:
    """Return sizes [C, 2] and places [C, 2] of charts on shelves of one width, and the height; None where none fits."""
    scale = 1.0
    while scale > _SMALLEST:
        sizes = np.maximum(np.ceil(extent * scale).astype(np.int64), 1)
        places = np.zeros_like(sizes)
        x, y, shelf = 0, 0, 0
        for c in np.lexsort((np.arange(len(sizes)), -sizes[:, 1])):
            w, h = sizes[c]
            if x + w > size_px:
                x, y, shelf = 0, y + shelf, 0
            places[c] = x, y
            x, shelf = x + w, max(shelf, int(h))
        if y + shelf <= size_px and sizes[:, 0].max() <= size_px:
            return sizes, places, int(y + shelf)
        scale *= _SMALLER
    return None
