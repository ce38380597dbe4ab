"""Motion of a cart from floor points: the joint fit, and the split at the horizon of Karpov 2026.

A floor point of the keyframe is where its ray meets the plane z = -H of the level frame; after the motion (theta, x, y)
the camera sees it again. The joint fit looks for the motion, for what the tilts of both images are off and for how far
the springs lifted the camera between them, so that the points appear where they are seen. On the floor one pixel is
worth d^2 / H; in the image all pixels are worth the same, so the weights by distance come by themselves. H only scales
the answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vislam.core.geometry import so3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array, Bools

_UNKNOWNS = 8  # theta, x, y; rotations about x and y, common to both images, and of the newer one beside that; lift
_STEPS = 30
_CONVERGED = 1e-6  # rad and m
_STEEPEST = 1e-3  # sine under the horizon below which a ray does not meet the floor
_HYPOTHESES = 60
_GATE = 3.0  # standard deviations of a residual's length, of an inlier
_RANSAC_PX = 2.5
_MAX_VARIANCE = 400.0  # of residuals over what is expected: beyond, nothing was fitted
_MIN_VARIANCE = 0.5
_TRIMMED = 2.5  # robust standard deviations, of directions above the horizon


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The motion of the level frame since the keyframe, T_level_key_now = (Rz(theta), [x, y, 0])."""

    motion: Array  # [3] theta, x, y
    tilt: Array  # [4] common [2], then of the newer image beside that [2]
    lift_m: float  # of the camera since the keyframe
    covariance: Array  # [8, 8] of all, in this order
    inliers: Bools  # [N]
    variance: float  # of residuals over what was expected
    failure: str  # empty when the motion can be trusted


@njit(cache=True, nogil=True)
def floor_points(rays: Array, R_level_cam: Array, height_m: float) -> Array:
    """Return x, y [N, 2] where rays [N, 2] (on z = 1) meet the floor, NaN where they do not."""
    out = np.full((len(rays), 2), np.nan)
    for i in range(len(rays)):
        z = R_level_cam[2, 0] * rays[i, 0] + R_level_cam[2, 1] * rays[i, 1] + R_level_cam[2, 2]
        if z < -_STEEPEST:
            for k in range(2):
                r = R_level_cam[k, 0] * rays[i, 0] + R_level_cam[k, 1] * rays[i, 1] + R_level_cam[k, 2]
                out[i, k] = -height_m * r / z
    return out


@njit(cache=True, nogil=True)
def _derivative(unknown: int, c: float, s: float, q: Array, r: Array, height_m: float, out: Array) -> None:
    """Write into `out` [3] how a floor point q in the newer level frame moves with one of the unknowns.

    `c` and `s` are of theta; `r` is the point's ray in the keyframe's level frame.
    """
    out[:] = 0.0
    if unknown == 7:
        out[2] = -1.0
        return
    if unknown == 0:
        out[0], out[1] = q[1], -q[0]
        return
    if unknown < 3:
        out[0], out[1] = (-c, s) if unknown == 1 else (-s, -c)
        return
    about_x = unknown % 2 == 1
    if unknown < 5:  # the keyframe's ray turns, and with it the point on the floor
        dx, dy, dz = (0.0, -r[2], r[1]) if about_x else (r[2], 0.0, -r[0])
        scale, along = -height_m / r[2], height_m * dz / (r[2] * r[2])
        px, py = scale * dx + along * r[0], scale * dy + along * r[1]
        out[0], out[1] = c * px + s * py, -s * px + c * py
    if about_x:  # q x rotation: the newer image turns under the point
        out[1] += q[2]
        out[2] -= q[1]
    else:
        out[0] -= q[2]
        out[2] += q[0]


class _Views(NamedTuple):
    """Points of the floor in keyframe and newer image, and what is known of both."""

    rays: Array  # [N, 2] on z = 1 in the keyframe
    seen: Array  # [N, 2] on z = 1 in the newer image
    height_m: float
    sigma: float  # of `seen`
    cauchy: float  # in sigmas


