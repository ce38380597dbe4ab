"""Pose of a camera against inverse-depth landmarks: robust Gauss-Newton with the uncertainty of both sides.

Every landmark gives a residual `(x, y)` or `(x, y, rho)` whose covariance is the measurement's plus the landmark's own,
carried through the projection; so a point of poor depth still helps where its depth does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.frontend.landmarks import predict, sandwich
from vislam.geometry import se3_exp
from vislam.messages import Array

_CONVERGED = 1e-6  # norm of the step in rad and m: a thousandth of a pixel
_SETTLED = 1e-3  # a step that still matters after the last iteration


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A camera pose relative to the keyframe's camera, with what it rests on."""

    T_key_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of the right perturbation of T_key_cam, rotation first
    chi2: Array  # [N] squared Mahalanobis distance of each landmark's residual; NaN where not used or behind
    dof: NDArray[np.int64]  # [N] 3 with measured depth, 2 without, 0 not used
    variance: float  # robust variance of the whitened residuals: 1 when the noise model is right
    converged: bool


def refine_pose(
    T_key_cam: Array, landmarks: Array, covariances: Array, xy: Array, rho: Array, sigma_xy: float, sigma_rho: Array,
    cauchy: float, iterations: int = 15,
) -> PoseEstimate:  # fmt: skip
    """Refine T_key_cam so that landmarks agree with what the camera measures.

    Args:
        T_key_cam: start [4, 4].
        landmarks: [N, 3] `(x, y, rho)` in the keyframe's camera.
        covariances: [N, 3, 3] of the landmarks.
        xy: measured directions [N, 2] on z = 1; NaN: landmark not used.
        rho: measured inverse depths [N] in 1/m; NaN: unknown.
        sigma_xy: standard deviation of `xy` (pixels / focal length).
        sigma_rho: standard deviations [N] of `rho` in 1/m.
        cauchy: scale of the Cauchy kernel in standard deviations of the whole residual.
        iterations: at most this many Gauss-Newton steps.

    Returns:
        The estimate; `converged` is False when the normal matrix is singular or the steps do not settle.
    """
    T, H, chi2, dof, variance, converged = _refine(
        T_key_cam, landmarks, covariances, xy, rho, sigma_xy, sigma_rho, cauchy, iterations
    )
    covariance = np.full((6, 6), np.nan)
    if converged:
        covariance = np.linalg.inv(H) * max(1.0, variance)
    return PoseEstimate(T, covariance, chi2, dof, float(variance), bool(converged))


@njit(cache=True, nogil=True)
def _refine(
    T_start: Array, landmarks: Array, covariances: Array, xy: Array, rho: Array, sigma_xy: float, sigma_rho: Array,
    cauchy: float, iterations: int,
) -> tuple[Array, Array, Array, NDArray[np.int64], float, bool]:  # fmt: skip
    T = T_start.copy()
    chi2 = _normal_equations(T, landmarks, covariances, xy, rho, sigma_xy, sigma_rho, cauchy)[2]
    size = np.inf
    for _ in range(iterations):
        # far from the answer every residual is an outlier: the kernel starts as wide as they are and closes with them
        scale = max(cauchy, 1.5 * np.sqrt(_median(chi2)))
        H, b, chi2, dof, variance = _normal_equations(
            T, landmarks, covariances, xy, rho, sigma_xy, sigma_rho, scale
        )
        if not _solvable(H):
            return T, H, chi2, dof, variance, False
        step = np.linalg.solve(H, -b)
        T = T @ se3_exp(step)
        size = np.sqrt(np.sum(step * step))
        if size < _CONVERGED and scale == cauchy:
            break
    H, b, chi2, dof, variance = _normal_equations(T, landmarks, covariances, xy, rho, sigma_xy, sigma_rho, cauchy)
    # a small last step is good enough; a large one means that the start was hopeless
    return T, H, chi2, dof, variance, size < _SETTLED and _solvable(H)


@njit(cache=True, nogil=True)
def _median(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) > 0 else 0.0


@njit(cache=True, nogil=True)
def _solvable(H: Array) -> bool:
    """Return whether the normal matrix is finite and fixes all six directions, whatever their units."""
    diagonal = np.diag(H).copy()
    if not (np.all(np.isfinite(H)) and np.min(diagonal) > 0.0):
        return False
    scale = 1.0 / np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(H * np.outer(scale, scale))[0] > 1e-9)


@njit(cache=True, nogil=True)
def _normal_equations(
    T: Array, landmarks: Array, covariances: Array, xy: Array, rho: Array, sigma_xy: float, sigma_rho: Array, cauchy: float
) -> tuple[Array, Array, Array, NDArray[np.int64], float]:
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    H, b = np.zeros((6, 6)), np.zeros(6)
    chi2 = np.full(len(landmarks), np.nan)
    dof = np.zeros(len(landmarks), dtype=np.int64)
    h, J, J_pose, S, r = np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3)), np.empty(3)
    weighted, weights = 0.0, 0.0
    for i in range(len(landmarks)):
        if not (np.isfinite(xy[i, 0]) and predict(landmarks[i], R, t, h, J, J_pose)):
            continue
        n = 3 if np.isfinite(rho[i]) else 2
        sandwich(J, covariances[i], S)
        S[0, 0] += sigma_xy * sigma_xy
        S[1, 1] += sigma_xy * sigma_xy
        r[0], r[1] = h[0] - xy[i, 0], h[1] - xy[i, 1]
        if n == 3:
            S[2, 2] += sigma_rho[i] * sigma_rho[i]
            r[2] = h[2] - rho[i]
        _whiten(S, n, r, J_pose)
        d2 = 0.0
        for a in range(n):
            d2 += r[a] * r[a]
        chi2[i] = d2
        dof[i] = n
        w = 1.0 / (1.0 + d2 / (cauchy * cauchy))
        for k in range(n):
            for a in range(6):
                weighted_row = w * J_pose[k, a]
                b[a] += weighted_row * r[k]
                for c in range(a, 6):
                    H[a, c] += weighted_row * J_pose[k, c]
        weighted += w * d2
        weights += w * n
    for a in range(6):
        for c in range(a):
            H[a, c] = H[c, a]
    variance = weighted / weights if weights > 0.0 else np.nan
    return H, b, chi2, dof, variance


@njit(cache=True, nogil=True)
def _whiten(S: Array, n: int, r: Array, J: Array) -> None:
    """Replace the first n rows of r [3] and J [3, 6] by L^-1 of themselves, S = L L^T [n, n]; S is destroyed."""
    for i in range(n):
        for j in range(i):
            factor = S[i, j]
            for k in range(j):
                factor -= S[i, k] * S[j, k]
            S[i, j] = factor / S[j, j]
        pivot = S[i, i]
        for k in range(i):
            pivot -= S[i, k] * S[i, k]
        S[i, i] = np.sqrt(pivot)
        for k in range(i):
            r[i] -= S[i, k] * r[k]
            for c in range(6):
                J[i, c] -= S[i, k] * J[k, c]
        r[i] /= S[i, i]
        for c in range(6):
            J[i, c] /= S[i, i]
