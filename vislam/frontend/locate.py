"""Finding a camera without a good prediction: P3P in RANSAC, and recognition of the keyframe by its descriptors."""

from __future__ import annotations

import cv2
import numpy as np

from vislam.camera import Camera
from vislam.features import describe, match
from vislam.geometry import invert, transform, transform_points
from vislam.messages import Array, ImageU8, Keyframe

_TRIES = 200
_CONFIDENCE = 0.999


def pnp_ransac(points_key_m: Array, xy: Array, threshold: float, min_inliers: int) -> Array | None:
    """Return T_key_cam [4, 4] of a camera that sees points [N, 3] of the keyframe's camera at `xy` [N, 2] on z = 1.

    `threshold` is a distance on that plane. None when fewer than `min_inliers` agree on a pose.
    """
    usable = np.isfinite(points_key_m).all(axis=1) & np.isfinite(xy).all(axis=1)
    if usable.sum() < max(min_inliers, 4):
        return None
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points_key_m[usable], xy[usable], np.eye(3), None, iterationsCount=_TRIES, reprojectionError=threshold,
        confidence=_CONFIDENCE, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not ok or inliers is None or len(inliers) < min_inliers:
        return None
    T_cam_key = transform(cv2.Rodrigues(rotation)[0], translation[:, 0].copy())
    return np.asarray(invert(T_cam_key)) if np.isfinite(T_cam_key).all() else None


def recognise(
    keyframe: Keyframe, image: ImageU8, camera: Camera, T_body_cam: Array, features: int, min_inliers: int
) -> Array | None:
    """Return T_key_cam [4, 4] of an image in which the keyframe's described points are recognised, or None."""
    if keyframe.points_body_m is None:
        return None
    pixels, descriptors = describe(image, features)
    pairs = match(keyframe.descriptors, descriptors)
    points = transform_points(np.asarray(invert(T_body_cam)), keyframe.points_body_m[pairs[:, 0]])
    return pnp_ransac(points, camera.normalise(pixels[pairs[:, 1]]), 4.0 / camera.fx, min_inliers)
