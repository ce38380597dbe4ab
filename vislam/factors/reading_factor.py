"""The factor of what one sensor said between two keyframes, by the definition that every estimator uses.

The residuals of all its readings stand in one factor, and each has a Cauchy kernel of its own in it, as gtsam would
apply one: the linearised rows carry the root of the weight, and the error is the loss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.core.chi_square import chi_square_limit
from vislam.core.messages import Array
from vislam.core.readings import Motion, OwnNow, PlacedReading
from vislam.factors.noise_models import conditioned
from vislam.sensors import USER_ERRORS, Sensor, SensorError, linearised
from vislam.sensors.body import between_keyframes, by_keyframes, path_variances, rate_by_keyframes
from vislam.sensors.linear import Linear

_RATIO_MAX = 1e12  # eigenvalues of a reading's correlations
_NOTHING = 1e-12  # square of a residual whose weight is 1


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A reading in its factor."""

    number: int  # among those of its sensor and keyframe
    placed: PlacedReading
    whitening: Array  # [m, m]
    cauchy_k2: float  # square of the kernel's scale, on the whitened norm
    place: slice  # of its residual among those of the factor


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """A reading at two poses and own variables: its residual and what that grows by with each of them."""

    residual: Array  # [m], measured minus predicted
    by_earlier: Array  # [m, 6] rotation, translation on the body side
    by_later: Array  # [m, 6]
    by_own: Array  # [m, V]
    noise: Array  # [m, m] with what the path between the keyframes adds


def system_of(sensor: Sensor, placed: PlacedReading, T_earlier: Array, T_later: Array, own: Array) -> System:
    """Return a reading between two keyframes as a linear system at their poses [4, 4] and own variables [V].

    Raises SensorError where the sensor's own code fails.
    """
    reading, station = placed.reading, placed.station
    T_earlier, T_later = np.ascontiguousarray(T_earlier), np.ascontiguousarray(T_later)
    body = between_keyframes(T_earlier, T_later, reading.t_ns, station)
    linear = linearised(sensor, reading, body, own)
    moved = by_keyframes(T_earlier, T_later, station)
    turned = rate_by_keyframes(T_earlier, T_later, station)
    # a rate that is larger by something is as good as a gyro bias that is smaller by it
    earlier, later = (
        linear.H[:, 9:12] @ rate - linear.H[:, :9] @ pose for pose, rate in zip(moved, turned, strict=True)
    )
    return System(linear.residual, earlier, later, -linear.H_own, _with_path(linear, placed))


def _with_path(linear: Linear, placed: PlacedReading) -> Array:
    """Return the noise of a reading with what is not known of the path between the keyframes."""
    position_m2, velocity_m2_s2 = path_variances(placed.station)
    H_p, H_v = linear.H[:, 3:6], linear.H[:, 6:9]
    noise = linear.noise + position_m2 * (H_p @ H_p.T) + velocity_m2_s2 * (H_v @ H_v.T)
    return np.asarray(0.5 * (noise + noise.T))


def _whitening(noise: Array) -> Array:
    """Return L^-1 of a covariance L L^T [m, m] whose numbers may have any units."""
    sigmas = np.sqrt(np.diag(noise))
    correlation = conditioned(noise / np.outer(sigmas, sigmas), _RATIO_MAX)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(correlation)) / sigmas)


