"""The motion behind poses that vision alone measures: what is published without an IMU steps as the body does.

Poses of single frames scatter by millimetres, which looks like 0.2 m/s at 30 Hz. A body goes on at its velocity but for
white acceleration (Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation", 2001, section 6.2.2),
whose density is learned from the innovations. Rotation and position are kept apart: their errors in one frame depend
on each other, but a hand turns far less steadily than it moves. Of a constant velocity, a constant acceleration and one
that decays, the first was the likeliest on hand-held recordings.
"""

import numpy as np

from vislam.config import GraphConfig, PublishConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import so3_exp, so3_log, transform
from vislam.core.messages import Array, NavState, VoMeasurement
from vislam.pipeline.coasting import LEAST_DENSITY, jerked_m
from vislam.pipeline.steps import Estimate

_NS = 1_000_000_000
_BEGINS = (1.0, 1.0)  # sigma of the first rate in rad/s and velocity in m/s: a walk, a turn by hand
_TAILS = 6.0  # degrees of freedom of Student's t, as which vision errs: its outliers lead away less
_FADES_S = 0.1  # what frames show of those before them comes as slowly, or it would be a step
_LEARNS_S = 3.0  # as quickly as a motion becomes wilder
_MOST_MISFIT = 4.0  # of a normalised squared innovation: one frame shows little
_REACH_M = 0.3  # what is turned is as long: a body that is jerked by a length turns by length over reach
_UNKNOWN_M2 = 1e6
_CONTRADICTION = chi_square_limit(0.9999, 3)


class _Half:
    """Owns how well a rotation or a position [3] and its rate are known: the covariance [6, 6], and the density."""

    def __init__(self, density: float, rate_sigma: float, floor: float) -> None:
        self.density, self._least, self._rate, self.floor = density, density, rate_sigma, np.eye(3) * floor**2
        self.begin()

    def begin(self) -> None:
        """Know the value exactly and of the rate what it may be."""
        self.covariance = np.diag(np.repeat([0.0, self._rate**2], 3))
        self._before, self._predicted, self._unlearned_s = self.covariance, self.covariance, 0.0

    def predict(self, dt_s: float, turn: Array) -> None:
        """Go on for a time, `turn` [3, 3] moving the error of the value."""
        F = np.eye(6)
        F[:3, :3], F[:3, 3:] = turn, np.eye(3) * dt_s
        grown = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]]) * self.density
        self._before, self._unlearned_s = self.covariance @ F.T, self._unlearned_s + dt_s
        self._predicted = self.covariance = F @ self._before + np.kron(grown, np.eye(3))

    def contradicts(self, off: Array, noise: Array, jerked: float) -> bool:
        """Return whether what was measured is farther off, by [3], than a body can be thrown."""
        spread = self.covariance[:3, :3] + noise + self.floor
        beyond = off * max(1.0 - jerked / max(float(np.linalg.norm(off)), 1e-12), 0.0)
        return bool(beyond @ np.linalg.solve(spread, beyond) > _CONTRADICTION)

    def revised(self, change: Array) -> Array:
        """Return by how much [3] a change [6] of now changes the value before `predict` (Rauch et al., 1965)."""
        return np.asarray(self._before[:3] @ np.linalg.solve(self._predicted, change))

    def correct(self, off: Array, noise: Array) -> Array:
        """Take in a measurement, off by [3] with covariance [3, 3]; return by how much value and rate change [6]."""
        noise = noise + self.floor
        spread = self.covariance[:3, :3] + noise
        misfit = float(off @ np.linalg.solve(spread, off))
        spread = spread + noise * max((misfit - 3.0) / (_TAILS + 3.0), 0.0)
        gain = np.linalg.solve(spread, self.covariance[:3]).T
        left = self.covariance - gain @ spread @ gain.T
        self.covariance = 0.5 * (left + left.T)
        share, self._unlearned_s = 1.0 - np.exp(-self._unlearned_s / _LEARNS_S), 0.0
        learned = self.density * float(np.exp(share * (min(misfit / 3.0, _MOST_MISFIT) - 1.0)))
        self.density = max(learned, self._least)
        return np.asarray(gain @ off)


