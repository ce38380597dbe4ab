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

from vislam.geometry import so3_exp
from vislam.messages import Array
from vislam.window.layout import CALIBRATION, Camera, Views

Rig = tuple[Camera, Array]  # with the corrected rotation [3, 3] of camera 0 on the body
COLUMNS = 20  # of an error: host pose 6, pose 6, calibration 5, landmark 3
_MIN_Z = 0.02  # relative to the host's depth: nearer is beside or behind the camera
_BEHIND_COST = 50.0  # of a view that the landmark lies behind; constant, so that it neither pulls nor stops a step


@njit(cache=True, nogil=True, inline="always")
def _product(A: Array, B: Array, out: Array) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@njit(cache=True, nogil=True, inline="always")
def _apply(A: Array, v: Array, out: Array) -> None:
    for i in range(3):
        out[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]


@njit(cache=True, nogil=True, inline="always")
def _apply_transposed(A: Array, v: Array, out: Array) -> None:
    for i in range(3):
        out[i] = A[0, i] * v[0] + A[1, i] * v[1] + A[2, i] * v[2]


@njit(cache=True, nogil=True, inline="always")
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True)
def _place(x: Array, rate: Array, dt: float, pose: Array, turn: Array) -> None:
    """Fill the pose [4, 3] (rotation, then position) `dt` after a state's stamp, and the turn [3, 3] since."""
    for i in range(3):
        for j in range(3):
            pose[i, j] = x[3 * i + j]
        pose[3, i] = x[9 + i] + dt * x[12 + i]
    if dt != 0.0:
        turn[:] = so3_exp(dt * rate)
        R = x[:9].reshape(3, 3)
        _product(R, turn, pose)


# Rows of the scratch space [_ROWS, 3] in which a view is computed: poses (4 rows) and turns (3) of host and keyframe,
# the landmark in the frames that it passes, and room for rows of derivatives.
_HOST, _TURN_HOST, _SEEN, _TURN_SEEN = 0, 4, 7, 11
_F_HOST, _F_WORLD, _F_SEEN, _Q, _F_CAM, _GAP, _FREE, _ROWS = 14, 15, 16, 17, 18, 19, 20, 29


@njit(cache=True, nogil=True)
def _chain(
    X: Array, host: int, seen: int, dt_host: float, dt_seen: float, point: Array, rig: Rig, cam: int, w: Array
) -> None:
    """Carry a landmark from its host into a camera, scaled by its inverse depth; leaves every step in `w`."""
    camera, R_body_cam = rig
    _place(X[host], camera.rate[host], dt_host, w[_HOST : _HOST + 4], w[_TURN_HOST : _TURN_HOST + 3])
    _place(X[seen], camera.rate[seen], dt_seen, w[_SEEN : _SEEN + 4], w[_TURN_SEEN : _TURN_SEEN + 3])
    rho = point[2]
    free = w[_FREE]
    free[0], free[1], free[2] = point[0], point[1], 1.0
    _apply(R_body_cam, free, w[_F_HOST])
    T = camera.T_body_cam
    for i in range(3):
        w[_F_HOST, i] += rho * T[i, 3]
        w[_GAP, i] = w[_HOST + 3, i] - w[_SEEN + 3, i]
    _apply(w[_HOST : _HOST + 3], w[_F_HOST], w[_F_WORLD])
    for i in range(3):
        w[_F_WORLD, i] += rho * w[_GAP, i]
    _apply_transposed(w[_SEEN : _SEEN + 3], w[_F_WORLD], w[_F_SEEN])
    for i in range(3):
        free[i] = w[_F_SEEN, i] - rho * T[i, 3]
    _apply_transposed(R_body_cam, free, w[_Q])
    T1 = camera.T_cam0_cams[cam]
    for i in range(3):
        free[i] = w[_Q, i] - rho * T1[i, 3]
    _apply_transposed(T1, free, w[_F_CAM])


