"""Triangles drawn into images: the depth a mesh has from a view, and what lies between values at its vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.mesh.posed import PosedView

NEAR_M = 0.1  # before the camera; nearer things are not in focus


def seen_at(points_m: NDArray[np.floating], view: PosedView) -> tuple[Array, Array]:
    """Return pixels [N, 2] and depth [N] in metres of points [N, 3] of the map; pixels behind the view mean nothing."""
    T = invert(view.T_map_view)
    p = points_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    z = np.where(np.abs(p[:, 2]) > 1e-9, p[:, 2], 1e-9)
    return p[:, :2] / z[:, None] * [view.K[0, 0], view.K[1, 1]] + view.K[:2, 2], p[:, 2]


def completed_depth(
    points_m: NDArray[np.floating], triangles: NDArray[np.int32], view: PosedView
) -> NDArray[np.float32]:
    """Return a view's depth [h, w] with that of the mesh where it has none itself, 0 where neither has."""
    pixels, z = seen_at(points_m, view)
    nearness = np.where(z > NEAR_M, 1.0 / np.maximum(z, NEAR_M), 0.0)
    drawn = np.zeros((*view.depth_m.shape, 1))
    draw(pixels, nearness[:, None], triangles, drawn)
    rendered = np.divide(1.0, drawn[..., 0], out=np.zeros(view.depth_m.shape), where=drawn[..., 0] > 0.0)
    return np.where(view.depth_m > 0.0, view.depth_m, rendered).astype(np.float32)


@njit(cache=True, nogil=True)
def draw(pixels: Array, values: Array, triangles: NDArray[np.int32], out: Array) -> None:
    """Draw triangles [M, 3] of points at pixels [N, 2] that carry values [N, C] into an image [h, w, C].

    Of two, the one with the larger first value wins; triangles with a first value of 0 are left out.
    """
    rows, columns, channels = out.shape
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if min(values[a, 0], values[b, 0], values[c, 0]) <= 0.0:
            continue
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), columns - 1.0)
        top, bottom = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), rows - 1.0)
        for v in range(int(top), int(bottom) + 1):
            for u in range(int(left), int(right) + 1):
                of_a = ((bx - u) * (cy - v) - (cx - u) * (by - v)) / area
                of_b = ((cx - u) * (ay - v) - (ax - u) * (cy - v)) / area
                of_c = 1.0 - of_a - of_b
                if min(of_a, of_b, of_c) < 0.0:
                    continue
                if of_a * values[a, 0] + of_b * values[b, 0] + of_c * values[c, 0] <= out[v, u, 0]:
                    continue
                for k in range(channels):
                    out[v, u, k] = of_a * values[a, k] + of_b * values[b, k] + of_c * values[c, k]
