"""Depth of another moment than its image: where the camera moved in between, depth is put where the image has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32

_STEPS = 3  # of the search for the pixel that sees a point; the first takes it for infinitely far


class DepthAtImage:
    """Puts depth where the camera saw it when its image was taken."""

    def __init__(self, camera: Camera) -> None:
        """Take the camera of both."""
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        self._camera = camera
        self._rays = camera.unproject(np.column_stack([u.ravel(), v.ravel()]))

    def __call__(self, depth_m: ImageF32, T_image_depth: Array) -> ImageF32:
        """Return depth [H, W] in metres along the optical axis as the image sees it, 0: unknown.

        Args:
            depth_m: registered depth image [H, W], NaN or 0 where unknown.
            T_image_depth: [4, 4] where the camera was when depth was taken, as the image sees it: some pixels away, so
                distortion is that of the pixel that looks into the same direction.

        Raises DataError when the depth image has not the camera's size.
        """
        camera, T_depth_image = self._camera, invert(T_image_depth)
        camera.check_image(depth_m)
        rays = self._rays @ T_depth_image[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = rays[:, :2] / rays[:, 2:]
        depth_m = np.ascontiguousarray(depth_m, dtype=np.float32)
        focal_px = np.array([camera.fx, camera.fy])
        return np.asarray(
            _gathered(depth_m, camera.project(rays), xy, T_depth_image[:3, 3], T_image_depth[2], focal_px)
        )


@njit(cache=True, nogil=True)
def _gathered(
    depth_m: ImageF32, at_infinity: Array, xy: Array, t: Array, to_z: Array, focal_px: Array
) -> NDArray[np.float32]:
    """Return depth [H, W] for pixels whose rays meet pixels `at_infinity` [H W, 2] of the depth image where far away.

    `xy` [H W, 2] are their directions there on z = 1, `t` [3] where the image was taken, and `to_z` [4] the row that
    gives a point's depth in the image.
    """
    rows, columns = depth_m.shape
    out = np.zeros((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            pixel = i * columns + j
            rho, z = 0.0, 0.0  # inverse depth as the image sees it
            for _ in range(_STEPS):
                nearer = 1.0 + rho * t[2]
                x, y = (xy[pixel, 0] + rho * t[0]) / nearer, (xy[pixel, 1] + rho * t[1]) / nearer
                u = at_infinity[pixel, 0] + focal_px[0] * (x - xy[pixel, 0])
                v = at_infinity[pixel, 1] + focal_px[1] * (y - xy[pixel, 1])
                z = 0.0
                if not (-0.5 <= u < columns - 0.5 and -0.5 <= v < rows - 0.5):  # also for NaN
                    break
                there = depth_m[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))]
                if not (there > 0.0 and there < np.inf):
                    break
                z = there * (to_z[0] * x + to_z[1] * y + to_z[2]) + to_z[3]
                if not z > 0.0:
                    z = 0.0
                    break
                rho = 1.0 / z
            out[i, j] = z
    return out
