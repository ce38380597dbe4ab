"""What the solved window says: relative poses, tilts, states and scale with their covariances."""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.geometry import skew, tangent_basis, transform
from vislam.messages import Array, NavState
from vislam.window.messages import WindowTilt

_NO_MOTION_M = 1e-3


@njit(cache=True, nogil=True)
def edges(X: Array, poses: Array) -> tuple[Array, Array]:
    """Return motions [M - 1, 4, 4] between consecutive states [M, 21] and their covariances [M - 1, 6, 6].

    `poses` [6 M, 6 M] is the joint covariance of the poses: rotation on the body side, position in world axes.
    """
    n = len(X) - 1
    T, P = np.zeros((n, 4, 4)), np.empty((n, 6, 6))
    J = np.zeros((6, 12))
    for k in range(n):
        Rat = X[k, :9].copy().reshape(3, 3).T.copy()
        Rb = X[k + 1, :9].copy().reshape(3, 3)
        R = Rat @ Rb
        t = Rat @ (X[k + 1, 9:12] - X[k, 9:12])
        T[k, :3, :3], T[k, :3, 3], T[k, 3, 3] = R, t, 1.0
        back = R.T.copy()
        J[:] = 0.0
        J[:3, :3] = -back
        J[3:, :3] = back @ skew(t)
        J[3:, 3:6] = -(back @ Rat)
        for i in range(3):
            J[i, 6 + i] = 1.0
        J[3:, 9:] = Rb.T.copy()
        P[k] = J @ poses[6 * k : 6 * k + 12, 6 * k : 6 * k + 12].copy() @ J.T.copy()
    return T, P


def pose(x: Array) -> Array:
    """Return the pose [4, 4] of a state [21]."""
    return transform(x[:9].reshape(3, 3), x[9:12])


def nav_state(t_ns: int, x: Array, covariance: Array) -> NavState:
    """Return a state [21] and its covariance [15, 15] as a value."""
    return NavState(t_ns, pose(x), x[12:15].copy(), x[15:18].copy(), x[18:21].copy(), 0.5 * (covariance + covariance.T))


def tilt(keyframe_id: int, x: Array, rotation_covariance: Array) -> WindowTilt:
    """Return the direction of up in body axes, with its covariance; the rotation's [3, 3] is on the body side."""
    up = x[6:9].copy()  # last row of R_world_body
    J = tangent_basis(up).T @ skew(up)  # up in the body moves by -[w] up = [up] w
    P = J @ rotation_covariance @ J.T
    return WindowTilt(keyframe_id, up, float(np.sqrt(np.linalg.eigvalsh(P)[-1])), P)


def scale_sigma(X: Array, poses: Array) -> float:
    """Return the relative sigma of the common scale of the positions; infinite where nothing moved.

    It is that of the least-squares factor on all displacements d from the first keyframe: the square root of
    `d @ P @ d / (d @ d)**2`, P their joint covariance.
    """
    n = len(X) - 1
    d = (X[1:, 9:12] - X[0, 9:12]).ravel()
    if n < 1 or float(np.max(np.abs(d))) < _NO_MOTION_M:
        return float("inf")
    by_positions = np.concatenate([-d.reshape(n, 3).sum(axis=0), d])
    index = (6 * np.arange(n + 1)[:, None] + np.arange(3, 6)).ravel()
    variance = float(by_positions @ poses[np.ix_(index, index)] @ by_positions)
    return float(np.sqrt(max(variance, 0.0)) / (d @ d))
