"""One view of a landmark: its whitened error and the derivative of that, by carrying the landmark through the frames.

A landmark is a bearing [a, b, 1] and an inverse depth rho in camera 0 of its host at the time its row was read. A
camera at time `dt` after its keyframe's stamp sits at `R @ exp(rate * dt), p + v * dt`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.geometry import so3_exp
from vislam.messages import Array
from vislam.window.layout import Camera, Views
from vislam.window.small import product

COLUMNS = 20  # of an error: host pose 6, pose 6, calibration 5, landmark 3
_MIN_Z = 0.02  # relative to the host's depth: nearer is beside or behind the camera

# Rows of the scratch space [_ROWS, 3] in which a view is computed: small arrays of their own would cost more than the
# arithmetic. Rotations take three rows. A landmark is carried through the frames scaled by its inverse depth.
_BODY_CAM, _CAMS = 0, 4  # rotation and position of camera 0 on the body; the same for each camera in camera 0
_HOST, _SEEN = 12, 16  # rotation and position of host and keyframe when the rows were read
_TURN_HOST, _TURN_SEEN = 20, 23  # rotation since the stamp
_RATE_HOST, _RATE_SEEN, _V_HOST, _V_SEEN = 26, 27, 28, 29
_BEARING, _F_HOST, _F_WORLD, _F_SEEN, _Q, F_CAM, _GAP, _FREE = 30, 31, 32, 33, 34, 35, 36, 37
_BY_CAM, _BY_Q, _BY_SEEN, _BY_WORLD, _BY_HOST, _BY_BEARING = 38, 39, 40, 41, 42, 43  # rows of a derivative
_ROWS = 44

# The signatures of the first helpers are given, for numba would compile them again for each constant among the rows.


@njit("void(f8[:, ::1], i8, i8, i8)", cache=True, nogil=True, error_model="numpy")
def _rotate(w: Array, matrix: int, vector: int, out: int) -> None:
    for i in range(3):
        w[out, i] = w[matrix + i, 0] * w[vector, 0] + w[matrix + i, 1] * w[vector, 1] + w[matrix + i, 2] * w[vector, 2]


@njit("void(f8[:, ::1], i8, i8, i8)", cache=True, nogil=True, error_model="numpy")
def _rotate_back(w: Array, matrix: int, vector: int, out: int) -> None:
    for i in range(3):
        w[out, i] = w[matrix, i] * w[vector, 0] + w[matrix + 1, i] * w[vector, 1] + w[matrix + 2, i] * w[vector, 2]


@njit("void(f8[:, ::1], i8, i8, i8)", cache=True, nogil=True, error_model="numpy")
def _cross(w: Array, a: int, b: int, out: int) -> None:
    w[out, 0] = w[a, 1] * w[b, 2] - w[a, 2] * w[b, 1]
    w[out, 1] = w[a, 2] * w[b, 0] - w[a, 0] * w[b, 2]
    w[out, 2] = w[a, 0] * w[b, 1] - w[a, 1] * w[b, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def scratch(camera: Camera, calibration: Array) -> Array:
    """Return scratch space with the cameras' geometry in it."""
    w = np.zeros((_ROWS, 3))
    R = product(camera.T_body_cam, so3_exp(calibration[1:4]))
    for i in range(3):
        w[_BODY_CAM + 3, i] = camera.T_body_cam[i, 3]
        for j in range(3):
            w[_BODY_CAM + i, j] = R[i, j]
    for c in range(len(camera.T_cam0_cams)):
        T, at = camera.T_cam0_cams[c], _CAMS + 4 * c
        for i in range(3):
            w[at + 3, i] = T[i, 3]
            for j in range(3):
                w[at + i, j] = T[i, j]
    return w


