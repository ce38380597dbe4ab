"""Products of 3 x 3 matrices in loops: numba compiles and runs these faster than the library calls behind `@`.

Signatures are given where callers pass constants, for each of which numba would compile once more.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array


@njit(cache=True, nogil=True, error_model="numpy")
def rotation(x: Array) -> Array:
    """Return the rotation [3, 3] of a state [21]."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = x[3 * i + j]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def product(A: Array, B: Array) -> Array:
    """Return A @ B."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def product_back(A: Array, B: Array) -> Array:
    """Return A.T @ B."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def rotated_back(A: Array, v: Array) -> Array:
    """Return A.T @ v of a vector [3]."""
    out = np.empty(3)
    for i in range(3):
        out[i] = A[0, i] * v[0] + A[1, i] * v[1] + A[2, i] * v[2]
    return out


@njit("void(f8[:, ::1], i8, i8, f8, f8[:, ::1])", cache=True, nogil=True, error_model="numpy")
def put(J: Array, row: int, column: int, scale: float, B: Array) -> None:
    """Write `scale * B` [3, 3] into J from a row and a column on."""
    for i in range(3):
        for j in range(3):
            J[row + i, column + j] = scale * B[i, j]


@njit("void(f8[:, ::1], i8, i8, f8, f8[:, ::1])", cache=True, nogil=True, error_model="numpy")
def put_back(J: Array, row: int, column: int, scale: float, B: Array) -> None:
    """Write `scale * B.T` [3, 3] into J from a row and a column on."""
    for i in range(3):
        for j in range(3):
            J[row + i, column + j] = scale * B[j, i]
