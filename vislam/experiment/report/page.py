"""The comparison as one HTML file that needs no network."""

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

from vislam.experiment.plan import Axis, Plan
from vislam.experiment.report import from_start, plots
from vislam.experiment.report.exports import best, shown, shown_spread, variant_text
from vislam.experiment.statistics import Comparison, Group
from vislam.experiment.trials import BY_NAME, FROM_START, Trial
from vislam.experiment.winners import Winner, verdict
from vislam.runs.report.html import (
    Cell,
    bullets,
    card,
    drawn,
    escape,
    folded,
    note,
    preformatted,
    section,
    stylesheet,
    table,
    tile,
)

_MAIN = ("ate_m", "rpe_1m_percent", "rotation_deg", "scale_error", "completeness")
_MORE = (
    "rpe_5m_percent", "rpe_10m_percent", "rpe_1m_deg_per_m", "rpe_5m_deg_per_m", "rpe_10m_deg_per_m",
    "start_scale_sigma", "end_scale_sigma",
)  # fmt: skip
_COST = (
    "first_pose_s", "first_pose_cpu_s", "initialisation_s", "doubts", "latency_p50_ms", "latency_p99_ms",
    "filter_p50_ms", "filter_p99_ms", "cpu_ms_per_frame", "cpu_s_per_s", "peak_memory_mb", "keyframes", "loops",
    "injected_kept",
)  # fmt: skip
_STATES = ("anees_position", "anees_rotation", "anees_velocity")
_COLUMNS = 5  # of one table: a page has room for no more
_MAX_FAILURES = 200  # shown; runs.csv holds all
_MEASURED = (
    "Causal trajectories hold each pose as it was known when its frame had been processed; final ones know the whole "
    "recording. They are compared among themselves only.",
    "ATE: RMS position error after alignment by yaw and position. Sim3 only for one camera without an IMU, SE3 for "
    "cameras with depth but no IMU; the scale error, s - 1 of the best Sim3 fit, is a column of its own.",
    "From the same start: every estimate is laid on the truth at the first pose that both have, by yaw and position, "
    "without gravity by all of it (and by the scale of the best fit for one camera). Axes are those of the truth.",
    "RPE: RMS error of the motion over all segments of 1, 5 and 10 m of the true path, relative to its length.",
    "Complete: share of the recording's time with a pose; holes above 1 s do not count. Below 50 % a trial failed.",
    "ANEES, NIS: averages per degree of freedom with the 95 % bounds for independent errors; 1 is consistent, above is "
    "overconfident. Errors along one trajectory are correlated, so values a little outside the bounds prove nothing.",
    "Cells: median [range] over seeds and ensemble members, from 20 trials on [5 %, 95 %]. Members differ by 1e-9 of "
    "gravity: what they spread is chaos of the estimator, not a property of the data.",
    "Failed trials count as infinitely wrong in errors and their tests, and are left out of time and memory.",
    "Tests: Wilcoxon signed-rank on the median of each sequence, condition and seed (or over its seeds, where the "
    "plan asks for it), corrected by Holm's method. With n pairs no p value is below 2/2^n.",
    "Time per frame is that of the whole pipeline, on one thread of the machine that ran the job beside other jobs. "
    "CPU time is that of all threads of the run, reading and decoding included, without compilation.",
)


def comparison_page(
    plan: Plan,
    groups: Sequence[Group],
    trials: Sequence[Trial],
    comparisons: Sequence[Comparison],
    winners: Sequence[Winner],
    manifest: dict[str, Any],
) -> str:
    """Return the page; everything in it comes from the arguments."""
    body = "".join(
        (
            _head(plan, trials, winners, manifest),
            section("Who wins?", card(_winners(winners))),
            section(
                "Accuracy",
                card(
                    _accuracy(groups, _MAIN),
                    note("A green dot marks the smallest median among causal or among final ones."),
                ),
                _picture(plots.errors_by_estimate(groups)),
                folded("more errors", _accuracy(groups, _MORE)),
            ),
            section("Over the conditions", *(_axis(groups, axis) for axis in plan.axes)),
            section("Relative errors", _picture(plots.over_segments(groups))),
            section("Is the difference real?", card(_tests(comparisons))),
            section("Trajectories", *_shown_trials(plan, trials, (plots.paths, plots.errors_over_time))),
            section("From the same start", *_from_start(plan, groups, trials)),
            section("Consistency", card(_consistency(groups))),
            section("Time, memory, counts", card(_cost(groups))),
            section("Failures", _failures(trials)),
            section("How it was measured", card(bullets(_MEASURED))),
            section("To run it again", folded("manifest", preformatted(_manifest_text(manifest)))),
        )
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(f'vislam compare: {plan.name}')}</title><style>{stylesheet()}</style></head><body><main>{body}"
        "<footer>Made by vislam compare; the numbers are in runs.csv and summary.csv beside this page.</footer>"
        "</main></body></html>\n"
    )