class ReadingFactor:
    """Readings of one sensor between two keyframes, as a function of both poses and the sensor's own variables."""

    def __init__(
        self,
        sensor: Sensor,
        placed: Sequence[PlacedReading],
        poses: tuple[Array, Array],
        own: Array,
        units: Array,
        failed: Callable[[int], None],
    ) -> None:
        """Take readings with the noise that they have at two poses [4, 4] and own variables [V].

        `units` [V] are those in which the solver has the variables. `failed` is told the number of each reading at
        which the sensor's own code fails, here or later; it then says nothing.
        """
        self._sensor = sensor
        self._units = units
        self._failed = failed
        self._rows: list[_Row] = []
        self._count = len(placed)
        self.size = 0  # of the residual
        for number, one in enumerate(placed):
            try:
                system = system_of(sensor, one, *poses, own)
            except SensorError:
                failed(number)
                continue
            m = len(system.residual)
            limit = chi_square_limit(sensor.gate_probability, m)
            whitening = _whitening(system.noise)
            self._rows.append(_Row(number, one, whitening, limit, slice(self.size, self.size + m)))
            self.size += m

    @property
    def is_whole(self) -> bool:
        """Return whether no reading had to be left out where the noise was taken."""
        return len(self._rows) == self._count

    def factor(self, earlier: int, later: int, own: Sequence[int]) -> gtsam.CustomFactor:
        """Return the factor between the keys of both poses and of the own variables."""

        def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            poses = values.atPose3(earlier).matrix(), values.atPose3(later).matrix()
            variables = np.array([values.atDouble(key) for key in own]) * self._units
            if jacobians is None:
                return self.losses(*poses, variables)
            residual, by_earlier, by_later, by_own = self.weighted(*poses, variables)
            jacobians[0], jacobians[1] = np.asfortranarray(by_earlier), np.asfortranarray(by_later)
            for n in range(len(own)):
                jacobians[2 + n] = np.asfortranarray(by_own[:, n : n + 1])
            return residual

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(self.size), [earlier, later, *own], error)

    def losses(self, T_earlier: Array, T_later: Array, own: Array) -> Array:
        """Return a residual [M] half of whose square is the loss."""
        out = np.zeros(self.size)
        for row, residual in self._residuals(T_earlier, T_later, own):
            square = max(float(residual @ residual), _NOTHING)
            out[row.place] = residual * np.sqrt(row.cauchy_k2 * np.log1p(square / row.cauchy_k2) / square)
        return out

    def outliers(self, T_earlier: Array, T_later: Array, own: Array) -> int:
        """Return how many readings fail the gate of their sensor: there the kernel's weight is below a half."""
        residuals = self._residuals(T_earlier, T_later, own)
        return sum(float(residual @ residual) > row.cauchy_k2 for row, residual in residuals)

    def _residuals(self, T_earlier: Array, T_later: Array, own: Array) -> Iterator[tuple[_Row, Array]]:
        """Yield each reading with its whitened residual; those that fail are left out."""
        poses = np.ascontiguousarray(T_earlier), np.ascontiguousarray(T_later)
        for row in self._rows:
            reading, station = row.placed.reading, row.placed.station
            body = between_keyframes(*poses, reading.t_ns, station)
            try:
                residual = row.whitening @ np.asarray(self._sensor.residual(reading.values, body, own), np.float64)
            except USER_ERRORS:
                residual = np.full(1, np.nan)
            if residual.shape != (len(row.whitening),) or not np.isfinite(residual).all():
                self._failed(row.number)
                continue
            yield row, residual

    def weighted(self, T_earlier: Array, T_later: Array, own: Array) -> tuple[Array, Array, Array, Array]:
        """Return the residual [M] and its Jacobians [M, 6], [M, 6] and [M, V], whitened and weighted."""
        size, count = self.size, len(self._units)
        out = np.zeros(size), np.zeros((size, 6)), np.zeros((size, 6)), np.zeros((size, count))
        for row, system, residual in self._systems(T_earlier, T_later, own):
            root = np.sqrt(row.cauchy_k2 / (row.cauchy_k2 + float(residual @ residual)))
            out[0][row.place] = root * residual
            parts = (system.by_earlier, system.by_later, system.by_own * self._units)
            for whole, part in zip(out[1:], parts, strict=True):
                whole[row.place] = root * (row.whitening @ part)
        return out

    def _systems(self, T_earlier: Array, T_later: Array, own: Array) -> list[tuple[_Row, System, Array]]:
        """Return each reading with its system and its whitened residual; those that fail are left out."""
        out = []
        for row in self._rows:
            try:
                system = system_of(self._sensor, row.placed, T_earlier, T_later, own)
                out.append((row, system, row.whitening @ system.residual))
            except (SensorError, ValueError):  # ValueError: a residual of another length than at first
                self._failed(row.number)
        return out


def as_motion(sensor: Sensor, placed: Sequence[PlacedReading], own: OwnNow, failed: Callable[[int], None]) -> Motion:
    """Return readings of a sensor as a function of both poses, at own variables that somebody else estimates.

    `failed` is told as that of a factor is; noise is as at the poses of the first call.
    """
    made: list[ReadingFactor] = []

    def weighted(T_earlier: Array, T_later: Array) -> tuple[Array, Array, Array, Array]:
        if not made:
            made.append(ReadingFactor(sensor, placed, (T_earlier, T_later), own.values, own.sigmas, failed))
        return made[0].weighted(T_earlier, T_later, own.values)

    return weighted
