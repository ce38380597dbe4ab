"""Compiled arithmetic of pose graphs: errors of edges, their normal equations, and steps on the manifold.

The error of an edge is r = Log(D) with D = Z^-1 @ T_i^-1 @ T_j, rotation first. Steps perturb on the body side.
Derivatives are exact: with Jr the right Jacobian of the group, dr/dxi_j = Jr(r)^-1 and
dr/dxi_i = -Jr(r)^-1 @ Ad(T_j^-1 @ T_i) (Sola et al. 2018, section IV).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array

_SMALL_RAD = 1e-7  # below this angle series of second order are exact to double precision
_SERIES_RAD = 1e-2  # below this angle the closed forms of higher coefficients lose digits, their series do not


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _log_rotation(R: Array, r: Array) -> float:
    """Write the rotation vector of R [3, 3] into r[:3]; return its norm. By quaternions, stable up to pi."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        w, x, y, z = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        w, x = R[2, 1] - R[1, 2], 1.0 + R[0, 0] - R[1, 1] - R[2, 2]
        y, z = R[1, 0] + R[0, 1], R[2, 0] + R[0, 2]
    elif R[1, 1] >= R[2, 2]:
        w, y = R[0, 2] - R[2, 0], 1.0 + R[1, 1] - R[0, 0] - R[2, 2]
        x, z = R[1, 0] + R[0, 1], R[2, 1] + R[1, 2]
    else:
        w, z = R[1, 0] - R[0, 1], 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
        x, y = R[2, 0] + R[0, 2], R[2, 1] + R[1, 2]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, w)
    scale = angle / sine if sine > _SMALL_RAD * w else 2.0 / w
    r[0], r[1], r[2] = scale * x, scale * y, scale * z
    return angle


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _difference(Ti: Array, Tj: Array, Z: Array, between: Array, D: Array) -> None:
    """Write T_i^-1 @ T_j [3, 4] and Z^-1 @ T_i^-1 @ T_j [3, 4] into `between` and D."""
    for a in range(3):
        s = 0.0
        for k in range(3):
            s += Ti[k, a] * (Tj[k, 3] - Ti[k, 3])
        between[a, 3] = s
        for b in range(3):
            between[a, b] = Ti[0, a] * Tj[0, b] + Ti[1, a] * Tj[1, b] + Ti[2, a] * Tj[2, b]
    for a in range(3):
        s = 0.0
        for k in range(3):
            s += Z[k, a] * (between[k, 3] - Z[k, 3])
        D[a, 3] = s
        for b in range(3):
            D[a, b] = Z[0, a] * between[0, b] + Z[1, a] * between[1, b] + Z[2, a] * between[2, b]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _log_pose(D: Array, r: Array) -> float:
    """Write the tangent [6] of D [3, 4] into r; return the angle."""
    angle = _log_rotation(D, r)
    if angle < _SERIES_RAD:
        k = 1.0 / 12.0 + angle * angle / 720.0
    else:
        k = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / (angle * angle)
    x, y, z, u, v, w = r[0], r[1], r[2], D[0, 3], D[1, 3], D[2, 3]
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    r[3] = u - 0.5 * a + k * (y * c - z * b)
    r[4] = v - 0.5 * b + k * (z * a - x * c)
    r[5] = w - 0.5 * c + k * (x * b - y * a)
    return angle


@njit(cache=True, nogil=True, error_model="numpy")
def errors_3d(edges: NDArray[np.int64], poses: Array, measurements: Array, out: Array) -> None:
    """Write the error r of every edge into out [E, 6]."""
    between, D = np.empty((3, 4)), np.empty((3, 4))
    for e in range(len(edges)):
        _difference(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], between, D)
        _log_pose(D, out[e])


@njit(cache=True, nogil=True, error_model="numpy")
def errors_2d(edges: NDArray[np.int64], poses: Array, measurements: Array, out: Array) -> None:
    """Write the error r of every edge into out [E, 3]."""
    for e in range(len(edges)):
        _error_2d(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], out[e])


