"""Reprojection errors of landmarks hosted in keyframes, with time offset, rolling shutter and extrinsic rotation.

A landmark is a bearing [a, b, 1] and an inverse depth rho in its host's camera at the time its row was read; points
at infinity are ordinary (Civera et al., "Inverse depth parametrization for monocular SLAM", TRO 2008). A camera at time
`dt` after its keyframe's stamp sits at `R @ exp(rate * dt), p + v * dt`. Derivatives of states that the marginal prior
holds are taken where it was linearised (first estimates: Huang, Mourikis and Roumeliotis, ISER 2008), so that the prior
and the views agree on what cannot be observed.
"""

from __future__ import annotations

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.core.small import minus
from vislam.window.equations.layout import Camera, Normal, States, Views
from vislam.window.equations.projection import (
    CALIBRATED,
    COLUMNS,
    ERROR,
    POINT,
    SEEN,
    VIEWED,
    Mount,
    Place,
    hosted,
    hosting,
    linearised,
    measured,
    mounted,
    optics,
    place,
    residual,
    robust,
    shift,
    sight,
    through,
)
from vislam.window.equations.schur import Landmarks, invert

_BEHIND_COST = 50.0  # of a view that the landmark lies behind; constant, so that it neither pulls nor stops a step
_OWN = 20  # columns of a view that belong to its landmark: host, calibration, point, error


@njit(cache=True, nogil=True, error_model="numpy")
def cost(X: Array, points: Array, calibration: Array, views: Views, camera: Camera, squares: Array) -> float:
    """Return half the robust cost of all views; `squares` [N, 2] gets the squared errors of pixel and depth."""
    mount, total = mounted(camera, calibration), 0.0
    first, hosts, keyframes, cameras, values = views
    cams, rates, offsets_s = optics(camera, calibration), camera.rate, camera.applied_offset_s
    huber_k, deep = camera.huber_k, len(camera.huber_k) - 1
    for p in range(len(points)):
        host, rho, row = hosts[p], points[p, 2], values[first[p], 5]
        own = hosting(cams, cameras[first[p]])
        at_host = place(X, host, rates, shift(offsets_s, calibration, host, row))
        landmark = hosted(at_host, mount, own, row, points[p, 0], points[p, 1], rho)
        total += camera.rho_information * rho * rho
        for n in range(first[p], first[p + 1]):
            k, view = keyframes[n], measured(values, n)
            at = at_host if k == host else place(X, k, rates, shift(offsets_s, calibration, k, view.row))
            cam = through(cams, cameras[n])
            ahead, e = residual(sight(landmark, at, mount, cam).in_cam, rho, view, cam)
            if not ahead:
                total += _BEHIND_COST
                squares[n, 0], squares[n, 1] = 1e6, 0.0
                continue
            squares[n, 0], squares[n, 1] = e[0] * e[0] + e[1] * e[1], e[2] * e[2]
            total += robust(squares[n, 0], huber_k[cameras[n]])[1] + robust(squares[n, 1], huber_k[deep])[1]
    return 0.5 * total


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    states: States,
    points: Array,
    calibration: Array,
    views: Views,
    camera: Camera,
    poses_at: int,
    normal: Normal,
    landmarks: Landmarks,
) -> None:
    """Add the views' normal equations of poses and calibration.

    Args:
        states: of M keyframes.
        points: bearing and inverse depth [L, 3].
        calibration: [16].
        views: observations.
        camera: geometry and timing.
        poses_at: where the poses begin among the unknowns; calibration follows them.
        normal: added to.
        landmarks: the blocks, gradients and cross terms of L landmarks, overwritten.
    """
    X, X_first, held = states
    mount, calibrated = mounted(camera, calibration), poses_at + 6 * len(X)
    first, hosts, keyframes, cameras, values = views
    cams, rates, offsets_s = optics(camera, calibration), camera.rate, camera.applied_offset_s
    huber_k, deep = camera.huber_k, len(camera.huber_k) - 1
    J, ours, theirs = np.zeros((3, COLUMNS)), np.empty((POINT + 3, _OWN)), np.empty((6, COLUMNS))
    blocks, gradients, cross = landmarks.blocks, landmarks.gradients, landmarks.cross
    cross[:] = 0.0
    for p in range(len(points)):
        host, rho, row = hosts[p], points[p, 2], values[first[p], 5]
        own = hosting(cams, cameras[first[p]])
        dt_host = shift(offsets_s, calibration, host, row)
        at_host = at_fixed = place(X, host, rates, dt_host)
        landmark = fixed = hosted(at_host, mount, own, row, points[p, 0], points[p, 1], rho)
        if held[host]:
            at_fixed = place(X_first, host, rates, dt_host)
            fixed = hosted(at_fixed, mount, own, row, points[p, 0], points[p, 1], rho)
        ours[:] = 0.0
        for n in range(first[p], first[p + 1]):
            k, view, cam = keyframes[n], measured(values, n), through(cams, cameras[n])
            dt = shift(offsets_s, calibration, k, view.row)
            at = at_host if k == host else place(X, k, rates, dt)
            seen = sight(landmark, at, mount, cam)
            ahead, error = residual(seen.in_cam, rho, view, cam)
            if ahead and (held[host] or held[k]):
                if k == host:
                    at = at_fixed
                elif held[k]:
                    at = place(X_first, k, rates, dt)
                seen = sight(fixed, at, mount, cam)
                ahead = residual(seen.in_cam, rho, view, cam)[0]
            if not ahead:
                continue
            linearised(fixed, seen, view, k == host, error, (huber_k[cameras[n]], huber_k[deep]), J)
            rows = 3 if view.depth_weight > 0.0 else 2
            _add_squares(J, rows, 0, ours)
            if k != host:
                theirs[:] = 0.0
                _add_squares(J, rows, SEEN, theirs)
                _add_seen(theirs, 6 * host, 6 * k, poses_at, calibrated, normal, cross[p])
        _add_own(ours, 6 * host, poses_at, calibrated, normal, cross[p])
        for i in range(3):
            gradients[p, i] = ours[POINT + i, ERROR]
            for j in range(3):
                blocks[p, i, j] = ours[POINT + i, POINT + j]
        blocks[p, 2, 2] += camera.rho_information
        gradients[p, 2] += camera.rho_information * rho