def _head(plan: Plan, trials: Sequence[Trial], winners: Sequence[Winner], manifest: dict[str, Any]) -> str:
    jobs = {trial.job.key for trial in trials}
    failed = {trial.job.key for trial in trials if trial.failure}
    tiles = (
        tile(str(len(plan.sequences)), "", "sequences"),
        tile(str(len(plan.estimators)), "", "estimators"),
        tile(f"{len(plan.seeds)} × {plan.members}", "", "seeds × ensemble members"),
        tile(str(len(jobs)), "", "runs"),
        tile(str(len(failed)), "", "of them failed", "bad" if failed else "good"),
    )
    revision = str(manifest.get("code_revision") or "not under version control")
    made_by = f"vislam {revision[:26]}, {manifest.get('finished', '')}, table {manifest.get('table_sha256', '')[:16]}"
    answer = verdict(winners) or "There is only one estimate of each kind: nothing to win."
    lead = f'<p class="verdict">{escape(answer)}</p><p class="lead">{escape(made_by)}</p>'
    return f'<h1>{escape(plan.title or plan.name)}</h1>{lead}<div class="tiles">{"".join(tiles)}</div>'


def _accuracy(groups: Sequence[Group], names: Sequence[str]) -> str:
    """Return the table of some errors; a page of 1400 px has room for five."""
    metrics = [BY_NAME[name] for name in names]
    rows: list[list[str | Cell]] = []
    for group in groups:
        cells: list[str | Cell] = []
        for metric in metrics:
            mark = "accepted" if metric.kind == "error" and best(group, groups, metric.name) else ""
            cells.append(Cell(shown_spread(group.spread(metric.name), metric), mark))
        rows.append([*_names(group), *cells, _failed(group)])
    head = [*_NAMES, *(metric.title for metric in metrics), "failed"]
    return table(head, rows, (0, 1, 2))


_NAMES = ("sequence", "condition", "estimate")


def _names(group: Group) -> list[str | Cell]:
    return [group.sequence, variant_text(group.variant), Cell(group.estimate, group.output, "text")]


def _failed(group: Group) -> Cell:
    return Cell(f"{group.failures} of {len(group.trials)}", "rejected" if group.failures else "")


def _cost(groups: Sequence[Group]) -> str:
    """Return tables of what estimators cost, of as many columns each as a page has room for."""
    runs: dict[tuple[Any, ...], Group] = {}
    for group in groups:
        runs.setdefault((group.sequence, group.variant, group.estimator), group)  # all outputs come from one run
    tables = []
    for k in range(0, len(_COST), _COLUMNS):
        metrics, rows = [BY_NAME[name] for name in _COST[k : k + _COLUMNS]], list[list[str | Cell]]()
        for group in runs.values():
            cells = [shown_spread(group.spread(metric.name), metric) for metric in metrics]
            rows.append([group.sequence, variant_text(group.variant), group.estimator, *cells])
        tables.append(table(["sequence", "condition", "estimator", *(m.title for m in metrics)], rows, (0, 1, 2)))
    return "".join(tables)


def _consistency(groups: Sequence[Group]) -> str:
    rows: list[list[str | Cell]] = []
    for group in groups:
        nis = sorted({name for trial in group.trials for name in trial.bounds if name.startswith("nis_")})
        for name in (*_STATES, *nis):
            spread = group.spread(name)
            if spread is None:
                continue
            first = next(trial for trial in group.trials if name in trial.bounds)
            low, high = first.bounds[name]
            inside = low <= spread.median <= high
            title = BY_NAME[name].title if name in BY_NAME else f"NIS {name.removeprefix('nis_').replace('_', ' ')}"
            value = shown_spread(spread, BY_NAME["anees_position"])
            rows.append(
                [*_names(group), title, Cell(value, "accepted" if inside else "pending"), f"{low:.2f} to {high:.2f}"]
            )
    if not rows:
        return note("No run had states with covariances and a truth to compare them with.")
    return table([*_NAMES, "statistic", "median [range]", "95 % bounds"], rows, (0, 1, 2, 3))


