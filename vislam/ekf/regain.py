"""A sensor of places that the gate refuses although its readings agree: when the filter believes it again.

What a filter does not model (a gyro worse than its data sheet, a minute without sight) makes it surer than it is, and
a gate then refuses good readings for ever. Autopilots take the newest after a time; here the refused readings have to
earn it. One error of the filter must explain them all to within their own noise: of place, of velocity where there is
one, and without sight of acceleration too, which is tilt. It must be one that the filter can have made since it last
believed the sensor. And no other sensor of places, believed meanwhile, may contradict.

Then the estimate moves by that error, clones and points with the body: of an error common to all, vision knows nothing.
The covariance grows by how surely the readings show it. A gate opened wide instead, with a usual update, would turn the
covariance of an invariant filter about a far origin, and pass the move for knowledge of the heading.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from vislam.core.chi_square import chi_square_limit
from vislam.core.messages import Array

_LEAST, _LEAST_NS = 5, 3_000_000_000  # refused readings that agree, and the time that they cover at least
_APART_NS = 200_000_000  # nearer ones are not kept: what they share in their errors would count twice
_KEPT = 24
_AGREE = 0.999  # that refused readings of a good sensor pass for agreeing
_DRIFT = 0.02  # of the way: twice what visual-inertial odometry drifts by
_ACCEL_M_S2 = 0.5  # that a filter without sight may err by: three degrees of tilt
_TILT_RAD = math.radians(10.0)  # at most
_SLACK_M = 0.5
_BLIND_NS = 1_000_000_000  # without sight: shorter pauses are none
_CONTRADICTS = 4.0  # squared sigmas of one reading of another sensor
_FREE = 1e-6  # of the largest: a direction of place that the readings do not see
_GRAVITY_M_S2 = 9.8


class Refused(NamedTuple):
    """A reading that the gate refused, whitened: `residual ~ H @ error of place + noise of 1`."""

    t_ns: int
    H: Array  # [m, 3]
    residual: Array  # [m]


class Trust(NamedTuple):
    """What a filter remembers of a sensor."""

    accepted_ns: int  # when it last believed it, or first heard of it
    blind_ns: int  # how long it had been without sight until then, in all
    H: Array  # [m, 3] of the last reading that it believed, whitened
    refused: tuple[Refused, ...] = ()  # since then, newest last


class Regain(NamedTuple):
    """By what an estimate is off, as readings of a sensor of places say it, and how surely."""

    place_m: Array  # [3] true minus estimated
    velocity_m_s: Array  # [3]; zero where it was not asked
    covariance: Array  # [6, 6] of both
    tilt_rad: float  # sigma; where there was no sight
    afresh: bool  # what places and velocity imply of the rest is forgotten: it was wrong by as much as they were
    text: str = ""


@dataclass(frozen=True, slots=True)
class Watch:
    """What a filter remembers of all sensors, and of how long it had no sight; part of its state."""

    start_ns: int = 0  # of the filter: of a sensor without a reading yet, drift counts from there
    seen_ns: int = 0
    blind_ns: int = 0
    sensors: Mapping[str, Trust] = field(default_factory=dict)

    def blind_until(self, t_ns: int) -> int:
        """Return for how many ns in all there was nothing to see by."""
        pause_ns = t_ns - self.seen_ns
        return self.blind_ns + (pause_ns if pause_ns > _BLIND_NS else 0)

    def seen(self, t_ns: int) -> Watch:
        """Return it after something that bounds drift: vision, rest, wheels."""
        return replace(self, seen_ns=max(t_ns, self.seen_ns), blind_ns=self.blind_until(t_ns))

    def begun(self, name: str, t_ns: int) -> Watch:
        """Return it after own variables were set."""
        return replace(self, sensors={**self.sensors, name: Trust(t_ns, self.blind_until(t_ns), np.zeros((0, 3)))})

    def accepted(self, name: str, t_ns: int, H: Array) -> Watch:
        """Return it after a reading that passed the gate, whitened H [m, 15]."""
        watch = self.seen(t_ns) if _bounds_drift(H) else self
        trust = Trust(t_ns, watch.blind_until(t_ns), H[:, 3:6])
        return replace(watch, sensors={**watch.sensors, name: trust})

    def refused(self, name: str, reading: Refused) -> Watch:
        """Return it after a reading that did not."""
        t_ns = reading.t_ns
        trust = self.sensors.get(name) or Trust(self.start_ns, 0, np.zeros((0, 3)))
        if trust.refused and t_ns - trust.refused[-1].t_ns < _APART_NS:
            return self
        trust = trust._replace(refused=(*trust.refused, reading)[-_KEPT:])
        return replace(self, sensors={**self.sensors, name: trust})

    def regain(self, name: str, t_ns: int, speed_m_s: float, farthest_m: float) -> Regain | None:
        """Return how to believe a sensor again whose last reading, of now, was refused; None: not."""
        trust = self.sensors[name]
        some = _enough(trust.refused)
        if farthest_m <= 0.0 or not some or some[-1].t_ns != t_ns:
            return None
        since_s, blind_s = (t_ns - trust.accepted_ns) * 1e-9, (self.blind_until(t_ns) - trust.blind_ns) * 1e-9
        # with sight the simplest error that explains them; without any, velocity and tilt are unknown as well
        found = next((f for n in ((2,) if blind_s else (0, 1)) if (f := _common_error(some, n)) is not None), None)
        if found is None:
            return None
        drifted_m = _SLACK_M + _DRIFT * speed_m_s * since_s + 0.5 * _ACCEL_M_S2 * blind_s**2
        distance_m = float(np.linalg.norm(found.place_m))
        if distance_m > min(drifted_m, farthest_m) or self._contradicted(name, some[0].t_ns, found.place_m):
            return None
        text = (
            f"believed again: {len(some)} readings over {(t_ns - some[0].t_ns) * 1e-9:.1f} s agree that the place is "
            f"off by {distance_m:.2f} m, {since_s:.0f} s after the last that was believed"
        )
        return found._replace(text=text)

    def _contradicted(self, name: str, since_ns: int, off_m: Array) -> bool:
        others = (trust for other, trust in self.sensors.items() if other != name and trust.accepted_ns >= since_ns)
        return any(float(np.sum((trust.H @ off_m) ** 2)) > _CONTRADICTS for trust in others)


def grown(P: Array, regain: Regain, body: Array, places: Sequence[int], up: Array) -> Array:
    """Return the covariance P [n, n] of a filter that believes a sensor again.

    `body` [15, 15] takes the error of `NavState` to the first 15 of the filter's, `places` are where the three numbers
    of each place begin, of the body first, and `up` [3] is the vertical in the body's axes.
    """
    P, J, mine = P.copy(), np.zeros((len(P), 6)), np.zeros(len(P), dtype=np.bool_)
    J[6:9, 3:], mine[6:9] = np.eye(3), True
    for at in places:
        J[at : at + 3, :3], mine[at : at + 3] = np.eye(3), True
    if regain.afresh:
        P[np.ix_(mine, ~mine)] = P[np.ix_(~mine, mine)] = 0.0
    tilted = regain.tilt_rad * body[:, :3] @ (np.eye(3) - np.outer(up, up))
    P[:15, :15] += tilted @ tilted.T
    return np.asarray(P + J @ regain.covariance @ J.T)


def _bounds_drift(H: Array) -> bool:
    """Whether a reading [m, 15] shows velocity along two axes at least."""
    return bool(H.shape[0] >= 2 and np.linalg.matrix_rank(H[:, 6:9]) >= 2)


def _enough(refused: tuple[Refused, ...]) -> tuple[Refused, ...]:
    """Return the newest that are just enough, none where there are fewer."""
    for count in range(_LEAST, len(refused) + 1):
        if refused[-1].t_ns - refused[-count].t_ns >= _LEAST_NS:
            return refused[-count:]
    return ()


def _common_error(some: tuple[Refused, ...], order: int) -> Regain | None:
    """Return the error of place, with `order` 1 of velocity and with 2 of acceleration too, that explains all readings.

    None where none does, and where they are too few to contradict any.
    """
    ago_s = np.array([(one.t_ns - some[-1].t_ns) * 1e-9 for one in some])
    powers = [ago_s**n / math.factorial(n) for n in range(order + 1)]
    A = np.vstack([np.hstack([power[i] * one.H for power in powers]) for i, one in enumerate(some)])
    b = np.concatenate([one.residual for one in some])
    eigenvalues, axes = np.linalg.eigh(A[:, :3].T @ A[:, :3])
    seen = axes[:, eigenvalues > _FREE * eigenvalues[-1]]
    count = seen.shape[1]
    free = len(b) - (order + 1) * count
    if free < count:
        return None
    A = np.hstack([A[:, 3 * n : 3 * n + 3] @ seen for n in range(order + 1)])
    try:
        covariance = np.linalg.inv(A.T @ A)
    except np.linalg.LinAlgError:
        return None
    found = covariance @ A.T @ b
    if not float(np.sum((b - A @ found) ** 2)) <= chi_square_limit(_AGREE, free):
        return None
    both, tilt_rad = min(order + 1, 2) * count, 0.0
    off, spread = np.zeros((2, 3)), np.zeros((6, 6))
    off[: order + 1] = (found[:both].reshape(-1, count) @ seen.T)[:2]
    basis = np.kron(np.eye(min(order + 1, 2)), seen)
    spread[: len(basis), : len(basis)] = basis @ covariance[:both, :both] @ basis.T
    if order == 2:
        accel = float(found[both:] @ found[both:]) + float(np.trace(covariance[both:, both:])) / count
        tilt_rad = min(math.sqrt(accel) / _GRAVITY_M_S2, _TILT_RAD)
    return Regain(off[0], off[1], spread, tilt_rad, order == 2)
