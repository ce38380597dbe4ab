"""Noise models from covariances: validated, bounded in condition, with robust kernels."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.errors import DataError
from vislam.messages import Array

_ASYMMETRY = 1e-6  # relative; what honest arithmetic leaves


def checked_covariance(covariance: Array, size: int, what: str) -> Array:
    """Return the symmetrised covariance [size, size] or raise DataError naming `what`.

    Allowed is any symmetric, finite, positive semi-definite matrix that is not zero.
    """
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.shape != (size, size):
        raise DataError(f"{what}: covariance has shape {matrix.shape}, asked for ({size}, {size})")
    if not np.all(np.isfinite(matrix)):
        raise DataError(f"{what}: covariance holds NaN or infinity; report lost tracking instead")
    scale = float(np.max(np.abs(matrix)))
    if scale == 0.0 or float(np.max(np.abs(matrix - matrix.T))) > _ASYMMETRY * scale:
        raise DataError(f"{what}: covariance must be symmetric and not zero, its largest entry is {scale:.3g}")
    symmetric = 0.5 * (matrix + matrix.T)
    smallest = float(np.linalg.eigvalsh(symmetric)[0])
    if smallest < -_ASYMMETRY * scale:
        raise DataError(f"{what}: covariance is not positive, its smallest eigenvalue is {smallest:.3g}")
    return np.asarray(symmetric)


def conditioned(covariance: Array, ratio_max: float) -> Array:
    """Return the covariance with small eigenvalues raised until largest / smallest <= `ratio_max`.

    gtsam 4.3.0 rejects a healthy system when a factor's eigenvalues lie more than about 1e7 apart.
    """
    values, vectors = np.linalg.eigh(covariance)
    floor = values[-1] / ratio_max
    if values[0] >= floor:
        return covariance
    return np.asarray((vectors * np.maximum(values, floor)) @ vectors.T)


def inflated(covariance: Array, sigma_factor: float, floor_rad: float, floor_m: float) -> Array:
    """Return `sigma_factor**2 * covariance` plus the variance of a floor; pose covariance [6, 6], rotation first."""
    floor = np.repeat([floor_rad**2, floor_m**2], 3)
    return np.asarray(sigma_factor**2 * covariance + np.diag(floor))


def gaussian(covariance: Array, ratio_max: float) -> gtsam.noiseModel.Gaussian:
    """Return the Gaussian model of a validated covariance, bounded in condition."""
    return gtsam.noiseModel.Gaussian.Covariance(conditioned(covariance, ratio_max))


def sigmas(values: Array) -> gtsam.noiseModel.Diagonal:
    """Return the diagonal Gaussian model with standard deviations `values`."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(values, dtype=np.float64))


def huber(model: gtsam.noiseModel.Base, k: float) -> gtsam.noiseModel.Robust:
    """Return the model under a Huber kernel with threshold `k` on the whitened norm."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(k), model)


def cauchy(model: gtsam.noiseModel.Base, k: float) -> gtsam.noiseModel.Robust:
    """Return the model under a Cauchy kernel with scale `k` on the whitened norm."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(k), model)