@njit(cache=True, nogil=True)
def _equations(views: _Views, R_key: Array, R_now: Array, motion: Array, A: Array, g: Array, squares: Array) -> float:
    """Sum up the normal equations A [8, 8], g [8] at a motion; `squares` [N] gets the residuals in sigmas, squared.

    `motion` [4] is theta, x, y and the lift.
    """
    rays, seen, height_m, sigma, cauchy = views
    c, s = np.cos(motion[0]), np.sin(motion[0])
    A[:], g[:] = 0.0, 0.0
    J, dm, r, q, step, m = np.empty((2, _UNKNOWNS)), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    cost = 0.0
    for i in range(len(rays)):
        squares[i] = np.inf
        for k in range(3):
            r[k] = R_key[k, 0] * rays[i, 0] + R_key[k, 1] * rays[i, 1] + R_key[k, 2]
        if r[2] > -_STEEPEST:
            continue
        scale = -height_m / r[2]
        dx, dy = scale * r[0] - motion[1], scale * r[1] - motion[2]
        q[0], q[1], q[2] = c * dx + s * dy, -s * dx + c * dy, -height_m - motion[3]
        for k in range(3):
            m[k] = R_now[0, k] * q[0] + R_now[1, k] * q[1] + R_now[2, k] * q[2]
        if m[2] < 1e-3:
            continue
        u, v = m[0] / m[2], m[1] / m[2]
        ru, rv = (seen[i, 0] - u) / sigma, (seen[i, 1] - v) / sigma
        for a in range(_UNKNOWNS):
            _derivative(a, c, s, q, r, height_m, step)
            for k in range(3):
                dm[k] = R_now[0, k] * step[0] + R_now[1, k] * step[1] + R_now[2, k] * step[2]
            J[0, a] = (dm[0] - u * dm[2]) / (m[2] * sigma)
            J[1, a] = (dm[1] - v * dm[2]) / (m[2] * sigma)
        square = ru * ru + rv * rv
        squares[i] = square
        weight = 1.0 / (1.0 + square / (cauchy * cauchy))
        cost += cauchy * cauchy * np.log(1.0 + square / (cauchy * cauchy))
        for a in range(_UNKNOWNS):
            g[a] += weight * (J[0, a] * ru + J[1, a] * rv)
            for b in range(_UNKNOWNS):
                A[a, b] += weight * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
    return cost


@njit(cache=True, nogil=True)
def _turned(R: Array, x: float, y: float) -> Array:
    return so3_exp(np.array([x, y, 0.0])) @ R


@njit(cache=True, nogil=True)
def _solve(
    views: _Views, R_key: Array, R_now: Array, start: Array, prior: Array, mean: Array
) -> tuple[Array, Array, Array, bool]:
    """Minimise over the unknowns from `start` [8] by Gauss-Newton; `prior` [8, 8] is information about `mean`."""
    x, motion = start.copy(), np.empty(4)
    A, g, squares = np.empty((_UNKNOWNS, _UNKNOWNS)), np.empty(_UNKNOWNS), np.empty(len(views.rays))
    settled = False
    for _ in range(_STEPS):
        key, now = _turned(R_key, x[3], x[4]), _turned(R_now, x[3] + x[5], x[4] + x[6])
        motion[:3], motion[3] = x[:3], x[7]
        _equations(views, key, now, motion, A, g, squares)
        H = A + prior
        d = np.linalg.solve(H, g + prior @ (mean - x))
        x += d
        if np.max(np.abs(d)) < _CONVERGED:
            settled = True
            break
    key, now = _turned(R_key, x[3], x[4]), _turned(R_now, x[3] + x[5], x[4] + x[6])
    motion[:3], motion[3] = x[:3], x[7]
    _equations(views, key, now, motion, A, g, squares)
    return x, A, squares, settled


