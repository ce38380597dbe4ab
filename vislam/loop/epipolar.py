"""Relative rotation and direction of two views without points: essential matrix, refined on the Sampson error.

Hartley and Zisserman, "Multiple View Geometry", sections 9.6 and 11.4. The translation has no length; its tangent is
the plane across the direction, so its covariance is singular along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.geometry import skew, so3_exp
from vislam.messages import Array

_MIN_MATCHES = 8
_RANSAC_ROUNDS = 1000
_CONFIDENCE = 0.999
_ROUNDS = 8
_CAUCHY = 2.0  # in sigmas
_MEDIAN_CHI2_1 = 0.4549  # median of chi-square with one degree of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Rotation and unit direction between two cameras."""

    T_a_b: Array  # [4, 4], translation of length 1
    covariance: Array  # [6, 6] of the fit, singular along the direction
    inliers: NDArray[np.bool_]  # [N]
    parallax: float  # median displacement of the inliers that rotation does not explain, on z = 1
    plane_share: float  # of the inliers that one plane explains; near 1, two directions fit equally well


def relative_direction(xy_a: Array, xy_b: Array, limit: float, seed: int) -> Direction | None:
    """Return rotation and direction from matches [N, 2] on z = 1 with inlier `limit` there; None when there is none."""
    if len(xy_a) < _MIN_MATCHES:
        return None
    settings = _ransac(limit, seed)
    eye, none = np.eye(3), np.zeros(4)
    try:
        E, mask = cv2.findEssentialMat(xy_b, xy_a, eye, eye, none, none, settings)
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, mask = cv2.recoverPose(E, xy_b, xy_a, eye, mask=mask)
    except cv2.error:  # degenerate samples only
        return None
    inliers = mask.ravel() > 0
    if np.count_nonzero(inliers) < _MIN_MATCHES:
        return None
    return _refined(R, t.ravel(), xy_a, xy_b, inliers, limit, seed)


def _ransac(limit: float, seed: int) -> Any:
    settings = cv2.UsacParams()
    settings.randomGeneratorState = seed % 2**31
    settings.threshold = limit
    settings.confidence = _CONFIDENCE
    settings.maxIterations = _RANSAC_ROUNDS
    settings.sampler = cv2.SAMPLING_UNIFORM
    settings.score = cv2.SCORE_METHOD_MSAC
    settings.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    settings.isParallel = False
    return settings


def _plane_share(xy_a: Array, xy_b: Array, limit: float, seed: int) -> float:
    """Return the largest share of matches [N, 2] that one homography explains."""
    try:
        _, mask = cv2.findHomography(xy_a, xy_b, _ransac(limit, seed))
    except cv2.error:  # degenerate samples only
        return 1.0
    return 1.0 if mask is None else float(np.mean(mask.ravel() > 0))


def _sampson(R: Array, t: Array, rays_a: Array, rays_b: Array) -> tuple[Array, Array]:
    """Return the Sampson errors [N] of rays with z = 1 and their denominators [N]."""
    E = skew(t) @ R
    across_a, across_b = rays_b @ E.T, rays_a @ E
    scale = np.sqrt(np.sum(across_a[:, :2] ** 2 + across_b[:, :2] ** 2, axis=1)) + 1e-15
    return np.sum(rays_a * across_a, axis=1) / scale, scale


def _tangent(R: Array, t: Array) -> Array:
    """Return a basis [3, 2] of the plane across the direction, in the axes of b."""
    basis: Array = np.linalg.svd((R.T @ t)[None])[2][1:].T
    return basis


def _refined(
    R: Array, t: Array, xy_a: Array, xy_b: Array, inliers: NDArray[np.bool_], limit: float, seed: int
) -> Direction | None:
    ones = np.ones((len(xy_a), 1))
    rays_a, rays_b = np.hstack([xy_a, ones]), np.hstack([xy_b, ones])
    sigma = limit / 3.0
    H = np.eye(5)
    for _ in range(_ROUNDS):
        a, b, basis = rays_a[inliers], rays_b[inliers], _tangent(R, t)
        residual, scale = _sampson(R, t, a, b)
        # d(a' [t] R b): rotation about b's axes, then translation R basis u
        by_rotation = np.cross(b, (a @ skew(t) @ R))
        by_translation = np.cross(b @ R.T, a) @ R @ basis
        J = np.hstack([by_rotation, by_translation]) / scale[:, None]
        weight = 1.0 / (1.0 + (residual / (_CAUCHY * sigma)) ** 2)
        H = J.T @ (weight[:, None] * J) / sigma**2
        try:
            step = -np.linalg.solve(H, J.T @ (weight * residual) / sigma**2)
        except np.linalg.LinAlgError:
            return None
        t = t + R @ basis @ step[3:]
        t = t / np.linalg.norm(t)
        R = R @ so3_exp(np.ascontiguousarray(step[:3]))
    residual, _ = _sampson(R, t, rays_a, rays_b)
    inliers = inliers & (np.abs(residual) <= limit)
    if not np.all(np.isfinite(H)) or np.linalg.cond(H) > 1e14 or np.count_nonzero(inliers) < _MIN_MATCHES:
        return None
    spread = float(np.median(residual[inliers] ** 2)) / (_MEDIAN_CHI2_1 * sigma**2)
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), _tangent(R, t)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    turned = rays_b[inliers] @ R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.linalg.norm(turned[:, :2] / turned[:, 2:] - xy_a[inliers], axis=1)
    plane = _plane_share(xy_a[inliers], xy_b[inliers], 2.0 * limit, seed)
    return Direction(T, spread * lift @ np.linalg.inv(H) @ lift.T, inliers, float(np.nanmedian(shift)), plane)