class SmoothMotion:
    """Owns the estimate of the motion in `odom`, which follows the chain of visual odometry without its scatter."""

    def __init__(self, config: GraphConfig, publish: PublishConfig) -> None:
        """Start before the first frame, with what no camera and calibration is better than, and what is wanted."""
        self._is_wanted = publish.enabled
        self._turning = _Half(float(LEAST_DENSITY[0]), _BEGINS[0], float(np.deg2rad(config.vo_floor_deg)))
        self._moving = _Half(float(LEAST_DENSITY[1]), _BEGINS[1], config.vo_floor_m)
        self._t_ns: int | None = None
        self._measured_ns, self._dt_s = 0, 0.0  # the last frame whose position was, and between the last two
        self._is_placed = True  # else only turns are known: where the body is then is a first answer
        self._T = np.eye(4)
        self._rate, self._velocity = np.zeros(3), np.zeros(3)  # rad/s in axes of the body, m/s in axes of odom
        self._off_rad, self._off_m = np.zeros(3), np.zeros(3)  # what is shown less what is estimated, axes of odom

    def follow(self, vo: VoMeasurement, T_vo_body: Array, is_torn: bool) -> Estimate:
        """Take a frame; return where the body is, how it came there since the frame before, and its velocity.

        Args:
            vo: what vision measured; where it was lost, the body goes on.
            T_vo_body: [4, 4] where the chain of keyframes has it by that, and where it is if nothing smooth is wanted.
            is_torn: whether the time since the last frame is not known.
        """
        smooth = self._followed(vo, T_vo_body, is_torn)
        return smooth if self._is_wanted else Estimate(T_vo_body, T_vo_body, np.inf, smooth.moving)

    def _followed(self, vo: VoMeasurement, T_vo_body: Array, is_torn: bool) -> Estimate:
        if self._t_ns is None or is_torn:
            self._begin(vo.t_ns, T_vo_body)
            return self._estimate()
        self._predict((vo.t_ns - self._t_ns) / _NS)
        was_measured, self._t_ns = self._measured_ns == self._t_ns, vo.t_ns
        if vo.T_keyframe_body is None:
            return self._estimate()
        covariance = vo.covariance if vo.has_scale else _of_turn_alone(vo.covariance)
        if self._is_elsewhere(T_vo_body, covariance):
            came = self._shown()
            self._begin(vo.t_ns, T_vo_body)
            return Estimate(came, self._T, np.inf, self._state())
        self._correct(T_vo_body, covariance)
        came, left = self._shown(), max(1.0 - self._dt_s / _FADES_S, 0.0) if was_measured else 0.0
        self._off_rad, self._off_m = left * self._off_rad, left * self._off_m
        was_placed, self._is_placed = self._is_placed, vo.has_scale
        if vo.has_scale:
            self._measured_ns = vo.t_ns
        if was_measured or not was_placed:
            return self._estimate()
        return Estimate(came, self._T, np.inf, self._state())  # after a loss it is more than scatter

    def _predict(self, dt_s: float) -> None:
        """Go on at the velocity."""
        self._dt_s = dt_s
        turn = so3_exp(self._rate * dt_s)
        self._turning.predict(dt_s, turn.T)
        self._moving.predict(dt_s, np.eye(3))
        self._T = transform(self._T[:3, :3] @ turn, self._T[:3, 3] + self._velocity * dt_s)

    def _correct(self, T_vo_body: Array, covariance: Array) -> None:
        """Take in where vision has the body, [4, 4] with covariance [6, 6] on the body side.

        What it shows of the frame before is no motion: what is shown goes on from where that is known to have been now.
        """
        R, R_vo = self._T[:3, :3], T_vo_body[:3, :3]
        off_rad, off_m = self._off(T_vo_body)
        moved = self._moving.correct(off_m, R_vo @ covariance[3:, 3:] @ R_vo.T)
        mistaken = R_vo.T @ (off_m - moved[:3])
        turned = self._turning.correct(*self._without_shift(off_rad, mistaken, covariance, R_vo))
        R_last = R @ so3_exp(self._rate * self._dt_s).T
        self._off_rad = self._off_rad - R_last @ self._turning.revised(turned)
        self._off_m = self._off_m - self._moving.revised(moved)
        self._T = transform(R @ so3_exp(turned[:3]), self._T[:3, 3] + moved[:3])
        self._rate, self._velocity = self._rate + turned[3:], self._velocity + moved[3:]

    def _begin(self, t_ns: int, T_odom_body: Array) -> None:
        """Be at a pose [4, 4], at an unknown velocity; how wild motions are is kept."""
        self._t_ns, self._measured_ns, self._T = t_ns, t_ns, T_odom_body.copy()
        self._rate, self._velocity = np.zeros(3), np.zeros(3)
        self._off_rad, self._off_m = np.zeros(3), np.zeros(3)
        self._turning.begin()
        self._moving.begin()

    def _off(self, T_vo_body: Array) -> tuple[Array, Array]:
        """Return by which turn [3], in axes of the body, and by which way [3], in axes of odom, a pose is off."""
        return so3_log(np.ascontiguousarray(self._T[:3, :3].T @ T_vo_body[:3, :3])), T_vo_body[:3, 3] - self._T[:3, 3]

    def _is_elsewhere(self, T_vo_body: Array, covariance: Array) -> bool:
        """Return whether the front end has jumped: no body moves so."""
        assert self._t_ns is not None
        jerked, R_vo = jerked_m((self._t_ns - self._measured_ns) / _NS), T_vo_body[:3, :3]
        off_rad, off_m = self._off(T_vo_body)
        return self._moving.contradicts(off_m, R_vo @ covariance[3:, 3:] @ R_vo.T, jerked) or (
            self._turning.contradicts(off_rad, covariance[:3, :3], jerked / _REACH_M)
        )

    def _without_shift(self, off: Array, mistaken_m: Array, covariance: Array, R_vo: Array) -> tuple[Array, Array]:
        """Return a measured turn [3] and its noise [3, 3] without what its position shows of the frame's error.

        Of the position `mistaken_m` [3], in axes of the body, turned out to be error, and a frame that takes a turn for
        a shift errs in both.
        """
        share = np.linalg.solve(covariance[3:, 3:] + self._moving.floor, covariance[3:, :3]).T
        unsure = R_vo.T @ self._moving.covariance[:3, :3] @ R_vo
        noise = covariance[:3, :3] - share @ covariance[3:, :3] + share @ unsure @ share.T
        return off - share @ mistaken_m, noise

    def _shown(self) -> Array:
        return transform(so3_exp(self._off_rad) @ self._T[:3, :3], self._T[:3, 3] + self._off_m)

    def _estimate(self) -> Estimate:
        """Return where the body is shown, which is no correction of where it was."""
        T = self._shown()
        return Estimate(T, T, np.inf, self._state())

    def _state(self) -> NavState:
        """Return what is shown, and the velocity; the covariance is NaN where nothing is estimated: of biases."""
        assert self._t_ns is not None
        T, covariance = self._shown(), np.full((15, 15), np.nan)
        off_rad = T[:3, :3].T @ self._off_rad
        covariance[:9, :9] = 0.0
        covariance[:3, :3] = self._turning.covariance[:3, :3] + np.outer(off_rad, off_rad)
        covariance[3:9, 3:9] = self._moving.covariance
        covariance[3:6, 3:6] += np.outer(self._off_m, self._off_m)
        unknown = np.full(3, np.nan)
        return NavState(self._t_ns, T, self._velocity, unknown, unknown, covariance)


def _of_turn_alone(covariance: Array) -> Array:
    """Return the covariance [6, 6] of a motion of whose length nothing is known."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = covariance[:3, :3], np.eye(3) * _UNKNOWN_M2
    return out
