"""Reprojection errors of landmarks hosted in keyframes, with time offset, rolling shutter and extrinsic rotation.

A landmark is a bearing [a, b, 1] and an inverse depth rho in camera 0 of its host at the time its row was read; points
at infinity are ordinary (Civera et al., "Inverse depth parametrization for monocular SLAM", TRO 2008). A camera at time
`dt` after its keyframe's stamp sits at `R @ exp(rate * dt), p + v * dt`. Derivatives of states that the marginal prior
holds are taken where it was linearised (first estimates: Huang, Mourikis and Roumeliotis, ISER 2008), so that the prior
and the views agree on what cannot be observed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.messages import Array
from vislam.window.layout import CALIBRATION, Camera, Views
from vislam.window.projection import (
    COLUMNS,
    F_CAM,
    chain,
    derivative,
    place_host,
    residual,
    robust,
    scratch,
    shift,
    weigh,
)
from vislam.window.schur import invert

_BEHIND_COST = 50.0  # of a view that the landmark lies behind; constant, so that it neither pulls nor stops a step


@njit(cache=True, nogil=True, error_model="numpy")
def cost(X: Array, points: Array, calibration: Array, views: Views, camera: Camera, squares: Array) -> float:
    """Return half the robust cost of all views; `squares` [N, 2] gets the squared errors of pixel and depth."""
    w, r = scratch(camera, calibration), np.empty(3)
    total = 0.0
    for p in range(len(points)):
        host, own = views.host[p], views.first[p]
        dt_host = shift(views, camera, calibration, own, host)
        place_host(X, host, camera, dt_host, points[p], w)
        total += camera.rho_information * points[p, 2] * points[p, 2]
        for n in range(own, views.first[p + 1]):
            seen = views.keyframe[n]
            dt = dt_host if seen == host else shift(views, camera, calibration, n, seen)
            chain(X, seen, camera, dt, points[p, 2], views.camera[n], w)
            if not residual(w, views, n, points[p, 2], r):
                total += _BEHIND_COST
                squares[n, 0], squares[n, 1] = 1e6, 0.0
                continue
            squares[n, 0], squares[n, 1] = r[0] * r[0] + r[1] * r[1], r[2] * r[2]
            total += robust(squares[n, 0], camera.huber_k)[1] + robust(squares[n, 1], camera.huber_k)[1]
    return 0.5 * total


@njit(cache=True, nogil=True, error_model="numpy")
def _where_linearised(X: Array, X_first: Array, held: Array) -> Array:
    out = X.copy()
    for k in range(len(X)):
        if held[k]:
            for i in range(X.shape[1]):
                out[k, i] = X_first[k, i]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    X: Array,
    X_first: Array,
    held: Array,
    points: Array,
    calibration: Array,
    views: Views,
    camera: Camera,
    poses_at: int,
    A: Array,
    g: Array,
    A_points: Array,
    g_points: Array,
    cross: Array,
) -> None:
    """Add the views' normal equations at X: poses and calibration into the upper triangle of A and into g [D].

    Args:
        X: states [M, 21].
        X_first: where the states are whose `held` [M] is set; their derivatives are taken there.
        held: touched by the marginal prior.
        points: bearing and inverse depth [L, 3].
        calibration: [5].
        views: observations.
        camera: geometry and timing.
        poses_at: where the poses begin among the unknowns; calibration follows them.
        A: [D, D], added to.
        g: [D], added to.
        A_points: the landmarks' own blocks [L, 3, 3], overwritten.
        g_points: their gradients [L, 3], overwritten.
        cross: landmarks by poses and calibration [L, 3, D - poses_at], overwritten.
    """
    w, r, J, waste = scratch(camera, calibration), np.empty(3), np.empty((3, COLUMNS)), np.empty(3)
    X_by = _where_linearised(X, X_first, held)
    cross[:] = 0.0
    for p in range(len(points)):
        host, own, rho = views.host[p], views.first[p], points[p, 2]
        A_points[p] = 0.0
        g_points[p] = 0.0
        A_points[p, 2, 2] = camera.rho_information
        g_points[p, 2] = camera.rho_information * rho
        dt_host = shift(views, camera, calibration, own, host)
        placed = False
        for n in range(own, views.first[p + 1]):
            seen = views.keyframe[n]
            dt = dt_host if seen == host else shift(views, camera, calibration, n, seen)
            if not placed:
                place_host(X, host, camera, dt_host, points[p], w)
                placed = True
            chain(X, seen, camera, dt, rho, views.camera[n], w)
            if not residual(w, views, n, rho, r):
                continue
            if held[host] or held[seen]:
                if held[host]:
                    place_host(X_by, host, camera, dt_host, points[p], w)
                    placed = False
                chain(X_by, seen, camera, dt, rho, views.camera[n], w)
                if not residual(w, views, n, rho, waste):
                    continue
            derivative(w, views, n, own, rho, seen == host, J)
            rows = 3 if views.depth_weight[n] > 0.0 else 2
            weigh(J, r, rows, camera.huber_k)
            for k in range(rows):
                for i in range(3):
                    g_points[p, i] += J[k, 17 + i] * r[k]
                    for j in range(3):
                        A_points[p, i, j] += J[k, 17 + i] * J[k, 17 + j]
            if seen != host:
                _accumulate(J, r, rows, host, seen, len(X), camera.active, poses_at, p, A, g, cross)


@njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(
    J: Array,
    r: Array,
    rows: int,
    host: int,
    seen: int,
    count: int,
    active: Array,
    poses_at: int,
    p: int,
    A: Array,
    g: Array,
    cross: Array,
) -> None:
    """Add one view of landmark p to the normal equations of poses and calibration."""
    blocks = (6 * host, 6 * seen, 6 * count)  # ascending, for the host is the first to see it
    for i in range(CALIBRATION):
        if not active[i]:
            for k in range(rows):
                J[k, 12 + i] = 0.0
    for a in range(3):
        for i in range(6 if a < 2 else CALIBRATION):
            column, at = 6 * a + i, blocks[a] + i
            for k in range(rows):
                value = J[k, column]
                g[poses_at + at] += value * r[k]
                for j in range(3):
                    cross[p, j, at] += J[k, 17 + j] * value
            out = A[poses_at + at]
            for b in range(a, 3):
                start = i if b == a else 0
                first = poses_at + blocks[b]
                for j in range(start, 6 if b < 2 else CALIBRATION):
                    total = J[0, column] * J[0, 6 * b + j] + J[1, column] * J[1, 6 * b + j]
                    if rows == 3:
                        total += J[2, column] * J[2, 6 * b + j]
                    out[first + j] += total


@njit(cache=True, nogil=True, error_model="numpy")
def start(
    X: Array, calibration: Array, views: Views, camera: Camera, wanted: Array, rho_start: float, points: Array
) -> None:
    """Give the `wanted` landmarks a bearing from their host's view and the inverse depth that all views suggest.

    Once through the linear equation for the inverse depth, then three Gauss-Newton steps with the poses fixed.
    """
    w = scratch(camera, calibration)
    for p in range(len(points)):
        if not wanted[p]:
            continue
        point, host, own = points[p], views.host[p], views.first[p]
        point[0], point[1] = views.xy[own, 0], views.xy[own, 1]
        dt_host = shift(views, camera, calibration, own, host)
        numerator, denominator = 1e2 * rho_start, 1e2
        for n in range(own, views.first[p + 1]):
            seen, cam = views.keyframe[n], views.camera[n]
            dt = dt_host if seen == host else shift(views, camera, calibration, n, seen)
            point[2] = 0.0
            place_host(X, host, camera, dt_host, point, w)
            chain(X, seen, camera, dt, 0.0, cam, w)
            far_x, far_y, far_z = w[F_CAM, 0], w[F_CAM, 1], w[F_CAM, 2]
            point[2] = 1.0
            place_host(X, host, camera, dt_host, point, w)
            chain(X, seen, camera, dt, 1.0, cam, w)
            by_z = w[F_CAM, 2] - far_z
            weight = views.white[n, 0, 0] ** 2
            for i in range(2):
                far = far_x if i == 0 else far_y
                a = (w[F_CAM, i] - far) - views.xy[n, i] * by_z
                numerator -= weight * a * (far - views.xy[n, i] * far_z)
                denominator += weight * a * a
            if views.depth_weight[n] > 0.0:
                a = 1.0 - views.inverse_depth[n] * by_z
                numerator += views.depth_weight[n] ** 2 * a * views.inverse_depth[n] * far_z
                denominator += views.depth_weight[n] ** 2 * a * a
        point[2] = min(max(numerator / denominator, 1e-3), 5.0)
        _refine(X, calibration, views, camera, p, point, dt_host, w)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(
    X: Array, calibration: Array, views: Views, camera: Camera, p: int, point: Array, dt_host: float, w: Array
) -> None:
    """Move landmark p [3] by three Gauss-Newton steps with the poses fixed."""
    host, own, r, J = views.host[p], views.first[p], np.empty(3), np.empty((3, COLUMNS))
    H, b, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for _ in range(3):
        for i in range(3):
            b[i] = camera.rho_information * point[i]
            for j in range(3):
                H[i, j] = camera.rho_information if i == j else 0.0
        place_host(X, host, camera, dt_host, point, w)
        for n in range(own, views.first[p + 1]):
            seen = views.keyframe[n]
            dt = dt_host if seen == host else shift(views, camera, calibration, n, seen)
            chain(X, seen, camera, dt, point[2], views.camera[n], w)
            if not residual(w, views, n, point[2], r):
                continue
            derivative(w, views, n, own, point[2], seen == host, J)
            rows = 3 if views.depth_weight[n] > 0.0 else 2
            weigh(J, r, rows, camera.huber_k)
            for k in range(rows):
                for i in range(3):
                    b[i] += J[k, 17 + i] * r[k]
                    for j in range(3):
                        H[i, j] += J[k, 17 + i] * J[k, 17 + j]
        if not invert(H, 0.0, inverse):
            break
        for i in range(3):
            point[i] -= inverse[i, 0] * b[0] + inverse[i, 1] * b[1] + inverse[i, 2] * b[2]
        point[2] = min(max(point[2], -0.1), 10.0)
