"""Relative rotation and direction of two views without points, and whether something else explains their matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import transform
from vislam.core.messages import Array
from vislam.vision.ransac import usac
from vislam.vision.two_view import epipolar_distances, essential_ransac, refine_two_view

_MIN_MATCHES = 8
_TRIES = 400  # find 25 inliers among 60 matches with 0.99; more mostly prolong the search in vain
_CAUCHY = 2.0  # in sigmas
_LIMIT_SIGMAS = 3.0  # of an inlier
_MEDIAN_CHI2_1 = 0.4549  # median of chi-square with one degree of freedom
_BOTH_ENDS = 2.0**0.5  # a keypoint is as noisy in one view as in the other


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Rotation and unit direction between two cameras."""

    T_a_b: Array  # [4, 4], translation of length 1
    covariance: Array  # [6, 6] of the fit, perturbed in b, singular along the direction
    inliers: NDArray[np.bool_]  # [N]
    parallax: float  # median displacement of the inliers that rotation does not explain, on z = 1
    plane_share: float  # of the inliers that one plane explains; near 1, two directions fit equally well


def relative_direction(xy_a: Array, xy_b: Array, limit: float, seed: int) -> Direction | None:
    """Return rotation and direction from matches [N, 2] on z = 1 with inlier `limit` there; None when there is none."""
    start = essential_ransac(None, xy_a, xy_b, limit, _MIN_MATCHES, usac(limit, _TRIES, seed))
    if start is None:
        return None
    R, direction, inliers = start
    seen = np.where(inliers[:, None], xy_b, np.nan)
    sigma = _BOTH_ENDS * limit / _LIMIT_SIGMAS
    found = refine_two_view(R, direction, xy_a, seen, sigma, _CAUCHY)
    inliers = found.inliers
    if not found.converged or np.count_nonzero(inliers) < _MIN_MATCHES:
        return None
    R, in_b = found.R_key_cam, np.eye(6)
    T_a_b = np.asarray(transform(R, found.direction_key))
    in_b[3:, 3:] = R.T
    turned = np.column_stack([xy_b[inliers], np.ones(np.count_nonzero(inliers))]) @ R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.linalg.norm(turned[:, :2] / turned[:, 2:] - xy_a[inliers], axis=1)
    plane = _plane_share(xy_a[inliers], xy_b[inliers], 2.0 * limit, seed)
    # keypoints scatter less than a limit made for the worst of them says, too
    scatter = np.median(epipolar_distances(T_a_b, xy_a, seen)[inliers] ** 2) / (_MEDIAN_CHI2_1 * sigma**2)
    covariance = found.covariance * scatter / max(1.0, found.variance)
    return Direction(T_a_b, in_b @ covariance @ in_b.T, inliers, float(np.nanmedian(shift)), plane)


def _plane_share(xy_a: Array, xy_b: Array, limit: float, seed: int) -> float:
    """Return the largest share of matches [N, 2] that one homography explains."""
    try:
        _, mask = cv2.findHomography(xy_a, xy_b, usac(limit, _TRIES, seed))
    except cv2.error:  # degenerate samples only
        return 1.0
    return 1.0 if mask is None else float(np.mean(mask.ravel() > 0))
