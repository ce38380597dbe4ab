"""Landmarks taken out of the normal equations and put back: the Schur complement, one block of three at a time."""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array


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


def eliminate(
    points_at: Array, A_points: Array, g_points: Array, cross: Array, damping: float, poses_at: int, A: Array, g: Array
) -> bool:
    """Take the landmarks out of the normal equations A, g (Schur complement); False if one is indefinite.

    `points_at` [L, 3, 3] gets the inverses of the landmarks' own blocks, for `follow`. The upper triangle of A is what
    counts; the lower one is filled with what the product leaves there.
    """
    carried = np.empty_like(cross)
    if not _carry(points_at, A_points, cross, damping, carried):
        return False
    rows = carried.reshape(-1, cross.shape[2])
    A[poses_at:, poses_at:] -= rows.T @ cross.reshape(rows.shape)
    g[poses_at:] -= rows.T @ g_points.ravel()
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(points_at: Array, A_points: Array, cross: Array, damping: float, carried: Array) -> bool:
    """Multiply the landmarks' inverses [L, 3, 3] with their cross terms [L, 3, D]; False if one is indefinite."""
    for p in range(len(A_points)):
        inverse, W, y = points_at[p], cross[p], carried[p]
        if not invert(A_points[p], damping, inverse):
            return False
        for i in range(3):
            for j in range(cross.shape[2]):
                y[i, j] = inverse[i, 0] * W[0, j] + inverse[i, 1] * W[1, j] + inverse[i, 2] * W[2, j]
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