@njit(cache=True, nogil=True, inline="always")
def _residual(w: Array, views: Views, n: int, rho: float, out: Array) -> bool:
    """Whitened error [3] of view n: two of the pixel, one of inverse depth; False behind the camera."""
    z = w[_F_CAM, 2]
    if not z > _MIN_Z:
        return False
    ex = w[_F_CAM, 0] / z - views.xy[n, 0]
    ey = w[_F_CAM, 1] / z - views.xy[n, 1]
    W = views.white[n]
    out[0] = W[0, 0] * ex + W[0, 1] * ey
    out[1] = W[1, 0] * ex + W[1, 1] * ey
    out[2] = views.depth_weight[n] * (rho / z - views.inverse_depth[n])
    return True


@njit(cache=True, nogil=True, inline="always")
def _robust(s: float, k: float) -> tuple[float, float]:
    """Return Huber's weight and twice its cost for a squared error."""
    if s <= k * k:
        return 1.0, s
    root = np.sqrt(s)
    return k / root, 2.0 * k * root - k * k


@njit(cache=True, nogil=True)
def _shifts(views: Views, camera: Camera, calibration: Array, n: int, host_view: int, host: int) -> tuple[float, float]:
    """Return the times from the stamps of host and keyframe to what was read."""
    dt_host = calibration[0] - camera.applied_offset_s[host] + views.row[host_view] * calibration[4]
    seen = views.keyframe[n]
    if seen == host:
        return dt_host, dt_host
    return dt_host, calibration[0] - camera.applied_offset_s[seen] + views.row[n] * calibration[4]


@njit(cache=True, nogil=True)
def cost(X: Array, points: Array, calibration: Array, views: Views, camera: Camera, squares: Array) -> float:
    """Return half the robust cost of all views; `squares` [N, 2] gets the squared errors of pixel and depth."""
    w = np.zeros((_ROWS, 3))
    r = np.empty(3)
    rig = (camera, camera.T_body_cam[:3, :3].copy() @ so3_exp(calibration[1:4].copy()))
    total = 0.0
    for p in range(len(points)):
        host = views.host[p]
        total += camera.rho_information * points[p, 2] * points[p, 2]
        for n in range(views.first[p], views.first[p + 1]):
            dt_host, dt = _shifts(views, camera, calibration, n, views.first[p], host)
            _chain(X, host, views.keyframe[n], dt_host, dt, points[p], rig, views.camera[n], w)
            if not _residual(w, views, n, points[p, 2], r):
                total += _BEHIND_COST
                squares[n, 0], squares[n, 1] = 1e6, 0.0
                continue
            squares[n, 0], squares[n, 1] = r[0] * r[0] + r[1] * r[1], r[2] * r[2]
            total += _robust(squares[n, 0], camera.huber_k)[1] + _robust(squares[n, 1], camera.huber_k)[1]
    return 0.5 * total


