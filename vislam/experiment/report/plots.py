"""The pictures of a comparison: colour separates filter and graph, marker and line style the estimators."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from vislam.experiment.measures import SEGMENTS_M
from vislam.experiment.plan import Axis
from vislam.experiment.report.exports import variant_text
from vislam.experiment.statistics import Group
from vislam.experiment.trials import BY_NAME, Trial
from vislam.runs.report.style import CODE, RC, svg

_MARKERS = "os^Dv<>P"
_LINES = ("-", "--", ":", "-.")
MAX_PANELS = 24  # more cannot be compared by eye; the tables hold all
WIDTH = 11.2
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")  # 0.02 is plainer than 2 x 10^-2


def _by_condition(groups: Sequence[Group]) -> dict[str, list[Group]]:
    """Return the groups of every panel: of one sequence and condition."""
    panels: dict[str, list[Group]] = {}
    for group in groups:
        name = ", ".join(part for part in (group.sequence, variant_text(group.variant)) if part)
        panels.setdefault(name, []).append(group)
    return dict(list(panels.items())[:MAX_PANELS])


def errors_by_estimate(groups: Sequence[Group], metric: str = "ate_m") -> str:
    """Draw median and range of an error for every estimate, one panel per sequence and condition."""
    chosen = _by_condition(groups)

    def draw(axes: Any, name: str) -> None:
        members = chosen[name]
        for y, group in enumerate(reversed(members)):
            _draw_error(axes, y, group, metric)
        axes.set_yticks(range(len(members)), [group.estimate for group in reversed(members)])
        axes.set_ylim(-0.6, len(members) - 0.4)
        axes.set_xscale("log")
        _label_plainly(axes.xaxis)
        axes.set_title(name, loc="left", fontsize=9)
        axes.grid(axis="y", visible=False)

    height = 0.26 * max(len(members) for members in chosen.values()) + 0.55
    return titled_panels(list(chosen), draw, height, BY_NAME[metric].title, "errors")


def _draw_error(axes: Any, y: float, group: Group, metric: str) -> None:
    """Draw one line of the panel: the range, each trial as a small dot, the median, and how many failed."""
    color, marker = _color(group.output), _marker(group)
    values = np.array([t.values[metric] for t in group.trials if not t.failure and metric in t.values])
    if len(values):
        axes.plot([values.min(), values.max()], [y, y], color=color, linewidth=1.2)
        axes.plot(values, np.full(len(values), y), ".", color=color, alpha=0.35, markersize=4)
    spread = group.spread(metric)
    if spread is not None and math.isfinite(spread.median):
        axes.plot([spread.median], [y], marker, color=color, markersize=6)
    if group.failures:
        text = f"{group.failures} of {len(group.trials)} failed"
        axes.text(0.99, y, text, color=CODE["bad"], ha="right", va="center", transform=axes.get_yaxis_transform())


def over_axis(groups: Sequence[Group], axis: Axis, metric: str = "ate_m") -> str:
    """Draw a metric over the numeric values of an axis, one panel per sequence and per value of the other axes."""
    panels: dict[str, list[Group]] = {}
    for group in groups:
        if axis.sequences and group.sequence not in axis.sequences:
            continue
        others = tuple(pair for pair in group.variant if pair[0] != axis.name)
        name = ", ".join(part for part in (group.sequence, variant_text(others)) if part)
        panels.setdefault(name, []).append(group)
    chosen = dict(list(panels.items())[:MAX_PANELS])

    def draw(axes: Any, name: str) -> None:
        lines: dict[str, list[Group]] = {}
        for group in chosen[name]:
            lines.setdefault(group.estimate, []).append(group)
        for estimate, members in lines.items():
            _draw_line(axes, axis, members, metric, estimate)
        axes.set_title(name, loc="left", fontsize=9)
        axes.set_xlabel(axis.name)
        axes.set_yscale("log")
        _label_plainly(axes.yaxis)

    return titled_panels(list(chosen), draw, 2.6, "", f"over-{metric}", BY_NAME[metric].title)


def _draw_line(axes: Any, axis: Axis, members: Sequence[Group], metric: str, label: str) -> None:
    points = []
    for group in members:
        spread = group.spread(metric)
        if spread is not None and math.isfinite(spread.median):
            value = next(value for name, value in group.variant if name == axis.name)
            top = spread.high if math.isfinite(spread.high) else spread.median
            points.append((float(value), spread.median, spread.low, top))
    if not points:
        return
    x, median, low, high = np.array(sorted(points)).T
    group = members[0]
    style = {"color": _color(group.output), "marker": _marker(group), "linestyle": _line(group), "markersize": 4}
    axes.errorbar(x, median, (median - low, high - median), label=label, linewidth=1.2, capsize=2, **style)


def over_segments(groups: Sequence[Group]) -> str:
    """Draw the relative error over the length of the segment, one panel per sequence and condition."""
    chosen = _by_condition(groups)

    def draw(axes: Any, name: str) -> None:
        for group in chosen[name]:
            spreads = [(length, group.spread(f"rpe_{length}m_percent")) for length in SEGMENTS_M]
            known = [(length, s) for length, s in spreads if s is not None and math.isfinite(s.median)]
            if known:
                axes.plot(
                    [length for length, _ in known], [s.median for _, s in known], color=_color(group.output),
                    marker=_marker(group), linestyle=_line(group), markersize=4, linewidth=1.2, label=group.estimate,
                )  # fmt: skip
        axes.set_title(name, loc="left", fontsize=9)
        axes.set_xticks(SEGMENTS_M)
        axes.set_xlabel("segment [m]")
        axes.set_yscale("log")
        _label_plainly(axes.yaxis)

    return titled_panels(list(chosen), draw, 2.4, "", "segments", "RPE [%]")


def paths(trials: Sequence[Trial]) -> str:
    """Draw the truth and every estimate from above, one panel per sequence; the trials are those to show."""

    def draw(axes: Any, members: list[Trial]) -> None:
        curve = members[0].curve
        axes.plot(curve["true_x_m"], curve["true_y_m"], color=CODE["truth"], linewidth=1.4, label="truth")
        for trial in members:
            style = {"color": _color(trial.output), "linestyle": _line(trial)}
            axes.plot(trial.curve["x_m"], trial.curve["y_m"], linewidth=0.9, label=trial.estimate, **style)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x [m]")

    return _by_sequence(trials, draw, 4.2, "paths", "y [m]")


def errors_over_time(trials: Sequence[Trial]) -> str:
    """Draw the position error of every estimate over time, one panel per sequence; the trials are those to show."""

    def draw(axes: Any, members: list[Trial]) -> None:
        for trial in members:
            style = {"color": _color(trial.output), "linestyle": _line(trial)}
            axes.plot(trial.curve["t_s"], trial.curve["error_m"], linewidth=0.9, label=trial.estimate, **style)
        axes.set_xlabel("time [s]")
        axes.set_ylim(bottom=0.0)

    return _by_sequence(trials, draw, 2.6, "time", "error [m]")


def _by_sequence(
    trials: Sequence[Trial], draw: Callable[[Any, list[Trial]], None], height: float, name: str, label: str
) -> str:
    panels: dict[str, list[Trial]] = {}
    for trial in trials:
        if trial.curve:
            panels.setdefault(trial.job.sequence, []).append(trial)

    def draw_titled(axes: Any, sequence: str) -> None:
        draw(axes, panels[sequence])
        axes.set_title(sequence, loc="left", fontsize=9)

    return titled_panels(list(panels)[:MAX_PANELS], draw_titled, height, "", name, label)


def titled_panels(
    names: Sequence[str], draw: Callable[[Any, str], None], height: float, x_label: str, name: str, y_label: str = ""
) -> str:
    """Draw named panels, two in a row, with one legend for all; an empty string without panels."""
    if not names:
        return ""
    columns = min(2, len(names))
    rows = -(-len(names) // columns)
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH, height * rows + 0.5), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, panel in zip(grid.flat, names, strict=False):
            draw(axes, panel)
            if x_label:
                axes.set_xlabel(x_label)
            if y_label:
                axes.set_ylabel(y_label)
        for axes in list(grid.flat)[len(names) :]:
            axes.set_visible(False)
        labels: dict[str, Any] = {}
        for axes in grid.flat:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                labels.setdefault(label, handle)
        if labels:
            figure.legend(labels.values(), labels.keys(), loc="outside upper left", ncols=3)
        return svg(figure, f"compare-{name}")


def _label_plainly(axis: Any) -> None:
    """Label a logarithmic axis at 1, 2, 5 of each decade, or at a few round numbers where it holds less than one."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)) if high >= 10.0 * low else MaxNLocator(4))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(PLAIN)


def _color(output: str) -> str:
    return CODE[{"causal": "live", "final": "graph"}.get(output, output)]  # programs show by marker and line


def _marker(item: Group) -> str:
    return _MARKERS[_rank(item) % len(_MARKERS)]


def _line(item: Group | Trial) -> str:
    return _LINES[_rank(item) % len(_LINES)]


def _rank(item: Group | Trial) -> int:
    """Return the place of an estimator in its plan."""
    trial = item.trials[0] if isinstance(item, Group) else item
    return trial.job.estimator_index
