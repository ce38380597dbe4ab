"""Where a body goes while nothing measures it: on at its velocity, as uncertain as its motion before was changeable.

Its turn ebbs away: who turns fast is about to stop (Singer, "Estimating Optimal Tracking Filter Performance for Manned
Maneuvering Targets", 1970, of rates in place of accelerations). Without inertial data a loss of sight is bridged by
habit: white noise of acceleration turns a twist into a spread that grows with the cube of time (Bar-Shalom et al.,
"Estimation with Applications to Tracking and Navigation", 2001, section 6.2.2). How strong it is shows each time how
far a body was from where it would have coasted to.
"""

from bisect import bisect_right

import numpy as np

from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import Array

_NS = 1_000_000_000
_LAGS_S = 0.1 * 2.0 ** np.arange(6)  # after which it is asked how far coasting would have led
_TWIST_S = 0.09  # over which a velocity is taken, at least: shorter, noise of poses is most of it
_RECENT_S = 3.0  # a motion that has become wilder is wilder now
# density of acceleration that anything that carries a camera may begin with, rad^2/s^3 and m^2/s^3: after a second 28
# degrees and 18 cm. A body that has only stood or gone straight has not shown how it turns
LEAST_DENSITY = np.array([0.7, 0.1])
# time constant of a rate of turn: after 0.2 s hands, flights and carts have turned 57 to 94 % of what it would come to,
# after 1.6 s -7 to 52 %; by this one they are 18 to 43 % nearer then than by a constant rate
_TURN_S = 0.8
_TURN_SHARE = 0.3  # of what the rate comes to, that a turn is off by about each axis: fast ones by more than usual ones
_MOST_M_S2 = 25.0  # that a carried camera has for a tenth of a second; impacts have more, for less
_TAILS = 1.5  # times the sigma: motions change by fits and starts. Measured on nine of flights, hands and carts


def jerked_m(dt_s: float) -> float:
    """Return how far off where it coasts to a body may be jerked within a time.

    Its velocity is that in the middle of `_TWIST_S`.
    """
    return 0.5 * _MOST_M_S2 * dt_s * (dt_s + _TWIST_S)


class Coasting:
    """Owns the last seconds of a body's poses, and what they say of its accelerations."""

    def __init__(self) -> None:
        """Start before the first pose."""
        self._t_ns: list[int] = []
        self._poses: list[Array] = []
        self._twists: list[Array] = []  # of the body, per second
        self._t_twist_ns: int | None = None  # when the last of them was measured; None: never
        self._sums, self._counts = np.zeros((len(_LAGS_S), 2)), np.zeros(len(_LAGS_S))
        self._recent = np.zeros((len(_LAGS_S), 2))

    @property
    def newest_ns(self) -> int | None:
        """When the body was last where it is known to be; None: never."""
        return self._t_ns[-1] if self._t_ns else None

    def follow(self, t_ns: int, T_vo_body: Array, sigma_m: float = 0.0) -> bool:
        """Take a pose [4, 4] that was measured; one known worse than a jerk takes a body is left out."""
        if self._t_ns and (t_ns <= self._t_ns[-1] or sigma_m > self.jerked_m(t_ns)):
            return False
        self._learn(t_ns, T_vo_body)
        twist = np.zeros(6)
        if self._t_ns:
            k = max(self._at_or_before(t_ns - round(_TWIST_S * _NS)), 0)
            twist = se3_log(invert(self._poses[k]) @ T_vo_body) / ((t_ns - self._t_ns[k]) / _NS)
            self._t_twist_ns = t_ns
        self._t_ns.append(t_ns)
        self._poses.append(T_vo_body)
        self._twists.append(twist)
        old = self._at_or_before(t_ns - round(2.0 * _LAGS_S[-1] * _NS))
        if old > 0:
            del self._t_ns[:old], self._poses[:old], self._twists[:old]
        return True

    def restart(self) -> None:
        """Forget where the body was, not how it moves: poses from now on have nothing to do with those before."""
        self._t_ns.clear()
        self._poses.clear()
        self._twists.clear()
        self._t_twist_ns = None

    def go_on(self, t_ns: int, T_vo_body: Array) -> None:
        """Begin again at a pose [4, 4] that was not measured, at the velocity that was: poses follow from there."""
        twists, t_twist_ns = self._twists[-1:], self._t_twist_ns
        self.restart()
        if t_twist_ns is not None:
            self._t_ns, self._poses, self._twists, self._t_twist_ns = [t_ns], [T_vo_body], twists, t_twist_ns

    def jerked_m(self, t_ns: int) -> float:
        """Return how far off where it coasts to a body may be jerked while it is seen, since the last pose."""
        return jerked_m((t_ns - self._t_ns[-1]) / _NS)

    def ahead(self, t_ns: int) -> tuple[Array, Array] | None:
        """Return the motion [4, 4] since the last pose and its covariance [6, 6]; None: there is no habit."""
        if self._t_twist_ns is None:
            return None
        dt_s, spread_s = (t_ns - self._t_ns[-1]) / _NS, (t_ns - self._t_twist_ns) / _NS
        variance = np.maximum(self._density(spread_s), LEAST_DENSITY) * (_TAILS**2 * spread_s**3 / 3.0)
        turn_rad = float(np.linalg.norm(self._twists[-1][:3])) * spread_s
        variance[0] = max(variance[0], (_TURN_SHARE * turn_rad) ** 2)
        return _moved(self._twists[-1], spread_s - dt_s, spread_s), np.diag(np.repeat(variance, 3))

    def _learn(self, t_ns: int, T_vo_body: Array) -> None:
        for n, lag_s in enumerate(_LAGS_S):
            k = self._at_or_before(t_ns - round(lag_s * _NS))
            if k < 1:  # before the second pose there was no velocity
                break
            dt_s = (t_ns - self._t_ns[k]) / _NS
            off = se3_log(invert(self._poses[k] @ _moved(self._twists[k], 0.0, dt_s)) @ T_vo_body)
            density = np.array([off[:3] @ off[:3], off[3:] @ off[3:]]) / dt_s**3  # of three axes, each a third
            self._sums[n] += density
            self._counts[n] += 1
            share = np.exp(-(t_ns - self._t_ns[-1]) / _NS / _RECENT_S)
            self._recent[n] = share * self._recent[n] + (1.0 - share) * density

    def _density(self, dt_s: float) -> Array:
        """Return the density of acceleration [2], as the shortest lag that is as long shows it, or the longest seen."""
        seen = int(np.count_nonzero(self._counts))
        if not seen:
            return np.zeros(2)
        n = min(int(np.searchsorted(_LAGS_S, dt_s)), seen - 1)
        return np.asarray(np.maximum(self._sums[n] / self._counts[n], self._recent[n]))

    def _at_or_before(self, t_ns: int) -> int:
        """Return which pose is the last one at or before a time, -1: none."""
        return bisect_right(self._t_ns, t_ns) - 1


def _moved(twist: Array, from_s: float, to_s: float) -> Array:
    """Return the motion [4, 4] between two times after a twist [6], per second, was measured."""
    turned_s = _TURN_S * (np.exp(-from_s / _TURN_S) - np.exp(-to_s / _TURN_S))
    return se3_exp(twist * np.repeat([turned_s, to_s - from_s], 3))
