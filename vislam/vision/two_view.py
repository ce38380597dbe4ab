"""Motion between two views of one camera: rotation and the direction of translation, from epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import so3_exp, so3_log, tangent_basis
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.core.quantiles import median
from vislam.core.small import back, by, cross, dot, in_a_row

CHI2_GATE = 10.8  # squared deviation with one degree of freedom that one good residual in 1000 exceeds
_MAX_ITERATIONS = 20
_CONVERGED = 1e-7  # rad, of rotation and direction together
_SETTLED = 5e-3  # a step that still matters after the last iteration
_LONGEST = 3.0  # times the usual parallax that one track may count for
_REWEIGHTED = 4
_CONFIDENCE = 0.999
_MAX_TRIES = 500
_MOST_ALIKE = 1e9  # condition of rotation and direction beside one more parameter
_ANY_DIRECTION = 1.0  # variance of each axis of a unit vector of which nothing is known


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewEstimate:
    """Pose of a camera relative to the keyframe's camera, up to scale."""

    R_key_cam: Array  # [3, 3]
    direction_key: Array  # [3] unit vector from the keyframe's camera to the camera
    covariance: Array  # [6, 6] of R_key_cam (right side) and of `direction_key` (key axes), singular along it
    inliers: NDArray[np.bool_]  # [N]
    converged: bool
    variance: float = float("nan")  # robust variance of the whitened residuals; the covariance has it where above 1


@dataclass(frozen=True, slots=True, eq=False)
class RotationPrior:
    """What the gyroscope shows of the rotation since the keyframe, once its bias is known."""

    R_key_cam: Array  # [3, 3]
    sigma_rad: float


def turn_only(view: TwoViewEstimate) -> TwoViewEstimate:
    """Return the rotation alone: no direction, and the covariance of a unit vector of which nothing is known."""
    covariance = view.covariance.copy()
    covariance[3:, :] = covariance[:, 3:] = 0.0
    covariance[3:, 3:] = np.eye(3) * _ANY_DIRECTION
    return replace(view, direction_key=np.zeros(3), covariance=covariance)


def moved_xy(R_key_cam: Array, key_xy: Array, xy: Array) -> Array:
    """Return how far points [N] moved on z = 1 once the rotation is taken out; NaN where they were not found."""
    turned = np.column_stack([xy, np.ones(len(xy))]) @ R_key_cam.T
    return np.asarray(np.linalg.norm(turned[:, :2] / turned[:, 2:] - key_xy, axis=1))


def refine_two_view(
    R_key_cam: Array,
    direction_key: Array,
    key_xy: Array,
    xy: Array,
    sigma_xy: float,
    cauchy: float,
    prior: RotationPrior | None = None,
) -> TwoViewEstimate:
    """Refine rotation and direction so that points lie on their epipolar lines.

    A flat or far scene explains a small translation as rotation nearly as well; the prior decides there. The covariance
    is that of vision with a prior ten times as wide, since the filter and the graph know the gyroscope already.

    Args:
        R_key_cam: start [3, 3].
        direction_key: start [3], any length above zero.
        key_xy: directions [N, 2] on z = 1 in the keyframe.
        xy: the same points in the camera [N, 2]; NaN: not used.
        sigma_xy: standard deviation of `xy`.
        cauchy: scale of the Cauchy kernel in standard deviations.
        prior: rotation from the gyroscope.

    Returns:
        The estimate, with the sign of the direction that puts most points in front of both cameras.
    """
    start = direction_key / np.linalg.norm(direction_key)
    R_prior, weight = (np.eye(3), 0.0) if prior is None else (prior.R_key_cam, prior.sigma_rad**-2)
    R, t, H, basis, chi2, variance, converged = _refine(
        R_key_cam, start, key_xy, xy, sigma_xy, cauchy, np.ascontiguousarray(R_prior), weight
    )
    with np.errstate(invalid="ignore"):
        inliers = np.asarray(chi2 < CHI2_GATE, dtype=np.bool_)
    covariance: Array = np.full((6, 6), np.nan)
    if converged:
        embed = np.zeros((6, 5))
        embed[:3, :3] = np.eye(3)
        embed[3:, 3:] = basis
        H[:3, :3] -= 0.99 * weight * np.eye(3)
        covariance = embed @ np.linalg.inv(H) @ embed.T * max(1.0, float(variance))
    ahead, behind = _in_front(R, t, key_xy, xy, inliers)
    if ahead < behind:
        t = -t
    return TwoViewEstimate(R, t, covariance, inliers, bool(converged), float(variance))


