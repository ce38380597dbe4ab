"""Pose of a camera against inverse-depth landmarks: robust Gauss-Newton with the uncertainty of both sides.

The covariance of a residual is that of the measurement plus the landmark's own, carried through the projection; so a
point of poor depth still helps where its depth does not matter. One of unknown depth is guessed as far away as those
around: its Jacobian by the pose is that of the guess; where that is off by a factor, steps lead away from the answer.
Depth that the current frame measures has a kernel of its own: on fr1_desk, where depth and colour are exposed at
different times, one kernel for all three components tripled the error, while two kernels halve it where the features
lie in one strip of the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import invert, se3_adjoint, se3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.vision.landmarks import UNKNOWN_RHO_SIGMA, known_depth, predict, sandwich

CHI2_GATE = 13.8  # squared Mahalanobis distance with two degrees of freedom that one good residual in 1000 exceeds
_CONVERGED = 1e-6  # norm of the step in rad and m: a thousandth of a pixel
_SETTLED = 1e-3  # a step that still matters after the last iteration
_MAX_ITERATIONS = 20
_CLOSING = 0.7  # of the kernel's width from one step to the next, at least
_ENOUGH_KNOWN = 60  # points whose depth is known, for a guess of the others'
_GROUPS = 4  # the image plane is cut into 4 x 4 regions whose residuals may err together


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A camera pose relative to the keyframe's camera, with what it rests on."""

    T_key_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of the right perturbation of T_key_cam, rotation first; NaN when not converged
    inliers: NDArray[np.bool_]  # [N] within the gate
    variance: float  # robust variance of the whitened residuals: 1 when the noise model is right
    converged: bool
    information: Array  # [6, 6] of that perturbation, for the noise that was given


class _Sightings(NamedTuple):
    """Landmarks of one view as the other saw them."""

    landmarks: Array  # [N, 3]
    covariances: Array  # [N, 3, 3]
    measured: Array  # [N, 3] direction on z = 1 and inverse depth; NaN where there is none
    sigma: Array  # [N, 3]
    share: Array  # [N] what the direction counts
    is_back: NDArray[np.bool_]  # [N] the landmark is of the camera, and the keyframe saw it


def refine_pose(
    T_key_cam: Array, landmarks: Array, covariances: Array, xy: Array, sigma_xy: float, cauchy: float,
    rho: Array | None = None, sigma_rho: Array | None = None, rotation_only: bool = False,
) -> PoseEstimate:  # fmt: skip
    """Refine T_key_cam so that landmarks appear where they are seen.

    Args:
        T_key_cam: start [4, 4].
        landmarks: [N, 3] `(x, y, rho)` in the keyframe's camera.
        covariances: [N, 3, 3] of the landmarks.
        xy: measured directions [N, 2] on z = 1; NaN: landmark not used.
        sigma_xy: standard deviation of `xy` (pixels / focal length).
        cauchy: scale of the Cauchy kernel in standard deviations, for direction and depth apart.
        rho: measured inverse depths [N] in 1/m, NaN where unknown; None: none.
        sigma_rho: standard deviations [N] of `rho` in 1/m.
        rotation_only: keep the translation of the start.

    Returns:
        The estimate; `converged` is False when the motion is not observable or the steps do not settle. The
        covariance is that of independent residuals times what the residuals show, see `pose_covariance`. With
        `rotation_only` that of the translation is meaningless.
    """
    seen = _sightings(landmarks, covariances, xy, sigma_xy, rho, sigma_rho)
    return _estimate(T_key_cam, seen, cauchy, rotation_only)


