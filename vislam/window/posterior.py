"""What the solved window says: relative poses, tilts, states and scale with their covariances."""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.geometry import skew, tangent_basis, transform
from vislam.messages import Array, NavState
from vislam.window.messages import WindowTilt


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

    The best linear estimate of a factor s on all displacements d from the first keyframe has the variance
    1 / (d @ inv(P) @ d), P their joint covariance.
    """
    n = len(X) - 1
    d = (X[1:, 9:12] - X[0, 9:12]).ravel()
    if n < 1 or float(np.max(np.abs(d))) < 1e-3:
        return float("inf")
    index = (6 * np.arange(n + 1)[:, None] + np.arange(3, 6)).ravel()
    joint = poses[np.ix_(index, index)]
    from_first = joint[3:, 3:] - np.tile(joint[:3, 3:], (n, 1)) - np.tile(joint[3:, :3], (1, n))
    from_first = from_first + np.tile(joint[:3, :3], (n, n))
    try:
        certainty = float(d @ np.linalg.solve(from_first, d))
    except np.linalg.LinAlgError:
        return float("inf")
    return 1.0 / np.sqrt(certainty) if certainty > 0.0 else float("inf")
