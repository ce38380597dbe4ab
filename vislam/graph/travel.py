"""Odometry from keyframe to keyframe, kept free of what loops made of it: how far, and how uncertain."""

from dataclasses import dataclass

import numpy as np

from vislam.core.geometry import invert, skew
from vislam.core.messages import Array

_TINY = 1e-12  # variance that keeps a covariance of two equal keyframes regular


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Odometry of N keyframes at one moment; sums along it make the covariance between any two cheap."""

    poses: Array  # [N, 4, 4] in a frame of their own
    rad2: Array  # [N] sums from the first keyframe on, of the variance per axis of each step
    m2: Array  # [N]
    lever: Array  # [N, 3] sums of rad2 times position
    levers: Array  # [N, 3, 3] sums of rad2 times its outer square

    def motion(self, a: int, b: int) -> tuple[Array, Array]:
        """Return T_a_b [4, 4] and its covariance [6, 6] perturbed at b, for keyframes a < b.

        The steps err independently, each alike along its axes, so only where they were matters.
        """
        T_b = self.poses[b]
        R, p = T_b[:3, :3], T_b[:3, 3]
        rad2 = float(self.rad2[b] - self.rad2[a])
        s, ss = self.lever[b] - self.lever[a], self.levers[b] - self.levers[a]
        t = R.T @ (s - rad2 * p)
        tt = R.T @ (ss - np.outer(s, p) - np.outer(p, s) + rad2 * np.outer(p, p)) @ R
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = (rad2 + _TINY) * np.eye(3)
        covariance[3:, :3] = skew(t)
        covariance[:3, 3:] = covariance[3:, :3].T
        covariance[3:, 3:] = (float(self.m2[b] - self.m2[a]) + float(np.trace(tt)) + _TINY) * np.eye(3) - tt
        return invert(self.poses[a]) @ T_b, covariance


class Travel:
    """The motion of each keyframe as the graph had it when it came, with its variances and the distance."""

    def __init__(self) -> None:
        """Start with keyframe 0."""
        self._count = 1
        self._poses: Array = np.tile(np.eye(4), (64, 1, 1))
        self._motions: Array = np.tile(np.eye(4), (64, 1, 1))
        self._steps: Array = np.zeros((64, 3))  # variance in rad^2 and m^2 per axis, distance in m

    def append(self, variance_rad2: float, variance_m2: float, T_previous_body: Array) -> None:
        """Add the motion [4, 4] to a new keyframe."""
        if self._count == len(self._steps):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
            self._motions = np.concatenate([self._motions, np.zeros_like(self._motions)])
            self._steps = np.concatenate([self._steps, np.zeros_like(self._steps)])
        self._count += 1
        self.amend(self._count - 1, variance_rad2, variance_m2, T_previous_body)

    def amend(self, k: int, variance_rad2: float, variance_m2: float, T_previous_body: Array) -> None:
        """Replace the motion to keyframe k, one of the newest."""
        self._steps[k] = variance_rad2, variance_m2, np.linalg.norm(T_previous_body[:3, 3])
        self._motions[k] = T_previous_body
        for n in range(k, self._count):
            self._poses[n] = self._poses[n - 1] @ self._motions[n]

    def scale(self, sigma_factor: float) -> None:
        """Multiply all sigmas."""
        self._steps[:, :2] *= sigma_factor**2

    @property
    def poses(self) -> Array:
        """Return the poses [N, 4, 4] that odometry alone gives, in a frame of their own: a view."""
        return self._poses[: self._count]

    def between(self, i: int, j: int) -> tuple[float, float, float]:
        """Return variance in rad^2 and m^2 per axis and the distance in m travelled between two keyframes."""
        rad2, m2, distance = self._steps[min(i, j) + 1 : max(i, j) + 1].sum(axis=0).tolist()
        return rad2, m2 + rad2 * distance**2 / 3.0, distance

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return a diagonal stand-in [6, 6] for the covariance of the relative pose, from odometry alone."""
        rad2, m2, _ = self.between(i, j)
        return np.diag(np.repeat([rad2 + _TINY, m2 + _TINY], 3))

    def chain(self) -> Chain:
        """Return what is known now; later changes do not reach it."""
        n = self._count
        poses = self._poses[:n].copy()
        p, rad2 = poses[:, :3, 3], self._steps[:n, 0]
        return Chain(
            poses,
            np.cumsum(rad2),
            np.cumsum(self._steps[:n, 1]),
            np.cumsum(rad2[:, None] * p, axis=0),
            np.cumsum(rad2[:, None, None] * p[:, :, None] * p[:, None, :], axis=0),
        )