def extra_of_two_views(
    view: TwoViewEstimate, xy: Sequence[Array], ahead: Sequence[Array], sigma_xy: float, cauchy: float,
    prior: RotationPrior | None,
) -> tuple[float, float]:  # fmt: skip
    """Estimate one more parameter beside rotation and direction: one Gauss-Newton step with these marginalised.

    Args:
        view: the optimum without the parameter.
        xy: directions [N, 2] in keyframe and camera, see `refine_two_view`.
        ahead: the same where the parameter is larger by one.
        sigma_xy: see `refine_two_view`.
        cauchy: see `refine_two_view`.
        prior: see `refine_two_view`.

    Returns:
        The change of the parameter and its information (inverse variance); zeros when nothing can be said.
    """
    R, t = np.ascontiguousarray(view.R_key_cam), np.ascontiguousarray(view.direction_key)
    r, J = _linearise(R, t, tangent_basis(t), *xy, sigma_xy)
    r_ahead, _ = _linearise(R, t, tangent_basis(t), *ahead, sigma_xy)
    A = np.column_stack([J, r_ahead - r])
    use = view.inliers & np.isfinite(r) & np.isfinite(r_ahead)
    A, r = A[use], r[use]
    weighted = A / (1.0 + (r / cauchy) ** 2)[:, None]
    H, b = weighted.T @ A, weighted.T @ r
    if prior is not None:
        H[:3, :3] += np.eye(3) / prior.sigma_rad**2
        b[:3] += so3_log(prior.R_key_cam.T @ R) / prior.sigma_rad**2
    if not np.linalg.cond(H[:5, :5]) < _MOST_ALIKE:
        return 0.0, 0.0
    carried = np.linalg.solve(H[:5, :5], H[:5, 5])
    information = float(H[5, 5] - carried @ H[:5, 5])
    if not information > 0.0:
        return 0.0, 0.0
    return -float(b[5] - carried @ b[:5]) / information, information / max(1.0, view.variance)


def epipolar_distances(T_key_cam: Array, key_xy: Array, xy: Array) -> Array:
    """Return how far points [N] seen at `xy` [N, 2] are from the epipolar lines of `key_xy` [N, 2], on z = 1.

    NaN where a point was not found, and everywhere if T_key_cam [4, 4] has no translation.
    """
    t = np.ascontiguousarray(T_key_cam[:3, 3])
    length = float(np.linalg.norm(t))
    if length == 0.0:
        return np.full(len(xy), np.nan)
    R, t = np.ascontiguousarray(T_key_cam[:3, :3]), t / length
    return np.asarray(_linearise(R, t, tangent_basis(t), np.ascontiguousarray(key_xy), xy, 1.0)[0])


def essential_ransac(
    R_guess: Array | None, key_xy: Array, xy: Array, threshold: float, min_inliers: int, search: Any = None
) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """Find rotation and direction by the five-point algorithm in RANSAC (Nister, PAMI 2004).

    Args:
        R_guess: the rotation as far as it is known [3, 3]. An essential matrix leaves two rotations half a turn apart;
            the one nearer to the guess is taken, which is safe where depths are too uncertain to decide, and the sign
            of the direction is left to `refine_two_view`. None: points in front of both cameras decide.
        key_xy: directions [N, 2] on z = 1 in the keyframe.
        xy: the same points in the camera [N, 2]; NaN rows are ignored.
        threshold: of an inlier, on z = 1.
        min_inliers: fewer are no motion.
        search: how RANSAC searches, see `usac`; by default OpenCV's plain one with at most 500 tries.

    Returns:
        R_key_cam [3, 3], a unit direction [3] in key axes and the inliers [N], or None.
    """
    usable = np.isfinite(xy).all(axis=1)
    if usable.sum() < max(min_inliers, 6):
        return None
    a, b = np.ascontiguousarray(key_xy[usable]), np.ascontiguousarray(xy[usable])
    try:
        E, mask = _essential(a, b, threshold, search)
        if E is None or E.shape != (3, 3) or mask is None:
            return None
        if R_guess is None:
            _, R_cam_key, t_cam_key, mask = cv2.recoverPose(E, a, b, np.eye(3), mask=mask)
            towards = -t_cam_key[:, 0]
        else:
            first, second, t_cam_key = cv2.decomposeEssentialMat(E)
            R_cam_key = first if np.trace(first @ R_guess) >= np.trace(second @ R_guess) else second
            towards = t_cam_key[:, 0]
    except cv2.error:  # degenerate samples only
        return None
    inliers = np.zeros(len(xy), dtype=np.bool_)
    inliers[usable] = mask.ravel() > 0
    if inliers.sum() < min_inliers:
        return None
    R = np.ascontiguousarray(R_cam_key.T)
    return R, R @ towards, inliers


