"""Depth and colours of one moment, the middle of the image: where the camera moved in between, both are put there.

Depth may be taken before or after its image, and the rows of both one after the other. Over a readout the motion is
small, and taken to the first order: half a pixel in the first and last rows at 140 deg/s and 30 ms.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32, ImageU8

_STEPS = 3  # of the search for the pixel that sees a point; the first takes it for infinitely far
_AT_ONCE: Array = np.zeros(6)


class DepthAtImage:
    """Puts depth and colours where the camera saw them in the middle of its image's time."""

    def __init__(self, camera: Camera) -> None:
        """Take the camera of both."""
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        self._camera = camera
        self._rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]))
        with np.errstate(divide="ignore", invalid="ignore"):
            self._xy = self._rays[:, :2] / self._rays[:, 2:]

    def __call__(self, depth_m: ImageF32, T_image_depth: Array, sweep: Array | None = None) -> ImageF32:
        """Return depth [H, W] in metres along the optical axis as the image sees it, 0: unknown.

        Args:
            depth_m: registered depth image [H, W], NaN or 0 where unknown.
            T_image_depth: [4, 4] where the camera was when depth was taken, as the image sees it: some pixels away, so
                distortion is that of the pixel that looks into the same direction.
            sweep: twist [6] of the camera from the first to the last row of depth, rotation first; None: taken at once.

        Raises DataError when the depth image has not the camera's size.
        """
        camera, T_depth_image = self._camera, invert(T_image_depth)
        camera.check_image(depth_m)
        rays = self._rays @ T_depth_image[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = rays[:, :2] / rays[:, 2:]
        depth_m = np.ascontiguousarray(depth_m, dtype=np.float32)
        focal_px = np.array([camera.fx, camera.fy])
        to_z = np.concatenate([T_image_depth[2], T_depth_image[:3, 3]])
        swept = _AT_ONCE if sweep is None else sweep
        return np.asarray(_gathered(depth_m, camera.project(rays), xy, to_z, focal_px, swept))

    def colors(self, image: ImageU8, depth_m: ImageF32, sweep: Array) -> ImageU8:
        """Return an image [H, W] or [H, W, 3] as it would be had all rows been taken when the middle one was.

        Args:
            image: of the camera.
            depth_m: [H, W] along the optical axis at that time; where it is 0, what is seen is far away.
            sweep: twist [6] of the camera from the first to the last row of the image, rotation first.
        """
        self._camera.check_image(image)
        focal_px = np.array([self._camera.fx, self._camera.fy])
        seen_at = _seen_at(np.ascontiguousarray(depth_m, np.float32), self._xy, focal_px, sweep)
        found = cv2.remap(image, seen_at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, np.uint8)


@njit(cache=True, nogil=True, inline="always")
def _by_row(x: float, y: float, rho: float, row: float, rows: int, sweep: Array) -> tuple[float, float, float]:
    """Return the direction of an inverse-depth point to a camera that has made its sweep up to a row."""
    late = min(max(row, 0.0), rows - 1.0) / (rows - 1.0) - 0.5
    return (
        x - late * (sweep[1] - sweep[2] * y + rho * sweep[3]),
        y - late * (sweep[2] * x - sweep[0] + rho * sweep[4]),
        1.0 - late * (sweep[0] * y - sweep[1] * x + rho * sweep[5]),
    )


@njit(cache=True, nogil=True)
def _seen_at(depth_m: ImageF32, xy: Array, focal_px: Array, sweep: Array) -> NDArray[np.float32]:
    """Return the pixels [H, W, 2] at which rows that are taken one after the other see what a pixel sees."""
    rows, columns = depth_m.shape
    out = np.empty((rows, columns, 2), np.float32)
    for i in range(rows):
        for j in range(columns):
            x, y = xy[i * columns + j]
            rho = 1.0 / depth_m[i, j] if depth_m[i, j] > 0.0 else 0.0
            u, v = float(j), float(i)
            for _ in range(_STEPS - 1):
                a, b, c = _by_row(x, y, rho, v, rows, sweep)
                u, v = j + focal_px[0] * (a / c - x), i + focal_px[1] * (b / c - y)
            out[i, j, 0], out[i, j, 1] = u, v
    return out


@njit(cache=True, nogil=True)
def _gathered(
    depth_m: ImageF32, at_infinity: Array, xy: Array, to_z: Array, focal_px: Array, sweep: Array
) -> NDArray[np.float32]:
    """Return depth [H, W] for pixels whose rays meet pixels `at_infinity` [H W, 2] of the depth image where far away.

    `xy` [H W, 2] are their directions there on z = 1, `to_z` [7] the row that gives a point's depth in the image, and
    where the image was taken, `sweep` [6] the camera's twist from the first to the last row of depth.
    """
    t, is_swept = to_z[4:], sweep.any()
    rows, columns = depth_m.shape
    out = np.zeros((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            pixel = i * columns + j
            rho, z, before = 0.0, 0.0, 0.0  # inverse depth as the image sees it, depth, and what was read last
            rho_there, v = 0.0, at_infinity[pixel, 1]  # as the middle row of depth sees it, and in which row that is
            for _ in range(_STEPS):
                nearer = 1.0 + rho * t[2]
                x, y = (xy[pixel, 0] + rho * t[0]) / nearer, (xy[pixel, 1] + rho * t[1]) / nearer
                a, b, c = _by_row(x, y, rho_there, v, rows, sweep) if is_swept else (x, y, 1.0)
                u = at_infinity[pixel, 0] + focal_px[0] * (a / c - xy[pixel, 0])
                v = at_infinity[pixel, 1] + focal_px[1] * (b / c - xy[pixel, 1])
                z = 0.0
                if not (-0.5 <= u < columns - 0.5 and -0.5 <= v < rows - 0.5):  # also for NaN
                    break
                there = depth_m[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))]
                if not (there > 0.0 and there < np.inf):
                    break
                rho_there = c / there
                z = (to_z[0] * x + to_z[1] * y + to_z[2]) / rho_there + to_z[3]
                if not z > 0.0:
                    z = 0.0
                    break
                if there == before:  # the same pixel again
                    break
                rho, before = 1.0 / z, there
            out[i, j] = z
    return out
