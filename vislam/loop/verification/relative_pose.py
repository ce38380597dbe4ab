"""The relative pose of two views from matched features with points: how far they are from it, and the best one.

A match can hold up to five numbers that the pose explains: the point of a in the pixels of b, the point of b in the
pixels of a, and the inverse depths of both against each other. Everything is in camera frames and normalised
coordinates; the tangent perturbs `T_a_b @ se3_exp(xi)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import invert, transform_points
from vislam.core.messages import Array
from vislam.vision.refine import refine_both_ways

_CAUCHY = 2.0  # in sigmas; 2.4 is 95 % efficient, a little less bears more wrong matches
_MIN_Z_M = 0.02
_MEDIAN_CHI2_2 = 1.3863  # median of chi-square with two degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Matched features of views a and b; points are NaN where unknown."""

    points_a: Array  # [N, 3] in cam0 of a, metres
    points_b: Array  # [N, 3] in cam0 of b, metres
    xy_a: Array  # [N, 2] normalised
    xy_b: Array  # [N, 2]

    def __len__(self) -> int:
        return len(self.xy_a)

    def take(self, which: NDArray[np.bool_]) -> Matched:
        """Return the matches selected by a mask [N]."""
        return Matched(self.points_a[which], self.points_b[which], self.xy_a[which], self.xy_b[which])


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A refined relative pose between cameras."""

    T_a_b: Array  # [4, 4]
    information: Array  # [6, 6] of the tangent, for the sigmas that were assumed
    variance_scale: float  # how much larger the squared residuals are than those sigmas say


def errors(T_a_b: Array, matched: Matched) -> tuple[Array, Array, Array]:
    """Return how far matches [N] are from a relative pose: a's points in b, b's points in a, and inverse depths (1/m).

    Reprojection errors are on the plane z = 1, infinite behind the camera; NaN where there is no point.
    """
    in_b, in_a = transform_points(invert(T_a_b), matched.points_a), transform_points(T_a_b, matched.points_b)
    depth = np.where(in_a[:, 2] > _MIN_Z_M, 1.0 / in_a[:, 2] - 1.0 / matched.points_a[:, 2], np.nan)
    return _off(in_b, matched.xy_b), _off(in_a, matched.xy_a), depth


def _off(points: Array, xy: Array) -> Array:
    """Return how far from `xy` [N, 2] points [N, 3] are seen; infinite behind the camera."""
    off = np.linalg.norm(points[:, :2] / points[:, 2:] - xy, axis=1)
    return np.where(points[:, 2] <= _MIN_Z_M, np.inf, off)


def refine(T_a_b: Array, matched: Matched, sigma_xy: float, sigma_inverse_m: float) -> Refined | None:
    """Refine a relative pose [4, 4] on all matches; None when they do not determine it.

    `sigma_xy` is a feature's standard deviation on z = 1, `sigma_inverse_m` that of an inverse depth difference in 1/m.
    """
    found = refine_both_ways(
        T_a_b, matched.points_a, matched.points_b, matched.xy_a, matched.xy_b, sigma_xy, sigma_inverse_m, _CAUCHY
    )
    forward, reverse, _ = errors(found.T_key_cam, matched)
    squared = np.concatenate([forward[np.isfinite(forward)], reverse[np.isfinite(reverse)]]) ** 2
    if not found.converged or len(squared) == 0:
        return None
    scale = float(np.median(squared)) / (_MEDIAN_CHI2_2 * sigma_xy**2)
    return Refined(found.T_key_cam, found.information, scale)
