"""The directions of the surfaces in a depth image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImageF32
from vislam.mapping.depth.image import DepthView, ImageU16

_STEP = 2  # pixels of the map's depth images: every n-th row and column is enough for directions
# steps to both sides that a normal is made of: wide against the noise of depth, which a run shows, or narrow against
# furniture
REACHES = (3, 5, 8)
_FLAT = 0.01  # of the range: so far may the middle lie off its neighbours' plane; a corner or an edge lies farther
_LEAST_COSINE = 0.15  # between ray and normal: flatter views of a surface say little but noise
_MOST = 2000  # normals per keyframe


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one keyframe shows of directions, in the frame of the map."""

    normals: NDArray[np.float32]  # [N, 3], towards the camera
    right: Array  # [3] of the image
    upward: Array  # [3] of the image


def view_of(depth: ImageU16, rays: DepthView, R_map_body: Array, R_body_cam: Array, reach: int = REACHES[0]) -> View:
    """Return the surface directions of one depth image.

    Args:
        depth: [h, w] in the rays' unit, 0 where there is none.
        rays: along which it looks.
        R_map_body: [3, 3] of the keyframe.
        R_body_cam: [3, 3] of the camera whose image is upright.
        reach: steps to both sides that a normal is made of.
    """
    z_m = depth[::_STEP, ::_STEP].astype(np.float64) * rays.unit_m
    z_m[z_m == 0.0] = np.nan
    normals = _normals(z_m, rays.rays_body[::_STEP, ::_STEP], reach)
    normals = normals[:: max(1, -(-len(normals) // _MOST))]
    R_map_cam = R_map_body @ R_body_cam
    return View((normals @ R_map_body.T).astype(np.float32), R_map_cam[:, 0], -R_map_cam[:, 1])


def _normals(depth_m: NDArray[np.float64], rays: ImageF32, g: int) -> Array:
    """Return unit normals [N, 3] where a surface is flat enough to have one, towards the camera."""
    points = rays.astype(np.float64) * depth_m[..., None]
    if min(depth_m.shape) <= 2 * g:
        return np.zeros((0, 3))
    middle = points[g:-g, g:-g]
    left, right = points[g:-g, : -2 * g], points[g:-g, 2 * g :]
    above, below = points[: -2 * g, g:-g], points[2 * g :, g:-g]
    normals = np.cross(right - left, below - above)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        cosine = np.sum(normals * middle, axis=2) / np.linalg.norm(middle, axis=2)
        off = [np.abs(np.sum((0.5 * (a + b) - middle) * normals, axis=2)) for a, b in ((left, right), (above, below))]
        is_flat = np.maximum(*off) < _FLAT * depth_m[g:-g, g:-g]
        keep = is_flat & (np.abs(cosine) > _LEAST_COSINE)  # NaN compares as false
    return np.asarray(normals[keep] * -np.sign(cosine[keep])[:, None])
