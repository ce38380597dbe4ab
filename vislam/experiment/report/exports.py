"""The results as files for other programs: CSV for every number, LaTeX (booktabs) for the paper."""

import math
from collections.abc import Sequence

from vislam.core.files import csv_text
from vislam.experiment.plan import Plan
from vislam.experiment.statistics import Comparison, Group, Spread, Variant
from vislam.experiment.trials import BY_NAME, CAUSAL, METRICS, Metric, Trial
from vislam.experiment.winners import Winner

_LATEX_METRICS = ("ate_m", "scale_error", "rpe_1m_percent", "rpe_5m_percent", "rpe_10m_percent", "completeness")
_SPECIAL = {
    "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "°": r"$^\circ$",
}  # fmt: skip


def variant_text(variant: Variant) -> str:
    """Return a condition as text; empty when nothing is varied."""
    return ", ".join(f"{name} {value}" for name, value in variant)


def shown(value: float | None, metric: Metric) -> str:
    """Return a number as a table shows it: a dash where nothing was measured, "failed" for an infinite error."""
    if value is None or math.isnan(value):
        return "–"
    return "failed" if math.isinf(value) else f"{value * metric.scale:.{metric.digits}f}"


def shown_spread(spread: Spread | None, metric: Metric) -> str:
    """Return a median with its range in brackets, where there is one."""
    if spread is None:
        return "–"
    median, low, high = (shown(value, metric) for value in (spread.median, spread.low, spread.high))
    return median if low == high else f"{median} [{low}, {high}]"


def runs_csv(plan: Plan, trials: Sequence[Trial]) -> str:
    """Return every trial with every number that was measured, one row each."""
    kinds = sorted({name for trial in trials for name in trial.bounds if name not in BY_NAME})
    names = [metric.name for metric in METRICS] + kinds
    axes = plan.axis_names
    head = ["sequence", *axes, "estimator", "output", "seed", "member", "status", "reason", *names, "sha256", "key"]
    rows = [
        [
            t.job.sequence, *_varied(plan, t.job.variant), t.job.estimator, t.output, t.job.seed, t.job.member,
            "failed" if t.failure else "ok", t.failure,
            *(t.values.get(name, "") for name in names), t.sha256, t.job.key,
        ]
        for t in trials
    ]  # fmt: skip
    return csv_text(head, rows)


def summary_csv(plan: Plan, groups: Sequence[Group]) -> str:
    """Return median, low and high of every metric of every group; "inf" where failures reach."""
    head = ["sequence", *plan.axis_names, "estimator", "output", "trials", "failures"]
    head += [f"{metric.name}_{part}" for metric in METRICS for part in ("median", "low", "high")]
    rows: list[list[object]] = []
    for group in groups:
        row: list[object] = [group.sequence, *_varied(plan, group.variant), group.estimator, group.output]
        row += [len(group.trials), group.failures]
        for metric in METRICS:
            found = group.spread(metric.name)
            row += ["", "", ""] if found is None else [found.median, found.low, found.high]
        rows.append(row)
    return csv_text(head, rows)


def tests_csv(comparisons: Sequence[Comparison]) -> str:
    """Return the paired tests."""
    head = [
        "metric",
        "first",
        "second",
        "pairs",
        "first_better",
        "second_better",
        "median_ratio",
        "effect",
        "p",
        "p_holm",
    ]
    return csv_text(
        head,
        [
            [c.metric, c.first, c.second, c.pairs, c.first_better, c.second_better, c.ratio, c.effect, c.p, c.p_holm]
            for c in comparisons
        ],
    )


def winners_csv(plan: Plan, winners: Sequence[Winner]) -> str:
    """Return who wins by how much, over the plan (no sequence) and on each sequence; no estimate where none does."""
    head = ["metric", "kind", "sequence", *plan.axis_names, "winner", "margin", "runner_up", "reason"]
    return csv_text(
        head,
        [
            [w.metric, w.kind, w.sequence, *_varied(plan, w.variant), w.estimate,
             "" if math.isnan(w.margin) else w.margin, w.runner_up, w.reason]
            for w in winners
        ],
    )  # fmt: skip


def latex(plan: Plan, groups: Sequence[Group]) -> str:
    """Return a table for a paper (packages booktabs); the best median of a sequence and condition is bold.

    Causal and final trajectories compete among themselves only.
    """
    metrics = [BY_NAME[name] for name in _LATEX_METRICS]
    lines = [
        f"% {plan.name}: median [range] over seeds and null-jitter members; failures are counted and rank worst",
        r"\begin{tabular}{ll" + "r" * len(metrics) + "r}",
        r"\toprule",
        "sequence & estimate & " + " & ".join(_tex(metric.title) for metric in metrics) + r" & failed \\",
    ]
    block = None
    for group in groups:
        here = (group.sequence, group.variant)
        if here != block:
            lines.append(r"\midrule")
        name = (
            ", ".join(part for part in (group.sequence, variant_text(group.variant)) if part) if here != block else ""
        )
        block = here
        cells = [_latex_cell(group, groups, metric) for metric in metrics]
        failed = f"{group.failures}/{len(group.trials)}"
        lines.append(" & ".join([_tex(name), _tex(group.estimate), *cells, failed]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def best(group: Group, groups: Sequence[Group], metric: str) -> bool:
    """Whether no other group of the same sequence, condition and class (causal, final) has a smaller median."""
    mine = group.spread(metric)
    if mine is None or math.isinf(mine.median):
        return False
    rivals = [
        other.spread(metric)
        for other in groups
        if (other.sequence, other.variant) == (group.sequence, group.variant)
        and (other.output in CAUSAL) == (group.output in CAUSAL)
    ]
    return len(rivals) > 1 and all(rival is None or mine.median <= rival.median for rival in rivals)


def _latex_cell(group: Group, groups: Sequence[Group], metric: Metric) -> str:
    text = _tex(shown_spread(group.spread(metric.name), metric).replace("–", "--"))
    return rf"\textbf{{{text}}}" if metric.kind == "error" and best(group, groups, metric.name) else text


def _tex(text: str) -> str:
    return "".join(_SPECIAL.get(character, character) for character in text)


def _varied(plan: Plan, variant: Variant) -> list[object]:
    """Return the value of everything that is varied; empty where it is not."""
    values: dict[str, object] = dict(variant)
    return [values.get(name, "") for name in plan.axis_names]
