"""Relative rotation and direction of two views without points: essential matrix, refined on the Sampson error.

Hartley and Zisserman, "Multiple View Geometry", sections 9.6 and 11.4. The translation has no length; its tangent is
the plane across the direction, so its covariance is singular along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.geometry import skew, so3_exp, tangent_basis
from vislam.messages import Array

_MIN_MATCHES = 8
_RANSAC_ROUNDS = 1000
_CONFIDENCE = 0.999
_ROUNDS = 8
_CAUCHY = 2.0  # in sigmas
_MEDIAN_CHI2_1 = 0.4549  # median of chi-square with one degree of freedom

Point = tuple[float, float, float]


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


@njit(cache=True, nogil=True)
def _sampson(R: Array, t: Array, xy_a: Array, xy_b: Array) -> Array:
    """Return the Sampson errors [N] of matches on z = 1."""
    E = skew(t) @ R
    out = np.empty(len(xy_a))
    for i in range(len(xy_a)):
        out[i] = _epipolar(E, xy_a[i], xy_b[i])[0]
    return out


@njit(cache=True, nogil=True)
def _epipolar(E: Array, xy_a: Array, xy_b: Array) -> tuple[float, float, Point]:
    """Return the Sampson error of one match, its denominator, and the epipolar line in b."""
    (ax, ay), (bx, by) = xy_a, xy_b
    in_a = (
        E[0, 0] * bx + E[0, 1] * by + E[0, 2], E[1, 0] * bx + E[1, 1] * by + E[1, 2],
        E[2, 0] * bx + E[2, 1] * by + E[2, 2],
    )  # fmt: skip
    in_b = (
        E[0, 0] * ax + E[1, 0] * ay + E[2, 0], E[0, 1] * ax + E[1, 1] * ay + E[2, 1],
        E[0, 2] * ax + E[1, 2] * ay + E[2, 2],
    )  # fmt: skip
    scale = np.sqrt(in_a[0] ** 2 + in_a[1] ** 2 + in_b[0] ** 2 + in_b[1] ** 2) + 1e-15
    return (ax * in_a[0] + ay * in_a[1] + in_a[2]) / scale, scale, in_b


@njit(cache=True, nogil=True)
def _descend(R: Array, t: Array, xy_a: Array, xy_b: Array, sigma: float) -> tuple[Array, Array, Array]:
    """Refine rotation and unit direction by Gauss-Newton with a Cauchy kernel; return them and the information [5, 5].

    Its tangent: rotation about b's axes, then the direction's in the plane that `tangent_basis` spans, in b's axes.
    """
    H, J = np.eye(5), np.empty(5)
    for _ in range(_ROUNDS):
        E, across = skew(t) @ R, R @ tangent_basis(R.T @ t)
        H, g = np.zeros((5, 5)), np.zeros(5)
        for i in range(len(xy_a)):
            (ax, ay), (bx, by) = xy_a[i], xy_b[i]
            residual, scale, line = _epipolar(E, xy_a[i], xy_b[i])
            J[0], J[1], J[2] = by * line[2] - line[1], line[0] - bx * line[2], bx * line[1] - by * line[0]
            x = R[0, 0] * bx + R[0, 1] * by + R[0, 2]
            y = R[1, 0] * bx + R[1, 1] * by + R[1, 2]
            z = R[2, 0] * bx + R[2, 1] * by + R[2, 2]
            nx, ny, nz = y - z * ay, z * ax - x, x * ay - y * ax
            J[3] = nx * across[0, 0] + ny * across[1, 0] + nz * across[2, 0]
            J[4] = nx * across[0, 1] + ny * across[1, 1] + nz * across[2, 1]
            weight = 1.0 / (1.0 + (residual / (_CAUCHY * sigma)) ** 2) / (sigma * scale) ** 2
            for k in range(5):
                g[k] += weight * J[k] * residual * scale
                for m in range(5):
                    H[k, m] += weight * J[k] * J[m]
        step = -np.linalg.solve(H, g)
        t = t + across @ step[3:]
        t = t / np.sqrt(np.sum(t * t))
        R = R @ so3_exp(step[:3])
    return R, t, H


def _refined(
    R: Array, t: Array, xy_a: Array, xy_b: Array, inliers: NDArray[np.bool_], limit: float, seed: int
) -> Direction | None:
    sigma = limit / 3.0
    try:
        R, t, H = _descend(np.ascontiguousarray(R), t, xy_a[inliers], xy_b[inliers], sigma)
    except np.linalg.LinAlgError:
        return None
    residual = _sampson(R, t, xy_a, xy_b)
    inliers = inliers & (np.abs(residual) <= limit)
    if not np.all(np.isfinite(H)) or np.linalg.cond(H) > 1e14 or np.count_nonzero(inliers) < _MIN_MATCHES:
        return None
    spread = float(np.median(residual[inliers] ** 2)) / (_MEDIAN_CHI2_1 * sigma**2)
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), tangent_basis(R.T @ t)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    turned = np.column_stack([xy_b[inliers], np.ones(np.count_nonzero(inliers))]) @ R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.linalg.norm(turned[:, :2] / turned[:, 2:] - xy_a[inliers], axis=1)
    plane = _plane_share(xy_a[inliers], xy_b[inliers], 2.0 * limit, seed)
    return Direction(T, spread * lift @ np.linalg.inv(H) @ lift.T, inliers, float(np.nanmedian(shift)), plane)