def _tests(comparisons: Sequence[Comparison]) -> str:
    if not comparisons:
        return note("There is only one estimate of each kind: nothing to test.")
    rows: list[list[str | Cell]] = [
        [
            BY_NAME[c.metric].title, c.first, c.second, str(c.pairs), f"{c.first_better} : {c.second_better}",
            shown(c.ratio, BY_NAME["anees_position"]), f"{c.effect:+.2f}", f"{c.p:.4f}",
            Cell(f"{c.p_holm:.4f}", "accepted" if c.p_holm < 0.05 else ""),
        ]
        for c in comparisons
    ]  # fmt: skip
    head = ["error", "first", "second", "pairs", "better", "median ratio", "effect", "p", "p (Holm)"]
    return table(head, rows, (0, 1, 2)) + note(
        "A green dot: the two differ at the 5 % level after correction. Effect: rank-biserial correlation of the "
        "pairs, -1 where the first is always better, 1 where the second is."
    )


def _winners(winners: Sequence[Winner]) -> str:
    if not winners:
        return note("There is only one estimate of each kind: nothing to win.")
    rows: list[list[str | Cell]] = [
        [
            w.sequence or "the whole plan", variant_text(w.variant), BY_NAME[w.metric].title, w.kind,
            Cell(w.estimate or "none", "accepted" if w.estimate and not w.sequence else ""),
            "" if math.isnan(w.margin) else f"{w.margin:.0%} less than {w.runner_up}", w.reason,
        ]
        for w in winners
    ]  # fmt: skip
    return table(
        ["sequence", "condition", "error", "kind", "winner", "margin", "how sure"], rows, tuple(range(7))
    ) + note(
        "Over the whole plan: better than every other one in a paired test at the 5 % level, after correction; the "
        "margin is the median over the pairs. On a sequence: the worst trial is better than the best of every other."
    )


def _axis(groups: Sequence[Group], axis: Axis) -> str:
    if len(axis.values) < 2 or any(isinstance(value, str | bool) for value in axis.values):
        return ""
    pictures = [plots.over_axis(groups, axis, metric) for metric in ("ate_m", "rpe_5m_percent")]
    return "".join(_picture(picture, axis.name) for picture in pictures)


def _shown_trials(
    plan: Plan, trials: Sequence[Trial], pictures: Sequence[Callable[[Sequence[Trial]], str]]
) -> list[str]:
    """Return pictures of the first condition, seed and member, which stand for the others."""
    if not trials:
        return []
    variant = trials[0].job.variant
    first = [t for t in trials if t.job.variant == variant and t.job.seed == plan.seeds[0] and t.job.member == 0]
    caption = f"{variant_text(variant) or 'as configured'}, seed {plan.seeds[0]}, member 0"
    return [_picture(picture(first), caption) for picture in pictures]


def _from_start(plan: Plan, groups: Sequence[Group], trials: Sequence[Trial]) -> list[str]:
    """Return what shows how an estimate drifts: way and errors from a common first pose, and their RMS by axis."""
    if not any(trial.start_curve for trial in trials):
        return []
    table_ = card(_accuracy(groups, FROM_START), title="RMS error by axis: median [range]")
    shown_ = _shown_trials(plan, trials, (from_start.paths, from_start.errors_over_time))
    return [*shown_, _picture(from_start.errors_by_axis(groups), "RMS error by axis"), table_]


def _failures(trials: Sequence[Trial]) -> str:
    failed = [trial for trial in trials if trial.failure]
    if not failed:
        return card(note("None."))
    rows: list[list[str | Cell]] = [
        [t.job.label, t.output, Cell(t.failure, kind="text long")] for t in failed[:_MAX_FAILURES]
    ]
    more = note(f"{len(failed) - _MAX_FAILURES} more are in runs.csv.") if len(failed) > _MAX_FAILURES else ""
    return card(table(["job", "output", "reason"], rows, (0, 1, 2)), more)


def _picture(picture: str, title: str = "") -> str:
    return card(drawn(picture), title=title) if picture else ""


def _manifest_text(manifest: dict[str, Any]) -> str:
    return json.dumps({name: value for name, value in manifest.items() if name != "results"}, indent=1)