@njit(cache=True, nogil=True)
def _search(key_m: Array, now_m: Array, sigma_m: Array, theta: float, know_theta: bool, seed: int) -> Array:
    """Return the motion [3] that most floor points agree on: hypotheses from one point if theta is known, else two."""
    np.random.seed(seed)
    best, best_count = np.zeros(3), -1
    count = len(key_m)
    for _ in range(_HYPOTHESES):
        a, b = np.random.randint(count), np.random.randint(count)
        turn = theta
        if not know_theta:
            ax, ay = key_m[a, 0] - key_m[b, 0], key_m[a, 1] - key_m[b, 1]
            bx, by = now_m[a, 0] - now_m[b, 0], now_m[a, 1] - now_m[b, 1]
            if a == b or ax * ax + ay * ay < 1e-4:
                continue
            turn = np.arctan2(bx * ay - by * ax, bx * ax + by * ay)
        c, s = np.cos(turn), np.sin(turn)
        x = key_m[a, 0] - c * now_m[a, 0] + s * now_m[a, 1]
        y = key_m[a, 1] - s * now_m[a, 0] - c * now_m[a, 1]
        agree = 0
        for i in range(count):
            ex = c * now_m[i, 0] - s * now_m[i, 1] + x - key_m[i, 0]
            ey = s * now_m[i, 0] + c * now_m[i, 1] + y - key_m[i, 1]
            if ex * ex + ey * ey < sigma_m[i] * sigma_m[i]:
                agree += 1
        if agree > best_count:
            best_count = agree
            best[0], best[1], best[2] = turn, x, y
    return best


@dataclass(frozen=True, slots=True, eq=False)
class FloorPair:
    """Floor points of the keyframe and where they are seen now; rows that are not finite do not count."""

    rays: Array  # [N, 2] in the keyframe, on z = 1
    seen: Array  # [N, 2] now
    R_key: Array  # [3, 3] level frame from cam0, in the keyframe
    R_now: Array  # [3, 3] now
    height_m: float
    px: float  # a pixel on z = 1

    def usable(self, max_distance_m: float) -> Bools:
        """Return which rows [N] lie on the floor within a distance in both images."""
        key = floor_points(self.rays, self.R_key, self.height_m)
        now = floor_points(self.seen, self.R_now, self.height_m)
        with np.errstate(invalid="ignore"):
            near = (key**2).sum(axis=1) < max_distance_m**2
            return np.asarray(near & ((now**2).sum(axis=1) < (1.5 * max_distance_m) ** 2))

    def searched(self, use: Bools, yaw_rad: float | None, seed: int) -> Array:
        """Return the motion [3] that most of the chosen rows agree on."""
        key = floor_points(self.rays[use], self.R_key, self.height_m)
        now = floor_points(self.seen[use], self.R_now, self.height_m)
        sigma_m = _RANSAC_PX * self.px * ((now**2).sum(axis=1) + self.height_m**2) / self.height_m
        return np.asarray(_search(key, now, sigma_m, 0.0 if yaw_rad is None else yaw_rad, yaw_rad is not None, seed))


