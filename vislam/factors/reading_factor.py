"""The factor of what one sensor said between two keyframes, by the definition that every estimator uses.

The residuals of all its readings stand in one factor, and each has a Cauchy kernel of its own in it, as gtsam would
apply one: the linearised rows carry the root of the weight, and the error is the loss. However many they are, they are
summed up in as many rows as the factor has columns. What the inertial path between the keyframes is off by, they share.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.core.chi_square import chi_square_limit
from vislam.core.messages import Array
from vislam.core.readings import Motion, OwnNow, PlacedReading
from vislam.factors.noise_models import conditioned
from vislam.sensors import USER_ERRORS, Sensor, SensorError, linearised
from vislam.sensors.body import between_keyframes, by_keyframes, path_by_force, rate_by_keyframes

_RATIO_MAX = 1e12  # eigenvalues of a reading's correlations
_NOTHING = 1e-12  # square of a residual whose weight is 1
_POSES = 12  # columns of two poses
_ENDS = ("used", "in_window", "early", "dropped", "unusable")  # of a reading that came with a keyframe


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A reading in its factor."""

    number: int  # among those of its sensor and keyframe
    placed: PlacedReading
    whitening: Array  # [m, m] of its own noise
    by_path: Array  # [m, 3] whitened, by the error of the force over its sigma
    judging: Array  # [m, m] further whitening, by what that may be
    cauchy_k2: float  # square of the kernel's scale, on the norm after both

    def square(self, whitened: Array) -> float:
        """Return the squared norm of a residual [m], whitened by its own noise, as the gate takes it."""
        judged = self.judging @ whitened
        return float(judged @ judged)


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """A reading at two poses and own variables: its residual and what that grows by with each of them."""

    residual: Array  # [m], measured minus predicted
    by_earlier: Array  # [m, 6] rotation, translation on the body side
    by_later: Array  # [m, 6]
    by_own: Array  # [m, V]
    by_path: Array  # [m, 3] by the error of the force between the keyframes, over its sigma
    noise: Array  # [m, m] its own


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
    position_m, velocity_m_s = path_by_force(station)
    by_path = -position_m * linear.H[:, 3:6] - velocity_m_s * linear.H[:, 6:9]
    return System(linear.residual, earlier, later, -linear.H_own, by_path, 0.5 * (linear.noise + linear.noise.T))


def _whitening(noise: Array) -> Array:
    """Return L^-1 of a covariance L L^T [m, m] whose numbers may have any units."""
    sigmas = np.sqrt(np.diag(noise))
    correlation = conditioned(noise / np.outer(sigmas, sigmas), _RATIO_MAX)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(correlation)) / sigmas)


