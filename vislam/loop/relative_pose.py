"""The relative pose of two views from matched features with points: robust refinement, and its covariance.

A match can hold up to five numbers that the pose explains: the point of a in the pixels of b, the point of b in the
pixels of a, and the inverse depths of both against each other. All are fitted together by Gauss-Newton with a Cauchy
kernel. Everything is in camera frames and normalised coordinates; the tangent perturbs `T_a_b @ se3_exp(xi)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.geometry import invert, se3_exp
from vislam.messages import Array

_ROUNDS = 12
_CONVERGED = 1e-6  # norm of a step in rad and m; a loop is good to millimetres
_CAUCHY = 2.0  # in sigmas; 2.4 is 95 % efficient, a little less bears more wrong matches
_MIN_Z_M = 0.02
_MEDIAN_CHI2_2 = 1.3863  # median of chi-square with two degrees of freedom

Point = tuple[float, float, float]


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


@njit(cache=True, nogil=True)
def _add(H: Array, g: Array, point: Point, J: Array, fx: float, fy: float, sigma: float, share: float) -> None:
    """Add the residual of a projected point at observed (fx, fy) to the upper half of H; J [3, 6] is d(point)/d(xi)."""
    x, y, z = point[0] / point[2], point[1] / point[2], point[2]
    rx, ry = (x - fx) / sigma, (y - fy) / sigma
    weight = share / (1.0 + (rx * rx + ry * ry) / (_CAUCHY * _CAUCHY))
    scale = 1.0 / (z * sigma)
    for i in range(6):
        x_i, y_i = scale * (J[0, i] - x * J[2, i]), scale * (J[1, i] - y * J[2, i])
        g[i] += weight * (x_i * rx + y_i * ry)
        for j in range(i, 6):
            x_j, y_j = scale * (J[0, j] - x * J[2, j]), scale * (J[1, j] - y * J[2, j])
            H[i, j] += weight * (x_i * x_j + y_i * y_j)


@njit(cache=True, nogil=True)
def _moved(T: Array, point: Array) -> Point:
    """Return where a transform [4, 4] brings a point [3]; as a tuple, since arrays so small cost more than the sums."""
    x, y, z = point
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@njit(cache=True, nogil=True)
def _normal_equations(
    T_a_b: Array, points_a: Array, points_b: Array, xy_a: Array, xy_b: Array, sigma_xy: float, sigma_inverse_m: float
) -> tuple[Array, Array]:
    H, g = np.zeros((6, 6)), np.zeros(6)
    T_b_a = invert(T_a_b)
    J = np.zeros((3, 6))
    for i in range(len(xy_a)):
        has_a, has_b = np.isfinite(points_a[i, 2]), np.isfinite(points_b[i, 2])
        share = 0.5 if has_a and has_b else 1.0  # the same four pixel coordinates, seen from both sides
        if has_a:
            p = _moved(T_b_a, points_a[i])
            if p[2] > _MIN_Z_M:
                # exp(-xi) p: d/d(rotation) = skew(p), d/d(translation) = -I
                J[0, 0], J[0, 1], J[0, 2] = 0.0, -p[2], p[1]
                J[1, 0], J[1, 1], J[1, 2] = p[2], 0.0, -p[0]
                J[2, 0], J[2, 1], J[2, 2] = -p[1], p[0], 0.0
                J[:, 3:] = 0.0
                J[0, 3], J[1, 4], J[2, 5] = -1.0, -1.0, -1.0
                _add(H, g, p, J, xy_b[i, 0], xy_b[i, 1], sigma_xy, share)
        if has_b:
            q0, q1, q2 = points_b[i]
            p = _moved(T_a_b, points_b[i])
            if p[2] > _MIN_Z_M:
                for r in range(3):  # R_a_b exp(xi) q: d/d(rotation) = -R_a_b skew(q), d/d(translation) = R_a_b
                    R0, R1, R2 = T_a_b[r, 0], T_a_b[r, 1], T_a_b[r, 2]
                    J[r, 0], J[r, 1], J[r, 2] = R2 * q1 - R1 * q2, R0 * q2 - R2 * q0, R1 * q0 - R0 * q1
                    J[r, 3], J[r, 4], J[r, 5] = R0, R1, R2
                _add(H, g, p, J, xy_a[i, 0], xy_a[i, 1], sigma_xy, share)
                if has_a:
                    r_depth = (1.0 / p[2] - 1.0 / points_a[i, 2]) / sigma_inverse_m
                    weight = 1.0 / (1.0 + r_depth * r_depth / (_CAUCHY * _CAUCHY))
                    scale = -1.0 / (p[2] * p[2] * sigma_inverse_m)
                    for k in range(6):
                        g[k] += weight * scale * J[2, k] * r_depth
                        for m in range(k, 6):
                            H[k, m] += weight * scale * J[2, k] * scale * J[2, m]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, g


@njit(cache=True, nogil=True)
def _gauss_newton(
    T_start: Array, points_a: Array, points_b: Array, xy_a: Array, xy_b: Array, sigma_xy: float, sigma_inverse_m: float
) -> tuple[Array, Array]:
    T = T_start.copy()
    H, g = _normal_equations(T, points_a, points_b, xy_a, xy_b, sigma_xy, sigma_inverse_m)
    for _ in range(_ROUNDS):
        for i in range(6):
            H[i, i] += 1e-9 * (H[i, i] + 1.0)  # keeps the solve regular; too small to matter
        step = -np.linalg.solve(H, g)
        T = T @ se3_exp(step)
        H, g = _normal_equations(T, points_a, points_b, xy_a, xy_b, sigma_xy, sigma_inverse_m)
        if np.sum(step * step) < _CONVERGED**2:
            break
    return T, H


@njit(cache=True, nogil=True)
def _errors(T_a_b: Array, points_a: Array, points_b: Array, xy_a: Array, xy_b: Array) -> tuple[Array, Array, Array]:
    """Return reprojection errors a in b, b in a [N] on z = 1, and inverse depth differences [N]; NaN: unknown."""
    count = len(xy_a)
    forward, reverse, depth = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    T_b_a = invert(T_a_b)
    for i in range(count):
        if np.isfinite(points_a[i, 2]):
            p = _moved(T_b_a, points_a[i])
            forward[i] = np.inf
            if p[2] > _MIN_Z_M:
                forward[i] = np.hypot(p[0] / p[2] - xy_b[i, 0], p[1] / p[2] - xy_b[i, 1])
        if np.isfinite(points_b[i, 2]):
            p = _moved(T_a_b, points_b[i])
            reverse[i] = np.inf
            if p[2] > _MIN_Z_M:
                reverse[i] = np.hypot(p[0] / p[2] - xy_a[i, 0], p[1] / p[2] - xy_a[i, 1])
                if np.isfinite(points_a[i, 2]):
                    depth[i] = 1.0 / p[2] - 1.0 / points_a[i, 2]
    return forward, reverse, depth


def errors(T_a_b: Array, matched: Matched) -> tuple[Array, Array, Array]:
    """Return how far matches [N] are from a relative pose: a's points in b, b's points in a, and inverse depths (1/m).

    Reprojection errors are on the plane z = 1, infinite behind the camera; NaN where there is no point.
    """
    forward, reverse, depth = _errors(T_a_b, matched.points_a, matched.points_b, matched.xy_a, matched.xy_b)
    return forward, reverse, depth


def refine(T_a_b: Array, matched: Matched, sigma_xy: float, sigma_inverse_m: float) -> Refined | None:
    """Refine a relative pose [4, 4] on all matches; None when they do not determine it.

    `sigma_xy` is a feature's standard deviation on z = 1, `sigma_inverse_m` that of an inverse depth difference in 1/m.
    """
    try:
        T, H = _gauss_newton(
            T_a_b, matched.points_a, matched.points_b, matched.xy_a, matched.xy_b, sigma_xy, sigma_inverse_m
        )
    except (np.linalg.LinAlgError, ZeroDivisionError):
        return None
    if not np.all(np.isfinite(T)) or not np.all(np.isfinite(H)) or np.linalg.eigvalsh(H)[0] <= 0.0:
        return None
    forward, reverse, _ = errors(T, matched)
    squared = np.concatenate([forward[np.isfinite(forward)], reverse[np.isfinite(reverse)]]) ** 2
    if len(squared) == 0:
        return None
    scale = float(np.median(squared)) / (_MEDIAN_CHI2_2 * sigma_xy**2)
    return Refined(T, H, scale)
