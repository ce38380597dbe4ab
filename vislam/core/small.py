"""Vectors of 3 and 3 x 3 matrices: numba compiles and runs these faster than the library calls behind `@`.

As arrays they are looped over; as tuples (a matrix is its rows in a row) they live in registers. What callers pass
constants to is inlined: numba would compile it once more for each of them, and a signature instead makes it load its
compiler on import.
"""

from __future__ import annotations

import math

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array

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
def in_a_row(R: Array) -> Mat:
    """Return the elements of R [3, 3] as a tuple."""
    return R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]


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
def product_transposed(A: Array, B: Array) -> Array:
    """Return A @ B.T."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def rotated_back(A: Array, v: Array) -> Array:
    """Return A.T @ v of a vector [3]."""
    out = np.empty(3)
    for i in range(3):
        out[i] = A[0, i] * v[0] + A[1, i] * v[1] + A[2, i] * v[2]
    return out


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def put(J: Array, row: int, column: int, scale: float, B: Array) -> None:
    """Write `scale * B` [3, 3] into J from a row and a column on."""
    for i in range(3):
        for j in range(3):
            J[row + i, column + j] = scale * B[i, j]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def put_back(J: Array, row: int, column: int, scale: float, B: Array) -> None:
    """Write `scale * B.T` [3, 3] into J from a row and a column on."""
    for i in range(3):
        for j in range(3):
            J[row + i, column + j] = scale * B[j, i]


@njit(cache=True, nogil=True)
def write_rotation(w: float, x: float, y: float, z: float, R: Array) -> None:
    """Write the rotation of a unit quaternion into R."""
    R[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[0, 1] = 2.0 * (x * y - w * z)
    R[0, 2] = 2.0 * (x * z + w * y)
    R[1, 0] = 2.0 * (x * y + w * z)
    R[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[1, 2] = 2.0 * (y * z - w * x)
    R[2, 0] = 2.0 * (x * z - w * y)
    R[2, 1] = 2.0 * (y * z + w * x)
    R[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True, nogil=True)
def write_right_jacobian(x: float, y: float, z: float, scale: float, J: Array) -> None:
    """J = scale * J_r([x, y, z]), to second order in the angle."""
    J[0, 0] = scale * (1.0 - (y * y + z * z) / 6.0)
    J[1, 1] = scale * (1.0 - (x * x + z * z) / 6.0)
    J[2, 2] = scale * (1.0 - (x * x + y * y) / 6.0)
    J[0, 1] = scale * (0.5 * z + x * y / 6.0)
    J[1, 0] = scale * (-0.5 * z + x * y / 6.0)
    J[0, 2] = scale * (-0.5 * y + x * z / 6.0)
    J[2, 0] = scale * (0.5 * y + x * z / 6.0)
    J[1, 2] = scale * (0.5 * x + y * z / 6.0)
    J[2, 1] = scale * (-0.5 * x + y * z / 6.0)


@njit(cache=True, nogil=True)
def write_left_jacobian(x: float, y: float, z: float, J: Array) -> None:
    """J = J_l([x, y, z]), at any angle."""
    t2 = x * x + y * y + z * z
    t = math.sqrt(t2)
    a = 0.5 - t2 / 24.0 if t < 1e-3 else (1.0 - math.cos(t)) / t2
    b = 1.0 / 6.0 - t2 / 120.0 if t < 1e-3 else (t - math.sin(t)) / (t2 * t)
    J[0, 0] = 1.0 - b * (y * y + z * z)
    J[1, 1] = 1.0 - b * (x * x + z * z)
    J[2, 2] = 1.0 - b * (x * x + y * y)
    J[0, 1] = -a * z + b * x * y
    J[1, 0] = a * z + b * x * y
    J[0, 2] = a * y + b * x * z
    J[2, 0] = -a * y + b * x * z
    J[1, 2] = -a * x + b * y * z
    J[2, 1] = a * x + b * y * z


@njit(cache=True, nogil=True)
def write_cross(fx: float, fy: float, fz: float, R: Array, scale: float, out: Array) -> None:
    """Write scale * [f]x @ R into `out`."""
    for j in range(3):
        out[0, j] = scale * (fy * R[2, j] - fz * R[1, j])
        out[1, j] = scale * (fz * R[0, j] - fx * R[2, j])
        out[2, j] = scale * (fx * R[1, j] - fy * R[0, j])
