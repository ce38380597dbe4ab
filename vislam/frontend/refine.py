"""Pose of a camera against inverse-depth landmarks: robust Gauss-Newton with the uncertainty of both sides.

The covariance of a residual is that of the pixel plus the landmark's own, carried through the projection; so a point of
poor depth still helps where its depth does not matter. The depth that the *current* frame measures is left out: on
fr1_desk, where depth and colour are exposed at different times, it tripled the error, and on MH_01 it changed nothing.
It improves the landmarks instead, once per keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.frontend.landmarks import predict, sandwich
from vislam.geometry import se3_exp
from vislam.messages import Array

CHI2_GATE = 13.8  # squared Mahalanobis distance with two degrees of freedom that one good residual in 1000 exceeds
_CONVERGED = 1e-6  # norm of the step in rad and m: a thousandth of a pixel
_SETTLED = 1e-3  # a step that still matters after the last iteration
_MAX_ITERATIONS = 20
_GROUPS = 4  # the image plane is cut into 4 x 4 regions whose residuals may err together


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A camera pose relative to the keyframe's camera, with what it rests on."""

    T_key_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of the right perturbation of T_key_cam, rotation first; NaN when not converged
    inliers: NDArray[np.bool_]  # [N] within the gate
    variance: float  # robust variance of the whitened residuals: 1 when the noise model is right
    converged: bool


def refine_pose(
    T_key_cam: Array, landmarks: Array, covariances: Array, xy: Array, sigma_xy: float, cauchy: float,
    translation_sigma_m: float = np.inf,
) -> PoseEstimate:  # fmt: skip
    """Refine T_key_cam so that landmarks appear where they are seen.

    Args:
        T_key_cam: start [4, 4].
        landmarks: [N, 3] `(x, y, rho)` in the keyframe's camera.
        covariances: [N, 3, 3] of the landmarks.
        xy: measured directions [N, 2] on z = 1; NaN: landmark not used.
        sigma_xy: standard deviation of `xy` (pixels / focal length).
        cauchy: scale of the Cauchy kernel in standard deviations of a whole residual.
        translation_sigma_m: how well the start's translation is known, for cameras that do not see scale.

    Returns:
        The estimate; `converged` is False when the motion is not observable or the steps do not settle. The
        covariance is that of independent residuals times what the residuals show: their variance, and how much those
        of the same image region err together (cluster-robust variance, Liang and Zeger, Biometrika 1986).
    """
    T, H, chi2, variance, together, converged = _refine(
        T_key_cam, landmarks, covariances, xy, sigma_xy, cauchy, translation_sigma_m
    )
    covariance: Array = np.full((6, 6), np.nan)
    if converged:
        covariance = np.linalg.inv(H) * max(1.0, variance, together)
    with np.errstate(invalid="ignore"):
        inliers = np.asarray(chi2 < CHI2_GATE, dtype=np.bool_)
    return PoseEstimate(T, covariance, inliers, float(variance), bool(converged))


def extra_parameter(
    T_key_cam: Array, landmarks: Array, covariances: Array, xy: Array, sigma_xy: float, cauchy: float, slope: Array
) -> tuple[float, float]:
    """Estimate one more parameter beside the pose: one Gauss-Newton step with the pose marginalised.

    Args:
        T_key_cam: pose [4, 4], the optimum without the parameter.
        landmarks: see `refine_pose`.
        covariances: see `refine_pose`.
        xy: see `refine_pose`.
        sigma_xy: see `refine_pose`.
        cauchy: see `refine_pose`.
        slope: derivative [N, 2] of predicted minus measured direction by the parameter.

    Returns:
        The change of the parameter and its information (inverse variance); zeros when nothing can be said.
    """
    r, A, chi2 = _whitened(T_key_cam, landmarks, covariances, xy, sigma_xy, slope)
    H, b, _ = _normal_equations(r, A, chi2, cauchy)
    if not _solvable(H[:6, :6].copy()):
        return 0.0, 0.0
    carried = np.linalg.solve(H[:6, :6], H[:6, 6])
    information = float(H[6, 6] - carried @ H[:6, 6])
    if not information > 0.0:
        return 0.0, 0.0
    return -float(b[6] - carried @ b[:6]) / information, information


@njit(cache=True, nogil=True)
def _refine(
    T_start: Array,
    landmarks: Array,
    covariances: Array,
    xy: Array,
    sigma_xy: float,
    cauchy: float,
    prior_sigma_m: float,
) -> tuple[Array, Array, Array, float, float, bool]:
    T = T_start.copy()
    no_slope = np.zeros((len(landmarks), 2))
    r, A, chi2 = _whitened(T, landmarks, covariances, xy, sigma_xy, no_slope)
    H = np.zeros((6, 6))
    size = np.inf
    for _ in range(_MAX_ITERATIONS):
        # far from the answer every residual is an outlier: the kernel starts as wide as they are and closes with them
        scale = max(cauchy, 1.5 * np.sqrt(_median(chi2)))
        full, gradient, _ = _normal_equations(r, A, chi2, scale)
        H, b = full[:6, :6].copy(), gradient[:6].copy()
        if np.isfinite(prior_sigma_m):
            R_inverse = T[:3, :3].T.copy()
            b[3:] += R_inverse @ (T[:3, 3].copy() - T_start[:3, 3].copy()) / prior_sigma_m**2
            H[3:, 3:] += np.eye(3) / prior_sigma_m**2
        if not _solvable(H):
            return T, H, chi2, np.nan, np.nan, False
        step = np.linalg.solve(H, -b)
        T = T @ se3_exp(step)
        size = np.sqrt(np.sum(step * step))
        r, A, chi2 = _whitened(T, landmarks, covariances, xy, sigma_xy, no_slope)
        if size < _CONVERGED and scale == cauchy:
            break
    full, _, variance = _normal_equations(r, A, chi2, cauchy)
    H = full[:6, :6].copy()
    if np.isfinite(prior_sigma_m):
        H[3:, 3:] += np.eye(3) / prior_sigma_m**2
    # where the translation is a guess anyway, it may wander by a part of its sigma
    settled = 0.2 * prior_sigma_m if np.isfinite(prior_sigma_m) else _SETTLED
    converged = size < settled and _solvable(H)
    together = _common_error(H, r, A, chi2, xy, cauchy) if converged else np.nan
    return T, H, chi2, variance, together, converged


