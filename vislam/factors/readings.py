"""Readings of other sensors in the graph: which have factors, and the keys of what the sensors estimate of their own.

Each own variable is a key of one number, in units of how well it was known when the sensor began: gtsam's thresholds of
relinearisation hold for all keys of one letter. One that does not change has one key; one that walks has a key at each
keyframe with readings, tied to the one before, and begins anew with each submap.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import gtsam
import numpy as np

from vislam.core.messages import Array
from vislam.core.readings import OwnStart, PlacedReading
from vislam.factors.builder import Step
from vislam.factors.journal import KeyframeRecord
from vislam.factors.keys import X, own_key, walking_key
from vislam.factors.reading import ReadingFactor
from vislam.sensors import Suite, Variable

MOST = 10  # readings of one sensor between two keyframes that get factors; of more, as many evenly spaced
_SIGMA_MIN = 1e-9  # of a prior: one that is known exactly must not be divided by


@dataclass(slots=True)
class _Begun:
    """A sensor whose own variables have first values."""

    start: Array  # [V]
    units: Array  # [V]
    constant: set[int] = field(default_factory=set)  # numbers of variables that do not change and have their key
    newest: dict[int, int] = field(default_factory=dict)  # of walking ones, by number: keyframe of the newest key


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    """What one sensor said with one keyframe, and how its own variables enter there."""

    sensor: str
    placed: list[PlacedReading]
    keys: list[int]  # of its own variables
    earlier: list[int | None]  # of each: the key from which it walked; None: it did not, or begins here
    new: list[bool]  # of each: its first factors come with this keyframe
    dt_s: list[float]  # of each: since that


class Own(NamedTuple):
    """Where one own variable is in the graph."""

    key: int
    unit: float


class Readings:
    """Owns the readings of a run as records; factors are built from them at any estimate, as often as asked."""

    def __init__(self, suite: Suite) -> None:
        """Start empty."""
        self._suite = suite
        self._begun: dict[str, _Begun] = {}
        self._entries: list[list[_Entry]] = []  # by keyframe
        self._t_ns: list[int] = []
        self._failed: set[tuple[int, str, int]] = set()
        self._counts: Counter[str] = Counter()
        self._recalled: dict[str, Array] = {}

    @property
    def counts(self) -> dict[str, int]:
        """Return how many readings have factors, and how many do not for which reason.

        `used`: in factors; `unknown`: of a sensor that the suite does not have; `unusable`: the sensor refuses them;
        `early`: own variables had no start yet; `thinned`: too many between two keyframes; `failed`: of those used,
        the sensor's own code failed at some estimate, and they say nothing there.
        """
        return {**self._counts, "failed": len(self._failed)}

    def recall(self, own: Iterable[OwnStart]) -> None:
        """Take the last estimate of an earlier run as first guess of the keyframes that are appended next."""
        self._recalled = {one.sensor: np.asarray(one.values, dtype=np.float64) for one in own}

    def append(self, record: KeyframeRecord) -> None:
        """Take the next keyframe."""
        self._t_ns.append(record.t_ns)
        if record.begins_submap:
            for begun in self._begun.values():
                begun.newest.clear()
        for start in record.own_starts:
            self._begin(start)
        by_sensor: dict[str, list[PlacedReading]] = {}
        for one in record.readings:
            if self._is_usable(one):
                by_sensor.setdefault(one.reading.sensor, []).append(one)
        entries = []
        for name, placed in by_sensor.items():
            if self._suite[name].variables and name not in self._begun:
                self._counts["early"] += len(placed)
                continue
            entries.append(self._entry(name, placed, record))
        self._entries.append(entries)

    def has(self, k: int) -> bool:
        """Return whether keyframe k came with factors."""
        return bool(self._entries[k])

    def keys_of(self, keyframes: Iterable[int]) -> list[int]:
        """Return the keys of own variables that any of some keyframes touch, and of those that do not change."""
        constant = {own_key(n) for begun in self._begun.values() for n in begun.constant}
        touched = (key for k in keyframes for entry in self._entries[k] for key in entry.keys)
        return sorted(constant.union(touched))

    def complete(self, values: gtsam.Values) -> None:
        """Add own variables that values lack, each as near as known."""
        for entry in (entry for entries in self._entries for entry in entries):
            for key, guess in zip(entry.keys, self._guesses(entry, values), strict=True):
                if not values.exists(key):
                    values.insert(key, guess)

    def joined(self, step: Step, k: int, T_earlier: Array, values: gtsam.Values) -> Step:
        """Return what ties keyframe k to the one before, at T_earlier [4, 4], with the factors of its readings."""
        if not self._entries[k]:
            return step
        T_later = values.atPose3(X(k)).matrix() if values.exists(X(k)) else step.guess.T_map_body
        factors, guesses = list(step.factors), dict[int, float]()
        for entry in self._entries[k]:
            sensor, own = self._suite[entry.sensor], self._guesses(entry, values)
            guesses |= {key: guess for key, guess, new in zip(entry.keys, own, entry.new, strict=True) if new}
            factors += self._ties(entry)
            units = self._units(entry.sensor)

            def failed(number: int, name: str = entry.sensor) -> None:
                self._failed.add((k, name, number))

            variables = np.array(own) * units
            factor = ReadingFactor(sensor, entry.placed, (T_earlier, T_later), variables, units, failed)
            if factor.size:
                factors.append(factor.factor(X(k - 1), X(k), entry.keys))
        return replace(step, factors=factors, own=guesses)

    def own(self, name: str) -> list[Own] | None:
        """Return where each own variable of a sensor is now; None before its first factors."""
        newest = next((e for entries in reversed(self._entries) for e in entries if e.sensor == name), None)
        if newest is None or not newest.keys:
            return None
        return [Own(key, unit) for key, unit in zip(newest.keys, self._units(name).tolist(), strict=True)]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the sensors with own variables that have begun."""
        return tuple(self._begun)

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
        if recalled is not None and recalled.shape == values.shape:
            values = recalled
        self._begun[start.sensor] = _Begun(values, np.maximum(units, _SIGMA_MIN))

    def _is_usable(self, placed: PlacedReading) -> bool:
        name = placed.reading.sensor
        if name not in self._suite.names:
            self._counts["unknown"] += 1
            return False
        try:
            why = self._suite.why_unusable(placed.reading)
        except Exception as error:  # its check is somebody else's code
            why = str(error) or type(error).__name__
        if why:
            self._counts["unusable"] += 1
        return not why

    def _entry(self, name: str, placed: list[PlacedReading], record: KeyframeRecord) -> _Entry:
        """Return what a sensor says with a keyframe; the keys do not hang on whether its code works."""
        if len(placed) > MOST:
            self._counts["thinned"] += len(placed) - MOST
            chosen = np.linspace(0.0, len(placed) - 1.0, MOST).round().astype(int).tolist()
            placed = [placed[n] for n in chosen]
        self._counts["used"] += len(placed)
        entry = _Entry(name, placed, [], [], [], [])
        if not self._suite[name].variables:
            return entry
        begun, first = self._begun[name], self._suite.own(name).start
        for n, variable in enumerate(self._suite[name].variables, first):
            at = begun.newest.get(n)
            walks = variable.walk > 0.0
            entry.keys.append(walking_key(n, record.id) if walks else own_key(n))
            entry.earlier.append(walking_key(n, at) if walks and at is not None else None)
            entry.new.append(walks or n not in begun.constant)
            entry.dt_s.append(0.0 if at is None else (record.t_ns - self._t_ns[at]) * 1e-9)
            if walks:
                begun.newest[n] = record.id
            else:
                begun.constant.add(n)
        return entry

    def _units(self, name: str) -> Array:
        return self._begun[name].units if self._suite[name].variables else np.zeros(0)

    def _guesses(self, entry: _Entry, values: gtsam.Values) -> list[float]:
        """Return the estimates of a sensor's own variables [V], in their units: the best there is of each."""
        if not entry.keys:
            return []
        begun = self._begun[entry.sensor]
        starts = (begun.start / begun.units).tolist()
        out = []
        for key, earlier, start in zip(entry.keys, entry.earlier, starts, strict=True):
            known = next((k for k in (key, earlier) if k is not None and values.exists(k)), None)
            out.append(start if known is None else float(values.atDouble(known)))
        return out

    def _ties(self, entry: _Entry) -> list[gtsam.NonlinearFactor]:
        """Return the priors of variables that are new, and the walks of those that are not."""
        if not entry.keys:
            return []
        variables, units = self._suite[entry.sensor].variables, self._units(entry.sensor).tolist()
        out: list[gtsam.NonlinearFactor] = []
        for n, (variable, unit) in enumerate(zip(variables, units, strict=True)):
            earlier = entry.earlier[n]
            if earlier is not None:
                sigma = max(variable.walk * np.sqrt(max(entry.dt_s[n], 0.0)), _SIGMA_MIN) / unit
                model = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
                out.append(gtsam.BetweenFactorDouble(earlier, entry.keys[n], 0.0, model))
            elif entry.new[n]:
                out.append(_prior(entry.keys[n], variable, unit))
        return out


def _prior(key: int, variable: Variable, unit: float) -> gtsam.PriorFactorDouble:
    """Return what is known of a variable before its first reading."""
    model = gtsam.noiseModel.Isotropic.Sigma(1, max(variable.sigma, _SIGMA_MIN) / unit)
    return gtsam.PriorFactorDouble(key, variable.start / unit, model)
