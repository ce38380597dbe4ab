"""Drawing points and triangles into an image with a depth buffer, on the processor.

Points are blended discs on the nearest surface (surface splatting, Zwicker et al., SIGGRAPH 2001, without the
anisotropic kernel); shading is eye-dome lighting (Boucheny 2009), which needs depth alone and makes shapes readable.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit

F32 = NDArray[np.float32]


@njit(cache=True, nogil=True)
def project_points(
    points: NDArray[np.float64],
    R: NDArray[np.float64],
    t: NDArray[np.float64],
    focal_px: float,
    centre: NDArray[np.float64],
    near: float,
) -> tuple[F32, F32]:
    """Return pixels [N, 2] and depth [N] of points [N, 3]; depth below `near` divides as if it were `near`."""
    pixels, depth = np.empty((len(points), 2), np.float32), np.empty(len(points), np.float32)
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
        depth[i] = z
        z = max(z, near)
        pixels[i, 0], pixels[i, 1] = focal_px * x / z + centre[0], focal_px * y / z + centre[1]
    return pixels, depth


@njit(cache=True, nogil=True)
def splat_depth(pixels: F32, z: F32, radius: F32, depth: F32) -> None:
    """Lower the depth buffer [H, W] where discs at pixels [N, 2] with radius [N] px are nearer."""
    rows, columns = depth.shape
    for i in range(len(z)):
        u, v, r = pixels[i, 0], pixels[i, 1], radius[i]
        for y in range(max(int(np.ceil(v - r)), 0), min(int(np.floor(v + r)), rows - 1) + 1):
            for x in range(max(int(np.ceil(u - r)), 0), min(int(np.floor(u + r)), columns - 1) + 1):
                if (x - u) ** 2 + (y - v) ** 2 <= r * r and z[i] < depth[y, x]:
                    depth[y, x] = z[i]


@njit(cache=True, nogil=True)
def splat_colors(pixels: F32, z: F32, radius: F32, colors: F32, depth: F32, thickness: float) -> F32:
    """Return the image [H, W, 4] of blended colour and coverage of all discs within `thickness` behind the surface.

    The depth buffer becomes the blended depth, which is smoother than that of single discs.
    """
    rows, columns = depth.shape
    out = np.zeros((rows, columns, 4), np.float32)
    deep = np.zeros((rows, columns), np.float32)
    for i in range(len(z)):
        u, v, r = pixels[i, 0], pixels[i, 1], radius[i]
        for y in range(max(int(np.ceil(v - r)), 0), min(int(np.floor(v + r)), rows - 1) + 1):
            for x in range(max(int(np.ceil(u - r)), 0), min(int(np.floor(u + r)), columns - 1) + 1):
                share = 1.0 - ((x - u) ** 2 + (y - v) ** 2) / (r * r)
                if share > 0.0 and z[i] <= depth[y, x] + thickness:
                    weight = share * share + 1e-4
                    for c in range(3):
                        out[y, x, c] += weight * colors[i, c]
                    out[y, x, 3] += weight
                    deep[y, x] += weight * z[i]
    for y in range(rows):
        for x in range(columns):
            weight = out[y, x, 3]
            if weight > 0.0:
                depth[y, x] = deep[y, x] / weight
                for c in range(3):
                    out[y, x, c] /= weight
                out[y, x, 3] = 1.0
    return out


@njit(cache=True, nogil=True)
def fill_triangles(pixels: F32, z: F32, colors: F32, triangles: NDArray[np.int32], depth: F32, image: F32) -> None:
    """Draw triangles [M, 3] of vertex pixels [N, 2], z [N], colours [N, 3] into depth [H, W] and image [H, W, 4]."""
    rows, columns = depth.shape
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        top, bottom = max(int(np.ceil(min(ay, by, cy))), 0), min(int(np.floor(max(ay, by, cy))), rows - 1)
        left, right = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(np.floor(max(ax, bx, cx))), columns - 1)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                wa, wb, wc = wa / z[a], wb / z[b], wc / z[c]  # perspective: linear in 1/z
                here = 1.0 / (wa + wb + wc)
                if here < depth[y, x]:
                    depth[y, x] = here
                    for k in range(3):
                        image[y, x, k] = here * (wa * colors[a, k] + wb * colors[b, k] + wc * colors[c, k])
                    image[y, x, 3] = 1.0


@njit(cache=True, nogil=True)
def light_onto(paper: NDArray[np.uint8], image: F32, depth: F32, radius: int, strength: float, noise_m: float) -> None:
    """Put the covered pixels of an image [H, W, 4] onto paper [H, W, 3], darker where neighbours are nearer to the eye.

    Neighbours at one and at three radii are asked, in eight directions; steps up to `noise_m` cast no shadow.
    """
    rows, columns = depth.shape
    log_depth = np.log(depth)
    for y in range(rows):
        for x in range(columns):
            if image[y, x, 3] == 0.0:
                continue
            here = log_depth[y, x] - noise_m / depth[y, x]
            hidden = 0.0
            for ring in range(2):
                reach = radius * (1 + 2 * ring)
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        yy, xx = y + dy * reach, x + dx * reach
                        if 0 <= yy < rows and 0 <= xx < columns and log_depth[yy, xx] < here:
                            hidden += min(here - log_depth[yy, xx], 0.04) / (1.0 + ring)
            light = np.exp(-strength * hidden / 8.0)
            for c in range(3):
                paper[y, x, c] = np.uint8(min(max(image[y, x, c] * light + 0.5, 0.0), 255.0))
