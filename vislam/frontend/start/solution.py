"""A solved window, whichever way it was solved, and whether a later one contradicts it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.angles import angle_between
from vislam.core.messages import Array
from vislam.frontend.start.inertial_alignment import Alignment
from vislam.window.bundle import BundleSolution

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """States of a window's nodes in a world with z up, position and heading of the first chosen freely."""

    t_ns: tuple[int, ...]  # [N]
    T_world_body: Array  # [N, 4, 4]
    velocities_m_s: Array  # [N, 3]
    gyro_bias_rad_s: Array  # [3]
    accel_bias_m_s2: Array  # [3]
    first_covariance: Array  # [15, 15] in the order of NavState
    last_covariance: Array  # [15, 15]
    scale_sigma: float  # relative, of all displacements together
    residual_ratio: float  # chi-square per degree of freedom

    @property
    def tilt_sigma_rad(self) -> float:
        """Return the larger sigma of roll and pitch of the last node."""
        R = self.T_world_body[-1, :3, :3]
        return float(np.sqrt(np.linalg.eigvalsh((R @ self.last_covariance[:3, :3] @ R.T)[:2, :2])[-1]))

    def contradiction(self, before: Solution, sigmas: float) -> str | None:
        """Return in which way this differs from an earlier solution by more than `sigmas` of both; empty: it does not.

        None where they have nothing in common.

        Compared are scale, vertical and velocity where both overlap in time, the last two at its newest common node.
        Both saw the same, so that the sigmas together are more than their difference should have.
        """
        t_ns, at = np.array(self.t_ns, dtype=np.int64), np.array(before.t_ns, dtype=np.int64)
        common = at[(at >= t_ns[0]) & (at <= t_ns[-1])]
        if len(common) < 2:
            return None
        now, then = self._lengths(common), before._lengths(common)
        change = float(now @ then / max(float(then @ then), 1e-12)) - 1.0
        limit = sigmas * float(np.hypot(self.scale_sigma * (1.0 + change), before.scale_sigma))
        if abs(change) > limit:
            return f"scale differs by {100.0 * change:+.0f} %, {100.0 * limit:.0f} % are chance"
        i, k = int(np.argmin(np.abs(t_ns - common[-1]))), int(np.flatnonzero(at == common[-1])[0])
        if t_ns[i] != at[k]:  # not a node of both
            return ""
        up_now, up_then = self.T_world_body[i, 2, :3], before.T_world_body[k, 2, :3]
        tilt = angle_between(up_now, up_then)
        limit = sigmas * float(np.hypot(self.tilt_sigma_rad, before.tilt_sigma_rad))
        if tilt > limit:
            return f"the vertical differs by {np.rad2deg(tilt):.1f} deg, {np.rad2deg(limit):.1f} are chance"
        apart = self.T_world_body[i, :3, :3].T @ self.velocities_m_s[i]
        apart = apart - before.T_world_body[k, :3, :3].T @ before.velocities_m_s[k]
        P = self.last_covariance[6:9, 6:9] + before.last_covariance[6:9, 6:9]
        limit = sigmas * float(np.sqrt(np.linalg.eigvalsh(P)[-1]))
        if float(np.linalg.norm(apart)) > limit:
            return f"velocity differs by {np.linalg.norm(apart):.2f} m/s, {limit:.2f} are chance"
        return ""

    def _lengths(self, t_ns: NDArray[np.int64]) -> Array:
        """Return the distances [K] from the first of some times."""
        own = np.array(self.t_ns, dtype=np.int64)
        t_s, at_s = (own - own[0]) / _NS, (t_ns - own[0]) / _NS
        at = np.column_stack([np.interp(at_s, t_s, self.T_world_body[:, i, 3]) for i in range(3)])
        return np.asarray(np.linalg.norm(at - at[0], axis=1))


def from_alignment(t_ns: tuple[int, ...], aligned: Alignment) -> Solution:
    """Return what metric motions gave."""
    return Solution(
        t_ns, aligned.T_world_body, aligned.velocities_m_s, aligned.gyro_bias_rad_s, aligned.accel_bias_m_s2,
        aligned.state_covariance(0), aligned.state_covariance(len(t_ns) - 1), 0.0, aligned.residual_ratio,
    )  # fmt: skip


def from_bundle(t_ns: tuple[int, ...], solved: BundleSolution) -> Solution:
    """Return what tracks gave."""
    return Solution(
        t_ns, solved.T_world_body, solved.velocity_world_m_s, solved.gyro_bias_rad_s[-1], solved.accel_bias_m_s2[-1],
        solved.first_covariance, solved.last_covariance, solved.scale_sigma, solved.inertial_ratio,
    )  # fmt: skip
