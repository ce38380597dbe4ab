"""Noise models from covariances: validated, bounded in condition, with robust kernels."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from vislam.core.errors import DataError
from vislam.core.messages import Array

DIRECTION_FLOOR_DEG = 0.2  # mono: direction of motion
DIRECTION_SOFT_M = 0.005  # mono: baselines shorter than this lose their say on direction
# mono: relative, on the expected step; wide, for only the IMU knows the scale
DIRECTION_SCALE_SIGMA = 5.0
_ASYMMETRY = 1e-6  # relative; what honest arithmetic leaves


def checked_covariance(covariance: Array, size: int, what: str) -> Array:
    """Return the symmetrised covariance [size, size] or raise DataError naming `what`.

    Allowed is any symmetric, finite, positive semi-definite matrix that is not zero.
    """
    return np.asarray(checked_covariances([covariance], size, [what])[0])


def checked_covariances(covariances: Sequence[Array], size: int, whats: Sequence[str]) -> Array:
    """Return symmetrised covariances [N, size, size], each as `checked_covariance` takes it; DataError names one."""
    for covariance, what in zip(covariances, whats, strict=True):
        if np.shape(covariance) != (size, size):
            raise DataError(f"{what}: covariance has shape {np.shape(covariance)}, asked for ({size}, {size})")
    matrices = np.array(covariances, dtype=np.float64).reshape(-1, size, size)
    for n in np.flatnonzero(~np.isfinite(matrices).all(axis=(1, 2))).tolist():
        raise DataError(f"{whats[n]}: covariance holds NaN or infinity; report lost tracking instead")
    turned = matrices.transpose(0, 2, 1)
    scales = np.abs(matrices).max(axis=(1, 2))
    crooked = (scales == 0.0) | (np.abs(matrices - turned).max(axis=(1, 2)) > _ASYMMETRY * scales)
    for n in np.flatnonzero(crooked).tolist():
        raise DataError(f"{whats[n]}: covariance must be symmetric and not zero, its largest entry is {scales[n]:.3g}")
    symmetric = 0.5 * (matrices + turned)
    smallest = np.linalg.eigvalsh(symmetric)[:, 0]
    for n in np.flatnonzero(smallest < -_ASYMMETRY * scales).tolist():
        raise DataError(f"{whats[n]}: covariance is not positive, its smallest eigenvalue is {smallest[n]:.3g}")
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
    out = np.array(sigma_factor**2 * covariance, order="C")
    out.ravel()[:21:7] += floor_rad**2
    out.ravel()[21::7] += floor_m**2
    return out


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