@njit(cache=True, nogil=True, error_model="numpy")
def chi2_3d(edges: NDArray[np.int64], poses: Array, measurements: Array, information: Array, out: Array) -> None:
    """Write r^T @ information @ r of every edge into out [E]."""
    between, D, r = np.empty((3, 4)), np.empty((3, 4)), np.empty(6)
    for e in range(len(edges)):
        _difference(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], between, D)
        _log_pose(D, r)
        total = 0.0
        for a in range(6):
            s = 0.0
            for b in range(6):
                s += information[e, a, b] * r[b]
            total += r[a] * s
        out[e] = total


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _half_cotangent(angle: float) -> float:
    """Return (a / 2) / tan(a / 2) of an angle in radians."""
    return 1.0 - angle * angle / 12.0 if abs(angle) < 1e-4 else 0.5 * angle / math.tan(0.5 * angle)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _error_2d(Ti: Array, Tj: Array, Z: Array, r: Array) -> None:
    """Write the tangent [3] (angle, then translation) of Z^-1 @ T_i^-1 @ T_j into r."""
    dx, dy = Tj[0, 2] - Ti[0, 2], Tj[1, 2] - Ti[1, 2]
    c, s = Ti[0, 0] * Tj[0, 0] + Ti[1, 0] * Tj[1, 0], Ti[0, 0] * Tj[1, 0] - Ti[1, 0] * Tj[0, 0]
    angle = math.atan2(Z[0, 0] * s - Z[1, 0] * c, Z[0, 0] * c + Z[1, 0] * s)
    u, v = Ti[0, 0] * dx + Ti[1, 0] * dy - Z[0, 2], Ti[0, 0] * dy - Ti[1, 0] * dx - Z[1, 2]
    u, v = Z[0, 0] * u + Z[1, 0] * v, Z[0, 0] * v - Z[1, 0] * u
    h = _half_cotangent(angle)
    r[0], r[1], r[2] = angle, h * u + 0.5 * angle * v, h * v - 0.5 * angle * u


@njit(cache=True, nogil=True, error_model="numpy")
def chi2_2d(edges: NDArray[np.int64], poses: Array, measurements: Array, information: Array, out: Array) -> None:
    """Write r^T @ information @ r of every edge into out [E]."""
    r = np.empty(3)
    for e in range(len(edges)):
        _error_2d(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], r)
        W = information[e]
        total = 0.0
        for a in range(3):
            total += r[a] * (W[a, 0] * r[0] + W[a, 1] * r[1] + W[a, 2] * r[2])
        out[e] = total


class Edges(NamedTuple):
    """What was measured between poses."""

    ends: NDArray[np.int64]  # [E, 2]
    later_is_to: NDArray[np.bool_]  # [E] whether the second is eliminated later
    measurements: Array  # [E, d + 1, d + 1]
    information: Array  # [E, k, k]


