"""Whether what the newest keyframe saw is what the window expected of it, asked before it is used.

The chi-square test of a filter (Mourikis and Roumeliotis, ICRA 2007) with the window's own prediction: after the fact
it is too late, for a crowd of tracks that agree with each other moves the solution and passes every test around it.
"""

from __future__ import annotations

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.window.equations import (
    CALIBRATED,
    CALIBRATION,
    COLUMNS,
    ERROR,
    POINT,
    SEEN,
    VIEWED,
    Camera,
    Hosted,
    Links,
    Measured,
    Mount,
    Normal,
    Optics,
    Place,
    States,
    Views,
    hosted,
    hosting,
    inertial,
    invert,
    linearised,
    measured,
    mounted,
    optics,
    place,
    residual,
    shift,
    sight,
    through,
)

_MAX_RHO = 20.0  # 1/m: nothing is seen nearer than 5 cm
_DEPTH_STEPS = 4
_DEPTH_IS_TAKEN = 1e12  # m^2, information on an inverse depth that is fixed


def predicted_covariance(known: Array, X: Array, calibration: Array, links: Links, gravity_m_s2: float) -> Array | None:
    """Return the covariance [6 M + 16, 6 M + 16] of all poses and the calibration, the last pose being a prediction.

    Args:
        known: [9 + 6 (M - 1) + 16] before the last keyframe: velocity and biases of the one before it, poses,
            calibration.
        X: states [M, 21].
        calibration: [16].
        links: [M - 1] of which the last one predicts.
        gravity_m_s2: of the link.

    Returns:
        None where the link constrains the motion too weakly.
    """
    last = Links(*(a[-2:] if name == "rest_weight" else a[-1:] for name, a in links._asdict().items()))
    size = 30 + CALIBRATION
    A, where = np.zeros((size, size)), np.arange(30).reshape(2, 15)
    states = States(X[-2:], X[-2:], np.zeros(2, dtype=np.bool_))
    inertial.linearise(states, calibration, last, gravity_m_s2, where, 1, 0, Normal(A, np.zeros(size)))
    A = A + np.triu(A, 1).T
    try:
        noise = np.linalg.inv(A[15:30, 15:30])
    except np.linalg.LinAlgError:
        return None
    forward = -(noise @ np.hstack([A[15:30, :15], A[15:30, 30:]]))[:6]  # of the new pose by last state and calibration
    poses = len(known) - 9 - CALIBRATION
    state = np.concatenate([9 + poses - 6 + np.arange(6), np.arange(9), 9 + poses + np.arange(CALIBRATION)])
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
        calibration: [16].
        views: of landmarks that an older keyframe hosts.
        camera: geometry and timing.
        covariance: [6 M + 16, 6 M + 16] of poses and calibration.
        squares: [N] gets the squared innovations, chi-square with two degrees of freedom; infinite behind the camera,
            NaN for older views.
    """
    mount, J = mounted(camera, calibration), np.zeros((3, COLUMNS))
    newest, width = len(X) - 1, 6 * len(X) + CALIBRATION
    own_block, inverse, cross = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, width))
    scratch = np.empty((2, 2, width))
    first, hosts, keyframes, cameras, values = views
    cams, rates, offsets_s = optics(camera, calibration), camera.rate, camera.applied_offset_s
    huber_k, deep = camera.huber_k, len(camera.huber_k) - 1
    squares[:] = np.nan
    for p in range(len(points)):
        host, rho, row = hosts[p], points[p, 2], values[first[p], 5]
        own_block[:], cross[:] = 0.0, 0.0
        own_block[2, 2] = camera.rho_information
        at_host = place(X, host, rates, shift(offsets_s, calibration, host, row))
        landmark = hosted(at_host, mount, hosting(cams, cameras[first[p]]), row, points[p, 0], points[p, 1], rho)
        for n in range(first[p], first[p + 1]):  # in order of time: the newest ones come last
            k, view, cam = keyframes[n], measured(values, n), through(cams, cameras[n])
            at = at_host if k == host else place(X, k, rates, shift(offsets_s, calibration, k, view.row))
            if k != newest:
                seen = sight(landmark, at, mount, cam)
                ahead, error = residual(seen.in_cam, rho, view, cam)
                if ahead:
                    linearised(landmark, seen, view, k == host, error, (huber_k[cameras[n]], huber_k[deep]), J)
                    _add_older(J, view.depth_weight > 0.0, host, k, len(X), own_block, cross)
                continue
            squares[n] = np.inf
            if not invert(own_block, 0.0, inverse):
                continue
            rho_information = 1.0 / inverse[2, 2]
            best = _best_depth(landmark, rho_information, mount, at, cam, view, J)
            if not np.isfinite(best):
                continue
            squares[n] = _square(J, host, k, len(X), own_block, cross, covariance, scratch)
            squares[n] += rho_information * (best - rho) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _square(
    J: Array, host: int, seen: int, count: int, own_block: Array, cross: Array, covariance: Array, scratch: Array
) -> float:
    """Return the squared error of a view whose derivative is J, by the spread that bearing and poses leave it."""
    H, spread = scratch[0], scratch[1]
    known, inverse = own_block.copy(), np.empty((3, 3))
    known[2, 2] += _DEPTH_IS_TAKEN
    if not invert(known, 0.0, inverse):
        return np.inf
    S, by_point = np.eye(2), np.zeros((2, 3))
    for k in range(2):
        for i in range(3):
            for j in range(3):
                by_point[k, i] += J[k, POINT + j] * inverse[j, i]
        a, b, c = by_point[k, 0], by_point[k, 1], by_point[k, 2]
        for j in range(H.shape[1]):
            H[k, j] = -(a * cross[0, j] + b * cross[1, j] + c * cross[2, j])
        _scatter(J, k, host, seen, count, 1.0, H[k])
    for a in range(2):
        for b in range(2):
            for i in range(3):
                S[a, b] += by_point[a, i] * J[b, POINT + i]
    _add_spread(H, covariance, spread, S)
    e0, e1 = J[0, ERROR], J[1, ERROR]
    det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    return (e0 * e0 * S[1, 1] - 2.0 * e0 * e1 * S[0, 1] + e1 * e1 * S[0, 0]) / det


@njit(cache=True, nogil=True, error_model="numpy")
def _best_depth(
    landmark: Hosted, rho_information: float, mount: Mount, at: Place, cam: Optics, view: Measured, J: Array,
) -> float:  # fmt: skip
    """Return the inverse depth that explains a view best, and J of it; NaN if none is in front of the camera."""
    rho = min(max(landmark.rho, 0.0), _MAX_RHO)
    for step in range(_DEPTH_STEPS + 1):
        trial = hosted(landmark.place, mount, landmark.cam, landmark.row, landmark.bearing[0], landmark.bearing[1], rho)
        seen = sight(trial, at, mount, cam)
        ahead, error = residual(seen.in_cam, rho, view, cam)
        if not ahead:
            return np.nan
        linearised(trial, seen, view, False, error, (np.inf, np.inf), J)
        if step < _DEPTH_STEPS:
            slope = J[0, POINT + 2] * error[0] + J[1, POINT + 2] * error[1] + rho_information * (rho - landmark.rho)
            curvature = J[0, POINT + 2] * J[0, POINT + 2] + J[1, POINT + 2] * J[1, POINT + 2] + rho_information
            rho = min(max(rho - slope / curvature, 0.0), _MAX_RHO)
    return rho


@njit(cache=True, nogil=True, error_model="numpy")
def _add_older(J: Array, deep: bool, host: int, seen: int, count: int, own_block: Array, cross: Array) -> None:
    """Add an older view to what is known of a landmark [3, 3] and how that depends on poses [3, 6 M + 16]."""
    for k in range(3 if deep else 2):
        for i in range(3):
            for j in range(3):
                own_block[i, j] += J[k, POINT + i] * J[k, POINT + j]
            _scatter(J, k, host, seen, count, J[k, POINT + i], cross[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(J: Array, k: int, host: int, seen: int, count: int, factor: float, out: Array) -> None:
    """Add row k of a derivative, times a factor, where its poses and the calibration lie."""
    for i in range(6):
        out[6 * host + i] += factor * J[k, i]
        out[6 * seen + i] += factor * J[k, SEEN + i]
    for i in range(VIEWED):
        out[6 * count + i] += factor * J[k, CALIBRATED + i]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_spread(H: Array, covariance: Array, spread: Array, S: Array) -> None:
    """Add H @ covariance @ H.T to S [2, 2], passing over columns of zeros; `spread` [2, D] is room for half of it."""
    width = H.shape[1]
    spread[:] = 0.0
    for i in range(width):
        a, b, row = H[0, i], H[1, i], covariance[i]
        if a == 0.0 and b == 0.0:
            continue
        for j in range(width):
            spread[0, j] += a * row[j]
            spread[1, j] += b * row[j]
    for j in range(width):
        S[0, 0] += H[0, j] * spread[0, j]
        S[0, 1] += H[0, j] * spread[1, j]
        S[1, 0] += H[1, j] * spread[0, j]
        S[1, 1] += H[1, j] * spread[1, j]
