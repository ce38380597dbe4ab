"""Who wins a comparison, by how much, and when nobody does."""

import math

import numpy as np
import pytest
from test_statistics import trial

from vislam.experiment.plan import Axis, Estimator, Plan, Sequence
from vislam.experiment.report.exports import winners_csv
from vislam.experiment.statistics import compare, groups
from vislam.experiment.winners import of_plan, of_sequences, outcome, verdict

SEQUENCES = [f"s{i}" for i in range(8)]


def over_sequences(**factors):
    """One trial of each estimator on eight sequences of different difficulty, the error times a factor."""
    return [
        trial(name, 0.01 * (i + 1) * factor, s) for name, factor in factors.items() for i, s in enumerate(SEQUENCES)
    ]


def test_who_is_better_than_every_other_one_wins_by_the_margin_to_the_nearest():
    (winner,) = of_plan(compare(over_sequences(a=1.0, b=0.8, c=2.0), "ate_m"))
    assert (winner.estimate, winner.runner_up, winner.kind) == ("b filter, causal", "a filter, causal", "causal")
    assert winner.margin == pytest.approx(0.2)
    assert outcome(winner) == "ATE, causal: b filter, causal, 20% less than a filter, causal (p 0.0234, 8 pairs)"


def test_no_difference_has_no_winner_and_says_between_whom():
    rng = np.random.default_rng(3)
    noisy = [trial(name, 0.1 + 0.01 * rng.normal(), s) for name in "ab" for s in SEQUENCES]
    (winner,) = of_plan(compare(noisy, "ate_m"))
    assert winner.estimate == ""
    assert math.isnan(winner.margin)
    assert "a filter, causal and b filter, causal cannot be distinguished (p 0." in outcome(winner)


def test_with_few_pairs_nobody_can_win():
    few = [trial(name, error, s) for name, error in (("a", 0.1), ("b", 0.9)) for s in SEQUENCES[:5]]
    assert "5 pairs of sequence, condition and seed: 6 are the least" in of_plan(compare(few, "ate_m"))[0].reason


def test_estimates_that_beat_one_another_in_a_ring_have_no_winner():
    # ranks of differences are not transitive: a beats b on most sequences, b beats c, c beats a
    errors = {"a": [1, 2, 3] * 30, "b": [2, 3, 1] * 30, "c": [3, 1, 2] * 30}
    ring = [trial(n, e + 1e-3 * i, f"s{i}") for n, values in errors.items() for i, e in enumerate(values)]
    tests = compare(ring, "ate_m")
    assert of_plan(tests)[0].estimate == ""


def test_failures_lose():
    trials = over_sequences(a=1.0) + [trial("b", None, s, failure="lost") for s in SEQUENCES]
    (winner,) = of_plan(compare(trials, "ate_m"))
    assert winner.estimate == "a filter, causal"
    assert math.isnan(winner.margin)  # a failure has no error that one could be smaller than by a share


def test_causal_and_final_estimates_have_winners_of_their_own():
    final = [trial(n, 0.1 * f, s, output="graph") for n, f in (("a", 1.0), ("b", 3.0)) for s in SEQUENCES]
    found = of_plan(compare(over_sequences(a=2.0, b=1.0) + final, "ate_m"))
    assert [(w.kind, w.estimate) for w in found] == [("causal", "b filter, causal"), ("final", "a graph, final")]


def test_the_verdict_names_winner_margin_and_test():
    final = [trial(n, 0.1 + 0.001 * i, s, output="graph") for n in "ab" for i, s in enumerate(SEQUENCES)]
    trials = over_sequences(a=1.0, b=0.8) + final
    says = verdict([*of_plan(compare(trials, "ate_m")), *of_sequences(groups(trials), "ate_m")])
    assert says.startswith("Of the final estimates none wins in ATE: ")
    assert "Of the causal estimates b filter wins, its ATE 20% below that of a filter (" in says
    assert "Wilcoxon with Holm's correction, p 0.0156, 8 pairs" in says


def test_a_plan_too_small_for_a_test_counts_its_sequences():
    few = over_sequences(a=1.0, b=0.8)
    few = [one for one in few if one.job.sequence in SEQUENCES[:2]]
    says = verdict([*of_plan(compare(few, "ate_m")), *of_sequences(groups(few), "ate_m")])
    assert "6 are the least" in says
    assert "b filter on 2 of 2 sequences and conditions" in says


def test_a_winner_over_failures_has_no_margin():
    trials = over_sequences(a=1.0) + [trial("b", None, s, failure="lost") for s in SEQUENCES]
    says = verdict(of_plan(compare(trials, "ate_m")))
    assert "a filter wins (" in says and "nan" not in says


def test_on_a_sequence_ensembles_must_not_overlap():
    members = {"a": [0.10, 0.11, 0.12], "b": [0.20, 0.21, 0.22]}
    apart = [trial(n, e, member=i) for n, errors in members.items() for i, e in enumerate(errors)]
    (winner,) = of_sequences(groups(apart), "ate_m")
    assert (winner.estimate, winner.sequence) == ("a filter, causal", "s")
    assert winner.margin == pytest.approx(1.0 - 0.11 / 0.21)
    (winner,) = of_sequences(groups([*apart, trial("a", 0.205, member=3)]), "ate_m")
    assert winner.estimate == ""
    assert winner.reason == "a filter, causal and b filter, causal overlap"
    (winner,) = of_sequences(groups([*apart, trial("a", None, member=3, failure="lost")]), "ate_m")
    assert winner.estimate == ""


def test_nobody_wins_alone():
    alone = [trial("a", 0.1, s) for s in SEQUENCES]
    assert of_plan(compare(alone, "ate_m")) == []
    assert of_sequences(groups(alone), "ate_m") == []


def test_the_effect_is_the_share_of_ranks():
    (always,) = compare(over_sequences(a=1.0, b=2.0), "ate_m")
    assert always.effect == -1.0
    assert compare(over_sequences(a=2.0, b=1.0), "ate_m")[0].effect == 1.0
    mixed = [trial("a", 0.0, s) for s in SEQUENCES[:3]] + [
        trial("b", e, s) for e, s in zip((1, 2, -3), SEQUENCES, strict=False)
    ]
    assert compare(mixed, "ate_m")[0].effect == pytest.approx((3 - 1 - 2) / 6)


def test_the_table_has_a_line_for_everything():
    plan = Plan("p", (Sequence("points:laps", "s"),), (Estimator("a"), Estimator("b")), axes=(Axis("delay", (0.0,)),))
    found = of_plan(compare(over_sequences(a=1.0, b=0.5), "ate_m"))
    lines = winners_csv(plan, found).splitlines()
    assert lines[0] == "metric,kind,sequence,delay,winner,margin,runner_up,reason"
    assert lines[1].startswith('ate_m,causal,,,"b filter, causal",0.5,"a filter, causal","p 0.0078')