def joint_fit(
    pair: FloorPair, use: Bools, start: Array, sigma_px: float, cauchy: float, tilt_prior: Array, heave_m: float,
    yaw: tuple[float, float] | None = None,
) -> Fit:  # fmt: skip
    """Fit motion and tilts together.

    Args:
        pair: floor points.
        use: which of its rows [N] to use.
        start: motion [3] to start from.
        sigma_px: of where a point is seen; what the residuals show widens it.
        cauchy: scale of the robust kernel in standard deviations.
        tilt_prior: covariance [4, 4] of the common tilt error and of the newer image's beside it, both zero at best.
        heave_m: sigma of the lift.
        yaw: theta by the gyroscope and its sigma in rad; None: not used.
    """
    prior, mean = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
    prior[3:7, 3:7], prior[7, 7] = np.linalg.inv(tilt_prior), 1.0 / heave_m**2
    if yaw is not None:
        mean[0], prior[0, 0] = yaw[0], 1.0 / yaw[1] ** 2
    x = np.concatenate([start, np.zeros(_UNKNOWNS - 3)])
    rays, seen = np.ascontiguousarray(pair.rays[use]), np.ascontiguousarray(pair.seen[use])
    sigma, variance, settled = sigma_px * pair.px, 1.0, False
    A, squares = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.full(len(rays), np.inf)
    none = np.zeros(len(use), dtype=np.bool_)
    try:
        for _ in range(2):  # once more with the noise that the residuals show
            sigma *= np.sqrt(variance)
            views = _Views(rays, seen, pair.height_m, sigma, cauchy)
            x, A, squares, settled = _solve(views, pair.R_key, pair.R_now, x, prior, mean)
            variance = float(np.clip(_variance(squares), _MIN_VARIANCE, _MAX_VARIANCE))
        covariance = np.linalg.inv(A + prior)
    except np.linalg.LinAlgError:
        return no_fit(x[:3], len(use), "the floor does not determine the motion")
    inliers = none.copy()
    inliers[use] = squares < _GATE**2 * 2.0
    total = (sigma / (sigma_px * pair.px)) ** 2 * variance
    failure = "" if settled and np.isfinite(x).all() else "the motion over the floor does not converge"
    symmetric = 0.5 * (covariance + covariance.T)
    return Fit(x[:3], x[3:7], float(x[7]), symmetric, inliers, float(total), failure)


def no_fit(motion: Array, count: int, failure: str) -> Fit:
    """Return the result for `count` points that no motion could be fitted to."""
    covariance: Array = np.full((_UNKNOWNS, _UNKNOWNS), np.nan)
    return Fit(motion, np.zeros(4), 0.0, covariance, np.zeros(count, dtype=np.bool_), np.inf, failure)


def _variance(squares: Array) -> float:
    """Return the variance per axis that squared lengths [N] in sigmas show, by their median."""
    finite = squares[np.isfinite(squares)]
    return float(np.median(finite)) / (2.0 * np.log(2.0)) if len(finite) else 1.0


def split_fit(
    pair: FloorPair, use: Bools, above: Bools, sigma_px: float, tilt_prior: Array, heave_m: float, least: int, seed: int
) -> Fit:
    """Fit as Karpov 2026, section 3.3: theta from directions above the horizon, then x and y from the floor.

    `use` and `above` [N] say which rows are where. Weights by distance are not in the paper; without them far points
    spoil its answer. The covariance is that of scattered points; tilts are as calibrated, with the covariance [4, 4] of
    `joint_fit`, as is the lift.
    """
    azimuth = _azimuth(pair.rays[above], pair.R_key) - _azimuth(pair.seen[above], pair.R_now)
    azimuth = (azimuth + np.pi) % (2.0 * np.pi) - np.pi
    if len(azimuth) < least or np.count_nonzero(use) < least:
        reason = f"{len(azimuth)} points above the horizon and {np.count_nonzero(use)} on the floor, needs {least} each"
        return no_fit(np.zeros(3), len(use), reason)
    middle = float(np.median(azimuth))
    spread = max(1.4826 * float(np.median(np.abs(azimuth - middle))), 0.1 * pair.px)
    agree = np.abs(azimuth - middle) < _TRIMMED * spread
    theta, theta_variance = float(azimuth[agree].mean()), spread**2 / float(agree.sum())
    motion = pair.searched(use, theta, seed)
    key = floor_points(pair.rays[use], pair.R_key, pair.height_m)
    now = floor_points(pair.seen[use], pair.R_now, pair.height_m)
    c, s = np.cos(theta), np.sin(theta)
    moved = key - now @ np.array([[c, s], [-s, c]])
    sigma = sigma_px * pair.px * ((now**2).sum(axis=1) + pair.height_m**2) / pair.height_m
    near = np.linalg.norm(moved - motion[1:], axis=1) < np.maximum(_RANSAC_PX / sigma_px, 3.0) * sigma
    if np.count_nonzero(near) < least:
        return no_fit(motion, len(use), "the floor points do not agree")
    weight = 1.0 / sigma[near] ** 2
    xy = (weight[:, None] * moved[near]).sum(axis=0) / weight.sum()
    off = (moved[near] - xy) / sigma[near][:, None]
    variance = max(float((off**2).sum() / (2 * len(off) - 2)), _MIN_VARIANCE)
    covariance = np.zeros((_UNKNOWNS, _UNKNOWNS))
    covariance[3:7, 3:7], covariance[7, 7] = tilt_prior, heave_m**2
    covariance[0, 0] = theta_variance
    covariance[1:3, 1:3] = np.eye(2) * variance / weight.sum()
    lever = now[near].mean(axis=0)  # an error of theta turns the floor about the camera
    across = np.array([s * lever[0] + c * lever[1], -c * lever[0] + s * lever[1]])
    covariance[1:3, 1:3] += theta_variance * np.outer(across, across)
    covariance[1:3, 0] = covariance[0, 1:3] = theta_variance * across
    inliers = np.zeros(len(use), dtype=np.bool_)
    inliers[np.flatnonzero(use)[near]] = True
    return Fit(np.array([theta, xy[0], xy[1]]), np.zeros(4), 0.0, covariance, inliers, variance, "")