def refine_both_ways(
    T_a_b: Array, points_a: Array, points_b: Array, xy_a: Array, xy_b: Array, sigma_xy: float, sigma_rho: float,
    cauchy: float,
) -> PoseEstimate:  # fmt: skip
    """Refine the relative pose of two cameras that saw the same points, each by the points that the other knows.

    Args:
        T_a_b: start [4, 4].
        points_a: [N, 3] in camera a, metres; NaN where unknown.
        points_b: [N, 3] in camera b.
        xy_a: directions [N, 2] on z = 1 in which a saw them.
        xy_b: directions [N, 2] in which b saw them.
        sigma_xy: standard deviation of a direction.
        sigma_rho: standard deviation of the difference of two inverse depths in 1/m.
        cauchy: scale of the Cauchy kernel in standard deviations, for direction and depth apart.

    Returns:
        The estimate with T_a_b as `T_key_cam`; its inliers are those of a's known points, then those of b's.
    """
    has_a, has_b = np.isfinite(points_a[:, 2]), np.isfinite(points_b[:, 2])
    points = np.vstack([points_a[has_a], points_b[has_b]])
    landmarks = np.column_stack([points[:, :2], np.ones(len(points))]) / points[:, 2:]
    no_noise: Array = np.zeros((len(points), 3, 3))
    xy = np.vstack([xy_b[has_a], xy_a[has_b]])
    # depths are compared once, and the same four coordinates count half from either side
    rho = np.concatenate([np.full(int(has_a.sum()), np.nan), 1.0 / points_a[has_b, 2]])
    share = np.where(np.concatenate([has_b[has_a], has_a[has_b]]), 0.5, 1.0)
    seen = _sightings(landmarks, no_noise, xy, sigma_xy, rho, np.full(len(rho), sigma_rho))
    is_back = np.arange(len(points)) >= has_a.sum()
    return _estimate(T_a_b, seen._replace(share=share, is_back=is_back), cauchy, False)


def _estimate(T_key_cam: Array, seen: _Sightings, cauchy: float, rotation_only: bool) -> PoseEstimate:
    T, H, chi2, variance, together, converged = _refine(T_key_cam, seen, cauchy, rotation_only)
    covariance: Array = np.full((6, 6), np.nan)
    if converged:
        covariance = np.linalg.inv(H) * max(1.0, variance, together)
    with np.errstate(invalid="ignore"):
        inliers = np.asarray(chi2 < CHI2_GATE, dtype=np.bool_)
    return PoseEstimate(T, covariance, inliers, float(variance), bool(converged), H)


def pose_covariance(
    T_key_cam: Array, landmarks: Array, covariances: Array, xy: Array, sigma_xy: float, cauchy: float,
    rho: Array | None, sigma_rho: Array | None, scale: float, slope: Array, slope_sigma: float,
) -> Array | None:  # fmt: skip
    """Return the covariance [6, 6] of a refined pose (right perturbation, rotation first), as residuals show it.

    It is that of independent residuals, times their robust variance or how much those of the same image region err
    together (cluster-robust variance, Liang and Zeger, Biometrika 1986), whichever is more and at least one. What one
    more parameter is unsure of is added. None when the motion is not observable.

    Args:
        T_key_cam: pose [4, 4], the optimum.
        landmarks: see `refine_pose`.
        covariances: see `refine_pose`.
        xy: see `refine_pose`.
        sigma_xy: see `refine_pose`.
        cauchy: see `refine_pose`.
        rho: see `refine_pose`.
        sigma_rho: see `refine_pose`.
        scale: factor on all standard deviations, which does not change what counts as an outlier.
        slope: see `extra_parameter`.
        slope_sigma: standard deviation of that parameter.
    """
    seen = _sightings(landmarks, covariances, xy, sigma_xy, rho, sigma_rho)
    r, A, chi2 = _whitened(T_key_cam, seen, slope)
    full, _, variance = _normal_equations(r, A, chi2, seen.share, cauchy)
    H = full[:6, :6].copy()
    if not _solvable(H):
        return None
    factor = scale * scale * max(1.0, variance, _common_error(H, r, A, chi2, seen.measured, cauchy))
    moved = np.linalg.solve(H, full[:6, 6]) * slope_sigma
    return np.asarray(np.linalg.inv(H) * factor + np.outer(moved, moved))


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
    seen = _sightings(landmarks, covariances, xy, sigma_xy, None, None)
    r, A, chi2 = _whitened(T_key_cam, seen, slope)
    H, b, _ = _normal_equations(r, A, chi2, seen.share, cauchy)
    if not _solvable(H[:6, :6].copy()):
        return 0.0, 0.0
    carried = np.linalg.solve(H[:6, :6], H[:6, 6])
    information = float(H[6, 6] - carried @ H[:6, 6])
    if not information > 0.0:
        return 0.0, 0.0
    return -float(b[6] - carried @ b[:6]) / information, information