class Normal(NamedTuple):
    """Normal equations of n free poses with tangents of size k, as `Factor` takes them."""

    diagonal: Array  # [n, k, k]
    off: Array  # [E, k, k]
    gradient: Array  # [n, k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def linearise_3d(  # noqa: PLR0912, PLR0915
    measured: Edges, index: NDArray[np.int64], poses: Array, weights: Array, normal: Normal
) -> float:
    """Write the normal equations of half the cost: H = J^T W J in blocks, gradient = J^T W r; return the cost.

    `index` [N] is the place of each pose among the free ones, -1 where it is fixed.
    """
    edges, later_is_to, measurements, information = measured
    diagonal, off, gradient = normal
    diagonal[:] = 0.0
    gradient[:] = 0.0
    between, D, r = np.empty((3, 4)), np.empty((3, 4)), np.empty(6)
    A, B, S, X, Y = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    Q, P, H, g = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    cost = 0.0
    for e in range(len(edges)):
        i, j, weight = index[edges[e, 0]], index[edges[e, 1]], weights[e]
        _difference(poses[edges[e, 0]], poses[edges[e, 1]], measurements[e], between, D)
        angle = _log_pose(D, r)
        # Jr^-1 = I + ad / 2 + c2 ad^2 + c4 ad^4: [[A, 0], [B, A]]
        c2, c4 = _even_coefficients(angle)
        x, y, z, u, v, w = r[0], r[1], r[2], r[3], r[4], r[5]
        angle2 = angle * angle
        own = c2 - c4 * angle2  # ad_w^4 = -angle^2 ad_w^2
        X[0, 0], X[0, 1], X[0, 2] = -(y * y + z * z), x * y, x * z
        X[1, 0], X[1, 1], X[1, 2] = x * y, -(x * x + z * z), y * z
        X[2, 0], X[2, 1], X[2, 2] = x * z, y * z, -(x * x + y * y)
        A[0, 0], A[0, 1], A[0, 2] = 1.0 + own * X[0, 0], own * X[0, 1] - 0.5 * z, own * X[0, 2] + 0.5 * y
        A[1, 0], A[1, 1], A[1, 2] = own * X[1, 0] + 0.5 * z, 1.0 + own * X[1, 1], own * X[1, 2] - 0.5 * x
        A[2, 0], A[2, 1], A[2, 2] = own * X[2, 0] - 0.5 * y, own * X[2, 1] + 0.5 * x, 1.0 + own * X[2, 2]
        # S = W V + V W with W = skew(r[:3]), V = skew(r[3:]); its square's part: X S + S X
        dot = x * u + y * v + z * w
        S[0, 0], S[0, 1], S[0, 2] = 2.0 * (x * u - dot), x * v + y * u, x * w + z * u
        S[1, 0], S[1, 1], S[1, 2] = S[0, 1], 2.0 * (y * v - dot), y * w + z * v
        S[2, 0], S[2, 1], S[2, 2] = S[0, 2], S[1, 2], 2.0 * (z * w - dot)
        for a in range(3):
            for b in range(3):
                s = X[a, 0] * S[0, b] + X[a, 1] * S[1, b] + X[a, 2] * S[2, b]
                t = S[a, 0] * X[0, b] + S[a, 1] * X[1, b] + S[a, 2] * X[2, b]
                B[a, b] = c2 * S[a, b] + c4 * (s + t)
        B[0, 1] -= 0.5 * w
        B[0, 2] += 0.5 * v
        B[1, 0] += 0.5 * w
        B[1, 2] -= 0.5 * u
        B[2, 0] -= 0.5 * v
        B[2, 1] += 0.5 * u
        # Q = weight W M, H = M^T Q for the pose `to`, with M the inverse Jacobian
        for a in range(6):
            s = 0.0
            for b in range(6):
                s += information[e, a, b] * r[b]
            g[a] = weight * s
            cost += r[a] * g[a]
        for a in range(6):
            for b in range(3):
                s = 0.0
                t = 0.0
                for k in range(3):
                    s += information[e, a, k] * A[k, b] + information[e, a, 3 + k] * B[k, b]
                    t += information[e, a, 3 + k] * A[k, b]
                Q[a, b], Q[a, 3 + b] = weight * s, weight * t
        for a in range(3):
            r[a] = A[0, a] * g[0] + A[1, a] * g[1] + A[2, a] * g[2] + B[0, a] * g[3] + B[1, a] * g[4] + B[2, a] * g[5]
            r[3 + a] = A[0, a] * g[3] + A[1, a] * g[4] + A[2, a] * g[5]
            for b in range(6):
                s = 0.0
                t = 0.0
                for k in range(3):
                    s += A[k, a] * Q[k, b] + B[k, a] * Q[3 + k, b]
                    t += A[k, a] * Q[3 + k, b]
                H[a, b], H[3 + a, b] = s, t
        # Ad of T_to_from = between^-1: [[R, 0], [skew(p) R, R]]
        p0 = -(between[0, 0] * between[0, 3] + between[1, 0] * between[1, 3] + between[2, 0] * between[2, 3])
        p1 = -(between[0, 1] * between[0, 3] + between[1, 1] * between[1, 3] + between[2, 1] * between[2, 3])
        p2 = -(between[0, 2] * between[0, 3] + between[1, 2] * between[1, 3] + between[2, 2] * between[2, 3])
        for b in range(3):
            q0, q1, q2 = between[b, 0], between[b, 1], between[b, 2]  # a row of R^T is a column of R
            X[0, b], X[1, b], X[2, b] = q0, q1, q2
            Y[0, b], Y[1, b], Y[2, b] = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
        if j >= 0:
            for a in range(6):
                gradient[j, a] += r[a]
                for b in range(6):
                    diagonal[j, a, b] += H[a, b]
        if i < 0:
            continue
        for a in range(6):
            for b in range(3):
                s = 0.0
                t = 0.0
                for k in range(3):
                    s += H[a, k] * X[k, b] + H[a, 3 + k] * Y[k, b]
                    t += H[a, 3 + k] * X[k, b]
                P[a, b], P[a, 3 + b] = s, t
        for a in range(3):
            s = 0.0
            t = 0.0
            for k in range(3):
                s += X[k, a] * r[k] + Y[k, a] * r[3 + k]
                t += X[k, a] * r[3 + k]
            gradient[i, a] -= s
            gradient[i, 3 + a] -= t
            for b in range(6):
                s = 0.0
                t = 0.0
                for k in range(3):
                    s += X[k, a] * P[k, b] + Y[k, a] * P[3 + k, b]
                    t += X[k, a] * P[3 + k, b]
                diagonal[i, a, b] += s
                diagonal[i, 3 + a, b] += t
        if j < 0:
            continue
        if later_is_to[e]:
            for b in range(6):
                for a in range(6):
                    off[e, b, a] = -P[a, b]
        else:
            for b in range(6):
                for a in range(6):
                    off[e, b, a] = -P[b, a]
    return cost


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _even_coefficients(angle: float) -> tuple[float, float]:
    """Return c2, c4 with Jr(r)^-1 = I + ad / 2 + c2 ad^2 + c4 ad^4.

    They make the polynomial equal x / 2 coth(x / 2) with its derivative at the double eigenvalues +-i angle of ad.
    """
    if angle < 0.05:
        angle2 = angle * angle
        return 1.0 / 12.0 - angle2 * angle2 / 30240.0, -1.0 / 720.0 - angle2 / 15120.0
    half = 0.5 * angle
    tangent, sine = math.tan(half), math.sin(half)
    g, slope = half / tangent, 0.5 / tangent - 0.25 * angle / (sine * sine)
    rest = 1.0 - g + 0.5 * angle * slope
    angle2 = angle * angle
    return 2.0 * rest / angle2 - 0.5 * slope / angle, rest / (angle2 * angle2)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def linearise_2d(  # noqa: PLR0912
    measured: Edges, index: NDArray[np.int64], poses: Array, weights: Array, normal: Normal
) -> float:
    """Write the normal equations, as `linearise_3d` does; blocks are 3 by 3."""
    edges, later_is_to, measurements, information = measured
    diagonal, off, gradient = normal
    diagonal[:] = 0.0
    gradient[:] = 0.0
    r, g, M, Ad = np.empty(3), np.empty(3), np.eye(3), np.eye(3)
    Q, H, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    cost = 0.0
    for e in range(len(edges)):
        i, j, weight = index[edges[e, 0]], index[edges[e, 1]], weights[e]
        Ti, Tj, W = poses[edges[e, 0]], poses[edges[e, 1]], information[e]
        _error_2d(Ti, Tj, measurements[e], r)
        for a in range(3):
            g[a] = weight * (W[a, 0] * r[0] + W[a, 1] * r[1] + W[a, 2] * r[2])
            cost += r[a] * g[a]
        # M = Jr^-1: [[1, 0, 0], [m_u, h, -angle / 2], [m_v, angle / 2, h]]
        angle, u, v = r[0], r[1], r[2]
        h = _half_cotangent(angle)
        k = angle / 12.0 if abs(angle) < 1e-4 else (1.0 - h) / angle
        M[1, 0], M[1, 1], M[1, 2] = 0.5 * v + k * u, h, -0.5 * angle
        M[2, 0], M[2, 1], M[2, 2] = k * v - 0.5 * u, 0.5 * angle, h
        for a in range(3):
            for b in range(3):
                Q[a, b] = weight * (W[a, 0] * M[0, b] + W[a, 1] * M[1, b] + W[a, 2] * M[2, b])
        for a in range(3):
            r[a] = M[0, a] * g[0] + M[1, a] * g[1] + M[2, a] * g[2]
            for b in range(3):
                H[a, b] = M[0, a] * Q[0, b] + M[1, a] * Q[1, b] + M[2, a] * Q[2, b]
        if j >= 0:
            for a in range(3):
                gradient[j, a] += r[a]
                for b in range(3):
                    diagonal[j, a, b] += H[a, b]
        if i < 0:
            continue
        # Ad of T_to_from: [[1, 0, 0], [p_v, c, -s], [-p_u, s, c]] with its rotation and translation
        c, s = Ti[0, 0] * Tj[0, 0] + Ti[1, 0] * Tj[1, 0], Tj[0, 0] * Ti[1, 0] - Tj[1, 0] * Ti[0, 0]
        dx, dy = Ti[0, 2] - Tj[0, 2], Ti[1, 2] - Tj[1, 2]
        pu, pv = Tj[0, 0] * dx + Tj[1, 0] * dy, Tj[0, 0] * dy - Tj[1, 0] * dx
        Ad[1, 0], Ad[1, 1], Ad[1, 2] = pv, c, -s
        Ad[2, 0], Ad[2, 1], Ad[2, 2] = -pu, s, c
        for a in range(3):
            for b in range(3):
                P[a, b] = H[a, 0] * Ad[0, b] + H[a, 1] * Ad[1, b] + H[a, 2] * Ad[2, b]
        for a in range(3):
            gradient[i, a] -= Ad[0, a] * r[0] + Ad[1, a] * r[1] + Ad[2, a] * r[2]
            for b in range(3):
                diagonal[i, a, b] += Ad[0, a] * P[0, b] + Ad[1, a] * P[1, b] + Ad[2, a] * P[2, b]
        if j < 0:
            continue
        for b in range(3):
            for a in range(3):
                off[e, b, a] = -P[a, b] if later_is_to[e] else -P[b, a]
    return cost