@njit(cache=True, nogil=True)
def _derivative(
    w: Array, views: Views, n: int, host_view: int, rho: float, rig: Rig, X: Array, host: int, J: Array
) -> None:
    """Fill J [3, 20], the derivative of view n's whitened error, from the chain in `w`."""
    camera, R_body_cam = rig
    seen, cam = views.keyframe[n], views.camera[n]
    z = w[_F_CAM, 2]
    x, y = w[_F_CAM, 0] / z, w[_F_CAM, 1] / z
    W = views.white[n]
    T, T1 = camera.T_body_cam, camera.T_cam0_cams[cam]
    R_host, R_seen = w[_HOST : _HOST + 3], w[_SEEN : _SEEN + 3]
    lever, row = w[_FREE + 1], w[_FREE + 2]
    in_q, in_seen, in_world = w[_FREE + 3], w[_FREE + 4], w[_FREE + 5]
    in_host, in_cam, bearing = w[_FREE + 6], w[_FREE + 7], w[_FREE + 8]
    for i in range(3):
        lever[i] = w[_F_HOST, i] - rho * T[i, 3]
    _apply_transposed(R_body_cam, lever, bearing)  # [a, b, 1] again
    depth_weight = views.depth_weight[n]
    for k in range(3):
        out = J[k]
        if k == 2 and depth_weight == 0.0:
            out[:] = 0.0
            continue
        if k < 2:
            in_cam[0], in_cam[1] = W[k, 0] / z, W[k, 1] / z
            in_cam[2] = -(W[k, 0] * x + W[k, 1] * y) / z
        else:
            in_cam[0], in_cam[1], in_cam[2] = 0.0, 0.0, -depth_weight * rho / (z * z)
        # the row of the derivative by what each step of the chain produced
        _apply(T1, in_cam, in_q)
        _apply(R_body_cam, in_q, in_seen)
        _apply(R_seen, in_seen, in_world)
        _apply_transposed(R_host, in_world, in_host)
        _cross(w[_F_HOST], in_host, row)
        _apply(w[_TURN_HOST : _TURN_HOST + 3], row, out[0:3])
        _cross(in_seen, w[_F_SEEN], row)
        _apply(w[_TURN_SEEN : _TURN_SEEN + 3], row, out[6:9])
        by_time_host, by_time = 0.0, 0.0
        _cross(camera.rate[host], w[_F_HOST], row)
        for i in range(3):
            out[3 + i] = rho * in_world[i]
            out[9 + i] = -rho * in_world[i]
            by_time_host += in_host[i] * row[i] + rho * in_world[i] * X[host, 12 + i]
        _cross(camera.rate[seen], w[_F_SEEN], row)
        for i in range(3):
            by_time -= in_seen[i] * row[i] + rho * in_world[i] * X[seen, 12 + i]
        out[12] = by_time_host + by_time
        out[16] = by_time_host * views.row[host_view] + by_time * views.row[n]
        _apply_transposed(R_body_cam, in_host, row)  # by [a, b, 1]
        out[17], out[18] = row[0], row[1]
        _cross(bearing, row, out[13:16])
        _cross(in_q, w[_Q], row)
        by_rho = 0.0
        for i in range(3):
            out[13 + i] += row[i]
            by_rho += (in_host[i] - in_seen[i]) * T[i, 3] + in_world[i] * w[_GAP, i] - in_q[i] * T1[i, 3]
        out[19] = by_rho + (depth_weight / z if k == 2 else 0.0)
        for i in range(CALIBRATION):
            if not camera.active[i]:
                out[12 + i] = 0.0
        if seen == host:  # moving the body moves landmark and camera alike
            out[:17] = 0.0


