"""Finding a camera without a good prediction: P3P in RANSAC, and recognition of the keyframe by its descriptors."""

from typing import Any

import cv2
import numpy as np

from vislam.core.camera import Camera
from vislam.core.geometry import invert, transform, transform_points
from vislam.core.messages import Array, Frame, Keyframe
from vislam.vision.features import describe, match

_LEAST_POINTS = 4
_TRIES = 200
_CONFIDENCE = 0.999


def pnp(points_m: Array, xy: Array, threshold: float, search: Any = None) -> tuple[Array, int] | None:
    """Return T_cam_points [4, 4] of a camera that sees points [N, 3] at `xy` [N, 2] on z = 1, and how many agree.

    `threshold` is a distance on that plane; rows with NaN are ignored. `search` sets how RANSAC searches, see `usac`;
    by default it is OpenCV's plain one, with P3P. None when there is no pose.
    """
    usable = np.isfinite(points_m).all(axis=1) & np.isfinite(xy).all(axis=1)
    if usable.sum() < _LEAST_POINTS:
        return None
    how: dict[str, Any] = {"params": search}
    if search is None:
        how = {"iterationsCount": _TRIES, "reprojectionError": threshold, "confidence": _CONFIDENCE}
        how["flags"] = cv2.SOLVEPNP_AP3P
    try:
        ok, *_, rotation, translation, inliers = cv2.solvePnPRansac(
            points_m[usable], xy[usable], np.eye(3), None, **how
        )
    except cv2.error:  # degenerate samples only: no pose
        return None
    if not ok or inliers is None:
        return None
    T_cam_points = transform(cv2.Rodrigues(rotation)[0], translation[:, 0].copy())
    return (T_cam_points, len(inliers)) if np.isfinite(T_cam_points).all() else None


def pnp_ransac(points_key_m: Array, xy: Array, threshold: float, min_inliers: int) -> Array | None:
    """Return T_key_cam [4, 4] of a camera that sees points [N, 3] of the keyframe's camera at `xy` [N, 2] on z = 1.

    `threshold` is a distance on that plane. None when fewer than `min_inliers` agree on a pose.
    """
    found = pnp(points_key_m, xy, threshold)
    return np.asarray(invert(found[0])) if found is not None and found[1] >= min_inliers else None


def recognise(
    keyframe: Keyframe, frame: Frame, camera: Camera, T_body_cam: Array, features: int, min_inliers: int
) -> Array | None:
    """Return T_key_cam [4, 4] of a frame in which the keyframe's described points are recognised, or None."""
    if keyframe.points_body_m is None:
        return None
    pixels, descriptors = describe(frame.images[0], features, mask=frame.mask(0))
    pairs = match(keyframe.descriptors, descriptors)
    points = transform_points(np.asarray(invert(T_body_cam)), keyframe.points_body_m[pairs[:, 0]])
    return pnp_ransac(points, camera.normalise(pixels[pairs[:, 1]]), 4.0 / camera.fx, min_inliers)
