"""Pictures laid on a mesh: each triangle shows what the view chosen for it saw of it, and borders are levelled."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vislam.core.messages import Array, ImageU8
from vislam.mapping.cloud.mesh import Mesh
from vislam.mapping.mesh.choice import MARGIN_PX, WHITE, Faces, chosen_views, scores
from vislam.mapping.mesh.drawing import draw, seen_at
from vislam.mapping.mesh.edges import neighbours
from vislam.mapping.mesh.exposure import exposure_gains
from vislam.mapping.mesh.posed import PosedView
from vislam.mapping.mesh.seams import offsets

I64 = NDArray[np.int64]

_PLACES = 20_000  # triangles, evenly over the mesh, by which exposures are compared
_BLUR_PX = 5  # over which colours at borders are averaged: poses are not exact to the pixel
_SMALLER = 0.85  # an atlas that gets too full gets charts smaller by this
_SMALLEST = 0.05  # less is worse than the colours of vertices


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """A mesh whose triangles come in two parts: those with a place in the picture, and those with colours alone."""

    points_m: NDArray[np.float32]  # [N, 3] of textured triangles; a point on the border of charts stands there twice
    uv: NDArray[np.float32]  # [N, 2] from the picture's upper left corner, 0 to 1
    triangles: NDArray[np.int32]  # [M, 3]
    atlas: ImageU8  # [H, W, 3] RGB
    rest: Mesh  # what no view saw
    filled: int = 0  # of the last triangles, how many close holes


@dataclass(frozen=True, slots=True, eq=False)
class _Charts:
    """Connected triangles that show one view, and their corners: a point on a border is one of each chart."""

    number: I64  # [M] of the triangles in the mesh
    of_triangle: I64  # [M]
    view: I64  # [C]
    of_corner: I64  # [P]
    vertex: I64  # [P] of the mesh
    triangles: NDArray[np.int32]  # [M, 3] of corners


def textured(mesh: Mesh, views: Callable[[], Iterable[PosedView]], size_px: int) -> TexturedMesh | None:
    """Return the mesh with an atlas of at most `size_px` squared, None where no view sees it or that is far too small.

    Pictures are multiplied so that they agree on what they see together. Views are asked for five times, one at a time;
    the same ones give the same bytes.
    """
    faces, pairs = Faces.of(mesh), neighbours(mesh.triangles)
    gains = _gains(faces, views)
    chosen = chosen_views(faces, pairs, views, gains)
    if not (chosen >= 0).any():
        return None
    charts = _charts(mesh, chosen, pairs)
    points, at_view = mesh.points_m[charts.vertex], charts.view[charts.of_corner]
    pixels, colors = np.zeros((len(points), 2)), np.zeros((len(points), 3))
    for k, view in enumerate(views()):
        if (here := np.flatnonzero(at_view == k)).size:
            pixels[here], _ = seen_at(points[here], view)
            column, row = np.round(pixels[here]).astype(np.int64).T
            colors[here] = cv2.blur(view.colors, (_BLUR_PX, _BLUR_PX))[row, column] * gains[k]
            brightest = cv2.dilate(view.colors.min(axis=2), np.ones((_BLUR_PX, _BLUR_PX), np.uint8))
            colors[here[brightest[row, column] >= WHITE]] = np.nan
    low, high = np.full((len(charts.view), 2), 1 << 30), np.zeros((len(charts.view), 2), np.int64)
    np.minimum.at(low, charts.of_corner, np.floor(pixels).astype(np.int64) - MARGIN_PX)
    np.maximum.at(high, charts.of_corner, np.ceil(pixels).astype(np.int64) + MARGIN_PX + 1)
    low = np.maximum(low, 0)
    packed = _packed(high - low, size_px)
    if packed is None:
        return None
    sizes, places, height = packed
    level = np.column_stack([np.ones(len(points)), offsets(colors, charts.vertex, charts.triangles)])
    first = np.searchsorted(charts.of_triangle, np.arange(len(charts.view) + 1))
    atlas = np.zeros((height, size_px, 3), np.uint8)
    for k, view in enumerate(views()):
        for c in np.flatnonzero(charts.view == k):
            part = view.colors[low[c, 1] : high[c, 1], low[c, 0] : high[c, 0]]
            corners, local = np.unique(charts.triangles[first[c] : first[c + 1]], return_inverse=True)
            shift = _between(pixels[corners] - low[c], level[corners], local.reshape(-1, 3), part.shape[:2])
            part = np.clip(part * gains[k] + shift + 0.5, 0.0, 255.0).astype(np.uint8)
            (x, y), (w, h) = places[c], sizes[c]
            atlas[y : y + h, x : x + w] = cv2.resize(part, (int(w), int(h)), interpolation=cv2.INTER_AREA)
    uv = (pixels + 0.5 - low[charts.of_corner]) * (sizes / (high - low))[charts.of_corner] + places[charts.of_corner]
    uv = (uv / [size_px, height]).astype(np.float32)
    is_filled = charts.number >= len(mesh.triangles) - mesh.filled
    triangles = charts.triangles[np.argsort(is_filled, kind="stable")]
    return TexturedMesh(points, uv, triangles, atlas, mesh.select(chosen < 0), int(is_filled.sum()))


def _between(pixels: Array, values: Array, triangles: I64, size: tuple[int, int]) -> Array:
    """Return offsets [h, w, 3] between the corners of a chart, and around it those of the nearest."""
    drawn = np.zeros((*size, 4))
    draw(pixels, values, triangles.astype(np.int32), drawn)
    known = drawn[..., 0] > 0.0
    around = cv2.blur(drawn, (2 * MARGIN_PX + 3,) * 2, borderType=cv2.BORDER_CONSTANT)
    around = around[..., 1:] / np.maximum(around[..., :1], 1e-9)
    return np.where(known[..., None], drawn[..., 1:], around)


def _gains(faces: Faces, views: Callable[[], Iterable[PosedView]]) -> Array:
    """Return what to multiply the pictures by [V, 3], by places that are evenly spread over the mesh."""
    some = faces.every(-(-len(faces.corners) // _PLACES))
    return exposure_gains([_colors_seen(some, view) for view in views()], len(some.corners))


def _colors_seen(faces: Faces, view: PosedView) -> tuple[I64, ImageU8]:
    """Return which triangles a view sees, and the colours [M, 3] in their middles."""
    seen = np.flatnonzero(scores(faces, view, np.ones(3)) > 0.0)
    pixels, _ = seen_at(faces.corners[seen].mean(axis=1), view)
    column, row = np.round(pixels).astype(np.int64).T
    return seen, view.colors[row, column]


def _charts(mesh: Mesh, chosen: NDArray[np.int32], pairs: I64) -> _Charts:
    """Return the charts, in order, of triangles with a chosen view each, -1 for none, and pairs of neighbours."""
    a, b = pairs[chosen[pairs[:, 0]] == chosen[pairs[:, 1]]].T
    links = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(len(chosen), len(chosen)))
    seen = np.flatnonzero(chosen >= 0)
    _, first, chart = np.unique(connected_components(links, directed=False)[1][seen], True, return_inverse=True)
    order = np.argsort(chart, kind="stable")
    keys, corners = np.unique(
        chart[order, None] * len(mesh.points_m) + mesh.triangles[seen[order]], return_inverse=True
    )
    return _Charts(
        seen[order],
        chart[order], chosen[seen[first]].astype(np.int64), keys // len(mesh.points_m), keys % len(mesh.points_m),
        corners.reshape(-1, 3).astype(np.int32),
    )  # fmt: skip


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