def _essential(a: Array, b: Array, threshold: float, search: Any) -> tuple[Array | None, Array | None]:
    if search is None:
        return cv2.findEssentialMat(
            a, b, np.eye(3), method=cv2.RANSAC, prob=_CONFIDENCE, threshold=threshold, maxIters=_MAX_TRIES
        )
    return cv2.findEssentialMat(a, b, np.eye(3), np.eye(3), np.zeros(4), np.zeros(4), search)


def direction_given_rotation(R_key_cam: Array, key_xy: Array, xy: Array) -> Array | None:
    """Return the unit direction [3] that best meets the epipolar constraint at a known rotation, or None.

    Points [N, 2] are on z = 1, NaN rows are ignored. The constraint is linear in the direction. A gross outlier moves
    much further than the others and would decide alone: lengths are cut, and misfits count linearly (reweighted least
    squares).
    """
    usable = np.isfinite(xy).all(axis=1)
    if usable.sum() < 2:
        return None
    ax, ay = key_xy[usable].T
    bx, by_, bz = (np.column_stack([xy[usable], np.ones(len(ax))]) @ R_key_cam.T).T
    normals = np.column_stack([ay * bz - by_, bx - ax * bz, ax * by_ - ay * bx])
    length = np.linalg.norm(normals, axis=1)
    usual = median(length)
    if usual > 0.0:
        normals *= np.minimum(1.0, _LONGEST * usual / np.maximum(length, usual))[:, None]
    direction = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    for _ in range(_REWEIGHTED):
        misfit = np.abs(normals @ direction)
        weight = 1.0 / np.maximum(misfit, max(median(misfit), 1e-12))
        direction = np.linalg.eigh((normals * weight[:, None]).T @ normals)[1][:, 0]
    return np.asarray(direction)


@njit(cache=True, nogil=True)
def _linearise(R: Array, t: Array, basis: Array, key_xy: Array, xy: Array, sigma: float) -> tuple[Array, Array]:
    """Return whitened distances [N] from the epipolar lines and Jacobians [N, 5] by rotation and direction.

    The residual is `x_key . (t x R x_cam)` over the length of the line's normal in the camera's image. The normal's own
    change is left out: it is multiplied by the residual, which vanishes at the solution.
    """
    r, J = np.full(len(xy), np.nan), np.zeros((len(xy), 5))
    rows, towards = in_a_row(R), (t[0], t[1], t[2])
    first, second = (basis[0, 0], basis[1, 0], basis[2, 0]), (basis[0, 1], basis[1, 1], basis[2, 1])
    for i in range(len(xy)):
        if not np.isfinite(xy[i, 0]):
            continue
        x_key, x_cam = (key_xy[i, 0], key_xy[i, 1], 1.0), (xy[i, 0], xy[i, 1], 1.0)
        line = back(rows, cross(x_key, towards))
        length = sigma * np.sqrt(line[0] * line[0] + line[1] * line[1])
        if length < 1e-12:
            continue  # at the epipole every direction fits
        r[i] = dot(line, x_cam) / length
        by_turn, by_direction = cross(x_cam, line), cross(by(rows, x_cam), x_key)
        for k in range(3):
            J[i, k] = by_turn[k] / length
        J[i, 3], J[i, 4] = dot(first, by_direction) / length, dot(second, by_direction) / length
    return r, J


@njit(cache=True, nogil=True)
def _bounded(J: Array, seen: NDArray[np.bool_]) -> Array:
    """Return weights [N] that bound what one track may say about the direction (Mallows; Hampel et al. 1986).

    A wrong match over half the image that lies near some epipolar line by chance has more leverage than all the true
    ones with their few pixels of parallax, and would draw the direction to itself.
    """
    reach = np.sqrt(J[:, 3] ** 2 + J[:, 4] ** 2)
    longest = _LONGEST * np.median(reach[seen])
    weights = np.ones(len(J))
    for i in range(len(J)):
        if reach[i] > longest > 0.0:
            weights[i] = (longest / reach[i]) ** 2
    return weights


