"""Where the calibration of a lens over spheres begins: a unified camera, of which the others are relatives.

With alpha = 1/2 a unified camera is about as wide as lenses of 120 to 200 degrees are, whatever they are made of: then
only the focal length is to be tried (Mei and Rives, ICRA 2007, begin at xi = 1, which is the same). Poses come from
homographies in views turned towards the board, so that a board beside or behind the camera is as good as one before it.
"""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from vislam.calibration.cameras.board import View
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.geometry import transform
from vislam.core.lens import Distortion
from vislam.core.messages import Array

WIDE: Mapping[str, Distortion] = {"ucm": "ucm", "eucm": "eucm", "ds": "ds", "omni": "omni"}

_FOCALS = np.geomspace(0.1, 2.0, 22)  # of the image's width
_XI = -0.2  # of a usual double sphere
_LOST_PX = 1e3  # of a view whose board no pose explains


def unified_start(views: list[View], size: tuple[int, int]) -> tuple[Camera, list[Array]]:
    """Return a unified camera of `size` (width, height) that explains most views roughly, and T_cam_board [4, 4] each.

    Raises DataError where none does.
    """
    width, height = size
    best: tuple[float, Camera, list[Array]] | None = None
    for focal_px in _FOCALS * width:
        camera = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, 0.0, "ucm", (0.5,))
        placed = [_place(camera, view) for view in views]
        error_px = float(np.mean([min(error, _LOST_PX) for error, _ in placed]))
        if best is None or error_px < best[0]:
            best = error_px, camera, [T for _, T in placed]
    if best is None or best[0] >= _LOST_PX:
        raise DataError("the views do not give a camera: no focal length explains them")
    return best[1], best[2]


def from_unified(camera: Camera, model: Distortion) -> Camera:
    """Return a unified camera as one of a model that contains it."""
    (alpha,) = camera.coefficients
    if model == "ds":
        return _nearest_double(camera)
    k = {"ucm": (alpha,), "eucm": (alpha, 1.0), "omni": (alpha / (1.0 - alpha), 0.0, 0.0, 0.0, 0.0)}
    return replace(camera, distortion=model, coefficients=k[model])


def _nearest_double(camera: Camera) -> Camera:
    """Return the double sphere most like a unified camera whose first sphere is not at 0, where both do the same."""
    angles = np.linspace(0.0, 1.6, 33)
    rays = np.column_stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)])
    doubles = [replace(camera, distortion="ds", coefficients=(_XI, alpha)) for alpha in np.linspace(0.02, 0.98, 97)]
    apart = [np.nan_to_num(np.abs(ds.project(rays) - camera.project(rays)), nan=_LOST_PX).sum() for ds in doubles]
    return doubles[int(np.argmin(apart))]


def _place(camera: Camera, view: View) -> tuple[float, Array]:
    """Return the rms error of a board [px] at its best pose, and the pose; infinite where there is none."""
    nowhere = float("inf"), np.eye(4)
    rays = camera.bearings(view.pixels)
    seen = np.isfinite(rays).all(axis=1)
    if seen.sum() < 4:
        return nowhere
    middle = rays[seen].mean(axis=0)
    # rows of R are axes of a view whose z points at the board
    R = np.linalg.svd(middle[None])[2][[1, 2, 0]]
    R[2] *= np.sign(R[2] @ middle)
    R[0] *= np.linalg.det(R)
    turned = rays @ R.T
    seen &= turned[:, 2] > 0.05
    H = cv2.findHomography(view.points_m[seen, :2], turned[seen, :2] / turned[seen, 2:])[0] if seen.sum() >= 4 else None
    if H is None:
        return nowhere
    H = H / np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1])) * np.sign(H[2] @ [*view.points_m[0, :2], 1.0])
    u, _, vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    T = transform(R.T @ (u @ vt), R.T @ H[:, 2])
    errors = view.pixels - camera.project(view.points_m @ T[:3, :3].T + T[:3, 3])
    squares = np.nan_to_num(np.sum(errors**2, axis=1), nan=_LOST_PX**2)
    return float(np.sqrt(np.mean(squares))), T