@njit("void(f8[:, ::1], i8, f8[:, ::1], f8, f8[:, ::1], i8, i8, i8, i8)", cache=True, nogil=True, error_model="numpy")
def _place(X: Array, k: int, rates: Array, dt: float, w: Array, at: int, turn: int, rate: int, velocity: int) -> None:
    """Put the pose `dt` after the stamp of keyframe k into the scratch space, and the turn since.

    The turn is Rodrigues' series, good to 1e-8 rad at 0.1 rad.
    """
    for i in range(3):
        w[rate, i], w[velocity, i] = rates[k, i], X[k, 12 + i]
        w[at + 3, i] = X[k, 9 + i] + dt * X[k, 12 + i]
    a, b, c = dt * rates[k, 0], dt * rates[k, 1], dt * rates[k, 2]
    square = a * a + b * b + c * c
    first, second = 1.0 - square / 6.0 * (1.0 - square / 20.0), 0.5 - square / 24.0
    w[turn, 0], w[turn + 1, 1] = 1.0 - second * (b * b + c * c), 1.0 - second * (a * a + c * c)
    w[turn + 2, 2] = 1.0 - second * (a * a + b * b)
    w[turn, 1], w[turn + 1, 0] = second * a * b - first * c, second * a * b + first * c
    w[turn, 2], w[turn + 2, 0] = second * a * c + first * b, second * a * c - first * b
    w[turn + 1, 2], w[turn + 2, 1] = second * b * c - first * a, second * b * c + first * a
    for i in range(3):
        for j in range(3):
            w[at + i, j] = (
                X[k, 3 * i] * w[turn, j] + X[k, 3 * i + 1] * w[turn + 1, j] + X[k, 3 * i + 2] * w[turn + 2, j]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def place_host(X: Array, host: int, camera: Camera, dt: float, point: Array, w: Array) -> None:
    """Put the host and the landmark in its body frame and in the world into the scratch space."""
    _place(X, host, camera.rate, dt, w, _HOST, _TURN_HOST, _RATE_HOST, _V_HOST)
    w[_BEARING, 0], w[_BEARING, 1], w[_BEARING, 2] = point[0], point[1], 1.0
    _rotate(w, _BODY_CAM, _BEARING, _F_HOST)
    for i in range(3):
        w[_F_HOST, i] += point[2] * w[_BODY_CAM + 3, i]


@njit(cache=True, nogil=True, error_model="numpy")
def chain(X: Array, seen: int, camera: Camera, dt: float, rho: float, cam: int, w: Array) -> None:
    """Carry a landmark from its host, already in the scratch space, into a camera; every step stays there."""
    at = _CAMS + 4 * cam
    _place(X, seen, camera.rate, dt, w, _SEEN, _TURN_SEEN, _RATE_SEEN, _V_SEEN)
    _rotate(w, _HOST, _F_HOST, _F_WORLD)
    for i in range(3):
        w[_GAP, i] = w[_HOST + 3, i] - w[_SEEN + 3, i]
        w[_F_WORLD, i] += rho * w[_GAP, i]
    _rotate_back(w, _SEEN, _F_WORLD, _F_SEEN)
    for i in range(3):
        w[_FREE, i] = w[_F_SEEN, i] - rho * w[_BODY_CAM + 3, i]
    _rotate_back(w, _BODY_CAM, _FREE, _Q)
    for i in range(3):
        w[_FREE, i] = w[_Q, i] - rho * w[at + 3, i]
    _rotate_back(w, at, _FREE, F_CAM)


@njit(cache=True, nogil=True, error_model="numpy")
def residual(w: Array, views: Views, n: int, rho: float, out: Array) -> bool:
    """Whitened error [3] of view n: two of the pixel, one of inverse depth; False behind the camera."""
    z = w[F_CAM, 2]
    if not z > _MIN_Z:
        return False
    ex = w[F_CAM, 0] / z - views.xy[n, 0]
    ey = w[F_CAM, 1] / z - views.xy[n, 1]
    out[0] = views.white[n, 0, 0] * ex + views.white[n, 0, 1] * ey
    out[1] = views.white[n, 1, 0] * ex + views.white[n, 1, 1] * ey
    out[2] = views.depth_weight[n] * (rho / z - views.inverse_depth[n])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def robust(s: float, k: float) -> tuple[float, float]:
    """Return Huber's weight and twice its cost for a squared error."""
    if s <= k * k:
        return 1.0, s
    root = np.sqrt(s)
    return k / root, 2.0 * k * root - k * k


@njit(cache=True, nogil=True, error_model="numpy")
def shift(views: Views, camera: Camera, calibration: Array, n: int, k: int) -> float:
    """Return the time from keyframe k's stamp to when view n's row was read."""
    return calibration[0] - camera.applied_offset_s[k] + views.row[n] * calibration[4]


@njit(cache=True, nogil=True, error_model="numpy")
def derivative(w: Array, views: Views, n: int, own: int, rho: float, same: bool, J: Array) -> None:
    """Fill J [3, 20], the derivative of view n's whitened error, from the chain in the scratch space.

    Without a depth, its third row is left as it was.

    A row of the derivative is carried back through the frames, as the landmark was carried forth.
    """
    at = _CAMS + 4 * views.camera[n]
    z = w[F_CAM, 2]
    x, y = w[F_CAM, 0] / z, w[F_CAM, 1] / z
    depth_weight = views.depth_weight[n]
    for k in range(3 if depth_weight > 0.0 else 2):
        if k < 2:
            w[_BY_CAM, 0], w[_BY_CAM, 1] = views.white[n, k, 0] / z, views.white[n, k, 1] / z
            w[_BY_CAM, 2] = -(w[_BY_CAM, 0] * x + w[_BY_CAM, 1] * y)
        else:
            w[_BY_CAM, 0], w[_BY_CAM, 1], w[_BY_CAM, 2] = 0.0, 0.0, -depth_weight * rho / (z * z)
        _rotate(w, at, _BY_CAM, _BY_Q)
        _rotate(w, _BODY_CAM, _BY_Q, _BY_SEEN)
        _rotate(w, _SEEN, _BY_SEEN, _BY_WORLD)
        _rotate_back(w, _HOST, _BY_WORLD, _BY_HOST)
        _rotate_back(w, _BODY_CAM, _BY_HOST, _BY_BEARING)
        by_rho, by_time_host, by_time = 0.0, 0.0, 0.0
        for i in range(3):
            by_rho += (w[_BY_HOST, i] - w[_BY_SEEN, i]) * w[_BODY_CAM + 3, i]
            by_rho += w[_BY_WORLD, i] * w[_GAP, i] - w[_BY_Q, i] * w[at + 3, i]
        J[k, 17], J[k, 18], J[k, 19] = w[_BY_BEARING, 0], w[_BY_BEARING, 1], by_rho
        if k == 2:
            J[k, 19] += depth_weight / z
        if same:  # moving the body moves landmark and camera alike
            for i in range(17):
                J[k, i] = 0.0
            continue
        _cross(w, _F_HOST, _BY_HOST, _FREE)  # by a turn of the host at the time of reading
        for i in range(3):
            by_time_host -= w[_FREE, i] * -w[_RATE_HOST, i] - rho * w[_BY_WORLD, i] * w[_V_HOST, i]
            J[k, i] = (
                w[_TURN_HOST + i, 0] * w[_FREE, 0]
                + w[_TURN_HOST + i, 1] * w[_FREE, 1]
                + w[_TURN_HOST + i, 2] * w[_FREE, 2]
            )
            J[k, 3 + i] = rho * w[_BY_WORLD, i]
        _cross(w, _BY_SEEN, _F_SEEN, _FREE)
        for i in range(3):
            by_time += w[_FREE, i] * w[_RATE_SEEN, i] - rho * w[_BY_WORLD, i] * w[_V_SEEN, i]
            J[k, 6 + i] = (
                w[_TURN_SEEN + i, 0] * w[_FREE, 0]
                + w[_TURN_SEEN + i, 1] * w[_FREE, 1]
                + w[_TURN_SEEN + i, 2] * w[_FREE, 2]
            )
            J[k, 9 + i] = -rho * w[_BY_WORLD, i]
        J[k, 12] = by_time_host + by_time
        J[k, 16] = by_time_host * views.row[own] + by_time * views.row[n]
        _cross(w, _BEARING, _BY_BEARING, _FREE)
        for i in range(3):
            J[k, 13 + i] = w[_FREE, i]
        _cross(w, _BY_Q, _Q, _FREE)
        for i in range(3):
            J[k, 13 + i] += w[_FREE, i]


@njit(cache=True, nogil=True, error_model="numpy")
def weigh(J: Array, r: Array, rows: int, huber_k: float) -> None:
    """Apply the robust weights of pixel and depth to an error and its derivative."""
    pixel = np.sqrt(robust(r[0] * r[0] + r[1] * r[1], huber_k)[0])
    for k in range(rows):
        weight = pixel if k < 2 else np.sqrt(robust(r[2] * r[2], huber_k)[0])
        if weight != 1.0:
            r[k] *= weight
            for i in range(COLUMNS):
                J[k, i] *= weight