@njit(cache=True, nogil=True)
def _refine(
    R_start: Array,
    t_start: Array,
    key_xy: Array,
    xy: Array,
    sigma: float,
    cauchy: float,
    R_prior: Array,
    prior_weight: float,
) -> tuple[Array, Array, Array, Array, Array, float, bool]:
    R, t = R_start.copy(), t_start.copy()
    H, basis, variance, size = np.zeros((5, 5)), tangent_basis(t), np.nan, np.inf
    chi2 = np.full(len(xy), np.nan)
    for iteration in range(_MAX_ITERATIONS + 1):
        basis = tangent_basis(t)
        r, J = _linearise(R, t, basis, key_xy, xy, sigma)
        chi2 = r * r
        seen = np.isfinite(chi2)
        if np.sum(seen) < 5:
            return R, t, H, basis, chi2, variance, False
        # the kernel starts as wide as the residuals are and closes with them
        last = iteration == _MAX_ITERATIONS or size < _CONVERGED
        scale = cauchy if last else max(cauchy, 1.5 * np.sqrt(np.median(chi2[seen])))
        leverage = _bounded(J, seen)
        H, b = np.zeros((5, 5)), np.zeros(5)
        weighted, weights = 0.0, 0.0
        for i in range(len(r)):
            if not seen[i]:
                continue
            w = leverage[i] / (1.0 + chi2[i] / (scale * scale))
            for a in range(5):
                weighted_row = w * J[i, a]
                b[a] += weighted_row * r[i]
                for c in range(a + 1):
                    H[a, c] += weighted_row * J[i, c]
            weighted += w * chi2[i]
            weights += w
        for a in range(5):
            for c in range(a):
                H[c, a] = H[a, c]
        b[:3] += prior_weight * so3_log(R_prior.T @ R)
        for a in range(3):
            H[a, a] += prior_weight
        variance = weighted / weights
        if not np.all(np.isfinite(H)):
            return R, t, H, basis, chi2, variance, False
        values, axes = np.linalg.eigh(H)
        if not values[0] > 1e-12 * values[4]:
            return R, t, H, basis, chi2, variance, False
        if last:
            break
        step = -axes @ ((axes.T @ b) / values)
        R = R @ so3_exp(step[:3].copy())
        t = t + basis @ step[3:].copy()
        t /= np.sqrt(np.sum(t * t))
        size = np.sqrt(np.sum(step * step))
    return R, t, H, basis, chi2, variance, size < _SETTLED


@njit(cache=True, nogil=True)
def _in_front(R: Array, t: Array, key_xy: Array, xy: Array, used: NDArray[np.bool_]) -> tuple[int, int]:
    """Return how many points have positive depth in both cameras, and how many would have it with -t."""
    ahead = behind = 0
    rows, towards = in_a_row(R), (t[0], t[1], t[2])
    for i in np.flatnonzero(used):
        a, b = (key_xy[i, 0], key_xy[i, 1], 1.0), by(rows, (xy[i, 0], xy[i, 1], 1.0))
        normal = cross(a, b)
        in_key, in_cam = dot(cross(towards, b), normal), dot(cross(towards, a), normal)
        ahead += in_key > 0.0 and in_cam > 0.0
        behind += in_key < 0.0 and in_cam < 0.0
    return ahead, behind


def from_epipolar_segment(T_key_cam: Array, key_xy: Array, xy: Array, max_rho: float) -> Array:
    """Return how far points [N] of the keyframe lie from where a motion can put what is now seen at `xy`.

    Args:
        T_key_cam: motion [4, 4] of the camera since the keyframe, in metres.
        key_xy: directions [N, 2] on z = 1 in the keyframe.
        xy: directions [N, 2] now; NaN where not seen, and so is the answer.
        max_rho: inverse depth in 1/m of the nearest point that there can be.
    """
    turned = np.column_stack([xy, np.ones(len(xy))]) @ T_key_cam[:3, :3].T
    at_infinity = turned[:, :2] / turned[:, 2:]
    reach = max_rho * (T_key_cam[:2, 3] - T_key_cam[2, 3] * at_infinity)
    gap = key_xy - at_infinity
    length = np.maximum(np.sum(reach * reach, axis=1), np.finfo(float).tiny)
    share = np.clip(np.sum(gap * reach, axis=1) / length, 0.0, 1.0)
    return np.asarray(np.linalg.norm(gap - share[:, None] * reach, axis=1))
