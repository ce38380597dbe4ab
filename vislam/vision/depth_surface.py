"""The surface that one depth image shows: a small organised map of planes, one per pixel, with how sure each is.

The inverse depth of a plane is linear in the image, so a plane through a neighbourhood is one linear fit whose noise is
the same everywhere for sensors that measure disparity (sigma_z = c z^2, see `frontend.view.ImageDepth`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import se3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32

_WIDTH_PX = 160  # about that of surfaces: their planes are smooth, and finer ones only cost time
_RADIUS = 2  # of the square of pixels that a plane is fitted to
_LEAST = 9  # pixels of that square with depth on the same surface
_ONE_SURFACE = 0.05  # of inverse depth: pixels that differ by more, in a block or from the middle, lie across an edge


class Surface(NamedTuple):
    """What alignment needs of each pixel; NaN where there is no surface."""

    points: Array  # [H, W, 3] in metres, in the camera
    planes: Array  # [H, W, 3] m with m @ p == 1 on the plane; its normal is m / |m|, its distance 1 / |m|
    tilt: Array  # [H, W] standard deviation of the normal's direction in rad, about either axis


@dataclass(frozen=True, slots=True, eq=False)
class DepthSurface:
    """A depth image as a surface, and the small camera that sees it."""

    camera: Camera
    surface: Surface

    @property
    def share(self) -> float:
        """Return which part of the pixels has a surface."""
        return float(np.isfinite(self.surface.planes[..., 0]).mean())

    def at_once(self, sweep: Array) -> DepthSurface:
        """Return what a camera would have seen that took all rows when it took the middle one.

        Its twist from the first to the last row was `sweep` [6], rotation first. Surfaces stay at the pixels that saw
        them, some pixels beside those that would have.
        """
        height = self.camera.height
        T = np.array([se3_exp((row / (height - 1.0) - 0.5) * sweep) for row in range(height)])
        points, planes, tilt = self.surface
        points, planes = _at_once(points, planes, T, sweep, self.camera.fy / (height - 1.0))
        return replace(self, surface=Surface(points, planes, tilt))


class SurfaceMaker:
    """Makes surfaces of the depth images of one camera."""

    def __init__(self, camera: Camera, nearest_m: float, farthest_m: float, sigma_rho: float) -> None:
        """Take the camera that depth is registered to, between which depths it counts, and its noise.

        `sigma_rho` is the standard deviation of inverse depth in 1/m, of a pixel.
        """
        self._range_m, self._sigma_rho = (nearest_m, farthest_m), sigma_rho
        self._full, self._block = camera, max(1, round(camera.width / _WIDTH_PX))
        small = camera.scaled(1.0 / self._block)
        self.camera = replace(small, width=camera.width // self._block, height=camera.height // self._block)
        u, v = np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height))
        xy = self.camera.normalise(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        self._xy = np.ascontiguousarray(xy.reshape(*u.shape, 2))

    def make(self, depth_m: ImageF32) -> DepthSurface:
        """Return the surface of a depth image [H, W]; holes, edges and depth out of range are left out.

        Raises DataError when the image does not have the size of the camera.
        """
        self._full.check_image(depth_m)
        if depth_m.ndim != 2:
            raise DataError(f"a depth image has rows and columns, this one has the shape {depth_m.shape}")
        rho = _reduced(np.ascontiguousarray(depth_m, dtype=np.float32), self._block, *self._range_m)
        return DepthSurface(self.camera, Surface(*_planes(rho, self._xy, self._sigma_rho)))


@njit(cache=True, nogil=True)
def _reduced(depth: ImageF32, block: int, nearest: float, farthest: float) -> Array:
    """Return the mean inverse depth of blocks of pixels; NaN where less than half is there, or an edge goes through."""
    out = np.full((depth.shape[0] // block, depth.shape[1] // block), np.nan)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total, count, lowest, highest = 0.0, 0, np.inf, 0.0
            for r in range(i * block, (i + 1) * block):
                for c in range(j * block, (j + 1) * block):
                    z = float(depth[r, c])
                    if not (z >= nearest and z <= farthest):
                        continue
                    rho = 1.0 / z
                    total, count = total + rho, count + 1
                    lowest, highest = min(lowest, rho), max(highest, rho)
            if 2 * count >= block * block and count > 0 and highest - lowest <= _ONE_SURFACE * highest:
                out[i, j] = total / count
    return out


@njit(cache=True, nogil=True)
def _planes(rho: Array, xy: Array, sigma_rho: float) -> tuple[Array, Array, Array]:
    """Return points, planes and tilts of `Surface`, by least squares of rho = a x + b y + c around every pixel."""
    height, width = rho.shape
    points, planes = np.full((height, width, 3), np.nan), np.full((height, width, 3), np.nan)
    tilt = np.full((height, width), np.nan)
    for i in range(height):
        for j in range(width):
            if not np.isfinite(rho[i, j]) or not np.isfinite(xy[i, j, 0]):
                continue
            A, b, squares, count = np.zeros((3, 3)), np.zeros(3), 0.0, 0
            for r in range(max(i - _RADIUS, 0), min(i + _RADIUS + 1, height)):
                for c in range(max(j - _RADIUS, 0), min(j + _RADIUS + 1, width)):
                    value = rho[r, c] - rho[i, j]
                    if not abs(value) <= _ONE_SURFACE * rho[i, j]:  # NaN too
                        continue
                    x, y = xy[r, c, 0] - xy[i, j, 0], xy[r, c, 1] - xy[i, j, 1]
                    A[0, 0] += x * x
                    A[0, 1] += x * y
                    A[1, 1] += y * y
                    A[0, 2] += x
                    A[1, 2] += y
                    b[0] += x * value
                    b[1] += y * value
                    b[2] += value
                    squares += value * value
                    count += 1
            if count < _LEAST:
                continue
            # the mean is taken out first: what is left are two equations
            n = float(count)
            sxx, sxy, syy = A[0, 0] - A[0, 2] ** 2 / n, A[0, 1] - A[0, 2] * A[1, 2] / n, A[1, 1] - A[1, 2] ** 2 / n
            bx, by = b[0] - A[0, 2] * b[2] / n, b[1] - A[1, 2] * b[2] / n
            determinant = sxx * syy - sxy * sxy
            if not determinant > 1e-2 * sxx * syy:
                continue
            sa, sb = (syy * bx - sxy * by) / determinant, (sxx * by - sxy * bx) / determinant
            here = (b[2] - sa * A[0, 2] - sb * A[1, 2]) / n
            left = max(squares - b[2] * b[2] / n - sa * bx - sb * by, 0.0) / (n - 3.0)
            x0, y0, at = xy[i, j, 0], xy[i, j, 1], rho[i, j] + here
            planes[i, j, 0], planes[i, j, 1], planes[i, j, 2] = sa, sb, at - sa * x0 - sb * y0
            points[i, j, 0], points[i, j, 1], points[i, j, 2] = x0 / at, y0 / at, 1.0 / at
            size2 = sa * sa + sb * sb + planes[i, j, 2] ** 2
            variance = max(left, 0.25 * sigma_rho * sigma_rho) * 0.5 * (sxx + syy) / determinant
            tilt[i, j] = np.sqrt(variance / size2)
    return points, planes, tilt


@njit(cache=True, nogil=True)
def _at_once(points: Array, planes: Array, T: Array, sweep: Array, rows_by_slope: float) -> tuple[Array, Array]:
    """Return points and planes [H, W, 3] with each row moved by its T [H, 4, 4].

    A wall that is seen row by row is bent as well: the next row's points are displaced by more. `rows_by_slope` is by
    which part of all rows a point is seen lower whose y grows by its z.
    """
    moved, turned = np.full_like(points, np.nan), np.full_like(planes, np.nan)
    w, v = sweep[:3], sweep[3:]
    for i in range(len(points)):
        R, t = np.ascontiguousarray(T[i, :3, :3]), T[i, :3, 3]
        for j in range(points.shape[1]):
            p, m = points[i, j], planes[i, j]
            if not np.isfinite(m[0]):
                continue
            by_row = np.array([w[1] * p[2] - w[2] * p[1], w[2] * p[0] - w[0] * p[2], w[0] * p[1] - w[1] * p[0]]) + v
            row_by = np.array([0.0, rows_by_slope / p[2], -rows_by_slope * p[1] / (p[2] * p[2])])
            turned[i, j] = R @ (m - row_by * ((by_row @ m) / (1.0 + by_row @ row_by)))
            moved[i, j] = R @ p + t
            turned[i, j] /= turned[i, j] @ moved[i, j]
    return moved, turned
