"""Depth of a camera with a lens and a place of its own, as the colour camera's pixels see it.

Every depth pixel is the area between its four corners, which neighbours on one surface share: whatever the sizes of
both images, a surface that depth covers has no holes. Within it the inverse depth is linear in the image, as that of a
plane is (see `depth_surface`), and where areas overlap the nearest wins. What colour sees and depth does not, behind
an edge, has no depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.lens import Lens, imaged
from vislam.core.messages import Array, ImageF32

_ONE_SURFACE = 0.05  # of inverse depth: neighbours that differ by more do not share their corners
_OVERLAP_PX = 0.05  # closes what is left where three of four neighbours share a corner
_MOST_LARGER = 4.0  # an area over this times what the focal lengths make it lies nearer to colour than to depth: damage
_LEAST_AREA_PX2 = 1e-6  # a slope over less is no slope
_LEAST_Z = 1e-3  # of a point's z, over its depth: what is not before the colour camera


@dataclass(frozen=True, slots=True, eq=False)
class DepthCamera:
    """The lens that depth images are seen through, and where it sits: `T_color_depth` [4, 4], metres."""

    camera: Camera
    T_color_depth: Array


class DepthRegistration:
    """Registers the images of one depth camera to one colour camera; threads may use it at once."""

    def __init__(self, depth: DepthCamera, color: Camera) -> None:
        """Take both cameras and prepare the rays of the corners of depth pixels."""
        self._from, self._color = depth, color
        u, v = np.meshgrid(np.arange(depth.camera.width + 1) - 0.5, np.arange(depth.camera.height + 1) - 0.5)
        rays = depth.camera.normalise(np.column_stack([u.ravel(), v.ravel()]))
        self._rays = np.ascontiguousarray(rays.reshape(*u.shape, 2))
        self._T = np.ascontiguousarray(depth.T_color_depth, dtype=np.float64)
        larger = max(color.fx / depth.camera.fx, color.fy / depth.camera.fy, 1.0)
        self._most_px = _MOST_LARGER * larger

    def registered(self, depth_m: ImageF32) -> ImageF32:
        """Return z-depth in the colour camera [H, W] of z-depth in the depth camera [h, w], both in metres.

        0, NaN and infinity mean that nothing was measured; where nothing is seen there is 0. Raises DataError when the
        image is not of the depth camera's size.
        """
        if depth_m.shape != (self._from.camera.height, self._from.camera.width):
            raise DataError(
                f"depth is {'x'.join(map(str, depth_m.shape[::-1]))} but its calibration is for "
                f"{self._from.camera.width}x{self._from.camera.height}; correct the resolution of depth"
            )
        depth = np.ascontiguousarray(depth_m, dtype=np.float32)
        size = (self._color.height, self._color.width)
        return np.asarray(_registered(depth, self._rays, self._T, self._color.lens, self._most_px, size))


@njit(cache=True, nogil=True)
def _registered(depth: ImageF32, rays: Array, T: Array, lens: Lens, most_px: float, size: tuple[int, int]) -> ImageF32:
    rho = _inverse(depth)
    shared = _shared_corners(rho, rays, T, lens)
    nearest, quad = np.zeros(size), np.empty((4, 3))
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            own, x, y = rho[i + 1, j + 1], 0.0, 0.0
            if own == 0.0:
                continue
            for k in range(4):
                r, c = i + k // 2, j + k % 2
                x, y = x + 0.25 * rays[r, c, 0], y + 0.25 * rays[r, c, 1]
                u, v, q = shared[r, c, 0], shared[r, c, 1], shared[r, c, 2]
                if np.isnan(u):
                    u, v, q = _seen(_mean(rho, r, c, own), rays[r, c, 0], rays[r, c, 1], T, lens)
                quad[k, 0], quad[k, 1], quad[k, 2] = u, v, q
            ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] + T[2, 3] * own
            if ahead > _LEAST_Z:
                _fill(nearest, quad, own / ahead, most_px)
    out = np.zeros(size, dtype=np.float32)
    for i in range(size[0]):
        for j in range(size[1]):
            if nearest[i, j] > 0.0:
                out[i, j] = 1.0 / nearest[i, j]
    return out


@njit(cache=True, nogil=True)
def _inverse(depth: ImageF32) -> Array:
    """Return inverse depth [h + 2, w + 2], 0 where it is unknown and in a rim around it."""
    rho = np.zeros((depth.shape[0] + 2, depth.shape[1] + 2))
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = depth[i, j]
            if z > 0.0 and z < np.inf:
                rho[i + 1, j + 1] = 1.0 / z
    return rho


@njit(cache=True, nogil=True)
def _shared_corners(rho: Array, rays: Array, T: Array, lens: Lens) -> Array:
    """Return pixel and inverse depth [h + 1, w + 1, 3] of corners whose four pixels are of one surface, else NaN."""
    out = np.full((len(rays), rays.shape[1], 3), np.nan)
    for i in range(len(rays)):
        for j in range(rays.shape[1]):
            a, b, c, d = rho[i, j], rho[i, j + 1], rho[i + 1, j], rho[i + 1, j + 1]
            lowest = min(a, b, c, d)
            if lowest > 0.0 and max(a, b, c, d) - lowest <= _ONE_SURFACE * lowest:
                seen = _seen(0.25 * (a + b + c + d), rays[i, j, 0], rays[i, j, 1], T, lens)
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = seen
    return out


@njit(cache=True, nogil=True)
def _mean(rho: Array, i: int, j: int, own: float) -> float:
    """Return the mean inverse depth of those of four pixels at a corner that are of the surface of one of them."""
    total, count = 0.0, 0
    for r in range(i, i + 2):
        for c in range(j, j + 2):
            if abs(rho[r, c] - own) <= _ONE_SURFACE * own:
                total, count = total + rho[r, c], count + 1
    return total / count


@njit(cache=True, nogil=True)
def _seen(rho: float, x: float, y: float, T: Array, lens: Lens) -> tuple[float, float, float]:
    """Return colour pixel and inverse depth in the colour camera of a point on the ray (x, y, 1); NaN if not seen."""
    px, py, pz = (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] + T[0, 3] * rho,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] + T[1, 3] * rho,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] + T[2, 3] * rho,
    )
    if not pz > _LEAST_Z:
        return np.nan, np.nan, np.nan
    u, v, _, _, _, _ = imaged(px / pz, py / pz, lens)
    return u + lens.pinhole[2], v + lens.pinhole[3], rho / pz


@njit(cache=True, nogil=True)
def _fill(nearest: Array, quad: Array, middle: float, most_px: float) -> None:
    """Draw an area of four corners [4, 3] whose middle has the inverse depth `middle` wherever it is the nearest."""
    left = right = quad[0, 0]
    top = bottom = quad[0, 1]
    lowest = highest = middle
    u = v = 0.0
    for k in range(4):
        left, right = min(left, quad[k, 0]), max(right, quad[k, 0])
        top, bottom = min(top, quad[k, 1]), max(bottom, quad[k, 1])
        lowest, highest = min(lowest, quad[k, 2]), max(highest, quad[k, 2])
        u, v = u + 0.25 * quad[k, 0], v + 0.25 * quad[k, 1]
    if not (right - left <= most_px and bottom - top <= most_px and u + v < np.inf):  # NaN too
        return
    rows, columns = _whole(top, bottom, nearest.shape[0]), _whole(left, right, nearest.shape[1])
    across_u, down_u = _across(quad, 0)
    across_v, down_v = _across(quad, 1)
    across_q, down_q = _across(quad, 2)
    determinant = across_u * down_v - across_v * down_u
    by_u = by_v = 0.0
    if abs(determinant) > _LEAST_AREA_PX2:
        by_u = (across_q * down_v - across_v * down_q) / determinant
        by_v = (across_u * down_q - across_q * down_u) / determinant
    for row in range(rows[0], rows[1]):
        for column in range(columns[0], columns[1]):
            value = min(max(middle + by_u * (column - u) + by_v * (row - v), lowest), highest)
            nearest[row, column] = max(nearest[row, column], value)


@njit(cache=True, nogil=True)
def _whole(low: float, high: float, count: int) -> tuple[int, int]:
    """Return the first of whole pixels between two places, and the one behind the last."""
    first, behind = np.ceil(low - _OVERLAP_PX), np.floor(high + _OVERLAP_PX) + 1.0
    return int(min(max(first, 0.0), float(count))), int(min(max(behind, 0.0), float(count)))


@njit(cache=True, nogil=True)
def _across(quad: Array, k: int) -> tuple[float, float]:
    """Return twice by how much a number of four corners grows to the right and down."""
    return quad[1, k] + quad[3, k] - quad[0, k] - quad[2, k], quad[2, k] + quad[3, k] - quad[0, k] - quad[1, k]