@njit(cache=True, nogil=True)
def _whitened(
    T: Array, landmarks: Array, covariances: Array, xy: Array, sigma_xy: float, slope: Array
) -> tuple[Array, Array, Array]:
    """Return whitened residuals [N, 2], their Jacobians [N, 2, 7] by pose and extra parameter, and chi2 [N]."""
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    r_out, A_out = np.zeros((len(landmarks), 2)), np.zeros((len(landmarks), 2, 7))
    chi2 = np.full(len(landmarks), np.nan)
    h, J, J_pose, S = np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for i in range(len(landmarks)):
        if not (np.isfinite(xy[i, 0]) and predict(landmarks[i], R, t, h, J, J_pose)):
            continue
        sandwich(J, covariances[i], S)
        # lower triangular L of S[:2, :2] + sigma^2, and its inverse applied to residual and Jacobian
        l00 = np.sqrt(S[0, 0] + sigma_xy * sigma_xy)
        l10 = S[1, 0] / l00
        l11 = np.sqrt(S[1, 1] + sigma_xy * sigma_xy - l10 * l10)
        r0 = (h[0] - xy[i, 0]) / l00
        r1 = (h[1] - xy[i, 1] - l10 * r0) / l11
        r_out[i, 0], r_out[i, 1] = r0, r1
        for c in range(7):
            a0, a1 = (J_pose[0, c], J_pose[1, c]) if c < 6 else (slope[i, 0], slope[i, 1])
            A_out[i, 0, c] = a0 / l00
            A_out[i, 1, c] = (a1 - l10 * A_out[i, 0, c]) / l11
        chi2[i] = r0 * r0 + r1 * r1
    return r_out, A_out, chi2


@njit(cache=True, nogil=True)
def _normal_equations(r: Array, A: Array, chi2: Array, cauchy: float) -> tuple[Array, Array, float]:
    """Return H [7, 7] and gradient [7] under Cauchy weights, and the weighted variance of the residuals."""
    H, b = np.zeros((7, 7)), np.zeros(7)
    weighted, weights = 0.0, 0.0
    for i in range(len(r)):
        if not np.isfinite(chi2[i]):
            continue
        w = 1.0 / (1.0 + chi2[i] / (cauchy * cauchy))
        for k in range(2):
            for a in range(7):
                row = w * A[i, k, a]
                b[a] += row * r[i, k]
                for c in range(a, 7):
                    H[a, c] += row * A[i, k, c]
        weighted += w * chi2[i]
        weights += 2.0 * w
    for a in range(7):
        for c in range(a):
            H[a, c] = H[c, a]
    return H, b, weighted / weights if weights > 0.0 else np.nan


@njit(cache=True, nogil=True)
def _common_error(H: Array, r: Array, A: Array, chi2: Array, xy: Array, cauchy: float) -> float:
    """Return by how much variance grows because residuals of one image region err together; 1 when independent.

    The scores (gradients) of a region are summed before they are squared; the mean eigenvalue of H^-1 times the sum of
    their outer products is the factor, corrected for the six parameters that the scores were fitted with.
    """
    seen = np.isfinite(chi2)
    lowest, highest = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(xy)):
        if seen[i]:
            for k in range(2):
                lowest[k], highest[k] = min(lowest[k], xy[i, k]), max(highest[k], xy[i, k])
    scores = np.zeros((_GROUPS * _GROUPS, 6))
    used = np.zeros(_GROUPS * _GROUPS)
    for i in range(len(xy)):
        if not seen[i]:
            continue
        group = 0
        for k in range(2):
            place = (xy[i, k] - lowest[k]) / max(highest[k] - lowest[k], 1e-9)
            group = group * _GROUPS + min(int(place * _GROUPS), _GROUPS - 1)
        w = 1.0 / (1.0 + chi2[i] / (cauchy * cauchy))
        used[group] = 1.0
        for a in range(6):
            scores[group, a] += w * (A[i, 0, a] * r[i, 0] + A[i, 1, a] * r[i, 1])
    groups = np.sum(used)
    if groups < 6:
        return 1.0
    middle = scores.T @ scores
    return float(np.trace(np.linalg.solve(H, middle)) / 6.0 * groups / (groups - 3.0))


@njit(cache=True, nogil=True)
def _median(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) > 0 else 0.0


@njit(cache=True, nogil=True)
def _solvable(H: Array) -> bool:
    """Return whether the normal matrix is finite and fixes all directions, whatever their units."""
    diagonal = np.diag(H).copy()
    if not (np.all(np.isfinite(H)) and np.min(diagonal) > 0.0):
        return False
    scale = 1.0 / np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(H * np.outer(scale, scale))[0] > 1e-9)
