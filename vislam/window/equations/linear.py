"""Linear algebra of the window over LAPACK: a Cholesky factor in place, and what is solved with it.

Matrices are upper triangles in rows: `A = U.T @ U`. Their transposes are lower triangles in columns, which is LAPACK's
own order, so nothing is copied.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs

from vislam.core.messages import Array

_PIVOTS = (1e-12, 1e30)  # outside, information is rounding or nonsense


def factorise(A: Array) -> bool:
    """Replace the upper triangle of A [D, D], contiguous, by its Cholesky factor; False where it has none."""
    _, info = dpotrf(A.T, lower=1, clean=0, overwrite_a=1)
    pivots = np.diag(A) ** 2
    return info == 0 and bool(((pivots > _PIVOTS[0]) & (pivots < _PIVOTS[1])).all())  # NaN is in no range


def solve(U: Array, rhs: Array) -> Array:
    """Return x with `U.T @ U @ x == rhs` for an upper factor [D, D] and a vector [D]."""
    x, _ = dpotrs(U.T, rhs, lower=1)
    return np.asarray(x, dtype=np.float64)


def trailing_covariance(U: Array, start: int) -> Array:
    """Return the covariance [D - start, D - start] of the unknowns that were eliminated last."""
    half, _ = dpotri(U[start:, start:].T.copy(order="F"), lower=1, overwrite_c=1)
    half = np.tril(half)
    return np.asarray(half + np.tril(half, -1).T)


def joint_covariance(U: Array, index: NDArray[np.int64]) -> Array:
    """Return the covariance [N, N] of some of the unknowns, from the factor [D, D] of the information of all."""
    columns = np.zeros((len(U), len(index)), order="F")
    columns[index, np.arange(len(index))] = 1.0
    half, _ = dtrtrs(U.T, columns, lower=1, overwrite_b=1)
    return np.asarray(half.T @ half)