def _summed(rows: Array) -> Array:
    """Return rows [N, 3 + K] with normal equations as few as K: what the first three columns explain is left out.

    Those are an unknown that all rows share, known to one.
    """
    R = np.asarray(np.linalg.qr(np.vstack([np.eye(3, rows.shape[1]), rows]), mode="r"))
    return R[3:, 3:]


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

        `units` [V] are those in which the solver has the variables. `failed` is called with the number of each reading
        at which the sensor's own code fails, here or later; that reading then adds no information.
        """
        self._sensor = sensor
        self._units = units
        self._failed = failed
        self._rows: list[_Row] = []
        self._count = len(placed)
        self._begun: list[tuple[_Row, System]] = []  # at the poses and variables of the beginning
        self._began_at = (*poses, own)
        numbers = 0
        for number, one in enumerate(placed):
            try:
                system = system_of(sensor, one, *poses, own)
            except SensorError:
                failed(number)
                continue
            m = len(system.residual)
            whitening = _whitening(system.noise)
            by_path = whitening @ system.by_path
            judging = _whitening(np.eye(m) + by_path @ by_path.T)
            limit = chi_square_limit(sensor.gate_probability, m)
            self._rows.append(_Row(number, one, whitening, by_path, judging, limit))
            self._begun.append((self._rows[-1], system))
            numbers += m
        self.size = min(numbers, _POSES + len(units) + 1)  # of the residual

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
                out = np.zeros(self.size)
                out[:1] = np.sqrt(2.0 * self.loss(*poses, variables))
                return out
            residual, by_earlier, by_later, by_own = self.weighted(*poses, variables)
            jacobians[0], jacobians[1] = np.asfortranarray(by_earlier), np.asfortranarray(by_later)
            for n in range(len(own)):
                jacobians[2 + n] = np.asfortranarray(by_own[:, n : n + 1])
            return residual

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(self.size), [earlier, later, *own], error)

    def loss(self, T_earlier: Array, T_later: Array, own: Array) -> float:
        """Return what the readings cost: the sum of their robust losses, less what an error of the path explains."""
        rows = [np.zeros((0, 4))]
        for row, residual in self._residuals(T_earlier, T_later, own):
            square = max(row.square(residual), _NOTHING)
            root = np.sqrt(row.cauchy_k2 * np.log1p(square / row.cauchy_k2) / square)
            rows.append(root * np.column_stack([row.by_path, residual]))
        return 0.5 * float((_summed(np.vstack(rows)) ** 2).sum())

    def outliers(self, T_earlier: Array, T_later: Array, own: Array) -> int:
        """Return how many readings fail the gate of their sensor: there the kernel's weight is below a half."""
        residuals = self._residuals(T_earlier, T_later, own)
        return sum(row.square(residual) > row.cauchy_k2 for row, residual in residuals)

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
        """Return a residual [M] and its Jacobians [M, 6], [M, 6] and [M, V]: all readings, whitened and weighted."""
        rows = [np.zeros((0, 3 + _POSES + len(self._units) + 1))]
        for row, system, residual in self._systems(T_earlier, T_later, own):
            root = np.sqrt(row.cauchy_k2 / (row.cauchy_k2 + row.square(residual)))
            parts = np.hstack([system.by_earlier, system.by_later, system.by_own * self._units])
            rows.append(root * np.column_stack([row.by_path, row.whitening @ parts, residual]))
        summed, out = _summed(np.vstack(rows)), np.zeros((self.size, rows[0].shape[1] - 3))
        out[: len(summed)] = summed
        return out[:, -1], out[:, :6], out[:, 6:_POSES], out[:, _POSES:-1]

    def _systems(self, T_earlier: Array, T_later: Array, own: Array) -> list[tuple[_Row, System, Array]]:
        """Return each reading with its system and its whitened residual; those that fail are left out."""
        begun, self._begun = self._begun, []  # once: they are asked for there first
        if begun and all(map(np.array_equal, (T_earlier, T_later, own), self._began_at)):
            return [(row, system, row.whitening @ system.residual) for row, system in begun]
        out = []
        for row in self._rows:
            try:
                system = system_of(self._sensor, row.placed, T_earlier, T_later, own)
                out.append((row, system, row.whitening @ system.residual))
            except (SensorError, ValueError):  # ValueError: a residual of another length than at first
                self._failed(row.number)
        return out


def as_motion(sensor: Sensor, placed: Sequence[PlacedReading], own: OwnNow, failed: Callable[[int], None]) -> Motion:
    """Return readings of a sensor as a function of both poses, at own variables that are estimated elsewhere.

    `failed` is called as that of a factor is; noise is as at the poses of the first call.
    """
    made: list[ReadingFactor] = []

    def weighted(T_earlier: Array, T_later: Array) -> tuple[Array, Array, Array, Array]:
        if not made:
            made.append(ReadingFactor(sensor, placed, (T_earlier, T_later), own.values, own.sigmas, failed))
        return made[0].weighted(T_earlier, T_later, own.values)

    return weighted


class ReadingCounts:
    """Counts, by sensor, how readings end; of those in factors also which the sensor's own code failed at."""

    def __init__(self) -> None:
        """Start with none."""
        self._ended: dict[str, Counter[str]] = {}
        self._failed: dict[str, set[tuple[int, int]]] = {}  # factors and the readings in them

    def add(self, name: str, end: str, number: int = 1) -> None:
        """Count readings of a sensor that end so."""
        self._ended.setdefault(name, Counter())[end] += number

    def fail(self, name: str, factor: int, reading: int) -> None:
        """Take it that a sensor's own code failed at a reading of a factor; once or often is the same."""
        self._failed.setdefault(name, set()).add((factor, reading))

    @property
    def total(self) -> dict[str, int]:
        """Return how the readings of all sensors ended, as far as there are any that did."""
        failed = sum(map(len, self._failed.values()))
        return {**sum(self._ended.values(), Counter[str]()), "failed": failed}

    def of(self, name: str) -> dict[str, int]:
        """Return how the readings of a sensor ended, each way."""
        ended = self._ended.get(name, Counter[str]())
        return {**{end: ended[end] for end in _ENDS}, "failed": len(self._failed.get(name, ()))}