def _sightings(
    landmarks: Array, covariances: Array, xy: Array, sigma_xy: float, rho: Array | None, sigma_rho: Array | None
) -> _Sightings:
    measured = np.column_stack([xy, np.full(len(xy), np.nan) if rho is None else rho])
    sigma = np.column_stack([np.full((len(xy), 2), sigma_xy), np.ones(len(xy)) if sigma_rho is None else sigma_rho])
    share, is_back = np.ones(len(xy)), np.zeros(len(xy), dtype=np.bool_)
    guessed = covariances[:, 2, 2] >= 0.999 * UNKNOWN_RHO_SIGMA**2
    known_rho = landmarks[known_depth(landmarks, covariances) & np.isfinite(xy[:, 0]), 2]
    if len(known_rho) >= _ENOUGH_KNOWN:
        landmarks = np.column_stack([landmarks[:, :2], np.where(guessed, np.median(known_rho), landmarks[:, 2])])
    return _Sightings(landmarks, covariances, measured, sigma, share, is_back)


@njit(cache=True, nogil=True)
def _refine(
    T: Array, seen: _Sightings, cauchy: float, rotation_only: bool
) -> tuple[Array, Array, Array, float, float, bool]:
    no_slope = np.zeros((len(seen.landmarks), 2))
    r, A, chi2 = _whitened(T, seen, no_slope)
    H, b, variance, size, scale = np.zeros((6, 6)), np.zeros(6), np.nan, np.inf, np.inf
    step, part = np.zeros(6), 1.0
    for iteration in range(_MAX_ITERATIONS + 1):
        # far from the answer every residual is an outlier: the kernel starts as wide as they are and closes
        last = iteration == _MAX_ITERATIONS or size < _CONVERGED
        scale = cauchy if last else max(cauchy, min(1.5 * np.sqrt(_median(chi2)), _CLOSING * scale))
        full, gradient, variance = _normal_equations(r, A, chi2, seen.share, scale)
        H, b = full[:6, :6].copy(), gradient[:6].copy()
        if rotation_only:
            H[3:, :], H[:, 3:], H[3:, 3:], b[3:] = 0.0, 0.0, np.eye(3), 0.0
        if not _solvable(H):
            return T, H, chi2, np.nan, np.nan, False
        if last:
            break
        before, step = step, np.linalg.solve(H, -b)
        part = 0.5 * part if np.sum(step * before) < 0.0 else min(2.0 * part, 1.0)  # there and back again: half the way
        T = T @ se3_exp(part * step)
        size = np.sqrt(np.sum(step * step))
        r, A, chi2 = _whitened(T, seen, no_slope)
    together = 1.0 if rotation_only else _common_error(H, r, A, chi2, seen.measured, cauchy)
    return T, H, chi2, variance, together, size < _SETTLED


