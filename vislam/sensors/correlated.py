"""An error that neighbouring readings share: any sensor, with a state for it (Gauss-Markov, one for each source)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vislam.core.errors import UsageError
from vislam.core.messages import Array
from vislam.core.readings import Reading
from vislam.sensors.body import NUDGE, BodyState
from vislam.sensors.linear import derived, linearised
from vislam.sensors.measuring_frame import is_heading_known, thinned_pairs
from vislam.sensors.sensor import USER_ERRORS, Begun, Configured, Sensor, Variable

_AS_THE_SENSOR = (
    "columns", "sigma_columns", "touches", "sees_motion_only", "gives_fixes", "slips", "sources", "gate_probability",
    "regain_m", "from_magnetometer", "channel", "check",
)  # fmt: skip


class Correlated(Configured):
    """A sensor whose residuals contain, beside its noise, an error that forgets all but 1/e within `correlation_s`."""

    def __init__(self, sensor: Sensor, sigmas: Sequence[float], correlation_s: float) -> None:
        """Give a sensor an error of standard deviations [m] in the units of its residual, or [1] for all of it.

        Raises UsageError for another number of sigmas than the residual has, for a time or all sigmas that are 0, and
        where the sensor cannot say its noise.
        """
        self.sensor = sensor
        vars(self).update({name: getattr(sensor, name, ()) for name in _AS_THE_SENSOR})
        self._sigmas = _one_each(sensor, sigmas, correlation_s)
        self._erring = np.flatnonzero(self._sigmas)  # numbers of the residual that have a state
        self._first = len(sensor.variables)
        self.variables = sensor.variables + tuple(
            Variable(f"shared_{source}_{n}", float(self._sigmas[n]), of_machine=False, correlation_s=correlation_s)
            for source in self.sources
            for n in self._erring
        )

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return that of the sensor less the error of its source [m]."""
        out = np.array(self.sensor.residual(values, body, own[: self._first]), dtype=np.float64)
        out[self._erring] -= own[self._of(values)]
        return out

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [m, 15] and H_own [m, V]."""
        inner = own[: self._first]
        given = self.sensor.jacobians(values, body, inner)
        H, H_inner = derived(self.sensor, values, body, inner) if given is None else given
        shared = np.zeros((len(H), len(own) - self._first))
        shared[self._erring, np.arange(self._of(values).start, self._of(values).stop) - self._first] = 1.0
        return H, np.hstack([H_inner, shared])

    def noise(self, values: Array) -> Array:
        """Return that of the sensor [m, m]: what readings do not share."""
        return self.sensor.noise(values)

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the values [C] of the sensor, moved so that its residual has the error, as far as they show in it."""
        if not isinstance(self.sensor, Configured):
            return super().draw(body, own, rng)
        inner = own[: self._first]
        values = self.sensor.draw(body, inner, rng)
        here = self.sensor.residual(values, body, inner)
        moved = values + NUDGE * np.eye(len(values))
        slopes = (np.array([self.sensor.residual(one, body, inner) for one in moved]) - here).T / NUDGE
        error = np.zeros(len(here))
        error[self._erring] = own[self._of(values)]
        return np.asarray(values + np.linalg.lstsq(slopes, error, rcond=None)[0])

    def about(self, path_m: Array, own: Array) -> Array:
        """Return own variables [V] as the sensor has them about a path."""
        if not isinstance(self.sensor, Configured):
            return own
        return np.concatenate([self.sensor.about(path_m, own[: self._first]), own[self._first :]])

    def begin(self, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Begun | None:
        """Return what the sensor begins with, as sure as readings that err together make it, and errors of none."""
        sensor, shared = self.sensor, np.diag(self._sigmas**2)
        noises = [sensor.noise(r.values) if r.covariance is None else r.covariance for r in readings]
        readings = [replace(r, covariance=c + shared) for r, c in zip(readings, noises, strict=True)]
        found = sensor.begin(readings, bodies)
        if found is None:
            return None
        sigmas = self._less_sure(found, *thinned_pairs(readings, bodies))
        if not is_heading_known(sensor.variables, sigmas):
            return None
        rest = self.variables[self._first :]
        return Begun(
            np.concatenate([found.values, np.zeros(len(rest))]),
            np.concatenate([sigmas, [variable.sigma for variable in rest]]),
        )

    def _less_sure(self, found: Begun, readings: Sequence[Reading], bodies: Sequence[BodyState]) -> Array:
        """Return the sigmas of what was found as though no two readings shared anything, with what they share."""
        known = np.array([variable.sigma for variable in self.sensor.variables])
        rows = np.flatnonzero(found.sigmas < known)
        if not len(rows) or not readings:
            return found.sigmas
        white, roots = [], []
        for reading, body in zip(readings, bodies, strict=True):
            linear = linearised(self.sensor, reading, body, found.values)
            root = np.linalg.inv(np.linalg.cholesky(linear.noise))
            white.append(root @ linear.H_own[:, rows])
            roots.append(root * self._sigmas)
        J = np.array(white)  # [N, m, F]
        normal = np.einsum("nmf,nmg->fg", J, J) + np.diag(known[rows] ** -2.0)
        moves = np.linalg.solve(normal, np.einsum("nmf,nmk->nfk", J, np.array(roots)))  # [N, F, m] by each error
        t_s = np.array([r.t_ns for r in readings]) * 1e-9
        source = np.array([self.channel(r.values) for r in readings])
        alike = np.exp(-np.abs(t_s[:, None] - t_s) / self.variables[-1].correlation_s) * (source[:, None] == source)
        np.fill_diagonal(alike, 0.0)
        sigmas = found.sigmas.copy()
        more = np.einsum("ij,ifk,jfk->f", alike, moves, moves, optimize=True)
        sigmas[rows] = np.sqrt(np.maximum(sigmas[rows] ** 2 + more, 0.25 * sigmas[rows] ** 2))
        return sigmas

    def _of(self, values: Array) -> slice:
        """Return where the errors of a reading's source stand among the own variables."""
        begin = self._first + self.sources.index(self.channel(values)) * len(self._erring)
        return slice(begin, begin + len(self._erring))


def _one_each(sensor: Sensor, sigmas: Sequence[float], correlation_s: float) -> Array:
    """Return a sigma for each number of a sensor's residual [m]."""
    try:
        m = len(sensor.noise(np.zeros(len(sensor.columns))))
    except USER_ERRORS as error:
        raise UsageError(f"correlated_sigma: its noise of a reading of zeros: {error}") from error
    given = np.array(sigmas, dtype=np.float64)
    if len(given) not in (1, m) or not np.isfinite(given).all() or given.min() < 0.0 or not given.any():
        asked = "a number above 0 is" if m == 1 else f"one for each of {m} numbers of its residual, or one for all, is"
        raise UsageError(f"correlated_sigma: {asked} asked, got {given.tolist()}")
    if not correlation_s > 0.0:
        raise UsageError(f"correlation_s: a time above 0 is asked with correlated_sigma, got {correlation_s:g}")
    return np.array(np.broadcast_to(given, m))
