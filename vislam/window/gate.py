"""Whether what the newest keyframe saw is what the window expected of it, asked before it is used.

The chi-square test of a filter (Mourikis and Roumeliotis, ICRA 2007) with the window's own prediction: after the fact
it is too late, for a crowd of tracks that agree with each other moves the solution and passes every test around it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array
from vislam.window import inertial
from vislam.window.layout import CALIBRATION, Camera, Links, Views
from vislam.window.projection import COLUMNS, chain, derivative, place_host, residual, scratch, shift, weigh
from vislam.window.schur import invert

_MAX_RHO = 20.0  # 1/m: nothing is seen nearer than 5 cm
_DEPTH_STEPS = 4
_DEPTH_IS_TAKEN = 1e12  # m^2, information on an inverse depth that is fixed


def predicted_covariance(known: Array, X: Array, links: Links, gravity_m_s2: float) -> Array | None:
    """Return the covariance [6 M + 5, 6 M + 5] of all poses and the calibration, the last pose being a prediction.

    Args:
        known: [9 + 6 (M - 1) + 5] before the last keyframe: velocity and biases of the one before it, poses,
            calibration.
        X: states [M, 21].
        links: [M - 1] of which the last one predicts.
        gravity_m_s2: of the link.

    Returns:
        None where the link does not tell enough.
    """
    last = Links(*(a[-2:] if name == "rest_weight" else a[-1:] for name, a in links._asdict().items()))
    A, where = np.zeros((30, 30)), np.arange(30).reshape(2, 15)
    inertial.linearise(
        X[-2:], X[-2:], np.zeros(2, dtype=np.bool_), last, gravity_m_s2, where, 1, 0, A, np.zeros(30)
    )  # fmt: skip
    A = A + np.triu(A, 1).T
    try:
        noise = np.linalg.inv(A[15:, 15:])
    except np.linalg.LinAlgError:
        return None
    forward = -(noise @ A[15:, :15])[:6]  # of the new pose by the last state
    poses = len(known) - 9 - CALIBRATION
    state = np.concatenate([9 + poses - 6 + np.arange(6), np.arange(9)])
    old = np.arange(9, len(known))
    out = np.zeros((poses + 6 + CALIBRATION,) * 2)
    kept = np.concatenate([np.arange(poses), poses + 6 + np.arange(CALIBRATION)])
    new = slice(poses, poses + 6)
    out[np.ix_(kept, kept)] = known[np.ix_(old, old)]
    out[new, kept] = forward @ known[np.ix_(state, old)]
    out[kept, new] = out[new, kept].T
    out[new, new] = forward @ known[np.ix_(state, state)] @ forward.T + noise[:6, :6]
    return out if bool(np.isfinite(out).all()) else None


@njit(cache=True, nogil=True, error_model="numpy")
def innovations(
    X: Array, points: Array, calibration: Array, views: Views, camera: Camera, covariance: Array, squares: Array
) -> None:
    """Compare the pixels that the newest keyframe saw with what older views of the same landmarks predict.

    Of the depths in front of the camera the one that fits best is taken, at the price of leaving what the older views
    say of it: linearised, a depth that is hardly known would explain any motion along the epipolar line.

    Args:
        X: states [M, 21], the last one a prediction.
        points: bearing and inverse depth [L, 3] by the older views.
        calibration: [5].
        views: of landmarks that an older keyframe hosts.
        camera: geometry and timing.
        covariance: [6 M + 5, 6 M + 5] of poses and calibration.
        squares: [N] gets the squared innovations, chi-square with two degrees of freedom; infinite behind the camera,
            NaN for older views.
    """
    w, r, J = scratch(camera, calibration), np.empty(3), np.empty((3, COLUMNS))
    newest, width = len(X) - 1, 6 * len(X) + CALIBRATION
    own_block, inverse, cross = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, width))
    squares[:] = np.nan
    for p in range(len(points)):
        host, own = views.host[p], views.first[p]
        own_block[:], cross[:] = 0.0, 0.0
        own_block[2, 2] = camera.rho_information
        dt_host = shift(views, camera, calibration, own, host)
        place_host(X, host, camera, dt_host, points[p], w)
        for n in range(own, views.first[p + 1]):  # in order of time: the newest ones come last
            seen, rho = views.keyframe[n], points[p, 2]
            if seen != newest:
                dt = dt_host if seen == host else shift(views, camera, calibration, n, seen)
                chain(X, seen, camera, dt, rho, views.camera[n], w)
                if residual(w, views, n, rho, r):
                    derivative(w, views, n, own, rho, seen == host, J)
                    weigh(J, r, 3 if views.depth_weight[n] > 0.0 else 2, camera.huber_k)
                    _add_older(J, views.depth_weight[n] > 0.0, host, seen, len(X), camera.active, own_block, cross)
                continue
            squares[n] = np.inf
            if not invert(own_block, 0.0, inverse):
                continue
            rho_information = 1.0 / inverse[2, 2]
            dt = shift(views, camera, calibration, n, seen)
            rho = _best_depth(X, points[p], rho_information, camera, dt_host, dt, views, n, host, seen, own, w, r, J)
            if not np.isfinite(rho):
                continue
            squares[n] = _square(J, r, host, seen, len(X), camera.active, own_block, cross, covariance)
            squares[n] += rho_information * (rho - points[p, 2]) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _square(
    J: Array,
    r: Array,
    host: int,
    seen: int,
    count: int,
    active: Array,
    own_block: Array,
    cross: Array,
    covariance: Array,
) -> float:
    """Return the squared error of a view whose derivative is J, by the spread that bearing and poses leave it."""
    known, inverse = own_block.copy(), np.empty((3, 3))
    known[2, 2] += _DEPTH_IS_TAKEN
    if not invert(known, 0.0, inverse):
        return np.inf
    H, by_point, S = np.zeros((2, cross.shape[1])), np.zeros((2, 3)), np.eye(2)
    for k in range(2):
        _scatter(J, k, host, seen, count, active, 1.0, H[k])
        for i in range(3):
            for j in range(3):
                by_point[k, i] += J[k, 17 + j] * inverse[j, i]
            for j in range(len(H[k])):
                H[k, j] -= by_point[k, i] * cross[i, j]
    for a in range(2):
        for b in range(2):
            for i in range(3):
                S[a, b] += by_point[a, i] * J[b, 17 + i]
    _add_spread(H, covariance, S)
    det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    return (r[0] * r[0] * S[1, 1] - 2.0 * r[0] * r[1] * S[0, 1] + r[1] * r[1] * S[0, 0]) / det


@njit(cache=True, nogil=True, error_model="numpy")
def _best_depth(
    X: Array,
    point: Array,
    rho_information: float,
    camera: Camera,
    dt_host: float,
    dt: float,
    views: Views,
    n: int,
    host: int,
    seen: int,
    own: int,
    w: Array,
    r: Array,
    J: Array,
) -> float:
    """Return the inverse depth that explains view n best, and r and J of it; NaN if none is in front of the camera."""
    trial = point.copy()
    trial[2] = rho = min(max(point[2], 0.0), _MAX_RHO)
    for step in range(_DEPTH_STEPS + 1):
        place_host(X, host, camera, dt_host, trial, w)
        chain(X, seen, camera, dt, rho, views.camera[n], w)
        if not residual(w, views, n, rho, r):
            return np.nan
        derivative(w, views, n, own, rho, False, J)
        if step < _DEPTH_STEPS:
            slope = J[0, 19] * r[0] + J[1, 19] * r[1] + rho_information * (rho - point[2])
            curvature = J[0, 19] * J[0, 19] + J[1, 19] * J[1, 19] + rho_information
            trial[2] = rho = min(max(rho - slope / curvature, 0.0), _MAX_RHO)
    return rho


@njit(cache=True, nogil=True, error_model="numpy")
def _add_older(
    J: Array, deep: bool, host: int, seen: int, count: int, active: Array, own_block: Array, cross: Array
) -> None:
    """Add an older view to what is known of a landmark [3, 3] and how that depends on poses [3, 6 M + 5]."""
    for k in range(3 if deep else 2):
        for i in range(3):
            for j in range(3):
                own_block[i, j] += J[k, 17 + i] * J[k, 17 + j]
            if seen != host:
                _scatter(J, k, host, seen, count, active, J[k, 17 + i], cross[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(J: Array, k: int, host: int, seen: int, count: int, active: Array, factor: float, out: Array) -> None:
    """Add row k of a derivative, times a factor, where its poses and the calibration lie."""
    for i in range(6):
        out[6 * host + i] += factor * J[k, i]
        out[6 * seen + i] += factor * J[k, 6 + i]
    for i in range(CALIBRATION):
        if active[i]:
            out[6 * count + i] += factor * J[k, 12 + i]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_spread(H: Array, covariance: Array, S: Array) -> None:
    """Add H @ covariance @ H.T to S [2, 2], passing over columns of zeros."""
    width = H.shape[1]
    for i in range(width):
        if H[0, i] == 0.0 and H[1, i] == 0.0:
            continue
        row = covariance[i]
        first, second = 0.0, 0.0
        for j in range(width):
            first += row[j] * H[0, j]
            second += row[j] * H[1, j]
        S[0, 0] += H[0, i] * first
        S[0, 1] += H[0, i] * second
        S[1, 0] += H[1, i] * first
        S[1, 1] += H[1, i] * second
