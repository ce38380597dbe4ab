"""Landmarks taken out of the normal equations and put back: the Schur complement, one block of three at a time."""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array
from vislam.window.layout import CALIBRATION


@njit(cache=True, nogil=True, error_model="numpy")
def invert(H: Array, damping: float, inverse: Array) -> bool:
    """Invert a landmark's own block [3, 3]; False if it is indefinite."""
    a, b, c = H[0, 0] * (1.0 + damping), H[0, 1], H[0, 2]
    d, e, f = H[1, 1] * (1.0 + damping), H[1, 2], H[2, 2] * (1.0 + damping)
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    inverse[1, 1], inverse[1, 2], inverse[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
    if not det > 1e-14 * a * d * f:
        return False
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= det
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def eliminate(
    points_at: Array, A_points: Array, g_points: Array, cross: Array, damping: float, poses_at: int, A: Array, g: Array
) -> bool:
    """Take the landmarks out of the normal equations A, g (Schur complement); False if one is indefinite.

    `points_at` [L, 3, 3] gets the inverses of the landmarks' own blocks, for `follow`.
    """
    width = cross.shape[2]
    y = np.empty((3, width))
    for p in range(len(A_points)):
        inverse, W = points_at[p], cross[p]
        if not invert(A_points[p], damping, inverse):
            return False
        q = g_points[p]
        for j in range(width):
            w0, w1, w2 = W[0, j], W[1, j], W[2, j]
            y[0, j] = inverse[0, 0] * w0 + inverse[0, 1] * w1 + inverse[0, 2] * w2
            y[1, j] = inverse[1, 0] * w0 + inverse[1, 1] * w1 + inverse[1, 2] * w2
            y[2, j] = inverse[2, 0] * w0 + inverse[2, 1] * w1 + inverse[2, 2] * w2
            g[poses_at + j] -= y[0, j] * q[0] + y[1, j] * q[1] + y[2, j] * q[2]
        # only the columns of keyframes that see it; they lie together, and calibration lies at the end
        end = width - CALIBRATION
        while end > 0 and W[0, end - 1] == 0.0 and W[1, end - 1] == 0.0 and W[2, end - 1] == 0.0:
            end -= 1
        for i in range(width):
            y0, y1, y2 = y[0, i], y[1, i], y[2, i]
            if y0 == 0.0 and y1 == 0.0 and y2 == 0.0:
                continue
            out = A[poses_at + i, poses_at:]
            for j in range(i, end):
                out[j] -= y0 * W[0, j] + y1 * W[1, j] + y2 * W[2, j]
            for j in range(max(i, width - CALIBRATION), width):
                out[j] -= y0 * W[0, j] + y1 * W[1, j] + y2 * W[2, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def follow(points: Array, points_at: Array, g_points: Array, cross: Array, step: Array, out: Array) -> None:
    """Move the landmarks [L, 3] to where the step [D - poses_at] of poses and calibration wants them, into `out`."""
    b = np.empty(3)
    for p in range(len(points)):
        for i in range(3):
            total = g_points[p, i]
            W = cross[p, i]
            for j in range(len(step)):
                total += W[j] * step[j]
            b[i] = total
        for i in range(3):
            out[p, i] = points[p, i] - (
                points_at[p, i, 0] * b[0] + points_at[p, i, 1] * b[1] + points_at[p, i, 2] * b[2]
            )
