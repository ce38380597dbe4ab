"""Medians, error bars and paired tests."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import wilcoxon

from vislam.experiment.jobs import Job
from vislam.experiment.plan import Estimator, Plan, Sequence
from vislam.experiment.report.exports import latex, runs_csv, shown_spread, summary_csv
from vislam.experiment.statistics import compare, groups, holm, spread
from vislam.experiment.trials import BY_NAME, Trial, table_sha256


def trial(estimator, ate_m, sequence="s", seed=0, member=0, output="ekf", failure="", **values):
    job = Job(
        f"{sequence}{estimator}{seed}{member}",
        sequence,
        (),
        estimator,
        0,
        seed,
        member,
        "src",
        {},
        False,
        "",
        {},
        (),
        1.0,
    )
    known = {} if ate_m is None else {"ate_m": ate_m}
    return Trial(job, output, failure, {**known, **values}, {}, "" if failure else "abc", {})


def test_spread_is_median_and_range_then_percentiles():
    assert spread([]) is None
    few = spread([3.0, 1.0, 2.0, 10.0])
    assert (few.median, few.low, few.high, few.count) == (2.5, 1.0, 10.0, 4)
    many = spread(list(range(101)))
    assert (many.median, many.low, many.high) == (50.0, 5.0, 95.0)


def test_failures_rank_worst_and_stay_visible():
    found = groups([trial("a", 0.1, seed=0), trial("a", 0.2, seed=1), trial("a", None, seed=2, failure="lost")])
    assert len(found) == 1
    assert found[0].failures == 1
    ate = found[0].spread("ate_m")
    assert (ate.median, ate.low, ate.high) == (0.2, 0.1, math.inf)
    assert shown_spread(ate, BY_NAME["ate_m"]) == "0.2000 [0.1000, failed]"
    all_failed = groups([trial("a", None, seed=i, failure="lost") for i in range(3)])[0]
    assert all_failed.spread("ate_m").median == math.inf
    assert shown_spread(all_failed.spread("ate_m"), BY_NAME["ate_m"]) == "failed"
    assert all_failed.spread("cpu_s_per_s") is None
    # a failed run may have an error that was measured on the part that it covered: it must not count
    partial = groups([trial("a", 0.001, failure="covers 10 %"), trial("a", 0.5, seed=1)])[0]
    assert partial.spread("ate_m").low == 0.5


def test_costs_are_told_of_the_runs_that_did_not_fail():
    found = groups([trial("a", 0.1, cpu_s_per_s=2.0), trial("a", None, seed=1, failure="crash", cpu_s_per_s=9.0)])
    assert found[0].spread("cpu_s_per_s").high == 2.0


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_is_monotone_and_between_plain_and_bonferroni(p):
    corrected = holm(p)
    for plain, adjusted in zip(p, corrected, strict=True):
        assert plain <= adjusted <= min(1.0, len(p) * plain) + 1e-12 or adjusted == max(
            c for q, c in zip(p, corrected, strict=True) if q <= plain
        )
    order = np.argsort(p, kind="stable")
    assert np.all(np.diff(np.array(corrected)[order]) >= 0.0)


def test_holm_against_worked_numbers():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


def test_paired_test_is_scipys_on_the_medians_of_the_ensembles():
    rng = np.random.default_rng(4)
    trials, a, b = [], [], []
    for k in range(9):
        a_values, b_values = rng.uniform(0.1, 0.3, 3), rng.uniform(0.15, 0.5, 3)
        a.append(np.median(a_values))
        b.append(np.median(b_values))
        for member in range(3):
            trials.append(trial("a", a_values[member], f"s{k}", member=member))
            trials.append(trial("b", b_values[member], f"s{k}", member=member))
    (found,) = compare(trials, "ate_m")
    assert found.pairs == 9
    assert found.p == pytest.approx(wilcoxon(np.array(a) - np.array(b)).pvalue)
    assert found.first_better == sum(x < y for x, y in zip(a, b, strict=True))
    assert found.ratio == pytest.approx(np.median(np.array(a) / np.array(b)))
    assert found.p_holm == found.p


def test_seeds_of_one_sequence_are_one_pair_where_the_plan_says_so():
    trials = [
        trial(name, better + 0.01 * seed + 0.1 * k, f"s{k}", seed=seed)
        for k in range(7) for seed in range(3) for name, better in (("a", 0.1), ("b", 0.2 + 0.001 * k))
    ]  # fmt: skip
    assert compare(trials, "ate_m")[0].pairs == 21
    (found,) = compare(trials, "ate_m", by_seed=False)
    assert (found.pairs, found.first_better) == (7, 7)
    assert found.p == pytest.approx(2 / 2**7)  # the least that seven pairs can say
    assert found.ratio == pytest.approx(np.median([(0.11 + 0.1 * k) / (0.21 + 0.101 * k) for k in range(7)]))


def test_the_table_is_the_same_whoever_made_it_in_whatever_order_and_time():
    trials = [trial(name, 0.1, f"s{k}", cpu_s_per_s=1.0) for k in range(3) for name in "ab"]
    known = table_sha256(trials)
    assert table_sha256(trials[::-1]) == known
    assert table_sha256([trial(t.job.estimator, 0.1, t.job.sequence, cpu_s_per_s=2.0) for t in trials]) == known
    assert table_sha256([*trials[1:], trial("a", 0.1 + 1e-12, "s0")]) != known
    assert table_sha256([*trials[1:], trial("a", 0.1, "s0", failure="lost")]) != known
    assert table_sha256(trials[1:]) != known


def test_a_failure_loses_its_pair_by_the_largest_rank():
    wins = [trial(name, value, f"s{k}") for k in range(6) for name, value in (("a", 0.1), ("b", 0.11 + 0.01 * k))]
    clean = compare(wins, "ate_m")[0]
    assert (clean.first_better, clean.second_better) == (6, 0)
    failed = [trial("a", None, "s6", failure="lost"), trial("b", 0.2, "s6")]
    both = [trial("a", None, "s7", failure="lost"), trial("b", None, "s7", failure="lost")]
    with_failure = compare(wins + failed + both, "ate_m")[0]
    assert (with_failure.pairs, with_failure.first_better, with_failure.second_better) == (8, 6, 1)
    assert with_failure.p > clean.p
    expected = wilcoxon([-0.01, -0.02, -0.03, -0.04, -0.05, -0.06, 99.0]).pvalue
    assert with_failure.p == pytest.approx(expected)
    assert math.isfinite(with_failure.ratio)


def test_causal_and_final_are_not_tested_against_each_other():
    trials = [
        trial(name, 0.1 + 0.01 * k, f"s{k}", output=output)
        for k in range(5)
        for name in ("a", "b")
        for output in ("ekf", "live", "graph")
    ]
    pairs = {(c.first, c.second) for c in compare(trials, "ate_m")}
    assert len(pairs) == 6 + 1  # four causal estimates, two final ones
    assert all(("final" in first) == ("final" in second) for first, second in pairs)


def test_segments_that_no_path_is_long_enough_for_are_left_out():
    trials = [trial(name, 0.1, f"s{k}") for k in range(4) for name in ("a", "b")]
    assert compare(trials, "rpe_10m_percent") == []


def test_tables_hold_every_trial_and_escape_names():
    plan = Plan("p_1", (Sequence("points:laps", "s_1"),), (Estimator("a"), Estimator("b")))
    trials = [trial("a", 0.1, "s_1"), trial("b", 0.2, "s_1"), trial("b", None, "s_1", seed=1, failure='lost, "all"')]
    rows = runs_csv(plan, trials).splitlines()
    assert len(rows) == 4
    assert rows[3].startswith('s_1,b,ekf,1,0,failed,"lost, ""all""",')
    summary = summary_csv(plan, groups(trials)).splitlines()
    assert summary[2].startswith("s_1,b,ekf,2,1,inf,0.2,inf")
    text = latex(plan, groups(trials))
    assert r"s\_1" in text
    assert r"\textbf{0.1000}" in text
    assert "1/2" in text
    assert text.count(r"\\") == 3
    assert all(line.count("&") == 8 for line in text.splitlines() if line.endswith(r"\\"))
