"""Compiled arithmetic of pose graphs: errors of edges, their normal equations, and steps on the manifold.

The error of an edge is r = Log(D) with D = Z^-1 @ T_i^-1 @ T_j, rotation first. Steps perturb on the body side.
Derivatives are exact: with Jr the right Jacobian of the group, dr/dxi_j = Jr(r)^-1 and
dr/dxi_i = -Jr(r)^-1 @ Ad(T_j^-1 @ T_i) (Sola et al. 2018, section IV).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.messages import Array

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
