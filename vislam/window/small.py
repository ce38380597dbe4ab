"""Vectors of 3 and 3 x 3 matrices: numba compiles and runs these faster than the library calls behind `@`.

As arrays they are looped over; as tuples (a matrix is its rows in a row) they live in registers. Signatures are given
where callers pass constants, for each of which numba would compile once more.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array

Vec = tuple[float, float, float]
Mat = tuple[float, float, float, float, float, float, float, float, float]


@njit(cache=True, nogil=True, error_model="numpy")
def plus(a: Vec, b: Vec) -> Vec:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def minus(a: Vec, b: Vec) -> Vec:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def times(s: float, a: Vec) -> Vec:
    """Return s * a."""
    return s * a[0], s * a[1], s * a[2]


@njit(cache=True, nogil=True, error_model="numpy")
def dot(a: Vec, b: Vec) -> float:
    """Return the dot product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def cross(a: Vec, b: Vec) -> Vec:
    """Return the cross product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True, error_model="numpy")
def by(R: Mat, a: Vec) -> Vec:
    """Return R @ a."""
    return (
        R[0] * a[0] + R[1] * a[1] + R[2] * a[2],
        R[3] * a[0] + R[4] * a[1] + R[5] * a[2],
        R[6] * a[0] + R[7] * a[1] + R[8] * a[2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def back(R: Mat, a: Vec) -> Vec:
    """Return R.T @ a."""
    return (
        R[0] * a[0] + R[3] * a[1] + R[6] * a[2],
        R[1] * a[0] + R[4] * a[1] + R[7] * a[2],
        R[2] * a[0] + R[5] * a[1] + R[8] * a[2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def turned(A: Mat, B: Mat) -> Mat:
    """Return A @ B."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6], A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8], A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7], A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6], A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )  # fmt: skip


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