@njit(cache=True, nogil=True, inline="always")
def _copy(source: Array, out: Array) -> None:
    """Copy [N, a, b]: where a slice is assigned, numba compiles the text of an error about shapes, too, for seconds."""
    for i in range(source.shape[0]):
        for a in range(source.shape[1]):
            for b in range(source.shape[2]):
                out[i, a, b] = source[i, a, b]


@njit(cache=True, nogil=True, error_model="numpy")
def retract_2d(poses: Array, free: NDArray[np.int64], step: Array, out: Array) -> None:
    """Write poses @ Exp(step) into out; step [n, 3] is of the poses free [n]."""
    _copy(poses, out)
    for k in range(len(free)):
        T, G = poses[free[k]], out[free[k]]
        w, u, v = step[k, 0], step[k, 1], step[k, 2]
        s, c = math.sin(w), math.cos(w)
        if abs(w) < 1e-4:
            a, b = 1.0 - w * w / 6.0, 0.5 * w
        else:
            a, b = s / w, (1.0 - c) / w
        x, y = a * u - b * v, b * u + a * v
        C, S = T[0, 0] * c - T[1, 0] * s, T[1, 0] * c + T[0, 0] * s
        scale = 1.5 - 0.5 * (C * C + S * S)  # one Newton step back to the unit circle
        G[0, 0] = G[1, 1] = C * scale
        G[1, 0], G[0, 1] = S * scale, -S * scale
        G[0, 2] = T[0, 2] + T[0, 0] * x - T[1, 0] * y
        G[1, 2] = T[1, 2] + T[1, 0] * x + T[0, 0] * y


