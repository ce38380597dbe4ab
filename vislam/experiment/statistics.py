"""How sure a comparison is: medians with the spread of the ensemble, and paired tests between estimates."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import rankdata, wilcoxon

from vislam.experiment.plan import Scalar
from vislam.experiment.trials import BY_NAME, CAUSAL, Trial

_PERCENTILES = (5.0, 95.0)
_MIN_FOR_PERCENTILES = 20  # with fewer trials, percentiles are made up: the range is reported as it is

Variant = tuple[tuple[str, Scalar], ...]


@dataclass(frozen=True, slots=True)
class Spread:
    """Median and error bar of a metric over seeds and members; infinite where failures reach."""

    median: float
    low: float
    high: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """All trials of one estimate on one sequence under one condition."""

    sequence: str
    variant: Variant
    estimator: str
    output: str
    trials: tuple[Trial, ...]

    @property
    def failures(self) -> int:
        """How many trials failed."""
        return sum(1 for trial in self.trials if trial.failure)

    @property
    def estimate(self) -> str:
        """What is compared: estimator and output."""
        return self.trials[0].estimate

    def spread(self, metric: str) -> Spread | None:
        """Return the spread of a metric; None when no trial measured it.

        A failed trial counts as an infinite error; what is no error (time, memory, scale) counts of the others only.
        """
        is_error = metric in BY_NAME and BY_NAME[metric].kind == "error"
        values = [trial.values[metric] for trial in self.trials if not trial.failure and metric in trial.values]
        if is_error and (values or self.failures == len(self.trials)):
            values += [math.inf] * self.failures
        return spread(values)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A paired test between two estimates: does one have the smaller error, over sequences, conditions and seeds?"""

    metric: str
    is_causal: bool  # both are, or neither is
    first: str
    second: str
    pairs: int
    first_better: int
    second_better: int
    ratio: float  # median of first / second over the pairs where both are finite; NaN without one
    effect: float  # matched-pairs rank-biserial correlation (Kerby 2014): -1 first always better, 0 neither, 1 second
    p: float  # Wilcoxon signed-rank, two-sided
    p_holm: float  # the same, corrected for all comparisons of this metric


def spread(values: Sequence[float]) -> Spread | None:
    """Return median and range of values, from 20 values on the 5 and 95 percentiles; None without values."""
    if not values:
        return None
    ordered = np.sort(np.array(values, dtype=np.float64))
    low, high = ordered[0], ordered[-1]
    if len(ordered) >= _MIN_FOR_PERCENTILES:  # an order statistic is never between a number and infinity
        low, high = np.percentile(ordered, _PERCENTILES, method="nearest")
    return Spread(_median(ordered), float(low), float(high), len(ordered))


def groups(trials: Sequence[Trial]) -> list[Group]:
    """Return the trials by sequence, condition and estimate, in the order in which they come."""
    found: dict[tuple[str, Variant, str, str], list[Trial]] = {}
    for trial in trials:
        key = (trial.job.sequence, trial.job.variant, trial.job.estimator, trial.output)
        found.setdefault(key, []).append(trial)
    return [Group(*key, tuple(members)) for key, members in found.items()]


def compare(trials: Sequence[Trial], metric: str, by_seed: bool = True) -> list[Comparison]:
    """Return the test of every two causal estimates and of every two final ones, by a metric of kind "error".

    A pair is one sequence, condition and seed; the median over the ensemble stands for it, for its members are no
    independent samples. Without `by_seed` a pair is one sequence and condition, and the median is over its seeds, too:
    then the test speaks of sequences like these, not of these ones with other noise. A failure is worse than any
    number; two failures are equal. Pairs that only one side measured (a path too short for the segment) are left out.
    P values follow Holm 1979.
    """
    values: dict[str, dict[tuple[str, Variant, int], float]] = {}
    causal: dict[str, bool] = {}
    for unit, members in _by_unit(trials, by_seed).items():
        measured = [math.inf if t.failure else t.values[metric] for t in members if t.failure or metric in t.values]
        if measured:
            values.setdefault(unit[0], {})[unit[1:]] = _median(np.sort(np.array(measured)))
            causal[unit[0]] = members[0].output in CAUSAL
    raw = [
        _test(metric, causal[first], first, second, values[first], values[second])
        for first, second in itertools.combinations(values, 2)
        if causal[first] == causal[second]
    ]
    corrected = holm([comparison.p for comparison in raw])
    return [replace(comparison, p_holm=p) for comparison, p in zip(raw, corrected, strict=True)]


def holm(p: Sequence[float]) -> list[float]:
    """Return p values corrected for multiple comparisons (Holm 1979): step down, never decreasing, at most 1."""
    order = np.argsort(p, kind="stable")
    corrected = [1.0] * len(p)
    largest = 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - rank) * p[index]))
        corrected[index] = largest
    return corrected


def _by_unit(trials: Sequence[Trial], by_seed: bool) -> dict[tuple[str, str, Variant, int], list[Trial]]:
    found: dict[tuple[str, str, Variant, int], list[Trial]] = {}
    for trial in trials:
        job = trial.job
        found.setdefault((trial.estimate, job.sequence, job.variant, job.seed if by_seed else 0), []).append(trial)
    return found


def _test(
    metric: str,
    is_causal: bool,
    first: str,
    second: str,
    a: dict[tuple[str, Variant, int], float],
    b: dict[tuple[str, Variant, int], float],
) -> Comparison:
    units = [unit for unit in a if unit in b]
    x, y = np.array([a[unit] for unit in units]), np.array([b[unit] for unit in units])
    both = np.isfinite(x) & np.isfinite(y)
    difference = np.zeros(len(units))
    difference[both] = x[both] - y[both]
    worst = 2.0 * float(np.abs(difference).max(initial=0.0)) + 1.0  # the largest rank, whatever its size
    difference[np.isinf(x) & np.isfinite(y)] = worst
    difference[np.isfinite(x) & np.isinf(y)] = -worst
    nonzero = difference[difference != 0.0]
    p = float(wilcoxon(nonzero).pvalue) if len(nonzero) else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = float(np.median(x[both] / y[both])) if both.any() else math.nan
    better = int((difference < 0.0).sum()), int((difference > 0.0).sum())
    return Comparison(metric, is_causal, first, second, len(units), *better, ratio, _effect(nonzero), p, p)


def _effect(differences: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return by how much the ranks of positive differences outweigh those of negative ones, as a share of all ranks."""
    if not len(differences):
        return 0.0
    ranks = rankdata(np.abs(differences))
    return float((ranks * np.sign(differences)).sum() / ranks.sum())


def _median(ordered: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the median of sorted values that may be infinite."""
    n = len(ordered)
    return float(0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]))
