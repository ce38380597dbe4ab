"""Compiled linear algebra of the window: a Cholesky factorisation that skips zeros, and what is solved with it.

Matrices are upper triangles in rows: `A = U.T @ U`. Inner loops run along rows, so that they vectorise.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array


@njit(cache=True, nogil=True, error_model="numpy")
def factorise(A: Array) -> bool:
    """Replace the upper triangle of A [D, D] by its Cholesky factor; False where A is not positive definite."""
    n = len(A)
    for k in range(n):
        pivot = A[k, k]
        if not (pivot > 1e-12 and pivot < 1e30):
            return False
        root = np.sqrt(pivot)
        row = A[k]
        for j in range(k, n):
            row[j] /= root
        for i in range(k + 1, n):
            factor = row[i]
            if factor != 0.0:
                below = A[i]
                for j in range(i, n):
                    below[j] -= factor * row[j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def solve(U: Array, rhs: Array) -> Array:
    """Return x with `U.T @ U @ x == rhs` for an upper factor [D, D] and a vector [D]."""
    n = len(U)
    y = rhs.copy()
    for k in range(n):
        y[k] /= U[k, k]
        value = y[k]
        if value != 0.0:
            row = U[k]
            for j in range(k + 1, n):
                y[j] -= row[j] * value
    for k in range(n - 1, -1, -1):
        row = U[k]
        total = y[k]
        for j in range(k + 1, n):
            total -= row[j] * y[j]
        y[k] = total / row[k]
    return y


def trailing_covariance(U: Array, start: int) -> Array:
    """Return the covariance [D - start, D - start] of the unknowns that were eliminated last."""
    inverse = _trailing_inverse(U, start)
    return np.asarray(inverse @ inverse.T)


@njit(cache=True, nogil=True, error_model="numpy")
def _trailing_inverse(U: Array, start: int) -> Array:
    n = len(U) - start
    inverse = np.zeros((n, n))  # of the trailing triangle, by rows from the last
    for i in range(n - 1, -1, -1):
        out = inverse[i]
        row = U[start + i]
        scale = 1.0 / row[start + i]
        out[i] = scale
        for k in range(i + 1, n):
            factor = -scale * row[start + k]
            if factor != 0.0:
                below = inverse[k]
                for j in range(k, n):
                    out[j] += factor * below[j]
    return inverse


def columns_of_covariance(U: Array, columns: np.ndarray) -> Array:
    """Return columns [D, N] of the inverse of `U.T @ U`."""
    unit = np.eye(len(U))[columns]
    return np.ascontiguousarray(np.array([solve(U, row) for row in unit]).T)