@njit(cache=True, nogil=True)
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
        A: [D, D], g: [D]; added to.
        A_points: [L, 3, 3], g_points: [L, 3], cross: [L, 3, D - poses_at]; overwritten.
    """
    w = np.zeros((_ROWS, 3))
    r, J, waste = np.empty(3), np.empty((3, COLUMNS)), np.empty(3)
    rig = (camera, camera.T_body_cam[:3, :3].copy() @ so3_exp(calibration[1:4].copy()))
    calibration_at = 6 * len(X)
    X_by = X.copy()
    for k in range(len(X)):
        if held[k]:
            X_by[k] = X_first[k]
    where = np.empty(17, dtype=np.int64)
    for i in range(CALIBRATION):
        where[12 + i] = calibration_at + i
    some_calibration = camera.active.any()
    width = 17 if some_calibration else 12
    cross[:] = 0.0
    for p in range(len(points)):
        host = views.host[p]
        H, b, W = A_points[p], g_points[p], cross[p]
        H[:] = 0.0
        b[:] = 0.0
        H[2, 2] = camera.rho_information
        b[2] = camera.rho_information * points[p, 2]
        for n in range(views.first[p], views.first[p + 1]):
            seen = views.keyframe[n]
            dt_host, dt = _shifts(views, camera, calibration, n, views.first[p], host)
            _chain(X, host, seen, dt_host, dt, points[p], rig, views.camera[n], w)
            if not _residual(w, views, n, points[p, 2], r):
                continue
            if held[host] or held[seen]:
                _chain(X_by, host, seen, dt_host, dt, points[p], rig, views.camera[n], w)
                if not _residual(w, views, n, points[p, 2], waste):
                    continue
            _derivative(w, views, n, views.first[p], points[p, 2], rig, X_by, host, J)
            weight = np.sqrt(_robust(r[0] * r[0] + r[1] * r[1], camera.huber_k)[0])
            rows = 2
            for k in range(2):
                r[k] *= weight
                for i in range(COLUMNS):
                    J[k, i] *= weight
            if views.depth_weight[n] > 0.0:
                rows = 3
                weight = np.sqrt(_robust(r[2] * r[2], camera.huber_k)[0])
                r[2] *= weight
                for i in range(COLUMNS):
                    J[2, i] *= weight
            for k in range(rows):
                row = J[k]
                for i in range(3):
                    b[i] += row[17 + i] * r[k]
                    for j in range(3):
                        H[i, j] += row[17 + i] * row[17 + j]
            if seen == host:
                continue
            for i in range(6):
                where[i], where[6 + i] = 6 * host + i, 6 * seen + i
            for k in range(rows):
                row = J[k]
                for i in range(width):
                    at = where[i]
                    value = row[i]
                    g[poses_at + at] += value * r[k]
                    for j in range(3):
                        W[j, at] += row[17 + j] * value
                    out = A[poses_at + at]
                    for j in range(i, width):
                        out[poses_at + where[j]] += value * row[j]


@njit(cache=True, nogil=True)
def eliminate(
    points_at: Array, A_points: Array, g_points: Array, cross: Array, damping: float, poses_at: int, A: Array, g: Array
) -> bool:
    """Take the landmarks out of the normal equations A, g (Schur complement); False if one is indefinite.

    `points_at` [L, 3, 3] gets the inverses of the landmarks' own blocks, for `follow`.
    """
    width = cross.shape[2]
    y = np.empty((3, width))
    for p in range(len(A_points)):
        H, inverse, W = A_points[p], points_at[p], cross[p]
        a, b, c = H[0, 0] * (1.0 + damping), H[0, 1], H[0, 2]
        d, e, f = H[1, 1] * (1.0 + damping), H[1, 2], H[2, 2] * (1.0 + damping)
        inverse[0, 0], inverse[0, 1], inverse[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
        inverse[1, 1], inverse[1, 2], inverse[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
        det = a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
        if not det > 1e-14 * a * d * f:
            return False
        inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
        for i in range(3):
            for j in range(3):
                inverse[i, j] /= det
        q = g_points[p]
        for j in range(width):
            w0, w1, w2 = W[0, j], W[1, j], W[2, j]
            y[0, j] = inverse[0, 0] * w0 + inverse[0, 1] * w1 + inverse[0, 2] * w2
            y[1, j] = inverse[1, 0] * w0 + inverse[1, 1] * w1 + inverse[1, 2] * w2
            y[2, j] = inverse[2, 0] * w0 + inverse[2, 1] * w1 + inverse[2, 2] * w2
            g[poses_at + j] -= y[0, j] * q[0] + y[1, j] * q[1] + y[2, j] * q[2]
        # only the columns of keyframes that see it; they lie together, and calibration lies at the end
        end = width - CALIBRATION
        while end > 0 and W[0, end - 1] == 0.0 and W[1, end - 1] == 0.0 and W[2, end - 1] == 0.0:
            end -= 1
        for i in range(width):
            y0, y1, y2 = y[0, i], y[1, i], y[2, i]
            if y0 == 0.0 and y1 == 0.0 and y2 == 0.0:
                continue
            out = A[poses_at + i, poses_at:]
            for j in range(i, end):
                out[j] -= y0 * W[0, j] + y1 * W[1, j] + y2 * W[2, j]
            for j in range(max(i, width - CALIBRATION), width):
                out[j] -= y0 * W[0, j] + y1 * W[1, j] + y2 * W[2, j]
    return True


@njit(cache=True, nogil=True)
def follow(points: Array, points_at: Array, g_points: Array, cross: Array, step: Array, out: Array) -> None:
    """Move the landmarks [L, 3] to where the step [D - poses_at] of poses and calibration wants them, into `out`."""
    b = np.empty(3)
    for p in range(len(points)):
        for i in range(3):
            total = g_points[p, i]
            W = cross[p, i]
            for j in range(len(step)):
                total += W[j] * step[j]
            b[i] = total
        for i in range(3):
            out[p, i] = points[p, i] - (
                points_at[p, i, 0] * b[0] + points_at[p, i, 1] * b[1] + points_at[p, i, 2] * b[2]
            )


@njit(cache=True, nogil=True)
def start(
    X: Array, calibration: Array, views: Views, camera: Camera, wanted: Array, rho_start: float, points: Array
) -> None:
    """Give the `wanted` landmarks a bearing from their host's view and the inverse depth that all views suggest.

    Once through the linear equation for the inverse depth, then three Gauss-Newton steps with the poses fixed.
    """
    w = np.zeros((_ROWS, 3))
    at_infinity, J, r = np.empty(3), np.empty((3, COLUMNS)), np.empty(3)
    rig = (camera, camera.T_body_cam[:3, :3].copy() @ so3_exp(calibration[1:4].copy()))
    for p in range(len(points)):
        if not wanted[p]:
            continue
        point, host, own = points[p], views.host[p], views.first[p]
        point[:2] = views.xy[own]
        numerator, denominator = 1e2 * rho_start, 1e2
        for n in range(own, views.first[p + 1]):
            dt_host, dt = _shifts(views, camera, calibration, n, own, host)
            point[2] = 0.0
            _chain(X, host, views.keyframe[n], dt_host, dt, point, rig, views.camera[n], w)
            at_infinity[:] = w[_F_CAM]
            point[2] = 1.0
            _chain(X, host, views.keyframe[n], dt_host, dt, point, rig, views.camera[n], w)
            weight = views.white[n, 0, 0] ** 2
            for i in range(2):
                a = (w[_F_CAM, i] - at_infinity[i]) - views.xy[n, i] * (w[_F_CAM, 2] - at_infinity[2])
                b = at_infinity[i] - views.xy[n, i] * at_infinity[2]
                numerator -= weight * a * b
                denominator += weight * a * a
            if views.depth_weight[n] > 0.0:
                a = 1.0 - views.inverse_depth[n] * (w[_F_CAM, 2] - at_infinity[2])
                numerator += views.depth_weight[n] ** 2 * a * views.inverse_depth[n] * at_infinity[2]
                denominator += views.depth_weight[n] ** 2 * a * a
        point[2] = min(max(numerator / denominator, 1e-3), 5.0)
        for _ in range(3):
            H, b = np.eye(3) * camera.rho_information, point * camera.rho_information
            for n in range(own, views.first[p + 1]):
                dt_host, dt = _shifts(views, camera, calibration, n, own, host)
                _chain(X, host, views.keyframe[n], dt_host, dt, point, rig, views.camera[n], w)
                if not _residual(w, views, n, point[2], r):
                    continue
                _derivative(w, views, n, own, point[2], rig, X, host, J)
                weight = _robust(r[0] * r[0] + r[1] * r[1], camera.huber_k)[0]
                for k in range(3):
                    scale = weight if k < 2 else _robust(r[2] * r[2], camera.huber_k)[0]
                    for i in range(3):
                        b[i] += scale * J[k, 17 + i] * r[k]
                        for j in range(3):
                            H[i, j] += scale * J[k, 17 + i] * J[k, 17 + j]
            step = np.linalg.solve(H, b)
            point[:2] -= step[:2]
            point[2] = min(max(point[2] - step[2], -0.1), 10.0)
