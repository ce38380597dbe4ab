"""Compiled linear algebra of the window: a Cholesky factorisation that skips zeros, and what is solved with it.

Matrices are upper triangles in rows: `A = U.T @ U`. Inner loops run along rows, so that they vectorise.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from vislam.messages import Array

_GAP = 12  # a shorter run of zeros costs less than a loop that leaves it out


@njit(cache=True, nogil=True, error_model="numpy")
def factorise(A: Array) -> bool:
    """Replace the upper triangle of A [D, D] by its Cholesky factor; False where A is not positive definite."""
    n = len(A)
    begins, ends = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)  # of runs of a row that are not zero
    for k in range(n):
        pivot = A[k, k]
        if not (pivot > 1e-12 and pivot < 1e30):
            return False
        root = np.sqrt(pivot)
        row = A[k]
        runs = 0
        for j in range(k, n):
            if row[j] != 0.0:
                row[j] /= root
                if runs == 0 or j - ends[runs - 1] >= _GAP:
                    begins[runs] = j
                    runs += 1
                ends[runs - 1] = j + 1
        for a in range(runs):
            for i in range(max(begins[a], k + 1), ends[a]):
                factor = row[i]
                below = A[i]
                for j in range(i, ends[a]):
                    below[j] -= factor * row[j]
                for b in range(a + 1, runs):
                    for j in range(begins[b], ends[b]):
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


def joint_covariance(U: Array, index: NDArray[np.int64]) -> Array:
    """Return the covariance [N, N] of some of the unknowns, from the factor [D, D] of the information of all."""
    half = solve_triangular(U, np.eye(len(U))[:, index], trans="T", check_finite=False)
    return np.asarray(half.T @ half)
