"""Readings of other sensors in the graph: which have factors, and the keys of what the sensors estimate of their own.

Each own variable is a key of one number, in units of how well it was known when the sensor began: gtsam's thresholds of
relinearisation hold for all keys of one letter. One that does not change has one key; one that walks has a key at each
keyframe with readings, tied to the one before, and begins again with each submap. One that forgets does likewise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.messages import Array
from vislam.core.readings import Motion, MotionReadings, OwnStart, PlacedReading
from vislam.factors.builder import Label, Step
from vislam.factors.journal import KeyframeRecord
from vislam.factors.keys import X, nearest_rigid, own_key, walking_key
from vislam.factors.reading_factor import ReadingCounts, ReadingFactor, as_motion
from vislam.factors.solvers import RELINEARIZE_OWN, RELINEARIZE_TRANSLATION_M
from vislam.sensors import USER_ERRORS, Suite, Variable

Covariance = Callable[[list[int]], Array | None]  # the joint one of keys
_REFRESHED = 6  # readings that are linearised again with a keyframe, or those of one entry where they are more
_NEWEST, _BLOCK = 20, 40  # entries that are looked at with each keyframe: the newest, and older ones in turn
_SIGMA_MIN = 1e-9  # of a prior: one that is known exactly must not be divided by


class Admission:
    """Decides which readings are used, and counts those that are not."""

    def __init__(self, suite: Suite, counts: ReadingCounts) -> None:
        """Set up for the sensors of a machine; unusable readings are counted in `counts`."""
        self._suite = suite
        self._counts = counts

    def is_usable(self, placed: PlacedReading) -> bool:
        """Return whether a sensor that is there takes a reading of its own."""
        if placed.reading.sensor not in self._suite.names:
            self._counts.add(placed.reading.sensor, "unknown")
            return False
        try:
            why = self._suite.why_unusable(placed.reading)
        except USER_ERRORS as error:
            why = str(error) or type(error).__name__
        if why:
            self._counts.add(placed.reading.sensor, "unusable")
        return not why

    def for_window(self, motions: Sequence[MotionReadings], k: int) -> list[Motion]:
        """Return what a window takes of each sensor between keyframe k and the one before, where vision was lost."""
        out = []
        for motion in motions:
            name = motion.sensor
            placed = [one for one in motion.placed if self.is_usable(one)]
            if placed:
                self._counts.add(name, "in_window", len(placed))
                out.append(as_motion(self._suite[name], placed, motion.own, partial(self._counts.fail, name, -k)))
        return out


@dataclass(slots=True)
class _Begun:
    """A sensor whose own variables have first values."""

    guess: Array  # [V]
    given: Array  # [V], with `units` as sigmas: readings before it are known by this alone
    units: Array  # [V]
    first: int = -1  # number of the first entry
    constant: set[int] = field(default_factory=set)  # numbers of variables that do not change and have their key
    newest: dict[int, int] = field(default_factory=dict)  # of walking ones, by number: keyframe of the newest key


class _Place(NamedTuple):
    """Where an entry is linearised."""

    T_earlier: Array  # [4, 4]
    T_later: Array  # [4, 4]
    own: Array  # [V] in units of the keys

    def left_by(self, now: _Place, config: GraphConfig) -> float:
        """Return how far the estimate has moved on, over what the solver itself takes for little."""
        farthest = float(np.abs(now.own - self.own).max(initial=0.0)) / RELINEARIZE_OWN
        for before, after in ((self.T_earlier, now.T_earlier), (self.T_later, now.T_later)):
            change = np.abs(after - before)
            m, rad = float(change[:3, 3].max()), float(change[:3, :3].max())
            farthest = max(farthest, m / RELINEARIZE_TRANSLATION_M, rad / config.relinearize_rotation_rad)
        return farthest


@dataclass(slots=True, eq=False)
class _Entry:
    """What one sensor said with one keyframe, how its own variables enter there, and where it was linearised."""

    number: int  # of all entries
    sensor: str
    k: int  # the keyframe
    placed: list[PlacedReading]
    keys: list[int] = field(default_factory=list)  # of its own variables
    earlier: list[int | None] = field(default_factory=list)  # of each: the key from which it walked; None: from none
    new: list[bool] = field(default_factory=list)  # of each: its first factors come with this keyframe
    dt_s: list[float] = field(default_factory=list)  # of each: since that
    factor: ReadingFactor | None = None
    place: _Place | None = None
    linear: gtsam.NonlinearFactor | None = None  # there

    def outliers(self, place: _Place, units: Array) -> int:
        """Return how many of its readings fail the gate of their sensor at a place."""
        return 0 if self.factor is None else self.factor.outliers(place.T_earlier, place.T_later, place.own * units)


class Readings:
    """Owns the readings of a run as records; factors are built from them at any estimate, as often as asked.

    Factors are linear: gtsam copies all its values into each call of a function in Python, and would call it for all
    readings whenever a variable that they share moves. Those whose estimate has moved since are linearised again, a few
    with each keyframe, and all of them with each new start of the solver.
    """

    def __init__(self, suite: Suite, config: GraphConfig) -> None:
        """Start empty."""
        self._suite = suite
        self._config = config
        self._begun: dict[str, _Begun] = {}
        self._entries: list[_Entry] = []
        self._by_keyframe: dict[int, list[_Entry]] = {}
        self._newest: dict[str, _Entry] = {}  # of each sensor
        self._next_old = 0  # where the next block of older entries begins that is looked at
        self._t_ns: list[int] = []
        self._counts = ReadingCounts()
        self.admission = Admission(suite, self._counts)
        self._recalled: dict[str, Array] = {}

    @property
    def counts(self) -> dict[str, int]:
        """Return how the readings of all sensors ended, as `counts_of`; `unknown`: the suite lacks their sensor."""
        return self._counts.total

    def counts_of(self, name: str, values: gtsam.Values) -> dict[str, int]:
        """Return how many readings of a sensor came with keyframes, and what became of them.

        `used`: in factors; `in_window`: in the window's equations; `unusable`: the sensor refuses them; `early`: own
        variables had no start yet; `dropped`: where a submap begins. `failed`: the sensor's own code did at some
        estimate, and they say nothing there. Of those used, `outliers` fail its gate at `values`.
        """
        mine = [entry for entry in self._entries if entry.sensor == name]
        outliers = sum(entry.outliers(self._place(entry, values), self._units(name)) for entry in mine)
        return {**self._counts.of(name), "outliers": outliers}

    def recall(self, own: Iterable[OwnStart]) -> None:
        """Take the last estimate of an earlier run as first guess of the keyframes that are appended next."""
        self._recalled = {one.sensor: np.asarray(one.values, dtype=np.float64) for one in own}

    def append(self, record: KeyframeRecord, offered: Sequence[PlacedReading]) -> None:
        """Take the next keyframe, with which these readings were `offered`: where a submap begins it has none."""
        self._t_ns.append(record.t_ns)
        if not record.readings:
            for one in offered:
                self._counts.add(one.reading.sensor, "dropped")
        if record.begins_submap:
            for begun in self._begun.values():
                begun.newest.clear()
        for start in record.own_starts:
            self._begin(start)
        by_sensor: dict[str, list[PlacedReading]] = {}
        for one in record.readings:
            if self.admission.is_usable(one):
                by_sensor.setdefault(one.reading.sensor, []).append(one)
        for name, placed in by_sensor.items():
            if self._suite[name].variables and name not in self._begun:
                self._counts.add(name, "early", len(placed))
                continue
            entry = self._newest[name] = self._entry(name, placed, record)
            self._entries.append(entry)
            self._by_keyframe.setdefault(record.id, []).append(entry)

    def __len__(self) -> int:
        """Return how many factors there are."""
        return len(self._entries)

    def has(self, k: int) -> bool:
        """Return whether keyframe k came with factors."""
        return k in self._by_keyframe

    def keys_of(self, keyframes: Iterable[int]) -> list[int]:
        """Return the keys of own variables that any of some keyframes touch, and of those that do not change."""
        constant = {own_key(n) for begun in self._begun.values() for n in begun.constant}
        touched = (key for k in keyframes for entry in self._by_keyframe.get(k, ()) for key in entry.keys)
        return sorted(constant.union(touched))

    def complete(self, values: gtsam.Values) -> None:
        """Add own variables that values lack, each as near as known."""
        for entry in self._entries:
            for key, guess in zip(entry.keys, self._guesses(entry, values), strict=True):
                if not values.exists(key):
                    values.insert(key, guess)

    def joined(self, step: Step, k: int, T_earlier: Array, values: gtsam.Values) -> Step:
        """Return what ties keyframe k to the one before, at T_earlier [4, 4], with the factors of its readings."""
        if k not in self._by_keyframe:
            return step
        T_later = values.atPose3(X(k)).matrix() if values.exists(X(k)) else step.guess.T_map_body
        factors, named, guesses = list(step.factors), dict(step.named), dict[int, float]()
        for entry in self._by_keyframe[k]:
            own = self._guesses(entry, values)
            guesses |= {key: guess for key, guess, new in zip(entry.keys, own, entry.new, strict=True) if new}
            factors += _ties(entry, self._begun.get(entry.sensor), self._suite[entry.sensor].variables)
            named[_label(entry)] = self._linear(entry, _Place(T_earlier, T_later, np.array(own)))
        return replace(step, factors=factors, named=named, own=guesses)

    def factors(self, values: gtsam.Values) -> list[gtsam.NonlinearFactor]:
        """Return all factors at an estimate that has all keys; see `complete`."""
        out: list[gtsam.NonlinearFactor] = []
        for entry in self._entries:
            out += _ties(entry, self._begun.get(entry.sensor), self._suite[entry.sensor].variables)
            out.append(self._linear(entry, self._place(entry, values)))
        return out

    def refreshed(self, values: gtsam.Values) -> dict[Label, gtsam.NonlinearFactor]:
        """Return new factors for a few of those whose estimate has moved on, those for which it has most."""
        newest = max(len(self._entries) - _NEWEST, 0)
        begin = self._next_old if self._next_old < newest else 0
        self._next_old = min(begin + _BLOCK, newest)
        moved: list[tuple[float, _Entry, _Place]] = []
        for entry in (*self._entries[newest:], *self._entries[begin : self._next_old]):
            if entry.place is not None:
                place = self._place(entry, values)
                moved.append((entry.place.left_by(place, self._config), entry, place))
        moved.sort(key=lambda item: -item[0])
        out: dict[Label, gtsam.NonlinearFactor] = {}
        count = 0
        for by, entry, place in moved:
            if by <= 1.0 or count >= _REFRESHED:
                break
            out[_label(entry)] = entry.linear = self._linearised(entry, place)
            count += len(entry.placed)
        return out

    def loss(self, values: gtsam.Values) -> float:
        """Return what the factors cost at an estimate, not linearised."""
        total = 0.0
        for entry in self._entries:
            if entry.factor is not None:
                T_earlier, T_later, own = self._place(entry, values)
                total += entry.factor.loss(T_earlier, T_later, own * self._units(entry.sensor))
        return total

    def own(self, name: str, values: gtsam.Values, covariance: Covariance) -> tuple[Array, Array] | None:
        """Return own variables [V] and sigmas [V], NaN where `covariance` of keys gives none; None: none there."""
        keys, units = self.own_keys(name)
        if not keys:
            return None
        joint = covariance(keys)
        sigmas = np.full(len(units), np.nan) if joint is None else np.sqrt(np.diag(joint))
        return np.array(self._guesses(self._newest[name], values)) * units, sigmas * units

    def own_keys(self, name: str) -> tuple[list[int], Array]:
        """Return keys [V] of a sensor's own variables, none while they have no factor, and of each its unit [V]."""
        newest = self._newest.get(name)
        return ([], np.empty(0)) if newest is None or not newest.keys else (newest.keys, self._units(name))

    def all_own(self, values: gtsam.Values) -> tuple[OwnStart, ...]:
        """Return the own variables of all sensors as they are now, each with the unit of its key for a sigma."""
        found = [(name, entry, self._units(name)) for name, entry in self._newest.items() if entry.keys]
        return tuple(OwnStart(name, np.array(self._guesses(entry, values)) * u, u) for name, entry, u in found)

    def _begin(self, start: OwnStart) -> None:
        """Take first values of a sensor's own variables; what is in the graph already knows better than later ones."""
        if start.sensor not in self._suite.names or start.sensor in self._begun:
            return
        variables = self._suite[start.sensor].variables
        values, sigmas = (np.asarray(part, dtype=np.float64) for part in (start.values, start.sigmas))
        if not variables or values.shape != (len(variables),):
            return
        known = np.array([variable.sigma for variable in variables])
        units = np.where(sigmas > 0.0, np.minimum(known, sigmas), known)
        recalled = self._recalled.get(start.sensor)
        guess = values if recalled is None or recalled.shape != values.shape else recalled
        self._begun[start.sensor] = _Begun(guess, values, np.maximum(units, _SIGMA_MIN))

    def _entry(self, name: str, placed: list[PlacedReading], record: KeyframeRecord) -> _Entry:
        """Return a sensor's readings with a keyframe; the keys do not depend on whether the sensor's code works."""
        self._counts.add(name, "used", len(placed))
        entry = _Entry(len(self._entries), name, record.id, placed)
        if not self._suite[name].variables:
            return entry
        begun, first = self._begun[name], self._suite.own(name).start
        begun.first = entry.number if begun.first < 0 else begun.first
        for n, variable in enumerate(self._suite[name].variables, first):
            at = begun.newest.get(n)
            walks = variable.changes
            entry.keys.append(walking_key(n, record.id) if walks else own_key(n))
            entry.earlier.append(walking_key(n, at) if walks and at is not None else None)
            entry.new.append(walks or n not in begun.constant)
            entry.dt_s.append(0.0 if at is None else (record.t_ns - self._t_ns[at]) * 1e-9)
            if walks:
                begun.newest[n] = record.id
            else:
                begun.constant.add(n)
        return entry

    def _linear(self, entry: _Entry, place: _Place) -> gtsam.NonlinearFactor:
        """Return the factor of an entry, at a place or so near to it that it makes no difference."""
        if entry.linear is None or entry.place is None or entry.place.left_by(place, self._config) > 1.0:
            entry.linear = self._linearised(entry, place)
        return entry.linear

    def _linearised(self, entry: _Entry, place: _Place) -> gtsam.NonlinearFactor:
        """Return the factor of an entry at a place."""
        units = self._units(entry.sensor)
        if entry.factor is None or not entry.factor.is_whole:

            def failed(n: int) -> None:
                self._counts.fail(entry.sensor, entry.number, n)

            sensor, poses = self._suite[entry.sensor], (place.T_earlier, place.T_later)
            entry.factor = ReadingFactor(sensor, entry.placed, poses, place.own * units, units, failed)
        entry.place = place
        around = gtsam.Values()  # few, for they are copied
        around.insert(X(entry.k - 1), gtsam.Pose3(nearest_rigid(place.T_earlier)))
        around.insert(X(entry.k), gtsam.Pose3(nearest_rigid(place.T_later)))
        for key, value in zip(entry.keys, place.own.tolist(), strict=True):
            around.insert(key, value)
        nonlinear = entry.factor.factor(X(entry.k - 1), X(entry.k), entry.keys)
        return gtsam.LinearContainerFactor(nonlinear.linearize(around), around)

    def _place(self, entry: _Entry, values: gtsam.Values) -> _Place:
        T_earlier, T_later = (values.atPose3(X(k)).matrix() for k in (entry.k - 1, entry.k))
        return _Place(T_earlier, T_later, np.array(self._guesses(entry, values)))

    def _units(self, name: str) -> Array:
        return self._begun[name].units if self._suite[name].variables else np.zeros(0)

    def _guesses(self, entry: _Entry, values: gtsam.Values) -> list[float]:
        """Return the estimates of a sensor's own variables [V], in their units: the best there is of each."""
        if not entry.keys:
            return []
        begun = self._begun[entry.sensor]
        starts = (begun.guess / begun.units).tolist()
        out = []
        for key, earlier, start in zip(entry.keys, entry.earlier, starts, strict=True):
            known = next((k for k in (key, earlier) if k is not None and values.exists(k)), None)
            out.append(start if known is None else float(values.atDouble(known)))
        return out