@njit(cache=True, nogil=True, error_model="numpy")
def _add_squares(J: Array, rows: int, column: int, out: Array) -> None:
    """Add to `out` [R, C] the products of R columns of J, from `column` on, with its first C columns."""
    for k in range(rows):
        for i in range(out.shape[0]):
            value = J[k, column + i]
            for j in range(out.shape[1]):
                out[i, j] += value * J[k, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_own(ours: Array, host: int, poses_at: int, calibrated: int, normal: Normal, cross: Array) -> None:
    """Add what all views of a landmark say of its host and the calibration, and of how the landmark hangs on them."""
    A, g = normal
    for i in range(POINT):
        at = poses_at + host + i if i < CALIBRATED else calibrated + i - CALIBRATED
        g[at] += ours[i, ERROR]
        for j in range(i, POINT):
            A[at, poses_at + host + j if j < CALIBRATED else calibrated + j - CALIBRATED] += ours[i, j]
        for j in range(3):
            cross[j, at - poses_at] += ours[i, POINT + j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_seen(
    theirs: Array, host: int, seen: int, poses_at: int, calibrated: int, normal: Normal, cross: Array
) -> None:
    """Add a view's terms of the pose that sees, which is later than the host's, and of all else that it depends on."""
    A, g = normal
    for i in range(6):
        at = poses_at + seen + i
        g[at] += theirs[i, ERROR]
        for j in range(6):
            A[poses_at + host + j, at] += theirs[i, j]
            if j >= i:
                A[at, poses_at + seen + j] += theirs[i, SEEN + j]
        for j in range(VIEWED):
            A[at, calibrated + j] += theirs[i, CALIBRATED + j]
        for j in range(3):
            cross[j, seen + i] += theirs[i, POINT + j]


@njit(cache=True, nogil=True, error_model="numpy")
def start(
    X: Array, calibration: Array, views: Views, camera: Camera, wanted: Array, rho_start: float, points: Array
) -> None:
    """Give the `wanted` landmarks a bearing from their host's view and the inverse depth that all views suggest.

    Once through the linear equation for the inverse depth, then three Gauss-Newton steps with the poses fixed.
    """
    mount = mounted(camera, calibration)
    first, hosts, keyframes, cameras, values = views
    cams, rates, offsets_s = optics(camera, calibration), camera.rate, camera.applied_offset_s
    for p in range(len(points)):
        if not wanted[p]:
            continue
        host, own, eye = hosts[p], measured(values, first[p]), hosting(cams, cameras[first[p]])
        at_host = place(X, host, rates, shift(offsets_s, calibration, host, own.row))
        far = hosted(at_host, mount, eye, own.row, own.x, own.y, 0.0)
        near = hosted(at_host, mount, eye, own.row, own.x, own.y, 1.0)
        numerator, denominator = 1e2 * rho_start, 1e2
        for n in range(first[p], first[p + 1]):
            k, view, cam = keyframes[n], measured(values, n), through(cams, cameras[n])
            at = at_host if k == host else place(X, k, rates, shift(offsets_s, calibration, k, view.row))
            at_infinity = sight(far, at, mount, cam).in_cam
            by_rho = minus(sight(near, at, mount, cam).in_cam, at_infinity)
            weight = (view.weight * cam.lens.pinhole[0]) ** 2
            ax, ay = by_rho[0] - view.x * by_rho[2], by_rho[1] - view.y * by_rho[2]
            numerator -= weight * ax * (at_infinity[0] - view.x * at_infinity[2])
            numerator -= weight * ay * (at_infinity[1] - view.y * at_infinity[2])
            denominator += weight * (ax * ax + ay * ay)
            if view.depth_weight > 0.0:
                a = 1.0 - view.inverse_depth * by_rho[2]
                numerator += view.depth_weight**2 * a * view.inverse_depth * at_infinity[2]
                denominator += view.depth_weight**2 * a * a
        points[p, 0], points[p, 1], points[p, 2] = own.x, own.y, min(max(numerator / denominator, 1e-3), 5.0)
        _refine(X, calibration, views, camera, p, points[p], at_host, mount)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(
    X: Array, calibration: Array, views: Views, camera: Camera, p: int, point: Array, at_host: Place, mount: Mount
) -> None:
    """Move landmark p [3] by three Gauss-Newton steps with the poses fixed."""
    first, hosts, keyframes, cameras, values = views
    cams, rates, offsets_s = optics(camera, calibration), camera.rate, camera.applied_offset_s
    huber_k, deep = camera.huber_k, len(camera.huber_k) - 1
    host, row, J = hosts[p], values[first[p], 5], np.zeros((3, COLUMNS))
    own = hosting(cams, cameras[first[p]])
    H, b, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for _ in range(3):
        for i in range(3):
            b[i] = camera.rho_information * point[i]
            for j in range(3):
                H[i, j] = camera.rho_information if i == j else 0.0
        landmark = hosted(at_host, mount, own, row, point[0], point[1], point[2])
        for n in range(first[p], first[p + 1]):
            k, view = keyframes[n], measured(values, n)
            at = at_host if k == host else place(X, k, rates, shift(offsets_s, calibration, k, view.row))
            cam = through(cams, cameras[n])
            seen = sight(landmark, at, mount, cam)
            ahead, error = residual(seen.in_cam, landmark.rho, view, cam)
            if not ahead:
                continue
            linearised(landmark, seen, view, k == host, error, (huber_k[cameras[n]], huber_k[deep]), J)
            for m in range(3 if view.depth_weight > 0.0 else 2):
                for i in range(3):
                    b[i] += J[m, POINT + i] * J[m, ERROR]
                    for j in range(3):
                        H[i, j] += J[m, POINT + i] * J[m, POINT + j]
        if not invert(H, 0.0, inverse):
            break
        for i in range(3):
            point[i] -= inverse[i, 0] * b[0] + inverse[i, 1] * b[1] + inverse[i, 2] * b[2]
        point[2] = min(max(point[2], -0.1), 10.0)
