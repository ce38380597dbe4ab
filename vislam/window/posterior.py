"""The posterior of the solved window: relative poses, tilts, states and scale with their covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.core.geometry import skew, tangent_basis, transform
from vislam.core.messages import Array, NavState
from vislam.window.equations import trailing_covariance
from vislam.window.messages import WindowGravity

GAUGE_SIGMA_M = 1e-3  # first position and yaw are a free choice: fixed far below what is measured
GAUGE_SIGMA_RAD = 1e-3
_NO_MOTION_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Covariance of what is eliminated last: velocity and biases of the newest keyframe, all poses, calibration."""

    covariance: Array  # [9 + 6 M + 16] in both directions; without the first 9 where there are poses alone
    count: int  # of keyframes, M
    others: int  # 9, or 0

    @classmethod
    def of(cls, U: Array, count: int, full: bool) -> Posterior:
        """Return it from the upper factor of the information of all unknowns."""
        return cls(trailing_covariance(U, 9 * (count - 1) if full else 0), count, 9 if full else 0)

    @property
    def poses(self) -> Array:
        """Return the covariance [6 M, 6 M] of all poses."""
        at, end = self.others, self.others + 6 * self.count
        return np.ascontiguousarray(self.covariance[at:end, at:end])

    @property
    def calibration(self) -> Array:
        """Return the covariance [16, 16] of the calibration."""
        at = self.others + 6 * self.count
        return self.covariance[at:, at:]

    @property
    def newest_state(self) -> Array:
        """Return the covariance [15, 15] of the newest keyframe, in the order of NavState."""
        at = self.others + 6 * (self.count - 1)
        index = np.concatenate([np.arange(at, at + 6), np.arange(9)])
        return self.covariance[np.ix_(index, index)]

    def of_newest(self, count: int) -> Array:
        """Return the covariance of newest velocity and biases, the newest `count` poses, and calibration."""
        gone = 6 * (self.count - count)
        kept = np.concatenate([np.arange(9), np.arange(9 + gone, len(self.covariance))])
        return self.covariance[np.ix_(kept, kept)]


def edges(X: Array, poses: Array) -> tuple[Array, Array]:
    """Return motions [M - 1, 4, 4] between consecutive states [M, 21] and their covariances [M - 1, 6, 6].

    `poses` [6 M, 6 M] is the joint covariance of the poses: rotation on the body side, position in world axes.
    """
    n = len(X) - 1
    R, p = X[:, :9].reshape(-1, 3, 3), X[:, 9:12]
    Ra_back, Rb_back = R[:-1].transpose(0, 2, 1), R[1:].transpose(0, 2, 1)
    T = np.zeros((n, 4, 4))
    T[:, :3, :3], T[:, 3, 3] = Ra_back @ R[1:], 1.0
    T[:, :3, 3] = t = np.einsum("kij,kj->ki", Ra_back, p[1:] - p[:-1])
    back = T[:, :3, :3].transpose(0, 2, 1)
    cross = np.zeros((n, 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = t, -t
    J = np.zeros((n, 6, 12))
    J[:, :3, :3], J[:, :3, 6:9] = -back, np.eye(3)
    J[:, 3:, :3], J[:, 3:, 3:6], J[:, 3:, 9:] = back @ cross, -Rb_back, Rb_back
    index = 6 * np.arange(n)[:, None] + np.arange(12)
    return T, J @ poses[index[:, :, None], index[:, None, :]] @ J.transpose(0, 2, 1)


def pose(x: Array) -> Array:
    """Return the pose [4, 4] of a state [21]."""
    return transform(x[:9].reshape(3, 3), x[9:12])


def nav_state(t_ns: int, x: Array, covariance: Array) -> NavState:
    """Return a state [21] and its covariance [15, 15] as a value."""
    return NavState(t_ns, pose(x), x[12:15].copy(), x[15:18].copy(), x[18:21].copy(), 0.5 * (covariance + covariance.T))


def tilt(keyframe_id: int, x: Array, rotation_covariance: Array) -> WindowGravity:
    """Return the direction of up in body axes, with its covariance; the rotation's [3, 3] is on the body side."""
    up = x[6:9].copy()  # last row of R_world_body
    J = tangent_basis(up).T @ skew(up)  # up in the body moves by -[w] up = [up] w
    P = J @ rotation_covariance @ J.T
    return WindowGravity(keyframe_id, up, float(np.sqrt(np.linalg.eigvalsh(P)[-1])), P)


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
