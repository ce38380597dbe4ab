"""What is known of a keyframe's depth before its first measurement: points of odometry, or the keyframe before it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MonoDepthConfig
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32

_FEWEST_POINTS = 8  # fewer say nothing about a whole image
_REACH = 0.06  # of the image's width: a point speaks for its surroundings, with a Gaussian's weight
_DISTRUST = 0.25  # least sigma of a prior from points, of its mean: surfaces between points are anywhere
_COVERED = 0.05  # weight of points at which a pixel's surroundings count as known


def flat_prior(shape: tuple[int, int], config: MonoDepthConfig) -> tuple[ImageF32, ImageF32]:
    """Return inverse depth and its sigma [h, w] when nothing is known: the whole range is searched."""
    low, high = 1.0 / config.max_depth_m, 1.0 / config.min_depth_m
    sigma = 0.5 * (high - low) / config.search_sigmas
    return np.full(shape, 0.5 * (low + high), np.float32), np.full(shape, sigma, np.float32)


def points_prior(
    shape: tuple[int, int], pixels: Array, rho: Array, config: MonoDepthConfig
) -> tuple[ImageF32, ImageF32]:
    """Return inverse depth and its sigma [h, w] around points [N, 2] of inverse depth [N], or `flat_prior` if too few.

    Near points, their weighted mean and spread; elsewhere those of all points.
    """
    columns, rows = np.round(pixels[:, 0]), np.round(pixels[:, 1])
    low, high = 1.0 / config.max_depth_m, 1.0 / config.min_depth_m
    with np.errstate(invalid="ignore"):
        good = (columns >= 0) & (rows >= 0) & (columns < shape[1]) & (rows < shape[0]) & (rho >= low) & (rho <= high)
    if np.count_nonzero(good) < _FEWEST_POINTS:
        return flat_prior(shape, config)
    at = (rows[good].astype(np.int64), columns[good].astype(np.int64))
    values = rho[good]
    sums = np.zeros((*shape, 3), np.float32)
    for k, moment in enumerate((np.ones_like(values), values, values * values)):
        np.add.at(sums[..., k], at, moment.astype(np.float32))
    reach_px = _REACH * shape[1]
    sums = np.asarray(cv2.GaussianBlur(sums, (0, 0), reach_px, borderType=cv2.BORDER_REFLECT), np.float32)
    weight = sums[..., 0] * np.float32(2.0 * np.pi * reach_px**2)
    middle, spread = float(np.median(values)), float(values.std())
    # the average of all points takes part with little weight, so that it rules where no point is near
    share = _COVERED / (weight + _COVERED)
    local = sums[..., 1:] / np.maximum(sums[..., :1], 1e-12)
    mean = (1.0 - share) * local[..., 0] + share * middle
    square = (1.0 - share) * local[..., 1] + share * (middle * middle + spread * spread)
    sigma = np.maximum(np.sqrt(np.maximum(square - mean * mean, 0.0)), _DISTRUST * mean)
    return mean.astype(np.float32), sigma.astype(np.float32)


@njit(cache=True, nogil=True)
def carried_over(rho: ImageF32, known: NDArray[np.bool_], K: Array, R: Array, t: Array) -> ImageF32:
    """Return the inverse depth [h, w] that known pixels have in another camera (x_other = R x + t), 0 elsewhere.

    The nearest surface wins; gaps of a pixel, which turning and coming nearer leave, are closed.
    """
    rows, columns = rho.shape
    fx, fy, cx, cy = K
    out = np.zeros((rows, columns), np.float32)
    for y in range(rows):
        for x in range(columns):
            if not known[y, x]:
                continue
            h, k, r = (x - cx) / fx, (y - cy) / fy, float(rho[y, x])
            z = R[2, 0] * h + R[2, 1] * k + R[2, 2] + t[2] * r
            if z <= 0.0:
                continue
            u = fx * (R[0, 0] * h + R[0, 1] * k + R[0, 2] + t[0] * r) / z + cx
            v = fy * (R[1, 0] * h + R[1, 1] * k + R[1, 2] + t[1] * r) / z + cy
            if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
                continue
            i, j = int(v + 0.5), int(u + 0.5)
            out[i, j] = max(out[i, j], np.float32(r / z))
    return close_gaps(out, 0.05)


@njit(cache=True, nogil=True)
def close_gaps(rho: ImageF32, tolerance: float) -> ImageF32:
    """Return inverse depth [h, w] with pixels of value 0 filled whose neighbours are mostly known and agree."""
    rows, columns = rho.shape
    out = rho.copy()
    for y in range(1, rows - 1):
        for x in range(1, columns - 1):
            if rho[y, x] > 0.0:
                continue
            count, total, low, high = 0, 0.0, np.inf, 0.0
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    r = float(rho[y + dy, x + dx])
                    if r > 0.0:
                        count, total, low, high = count + 1, total + r, min(low, r), max(high, r)
            if count >= 5 and high - low <= tolerance * high:
                out[y, x] = total / count
    return out
