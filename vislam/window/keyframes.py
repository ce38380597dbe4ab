"""The keyframes that a window holds: their states and what belongs to each, oldest first."""

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import interpolate, invert
from vislam.core.messages import Array, KeyframePacket, Tracking
from vislam.window.equations import STATE, Ints
from vislam.window.posterior import pose

_EXTENT_M = 0.1  # of the held keyframes about their mean, root of the sum of squares: less has no scale to agree on


class Keyframes:
    """Owns the states [M, 21] and where they were linearised first."""

    def __init__(self) -> None:
        """Start empty."""
        self.ids: Ints = np.zeros(0, dtype=np.int64)
        self.t_ns: Ints = np.zeros(0, dtype=np.int64)
        self.X: Array = np.zeros((0, STATE))
        self.X_first: Array = np.zeros((0, STATE))  # what the prior was linearised at, where it holds a keyframe
        self.held: NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)
        self.applied_offset_s: Array = np.zeros(0)  # time offset that is already in the stamp
        self._gyro_rad_s: Array = np.zeros((0, 3))  # measured at each keyframe; zero at rest
        self._T_odom: list[Array | None] = []

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.ids)

    @property
    def newest(self) -> tuple[int, int] | None:
        """Return id and time in ns of the newest keyframe; None if there is none."""
        return (int(self.ids[-1]), int(self.t_ns[-1])) if len(self) > 0 else None

    @property
    def rate_rad_s(self) -> Array:
        """Return how fast the body turned [M, 3] at each keyframe, biases taken off."""
        return np.where(self._gyro_rad_s.any(axis=1, keepdims=True), self._gyro_rad_s - self.X[:, 15:18], 0.0)

    def linearised(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return first estimates [M, 21] and of which states [M] they are where equations are linearised.

        Before anything was marginalised that is none: they are then what the first prior speaks of, no more.
        """
        if not self.held.any():
            return self.X_first, self.held
        return at_first_scale(self.X, self.X_first, self.held), np.ones(len(self), dtype=np.bool_)

    def push(self, packet: KeyframePacket, x: Array, T_odom_body: Array | None, turned_before: bool) -> None:
        """Append a keyframe at state [21]; `turned_before`: its span has the turn rate of the first, too."""
        gyro = np.zeros(3)
        if packet.imu is not None and len(packet.imu.t_ns) > 0 and not packet.at_rest:
            gyro = packet.imu.gyro_rad_s[-1]
            if len(self) == 1 and turned_before:
                self._gyro_rad_s[0] = packet.imu.gyro_rad_s[0]
        self.ids = np.append(self.ids, packet.keyframe.id)
        self.t_ns = np.append(self.t_ns, packet.keyframe.t_ns)
        self.X, self.X_first = np.vstack([self.X, x]), np.vstack([self.X_first, x])
        self.held = np.append(self.held, False)
        self.applied_offset_s = np.append(self.applied_offset_s, packet.time_offset_s)
        self._gyro_rad_s = np.vstack([self._gyro_rad_s, gyro])
        self._T_odom.append(None if T_odom_body is None else T_odom_body.copy())

    def pop_front(self, held: NDArray[np.bool_], X_linear: Array) -> None:
        """Let the oldest go; of the others, the prior holds from now on those in `held` [M - 1].

        `X_linear` [M, 21] is where it was linearised.
        """
        self.X_first = X_linear[1:]
        self.held, self.X, self.ids, self.t_ns = held, self.X[1:], self.ids[1:], self.t_ns[1:]
        self.applied_offset_s, self._gyro_rad_s = self.applied_offset_s[1:], self._gyro_rad_s[1:]
        del self._T_odom[0]

    def odometry_to(self, T_odom_body: Array | None) -> Array | None:
        """Return the motion [4, 4] since the newest keyframe by odometry; None where either pose is unknown."""
        last = self._T_odom[-1]
        return None if T_odom_body is None or last is None else invert(last) @ T_odom_body

    def assumed_motion(self, packet: KeyframePacket, dt_s: float, has_velocity: bool) -> Array:
        """Return the motion [4, 4] to a keyframe `dt_s` after the newest one as vision or habit have it."""
        vo = packet.vo
        if vo.T_keyframe_body is not None and vo.has_scale and vo.tracking != Tracking.LOST:
            return vo.T_keyframe_body
        if has_velocity:
            motion = np.eye(4)
            motion[:3, 3] = self.X[-1, :9].reshape(3, 3).T @ self.X[-1, 12:15] * dt_s
            return motion
        if len(self) < 2:
            return np.eye(4)
        before_s = float(self.t_ns[-1] - self.t_ns[-2]) * 1e-9
        last = invert(pose(self.X[-2])) @ pose(self.X[-1])
        return interpolate(np.eye(4), last, dt_s / before_s)


def at_first_scale(X: Array, X_first: Array, held: NDArray[np.bool_]) -> Array:
    """Return where to linearise states [M, 21]: those held where they were first, others as if they were with them.

    So first estimates agree on scale, place and attitude, whether or not the motion shows them.

    In uniform motion, "everything larger" is a direction that nothing measures: positions from each other and
    velocities, times one factor. A linearised inertial link finds that direction free only where the states that it is
    linearised at move uniformly themselves. States that the marginal prior holds are linearised where they were first;
    the estimate of scale wanders within its sigma, so newer states are at another scale, the step between the two looks
    like an acceleration, and acceleration shows scale. The newer ones are therefore linearised where they would be had
    they been estimated together with the held ones: at their scale, place and attitude (tilt wanders too, against the
    bias of force). Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
    estimators", IJRR 2010; for scale under constant acceleration: Wu et al., "VINS on wheels", ICRA 2017. At rest the
    same goes for tilt and the bias of force, which are one there.

    It is done always, not only in uniform motion: the step is there just when a straight way ends in its first turn and
    the estimates move most, and where motion does show scale both agree anyway.
    """
    out = np.where(held[:, None], X_first, X)
    others, of_prior = np.flatnonzero(~held), np.flatnonzero(held)
    if len(others) == 0:
        return out
    k = of_prior[-1]
    turn = X_first[k, :9].reshape(3, 3) @ X[k, :9].reshape(3, 3).T
    now, first = X[of_prior, 9:12] @ turn.T, X_first[of_prior, 9:12]
    away, away_first = now - now.mean(axis=0), first - first.mean(axis=0)
    square = float(np.sum(away * away))
    factor = float(np.sum(away * away_first)) / square if square > _EXTENT_M**2 else 1.0
    out[others, :9] = (turn @ X[others, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    out[others, 9:12] = first[-1] + factor * (X[others, 9:12] @ turn.T - now[-1])
    out[others, 12:15] = factor * X[others, 12:15] @ turn.T
    return out
