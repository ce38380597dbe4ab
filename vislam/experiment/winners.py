"""Which estimate is the best one, by how much, or why none is: over a whole plan, and on each of its sequences."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from vislam.experiment.statistics import Comparison, Group, Variant
from vislam.experiment.trials import BY_NAME, CAUSAL

LEVEL = 0.05  # of the tests, after correction
_KINDS = ("causal", "final")
_FEWEST_PAIRS = 6  # of a signed-rank test that can say anything at this level


@dataclass(frozen=True, slots=True)
class Winner:
    """The best of the causal or of the final estimates in one respect, or that there is none."""

    metric: str
    kind: str  # "causal" or "final": they compete among themselves only
    sequence: str  # empty: the whole plan
    variant: Variant
    estimate: str  # empty: none
    margin: float  # by how much its error is smaller than that of the runner-up: 0.1 is 10 %; NaN where there is none
    runner_up: str
    reason: str  # how sure that is, or why there is none


def of_plan(comparisons: Sequence[Comparison]) -> list[Winner]:
    """Return the winner among causal and among final estimates, by the tests of one metric.

    An estimate wins that is better than every other one in a paired test at the 5 % level after Holm's correction. The
    margin is the median ratio to the other that comes nearest.
    """
    found = []
    for kind in _KINDS:
        tests = [c for c in comparisons if c.is_causal == (kind == "causal")]
        if not tests:
            continue
        names = list(dict.fromkeys(name for c in tests for name in (c.first, c.second)))
        metric = tests[0].metric
        beaten = {name: [c for c in tests if _better(c) == name] for name in names}
        won = [name for name in names if len(beaten[name]) == len(names) - 1]
        if won:
            nearest = min(beaten[won[0]], key=lambda c: abs(math.log(c.ratio)) if c.ratio > 0.0 else math.inf)
            ratio = nearest.ratio if nearest.first == won[0] else 1.0 / nearest.ratio
            p = max(c.p_holm for c in beaten[won[0]])
            other = nearest.second if nearest.first == won[0] else nearest.first
            found.append(Winner(metric, kind, "", (), won[0], 1.0 - ratio, other, f"p {p:.4f}, {nearest.pairs} pairs"))
        else:
            found.append(Winner(metric, kind, "", (), "", math.nan, "", _why_none(tests)))
    return found


def of_sequences(groups: Sequence[Group], metric: str) -> list[Winner]:
    """Return the winner on each sequence and condition: its worst trial is better than the best one of every other.

    Ensembles that overlap leave none: what lies within them is chaos. The margin is between medians.
    """
    found = []
    for sequence, variant in dict.fromkeys((group.sequence, group.variant) for group in groups):
        here = [group for group in groups if (group.sequence, group.variant) == (sequence, variant)]
        for kind in _KINDS:
            rivals = [g for g in here if (g.output in CAUSAL) == (kind == "causal") and g.spread(metric) is not None]
            if len(rivals) > 1:
                found.append(_on(sequence, variant, kind, metric, rivals))
    return found


def outcome(winner: Winner) -> str:
    """Return the outcome in one line."""
    head = f"{BY_NAME[winner.metric].title.partition(' [')[0]}, {winner.kind}: "
    if not winner.estimate:
        return f"{head}no winner, {winner.reason}"
    return f"{head}{winner.estimate}, {winner.margin:.0%} less than {winner.runner_up} ({winner.reason})"


def verdict(winners: Sequence[Winner]) -> str:
    """Return who wins, by how much and by which test, in a sentence for the final and one for the causal estimates.

    Where the plan is too small for a test the sequences are counted, and that is said.
    """
    sentences = []
    for kind in reversed(_KINDS):
        whole = next((w for w in winners if w.kind == kind and not w.sequence), None)
        if whole is None:
            continue
        error = BY_NAME[whole.metric].title.partition(" [")[0]
        if whole.estimate:
            # no margin: the runner-up failed, and a failure has no error
            margin = (
                "" if math.isnan(whole.margin) else f", its {error} {whole.margin:.0%} below that of {whole.runner_up}"
            )
            beats = f"{whole.estimate} wins{margin}"
            sentences.append(f"Of the {kind} estimates {beats} (Wilcoxon with Holm's correction, {whole.reason}).")
            continue
        here = [w for w in winners if w.kind == kind and w.sequence and w.metric == whole.metric]
        wins = Counter(w.estimate for w in here if w.estimate)
        counted = ", ".join(f"{name} on {count} of {len(here)}" for name, count in wins.most_common())
        on_parts = f" Trials without overlap: {counted} sequences and conditions." if wins else ""
        sentences.append(f"Of the {kind} estimates none wins in {error}: {whole.reason}.{on_parts}")
    # which kind competes is said already
    return re.sub(rf", (?:{'|'.join(_KINDS)})(?= )", "", " ".join(sentences))


def _on(sequence: str, variant: Variant, kind: str, metric: str, rivals: Sequence[Group]) -> Winner:
    spreads = {group.estimate: spread for group in rivals if (spread := group.spread(metric)) is not None}
    first, second = sorted(spreads, key=lambda name: spreads[name].median)[:2]
    best, others = spreads[first], [spread for name, spread in spreads.items() if name != first]
    if not math.isfinite(best.high) or best.high >= min(other.low for other in others):
        reason = "all fail at times" if not math.isfinite(best.high) else f"{first} and {second} overlap"
        return Winner(metric, kind, sequence, variant, "", math.nan, "", reason)
    margin = 1.0 - best.median / spreads[second].median
    return Winner(metric, kind, sequence, variant, first, margin, second, f"{best.count} trials, none overlaps")


def _better(c: Comparison) -> str:
    """Return the estimate that a test finds better; empty where it finds none."""
    if c.p_holm >= LEVEL or c.effect == 0.0:
        return ""
    return c.first if c.effect < 0.0 else c.second


def _why_none(tests: Sequence[Comparison]) -> str:
    fewest = min(c.pairs for c in tests)
    if fewest < _FEWEST_PAIRS:
        return (
            f"{fewest} pairs of sequence, condition and seed: {_FEWEST_PAIRS} are the least that can show a difference"
        )
    closest = max((c for c in tests if not _better(c)), key=lambda c: c.p_holm, default=None)
    if closest is None:
        return "each is beaten by another one"
    return (
        f"{closest.first} and {closest.second} cannot be distinguished (p {closest.p_holm:.2f}, {closest.pairs} pairs)"
    )
