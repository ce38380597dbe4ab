"""Landmarks taken out of the normal equations and put back: the Schur complement, one block of three at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dsyrk

from vislam.core.jit import njit
from vislam.core.messages import Array


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


class Landmarks(NamedTuple):
    """The landmarks' part of the normal equations, and what is left of it when they are taken out.

    The blocks are `L @ L.T`. What is carried is `inv(L)` times what it is named after.
    """

    blocks: Array  # [L, 3, 3]
    gradients: Array  # [L, 3]
    cross: Array  # [L, 3, K] by poses and calibration
    roots: Array  # [L, 3, 3] inv(L), lower
    carried_gradients: Array  # [L, 3]
    carried: Array  # [L, 3, K]


def room_for(landmarks: int, width: int) -> Landmarks:
    """Return uninitialised arrays for `landmarks` landmarks and `width` K."""
    shapes = ((3, 3), (3,), (3, width), (3, 3), (3,), (3, width))
    return Landmarks(*(np.empty((landmarks, *shape)) for shape in shapes))


def eliminate(landmarks: Landmarks, damping: float, poses_at: int, A: Array, g: Array) -> bool:
    """Take the landmarks out of the normal equations A, g (Schur complement); False if one is indefinite.

    Only the upper triangle of A is changed.
    """
    if not _carry(landmarks, damping):
        return False
    rows = landmarks.carried.reshape(-1, landmarks.carried.shape[2])
    if len(rows) > 0:
        A[poses_at:, poses_at:] -= dsyrk(1.0, rows.T, lower=1).T
        g[poses_at:] -= landmarks.carried_gradients.ravel() @ rows
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(landmarks: Landmarks, damping: float) -> bool:
    """Factorise the landmarks' own blocks, damped, and carry what hangs on them; False if one is indefinite."""
    blocks, gradients, cross, roots, carried_gradients, carried = landmarks
    for p in range(len(blocks)):
        a, b, c = (
            blocks[p, 0, 0] * (1.0 + damping),
            blocks[p, 1, 1] * (1.0 + damping),
            blocks[p, 2, 2] * (1.0 + damping),
        )
        ba, ca, cb = blocks[p, 1, 0], blocks[p, 2, 0], blocks[p, 2, 1]
        second = b - ba * ba / a
        between = cb - ca * ba / a
        third = c - ca * ca / a - between * between / second
        if not (a > 0.0 and second > 0.0 and second * third > 1e-14 * b * c):
            return False
        xx, yy, zz = 1.0 / np.sqrt(a), 1.0 / np.sqrt(second), 1.0 / np.sqrt(third)
        yx = -yy * ba / a
        zy = -zz * between / second
        zx = -zz * ca / a - zy * ba / a
        roots[p] = 0.0
        roots[p, 0, 0], roots[p, 1, 0], roots[p, 1, 1] = xx, yx, yy
        roots[p, 2, 0], roots[p, 2, 1], roots[p, 2, 2] = zx, zy, zz
        x, y, z = gradients[p, 0], gradients[p, 1], gradients[p, 2]
        carried_gradients[p, 0], carried_gradients[p, 1] = xx * x, yx * x + yy * y
        carried_gradients[p, 2] = zx * x + zy * y + zz * z
        for j in range(cross.shape[2]):
            carried[p, 0, j] = xx * cross[p, 0, j]
            carried[p, 1, j] = yx * cross[p, 0, j] + yy * cross[p, 1, j]
            carried[p, 2, j] = zx * cross[p, 0, j] + zy * cross[p, 1, j] + zz * cross[p, 2, j]
    return True


def follow(landmarks: Landmarks, step: Array) -> Array:
    """Return how far the landmarks [L, 3] move with the step [K] of poses and calibration."""
    b = landmarks.carried @ step + landmarks.carried_gradients
    return -(landmarks.roots.transpose(0, 2, 1) @ b[:, :, None])[:, :, 0]