def _ties(entry: _Entry, begun: _Begun | None, variables: Sequence[Variable]) -> list[gtsam.NonlinearFactor]:
    """Return the priors of variables that are new, and the walks of those that are not."""
    if begun is None:
        return []
    given, units = (begun.given / begun.units).tolist(), begun.units.tolist()
    out: list[gtsam.NonlinearFactor] = []
    for n, (variable, unit) in enumerate(zip(variables, units, strict=True)):
        earlier = entry.earlier[n]
        if earlier is not None:
            decay, variance = variable.after(entry.dt_s[n])
            model = gtsam.noiseModel.Isotropic.Sigma(1, max(np.sqrt(variance), _SIGMA_MIN) / unit)
            if decay == 1.0:
                out.append(gtsam.BetweenFactorDouble(earlier, entry.keys[n], 0.0, model))
            else:
                out.append(_forgetting(earlier, entry.keys[n], decay, variable.start / unit, model))
        elif entry.new[n]:
            # what walks and begins again with a submap has walked an unknown way since its value was given
            sigma = 1.0 if entry.number == begun.first else max(variable.sigma / unit, 1.0)
            model = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
            out.append(gtsam.PriorFactorDouble(entry.keys[n], given[n], model))
    return out


def _forgetting(
    earlier: int, later: int, decay: float, start: float, model: gtsam.noiseModel.Isotropic
) -> gtsam.NonlinearFactor:
    """Return the factor `later - start = decay * (earlier - start) + noise`; it is linear."""
    around, one = gtsam.Values(), np.ones((1, 1))
    around.insert(earlier, 0.0)
    around.insert(later, 0.0)
    linear = gtsam.JacobianFactor(earlier, -decay * one, later, one, np.array([(1.0 - decay) * start]), model)
    return gtsam.LinearContainerFactor(linear, around)


def _label(entry: _Entry) -> Label:
    return "reading", entry.number