def _azimuth(rays: Array, R_level_cam: Array) -> Array:
    level = np.column_stack([rays, np.ones(len(rays))]) @ R_level_cam.T
    return np.asarray(np.arctan2(level[:, 1], level[:, 0]))


def camera_motion(fit: Fit, R_key: Array, R_now: Array) -> tuple[Array, Array]:
    """Return T_key_now [4, 4] of cam0 and its covariance [6, 6], rotation first, perturbed on the newer side.

    The tilts and the lift that were fitted are in both.
    """
    theta, xy, common, extra = fit.motion[0], fit.motion[1:], fit.tilt[:2], fit.tilt[2:]
    key, now = _turned(R_key, common[0], common[1]), _turned(R_now, common[0] + extra[0], common[1] + extra[1])
    yaw = np.asarray(so3_exp(np.array([0.0, 0.0, theta])))
    t = np.array([xy[0], xy[1], fit.lift_m])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = key.T @ yaw @ now, key.T @ t
    J = np.zeros((6, _UNKNOWNS))
    to_now = now.T @ yaw.T  # from the key's level frame to the newer camera
    J[:3, 0] = now.T[:, 2]
    J[3:, 1], J[3:, 2], J[3:, 7] = to_now[:, 0], to_now[:, 1], to_now[:, 2]
    for axis in range(2):
        unit = np.zeros(3)
        unit[axis] = 1.0
        J[:3, 3 + axis] = now.T @ unit - to_now @ unit
        J[3:, 3 + axis] = -to_now @ np.cross(unit, t)
        J[:3, 5 + axis] = now.T @ unit
    out = J @ fit.covariance @ J.T
    return T, 0.5 * (out + out.T)


def scale_sigma(fit: Fit, tilt_covariance: Array) -> float:
    """Return the relative sigma of the way's length that errors [2, 2] of the mean tilt cause, which last."""
    length = float(np.linalg.norm(fit.motion[1:]))
    if length < 1e-3 or not np.isfinite(fit.covariance).all():
        return 0.0
    information = np.linalg.inv(fit.covariance + 1e-18 * np.eye(_UNKNOWNS))
    free = np.array([0, 1, 2, 5, 6, 7])  # unknowns that are fitted again where the common tilt [3:5] is another one
    by_tilt = np.linalg.solve(information[np.ix_(free, free)], -information[free, 3:5])
    along = fit.motion[1:] @ by_tilt[1:3] / length**2
    return float(np.sqrt(along @ tilt_covariance @ along))
