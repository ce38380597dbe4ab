"""The pose that is published: it follows the estimate and takes corrections in as the body moves, not as jumps.

An estimator corrects itself whenever a measurement comes in: the pose of one instant is suddenly another one. What
steers by it takes that for motion. Here the published pose goes on as the body does, and what is still to be corrected
is let go gradually: with the way and the turn that the body makes, and slowly in time. So at rest next to nothing
moves, and while it moves a correction looks like an odometry that errs by some percent for a while. A correction
that is too large for that comes at once, for it is another belief about the place, not a better one. So does the first
answer to where the place is, by `clear`: nothing was known that the pose could go on from.

Position and rotation are kept apart: a turn of the frame moves the body where it turns it, not at a lever arm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.config import Config, PublishConfig
from vislam.core.geometry import so3_exp, so3_log, transform
from vislam.core.messages import Array

_WAY_M = 1.0  # the way over which a correction fades by e, where that is faster
_REACH_M = 0.3  # how far a turn counts as way: the length of an arm, or of a cart
_FADE_S = 0.1  # a correction fades no faster: corrections of single frames contradict each other
_CREEP_S = 10.0  # and at rest a correction fades in so long
_GYRO_SHARE = 0.5  # ... or by so much of what the gyroscope itself may err, where that is faster
_AT_ONCE_M = 1.0  # a larger correction is another belief about the place: it comes at once
_AT_ONCE_DEG = 5.0
_NS = 1_000_000_000


class Continuity:
    """Owns what a published pose is still to be corrected by. One per frame that is published.

    Attributes:
        owed_m: [3] published less estimated position, in axes of the frame.
        owed_rad: [3] rotation vector, in axes of the frame: published = Exp(owed) estimated.
    """

    def __init__(self, config: PublishConfig) -> None:
        """Start with nothing owed."""
        self._config = config
        self.clear()

    def clear(self) -> None:
        """Forget what is owed: the next pose is published as it is estimated."""
        self.owed_m, self.owed_rad = np.zeros(3), np.zeros(3)
        self._t_ns: int | None = None
        self._T: Array = np.eye(4)

    def follow(self, t_ns: int, T_before: Array, T_after: Array, rate_sigma_rad_s: float = 0.0) -> Array:
        """Return the pose [4, 4] to publish at a time, which does not go back.

        Args:
            t_ns: of the estimate.
            T_before: [4, 4] the estimate as it was before what came in with this call, carried on to `t_ns`.
            T_after: [4, 4] the estimate of the same instant now.
            rate_sigma_rad_s: how well the body's rate of turn is known: the gyroscope's drift is unseen.
                Infinite: vision alone measures it, which errs with the turn.
        """
        if self._t_ns is not None:
            self._let_go(max(t_ns - self._t_ns, 0) / _NS, T_before, rate_sigma_rad_s)
            self._owe(T_before, T_after)
        self._t_ns, self._T = t_ns, T_after
        return transform(so3_exp(self.owed_rad) @ T_after[:3, :3], T_after[:3, 3] + self.owed_m)

    def _let_go(self, dt_s: float, T: Array, rate_sigma_rad_s: float) -> None:
        """Pay back for the time and the motion since the last call, which brought the body to T [4, 4]."""
        config = self._config
        turn_rad = float(np.linalg.norm(so3_log(np.ascontiguousarray(self._T[:3, :3].T @ T[:3, :3]))))
        way_m = float(np.linalg.norm(T[:3, 3] - self._T[:3, 3])) + _REACH_M * turn_rad
        owed_m = float(np.linalg.norm(self.owed_m))
        moving_m = min(max(config.way_share, owed_m / _WAY_M) * way_m, owed_m * dt_s / _FADE_S)
        resting_m = min(config.creep_m_s, owed_m / _CREEP_S) * dt_s
        self.owed_m = self.owed_m * _left(owed_m, moving_m + resting_m)
        owed_rad = float(np.linalg.norm(self.owed_rad))
        if np.isfinite(rate_sigma_rad_s):
            turning_rad = _GYRO_SHARE * rate_sigma_rad_s * dt_s
        else:
            turning_rad = config.turn_share * turn_rad
        paid_rad = min(max(owed_rad * dt_s / config.turn_s, turning_rad), owed_rad * dt_s / _FADE_S)
        self.owed_rad = self.owed_rad * _left(owed_rad, paid_rad)

    def _owe(self, T_before: Array, T_after: Array) -> None:
        """Take in that the estimate of one instant has changed."""
        config = self._config
        owed_m = self.owed_m + T_before[:3, 3] - T_after[:3, 3]
        shown = so3_exp(self.owed_rad) @ T_before[:3, :3]
        owed_rad = so3_log(np.ascontiguousarray(shown @ T_after[:3, :3].T))
        far = np.linalg.norm(owed_m) > _AT_ONCE_M or np.linalg.norm(owed_rad) > np.deg2rad(_AT_ONCE_DEG)
        if far or not config.enabled:
            owed_m, owed_rad = np.zeros(3), np.zeros(3)
        self.owed_m, self.owed_rad = owed_m, owed_rad


def in_odom(config: Config) -> Continuity:
    """Return what makes `odom` continuous, where it is wanted so."""
    wanted = config.publish.enabled and config.ekf.odom == "continuous"
    return Continuity(replace(config.publish, enabled=wanted))


def _left(owed: float, paid: float) -> float:
    """Return the share of a debt that is left."""
    return max(1.0 - paid / owed, 0.0) if owed > 0.0 else 1.0
