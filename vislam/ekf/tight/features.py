"""Compiled arithmetic of tracks: where a point is, what its pixels say about the poses they were seen from.

One observation is a row [12]: direction x, y on z = 1 and pixel from the principal point; the same four numbers for the
right camera; inverse depth in 1/m; seconds after the frame's time at which its row was read; its standard deviations
over those given; the camera that sees. NaN where not measured: only cam0 has a right camera and depth. Predictions go
through the lens: derivatives at the pixel that was measured would have its noise in common with the residual, and the
focal length would drift by it.
Residuals are whitened: left pixels; right minus left pixels (matching left to right is better than following a corner
over time, and both share the error of the corner); inverse depth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import skew, so3_exp
from vislam.core.jit import njit
from vislam.core.lens import Lenses, imaged, lens_at
from vislam.core.messages import Array
from vislam.core.small import by, in_a_row, minus, plus, times, turned

COLUMNS = 12
CALIBRATION = 5  # errors that all observations share: rotation of the camera (3), focal length, metres
ROWS_MAX = 5  # of one observation
_STEPS = 10
_CONVERGED = 1e-4  # of the cost
_FAR_RHO = 1e-3  # 1/m: no parallax distinguishes such points from infinity
_NEAR_RHO = 20.0  # 1/m
_KERNEL = 3.0  # Cauchy, in standard deviations, while the point is found

USED, FEW, PARALLAX, RANGE, OUTLIER, GATED = 0, 1, 2, 3, 4, 5


class Sensor(NamedTuple):
    """What the cameras measure with."""

    lenses: Lenses  # the right camera is the second
    sigmas: Array  # [3] pixels, disparity in pixels, inverse depth in 1/m
    R_cams_cam0: Array  # [C, 3, 3] rotation from cam0 into each camera
    t_cams_cam0: Array  # [C, 3] origin of cam0 in each
    focal: float = 1.0  # times what was given, as `metres`: the baseline or the unit of depth
    metres: float = 1.0
    spread: float = 1.0  # of whitened rows as they turn out, at most 1: outliers are judged by it


class Views(NamedTuple):
    """Observations, and where each was made from."""

    at: NDArray[np.int64]  # [M] clone
    seen: Array  # [M, 12] rows as above
    R_cam: Array  # [M, 3, 3] R_cam_world of the camera that sees
    centres: Array  # [M, 3] of the same


class Prior(NamedTuple):
    """What is known before a frame of the part of the state that tracks hang on."""

    P: Array  # [n, n]
    change: Array  # [n] since then; residuals are brought back to it


class Bounds(NamedTuple):
    """Which tracks are of use."""

    min_rho: float  # 1/m
    max_rho: float  # 1/m
    max_ratio: float  # sigma of inverse depth over it
    outlier_sigmas: float
    min_views: float


class Tracks(NamedTuple):
    """What became of tracks, F of them."""

    status: NDArray[np.int64]  # [F]
    points: Array  # [F, 3] m
    tests: Array  # [F, 4] NIS by the spread, degrees of freedom, relative sigma of inverse depth, NIS as whitened
    fixing: Array  # [F, 3, 5 + 6 C + 1] the rows that fix each point, as in `linearise`
    H_points: Array  # [F, 3, 3] and by the point
    rows: Array  # [m, 5 + 6 C + 1] the projected rows of all used tracks, stacked


@njit(cache=True, nogil=True)
def observe(y: Array, seen: Array, sensor: Sensor, r: Array, J: Array, by_lens: Array) -> int:
    """Write the whitened residuals r [5] of a point y [3] in the camera that sees, and derivatives of predictions.

    By y J [5, 3], by focal length and metres `by_lens` [5, 2]. Returns how many rows; 0: the point is not in front of
    the camera.
    """
    if not y[2] > 1e-6:
        return 0
    lenses, sigmas, R_cams_cam0, t_cams_cam0, focal, metres, _ = sensor
    pixel, disparity, depth = sigmas[0] * seen[10], sigmas[1] * seen[10], sigmas[2] * seen[10]
    z = 1.0 / y[2]
    u, v, ux, uy, vx, vy = imaged(y[0] * z, y[1] * z, lens_at(lenses, int(seen[11])))
    if not np.isfinite(u):
        return 0
    for i in range(2):
        at, a, b = (u, focal * ux, focal * uy) if i == 0 else (v, focal * vx, focal * vy)
        r[i] = seen[2 + i] - focal * at
        by_lens[i, 0], by_lens[i, 1] = at, 0.0
        J[i, 0], J[i, 1], J[i, 2] = a * z, b * z, -(a * y[0] + b * y[1]) * z * z
    rows = 2
    if np.isfinite(seen[4]):
        R1, t1 = R_cams_cam0[1], metres * t_cams_cam0[1]
        y10 = R1[0, 0] * y[0] + R1[0, 1] * y[1] + R1[0, 2] * y[2] + t1[0]
        y11 = R1[1, 0] * y[0] + R1[1, 1] * y[1] + R1[1, 2] * y[2] + t1[1]
        y12 = R1[2, 0] * y[0] + R1[2, 1] * y[1] + R1[2, 2] * y[2] + t1[2]
        if not y12 > 1e-6:
            return 0
        z1 = 1.0 / y12
        u, v, ux, uy, vx, vy = imaged(y10 * z1, y11 * z1, lens_at(lenses, 1))
        if not np.isfinite(u):
            return 0
        for i in range(2):
            at, a, b = (u, focal * ux, focal * uy) if i == 0 else (v, focal * vx, focal * vy)
            r[rows] = (seen[6 + i] - focal * at - r[i]) / disparity
            by_lens[rows, 0] = (at - by_lens[i, 0]) / disparity
            d0, d1, d2 = a * z1, b * z1, -(a * y10 + b * y11) * z1 * z1
            by_lens[rows, 1] = (d0 * t1[0] + d1 * t1[1] + d2 * t1[2]) / metres / disparity
            for k in range(3):
                J[rows, k] = (d0 * R1[0, k] + d1 * R1[1, k] + d2 * R1[2, k] - J[i, k]) / disparity
            rows += 1
    if np.isfinite(seen[8]):
        r[rows] = (seen[8] - metres * z) / depth
        J[rows, 0], J[rows, 1], J[rows, 2] = 0.0, 0.0, -metres * z * z / depth
        by_lens[rows, 0], by_lens[rows, 1] = 0.0, z / depth
        rows += 1
    for i in range(2):
        r[i] /= pixel
        by_lens[i, 0] /= pixel
        for k in range(3):
            J[i, k] /= pixel
    return rows


@njit(cache=True, nogil=True)
def camera_poses(
    at: NDArray[np.int64],
    seen: Array,
    R: Array,
    p: Array,
    rate: Array,
    velocity: Array,
    T_body_cam: tuple[Array, Array],
    sensor: Sensor,
) -> tuple[Array, Array]:
    """Return R_cam_world [M, 3, 3] and camera centres [M, 3] of observations [M, 12] made from the clones `at` [M].

    The body has cam0 at T_body_cam, rotation [3, 3] and place [3], and the other cameras sit on that one. Clones: R
    [C, 3, 3], p [C, 3], body rate [C, 3], world velocity [C, 3]; the last two carry the pose to the time at which a
    rolling shutter read the row.
    """
    R_body_cam, p_body_cam = T_body_cam
    out_R = np.empty((len(at), 3, 3))
    out_c = np.empty((len(at), 3))
    for m in range(len(at)):
        i = at[m]
        R_world_body, centre = R[i].copy(), p[i].copy()
        if seen[m, 9] != 0.0:
            R_world_body = R_world_body @ so3_exp(rate[i] * seen[m, 9])
            centre = centre + velocity[i] * seen[m, 9]
        camera = int(seen[m, 11])
        out_c[m] = centre + R_world_body @ p_body_cam
        out_R[m] = (R_world_body @ R_body_cam).T
        if camera > 0:
            R_cam_world = sensor.R_cams_cam0[camera] @ out_R[m]
            out_c[m] -= R_cam_world.T @ sensor.t_cams_cam0[camera]
            out_R[m] = R_cam_world
    return out_R, out_c


@njit(cache=True, nogil=True)
def triangulate(views: Views, sensor: Sensor) -> tuple[Array, float, float]:
    """Return a point [3] in the world, its inverse depth in the first view and that one's sigma (1/m).

    A linear start, then Levenberg-Marquardt on direction and inverse depth (Montiel et al., RSS 2006) with a Cauchy
    kernel, since one bad pixel must not decide where a point is.
    """
    seen = views.seen
    R_a = np.ascontiguousarray(views.R_cam[0].T)
    state = np.array([seen[0, 0], seen[0, 1], _first_rho(views, sensor)])
    r = np.empty(ROWS_MAX)
    J = np.empty((ROWS_MAX, 3))
    damping = 1e-3
    cost, A, g = _normal(state, views, R_a, sensor, r, J)
    for _ in range(_STEPS):
        damped = A.copy()
        for k in range(3):
            damped[k, k] += damping * A[k, k] + 1e-12
        trial = state + np.linalg.solve(damped, g)
        trial[2] = min(max(trial[2], _FAR_RHO), _NEAR_RHO)
        new_cost, new_A, new_g = _normal(trial, views, R_a, sensor, r, J)
        if new_cost < cost:
            done = cost - new_cost < _CONVERGED * (cost + 1e-3)
            state, cost, A, g = trial, new_cost, new_A, new_g
            damping *= 0.1
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    point = views.centres[0] + R_a @ np.array([state[0], state[1], 1.0]) / state[2]
    for k in range(3):
        A[k, k] += 1e-12
    variance = np.linalg.inv(A)[2, 2]
    return point, state[2], np.sqrt(max(variance, 0.0))


@njit(cache=True, nogil=True)
def _first_rho(views: Views, sensor: Sensor) -> float:
    """Return an inverse depth in the first view: as measured, or where the rays meet best on the first one."""
    _, seen, R_cam, centres = views
    total, weight = 0.0, 0.0
    base = np.array([seen[0, 0], seen[0, 1], 1.0])
    ray = R_cam[0].T @ base
    for m in range(len(seen)):
        if m == 0 and np.isfinite(seen[m, 8]):
            return min(max(seen[m, 8], _FAR_RHO), _NEAR_RHO)
        # (direction seen) x (rho (c0 - c) + ray) = 0 in camera m is linear in rho
        a, b = R_cam[m] @ ray, R_cam[m] @ (centres[0] - centres[m])
        d = np.array([seen[m, 0], seen[m, 1], 1.0])
        u, w = np.cross(d, a), np.cross(d, b)
        total -= float(u @ w)
        weight += float(w @ w)
        if np.isfinite(seen[m, 4]):
            d = np.array([seen[m, 4], seen[m, 5], 1.0])
            R1, t1 = sensor.R_cams_cam0[1], sensor.t_cams_cam0[1]
            u, w = np.cross(d, R1 @ a), np.cross(d, R1 @ b + t1)
            total -= float(u @ w)
            weight += float(w @ w)
    rho = total / weight if weight > 1e-12 else 0.2
    return min(max(rho, 0.02), _NEAR_RHO)


@njit(cache=True, nogil=True)
def _normal(state: Array, views: Views, R_a: Array, sensor: Sensor, r: Array, J: Array) -> tuple[float, Array, Array]:
    _, seen, R_cam, centres = views
    A = np.zeros((3, 3))
    g = np.zeros(3)
    cost = 0.0
    away = 1.0 / state[2]
    y, G, JG, by_lens = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((ROWS_MAX, 2))
    rows_a, first = in_a_row(R_a), (centres[0, 0], centres[0, 1], centres[0, 2])
    offset = times(away, by(rows_a, (state[0], state[1], 1.0)))
    for m in range(len(seen)):
        R = in_a_row(R_cam[m])
        y[0], y[1], y[2] = by(R, minus(plus(offset, first), (centres[m, 0], centres[m, 1], centres[m, 2])))
        rows = observe(y, seen[m], sensor, r, J, by_lens)
        if rows == 0:
            cost += 100.0
            continue
        by_ray, along = turned(R, rows_a), by(R, offset)
        for i in range(3):
            G[i, 0], G[i, 1], G[i, 2] = by_ray[3 * i] * away, by_ray[3 * i + 1] * away, -along[i] * away
        squared = 0.0
        for i in range(rows):
            squared += r[i] * r[i]
        scale = _KERNEL * _KERNEL
        weight = 1.0 / (1.0 + squared / scale)
        cost += scale * np.log1p(squared / scale)
        for i in range(rows):
            for k in range(3):
                JG[k] = J[i, 0] * G[0, k] + J[i, 1] * G[1, k] + J[i, 2] * G[2, k]
            for k in range(3):
                g[k] += weight * JG[k] * r[i]
                for c in range(3):
                    A[k, c] += weight * JG[k] * JG[c]
    return cost, A, g


@njit(cache=True, nogil=True)
def turned_with_cam0(J: Array, y: Array, camera: int, sensor: Sensor) -> Array:
    """Return derivatives [n, 3] by a turn of cam0 (camera side), on which all cameras sit; J [n, 3] is that by y."""
    if camera == 0:
        return J @ skew(y)
    R = sensor.R_cams_cam0[camera]
    return (J @ R) @ skew(R.T @ (y - sensor.t_cams_cam0[camera]))


@njit(cache=True, nogil=True)
def linearise(point: Array, views: Views, sensor: Sensor, clones: int) -> tuple[Array, Array, int]:
    """Return A [rows, 5 + 6 C + 1] and H_f [rows, 3] of one point, and the rows; 0: it is behind a camera.

    A holds the derivatives of the prediction by the extrinsic rotation (camera side), focal length, metres and by the
    clones (right-invariant, rotation then position each), then the residual. H_f: by the point, in world axes.
    """
    at, seen, R_cam, centres = views
    width = CALIBRATION + 6 * clones + 1
    A = np.zeros((ROWS_MAX * len(at), width))
    H_f = np.zeros((ROWS_MAX * len(at), 3))
    r = np.empty(ROWS_MAX)
    J, by_lens = np.empty((ROWS_MAX, 3)), np.empty((ROWS_MAX, 2))
    S = skew(point)
    n = 0
    for m in range(len(at)):
        y = R_cam[m] @ (point - centres[m])
        rows = observe(y, seen[m], sensor, r, J, by_lens)
        if rows == 0:
            return A, H_f, 0
        by_point = J[:rows] @ R_cam[m]
        by_turn = by_point @ S
        by_mount = turned_with_cam0(J[:rows], y, int(seen[m, 11]), sensor)
        first = CALIBRATION + 6 * at[m]
        for i in range(rows):
            A[n + i, 3], A[n + i, 4] = by_lens[i, 0], by_lens[i, 1]
            for k in range(3):
                A[n + i, k] = by_mount[i, k]
                A[n + i, first + k] = by_turn[i, k]
                A[n + i, first + 3 + k] = -by_point[i, k]
                H_f[n + i, k] = by_point[i, k]
            A[n + i, width - 1] = r[i]
        n += rows
    return A[:n], H_f[:n], n


@njit(cache=True, nogil=True)
def project_out(A: Array, H_f: Array) -> None:
    """Rotate the rows of A and H_f [rows, 3] in place so that only the first three of H_f are not zero.

    Householder: the rows of A from the fourth on are its projection onto the left nullspace of H_f.
    """
    rows, width = A.shape
    v = np.empty(rows)
    for c in range(3):
        norm = 0.0
        for i in range(c, rows):
            norm += H_f[i, c] * H_f[i, c]
        norm = np.sqrt(norm)
        if norm == 0.0:
            continue
        alpha = -norm if H_f[c, c] >= 0.0 else norm
        size = 0.0
        for i in range(c, rows):
            v[i] = H_f[i, c] - (alpha if i == c else 0.0)
            size += v[i] * v[i]
        if size == 0.0:
            continue
        for j in range(c, 3):
            dot = 0.0
            for i in range(c, rows):
                dot += v[i] * H_f[i, j]
            dot *= 2.0 / size
            for i in range(c, rows):
                H_f[i, j] -= dot * v[i]
        dots = np.zeros(width)
        for i in range(c, rows):
            for j in range(width):
                dots[j] += v[i] * A[i, j]
        for i in range(c, rows):
            factor = 2.0 / size * v[i]
            for j in range(width):
                A[i, j] -= factor * dots[j]


@njit(cache=True, nogil=True)
def gate(H: Array, r: Array, P: Array, spread: float) -> tuple[float, float]:
    """Return the normalised innovation squared of rows whose noise is `spread`, and of whitened ones.

    Infinite where they cannot be computed.
    """
    S = H @ P @ H.T
    for i in range(len(r)):
        S[i, i] += spread * spread
    nis = float(r @ np.linalg.solve(S, r))
    for i in range(len(r)):
        S[i, i] += 1.0 - spread * spread
    whitened = float(r @ np.linalg.solve(S, r))
    good = np.isfinite(nis) and np.isfinite(whitened) and nis >= 0.0
    return (nis, whitened) if good else (np.inf, np.inf)


@njit(cache=True, nogil=True)
def _fitting(point: Array, views: Views, sensor: Sensor, outlier: float) -> NDArray[np.int64]:
    """Return which observations of a point are not farther from it than an outlier (in standard deviations)."""
    _, seen, R_cam, centres = views
    keep = np.zeros(len(seen), dtype=np.bool_)
    r, by_lens = np.empty(ROWS_MAX), np.empty((ROWS_MAX, 2))
    J = np.empty((ROWS_MAX, 3))
    for m in range(len(seen)):
        y = R_cam[m] @ (point - centres[m])
        rows = observe(y, seen[m], sensor, r, J, by_lens)
        keep[m] = rows > 0 and r[0] * r[0] + r[1] * r[1] < outlier * outlier
    return np.flatnonzero(keep)


@njit(cache=True, nogil=True)
def process(
    starts: NDArray[np.int64], views: Views, sensor: Sensor, prior: Prior, bounds: Bounds, limits: Array
) -> Tracks:
    """Find, linearise, project and gate every track.

    Args:
        starts: [F + 1] first observation of each track in what follows.
        views: of all tracks.
        sensor: see there.
        prior: of what observations share and of clones, n = 5 + 6 C.
        bounds: of tracks that are used.
        limits: [d] chi-square limit of d degrees of freedom.
    """
    at, seen, R_cam, centres = views
    P, change = prior
    count = len(starts) - 1
    width = len(P) + 1
    clones = (len(P) - CALIBRATION) // 6
    status = np.full(count, FEW)
    points = np.zeros((count, 3))
    tests = np.zeros((count, 4))
    fixing = np.zeros((count, 3, width))
    H_points = np.zeros((count, 3, 3))
    stack = np.empty((ROWS_MAX * len(at), width))
    n = 0
    for f in range(count):
        s, e = starts[f], starts[f + 1]
        own = Views(at[s:e], seen[s:e], R_cam[s:e], centres[s:e])
        point, rho, sigma = triangulate(own, sensor)
        chosen = s + _fitting(point, own, sensor, bounds.outlier_sigmas)
        enough = 0
        for m in chosen:
            enough += 3 if np.isfinite(seen[m, 4]) or np.isfinite(seen[m, 8]) else 1
        if len(chosen) < 2 or enough < bounds.min_views:
            continue
        tests[f, 2] = sigma / rho
        if not tests[f, 2] < bounds.max_ratio:
            status[f] = PARALLAX
            continue
        if not bounds.min_rho < rho < bounds.max_rho:
            status[f] = RANGE
            continue
        points[f] = point
        fit = Views(at[chosen], seen[chosen], R_cam[chosen], centres[chosen])
        A, H_f, rows = linearise(point, fit, sensor, clones)
        if rows < 4:
            continue
        project_out(A, H_f)
        rest = np.ascontiguousarray(A[3:, : width - 1])
        A[3:, width - 1] += rest @ change
        residual = np.ascontiguousarray(A[3:, width - 1])
        tests[f, 1] = rows - 3
        tests[f, 0], tests[f, 3] = gate(rest, residual, P, sensor.spread)
        if not tests[f, 0] <= limits[rows - 3]:
            status[f] = OUTLIER if tests[f, 3] <= limits[rows - 3] else GATED
            continue
        status[f] = USED
        fixing[f] = A[:3]
        H_points[f] = H_f[:3]
        stack[n : n + rows - 3] = A[3:]
        n += rows - 3
    return Tracks(status, points, tests, fixing, H_points, stack[:n])