@njit(cache=True, nogil=True, error_model="numpy")
def retract_3d(poses: Array, free: NDArray[np.int64], step: Array, out: Array) -> None:
    """Write poses @ Exp(step) into out; step [n, 6] is of the poses free [n]."""
    _copy(poses, out)
    E, N = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(free)):
        T, G = poses[free[n]], out[free[n]]
        x, y, z, u, v, w = step[n, 0], step[n, 1], step[n, 2], step[n, 3], step[n, 4], step[n, 5]
        angle2 = x * x + y * y + z * z
        angle = math.sqrt(angle2)
        if angle < _SERIES_RAD:
            a = 1.0 - angle2 / 6.0 + angle2 * angle2 / 120.0
            b = 0.5 - angle2 / 24.0 + angle2 * angle2 / 720.0
            c = 1.0 / 6.0 - angle2 / 120.0
        else:
            a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
            c = (1.0 - a) / angle2
        E[0, 0], E[0, 1], E[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
        E[1, 0], E[1, 1], E[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
        E[2, 0], E[2, 1], E[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
        p, q, s = y * w - z * v, z * u - x * w, x * v - y * u
        p, q, s = u + b * p + c * (y * s - z * q), v + b * q + c * (z * p - x * s), w + b * s + c * (x * q - y * p)
        for k in range(3):
            G[k, 3] = T[k, 3] + T[k, 0] * p + T[k, 1] * q + T[k, 2] * s
            for m in range(3):
                N[k, m] = T[k, 0] * E[0, m] + T[k, 1] * E[1, m] + T[k, 2] * E[2, m]
        # one Newton step back to the rotations: N (3 I - N^T N) / 2
        for k in range(3):
            for m in range(3):
                g = N[0, k] * N[0, m] + N[1, k] * N[1, m] + N[2, k] * N[2, m]
                E[k, m] = (1.5 if k == m else 0.0) - 0.5 * g
        for k in range(3):
            for m in range(3):
                G[k, m] = N[k, 0] * E[0, m] + N[k, 1] * E[1, m] + N[k, 2] * E[2, m]
