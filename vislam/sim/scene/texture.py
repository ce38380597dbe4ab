"""The colour of a surface under a pixel: mip maps, probes along the pixel's footprint, samples along its motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array

_MAX_PROBES = 4
_BLEND = 2.0  # how much narrower than the distance between mip levels their blending is

Color = tuple[np.float32, np.float32, np.float32]  # blue, green, red in display encoding
Motion = tuple[float, float]  # of a point in the image while the shutter is open, in lengths of a ray (x, y, 1)
Filter = tuple[float, int, float, float, int, float, float]
"""Mip level, probes, step between them in metres along u and v; samples along the motion, and its whole length."""


@njit(cache=True, nogil=True)
def _bilinear(texels: NDArray[np.uint32], offset: int, width: int, height: int, x: float, y: float) -> Color:
    """Return the colour of a mip level at texel coordinates; borders are held."""
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
def footprint(
    ray: tuple[float, float],
    hit: tuple[float, float],
    motion: Motion,
    is_cylinder: bool,
    s: Array,
    level_count: int,
    pixel_rad: float,
    most: int,
) -> Filter:
    """Return how to sample a surface under a pixel.

    Args:
        ray: x and y of the pixel's ray (x, y, 1).
        hit: its depth, and metres along the surface's u.
        motion: of the surface's point in the image while the shutter is open.
        is_cylinder: what the surface is.
        s: the surface as the camera has it, see `turn_to`.
        level_count: number of its mip levels.
        pixel_rad: width of a pixel.
        most: samples along the motion at most.
    """
    (x, y), (t, a), (mx, my) = ray, hit, motion
    along_u, along_v, along_n = s[3] * x + s[4] * y + s[5], s[6] * x + s[7] * y + s[8], s[9] * x + s[10] * y + s[11]
    move_u, move_v, move_n = s[3] * mx + s[4] * my, s[6] * mx + s[7] * my, s[9] * mx + s[10] * my
    if is_cylinder:
        angle = 2.0 * np.pi * a / s[12]
        sine, cosine = np.sin(angle), np.cos(angle)
        along_u, along_n = cosine * along_n - sine * along_u, cosine * along_u + sine * along_n
        move_u, move_n = cosine * move_n - sine * move_u, cosine * move_u + sine * move_n
    in_plane = along_u * along_u + along_v * along_v
    ratio = min(np.sqrt(1.0 + in_plane / (along_n * along_n + 1e-9)), 50.0)
    probes = min(_MAX_PROBES, int(ratio + 0.5))
    step_m = t * pixel_rad * ratio / probes
    level = min(max(np.log2(np.float32(step_m * s[14])), 0.0), level_count - 1.0)
    norm = step_m / np.sqrt(in_plane + 1e-12)
    # The pixel looks at where the ray meets the tangent plane; that runs against the motion of what it sees.
    sink = move_n / min(along_n, -1e-3)
    samples = max(min(int(np.ceil(np.sqrt(mx * mx + my * my) / pixel_rad)), most), 1)
    return (
        level, probes, norm * along_u, norm * along_v, samples,
        t * (sink * along_u - move_u), t * (sink * along_v - move_v),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def sample(
    filtered: Filter, a: float, b: float, s: Array, texels: NDArray[np.uint32], levels: NDArray[np.int64]
) -> Color:
    """Return the colour of a surface at `a`, `b` metres along its u and v, averaged over its motion."""
    level, probes, step_u_m, step_v_m, count, move_u, move_v = filtered
    low = int(level)
    # Sharp between levels, blended only around the middle: most pixels then read one level instead of two.
    fraction = np.float32(min(max(_BLEND * (level - low - 0.5) + 0.5, 0.0), 1.0))
    begin, end = (1 if fraction == 1.0 else 0), (1 if fraction == 0.0 else 2)
    blue, green, red = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(count):
        part = (k + 0.5) / count - 0.5
        a_k, b_k = a + part * move_u, b + part * move_v
        one_b, one_g, one_r = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for m in range(begin, end):
            weight = (fraction if m == 1 else np.float32(1.0) - fraction) / np.float32(probes)
            offset, width, height = levels[low + m, 0], levels[low + m, 1], levels[low + m, 2]
            scale_u, scale_v = width / s[12], height / s[13]
            step_u, step_v = step_u_m * scale_u, step_v_m * scale_v
            x = a_k * scale_u - 0.5 - 0.5 * (probes - 1) * step_u
            y = b_k * scale_v - 0.5 - 0.5 * (probes - 1) * step_v
            for _ in range(probes):
                texel = _bilinear(texels, offset, width, height, x, y)
                one_b, one_g, one_r = one_b + weight * texel[0], one_g + weight * texel[1], one_r + weight * texel[2]
                x, y = x + step_u, y + step_v
        if count == 1:
            return one_b, one_g, one_r
        # Light adds up linearly; squares are close enough to the 2.2 of the display encoding, and fast.
        blue, green, red = blue + one_b * one_b, green + one_g * one_g, red + one_r * one_r
    scale = np.float32(1.0) / np.float32(count)
    return np.sqrt(scale * blue), np.sqrt(scale * green), np.sqrt(scale * red)