@njit(cache=True, nogil=True)
def _whitened(T: Array, seen: _Sightings, slope: Array) -> tuple[Array, Array, Array]:
    """Return whitened residuals [N, 3], their Jacobians [N, 3, 7] by pose and extra parameter, and chi2 [N] of x, y.

    Depth is whitened by itself: its own noise is the larger part, and where it is wrong the direction must not suffer.
    """
    landmarks, measured, sigma = seen.landmarks, seen.measured, seen.sigma
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    T_back, adjoint = invert(T), se3_adjoint(T)
    R_back, t_back = T_back[:3, :3].copy(), T_back[:3, 3].copy()
    r, A = np.zeros((len(landmarks), 3)), np.zeros((len(landmarks), 3, 7))
    chi2 = np.full(len(landmarks), np.nan)
    h, J, J_pose, S = np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for i in range(len(landmarks)):
        if not np.isfinite(measured[i, 0]):
            continue
        if seen.is_back[i]:
            if not predict(landmarks[i], R_back, t_back, h, J, J_pose):
                continue
            _turn_back(J_pose, adjoint)
        elif not predict(landmarks[i], R, t, h, J, J_pose):
            continue
        sandwich(J, seen.covariances[i], S)
        for k in range(3):
            S[k, k] += sigma[i, k] * sigma[i, k]
        # lower triangular L with L L^T = S[:2, :2], and its inverse applied to residual and Jacobian
        l00 = np.sqrt(S[0, 0])
        l10 = S[1, 0] / l00
        l11 = np.sqrt(S[1, 1] - l10 * l10)
        r[i, 0] = (h[0] - measured[i, 0]) / l00
        r[i, 1] = (h[1] - measured[i, 1] - l10 * r[i, 0]) / l11
        for c in range(7):
            a0, a1 = (J_pose[0, c], J_pose[1, c]) if c < 6 else (slope[i, 0], slope[i, 1])
            A[i, 0, c] = a0 / l00
            A[i, 1, c] = (a1 - l10 * A[i, 0, c]) / l11
        chi2[i] = r[i, 0] * r[i, 0] + r[i, 1] * r[i, 1]
        if np.isfinite(measured[i, 2]):
            l22 = np.sqrt(S[2, 2])
            r[i, 2] = (h[2] - measured[i, 2]) / l22
            A[i, 2, :6] = J_pose[2] / l22
    return r, A, chi2


@njit(cache=True, nogil=True)
def _turn_back(J: Array, adjoint: Array) -> None:
    """Turn J [3, 6] by invert(T) into that by T, since invert(T exp(xi)) = invert(T) exp(-Ad xi)."""
    for row in range(3):
        j0, j1, j2, j3, j4, j5 = J[row]
        for c in range(6):
            J[row, c] = -(
                j0 * adjoint[0, c] + j1 * adjoint[1, c] + j2 * adjoint[2, c]
                + j3 * adjoint[3, c] + j4 * adjoint[4, c] + j5 * adjoint[5, c]
            )  # fmt: skip


@njit(cache=True, nogil=True)
def _normal_equations(r: Array, A: Array, chi2: Array, share: Array, cauchy: float) -> tuple[Array, Array, float]:
    """Return H [7, 7] and gradient [7] under Cauchy weights, and the weighted variance of the directions' residuals.

    A direction counts by its share [N], too.
    """
    H, b = np.zeros((7, 7)), np.zeros(7)
    weighted, weights = 0.0, 0.0
    for i in range(len(r)):
        if not np.isfinite(chi2[i]):
            continue
        w = share[i] * _weight(chi2[i], cauchy)
        for k in range(3):
            w_k = w if k < 2 else _weight(r[i, 2] * r[i, 2], cauchy)
            for a in range(7):
                row = w_k * A[i, k, a]
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
def _weight(chi2: float, cauchy: float) -> float:
    return 1.0 / (1.0 + chi2 / (cauchy * cauchy))


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
        used[group] = 1.0
        for k in range(3):
            weighted = _weight(chi2[i] if k < 2 else r[i, 2] * r[i, 2], cauchy) * r[i, k]
            for a in range(6):
                scores[group, a] += weighted * A[i, k, a]
    groups = np.sum(used)
    if groups < 6:
        return 1.0
    return float(np.trace(np.linalg.solve(H, scores.T @ scores)) / 6.0 * groups / (groups - 3.0))


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
