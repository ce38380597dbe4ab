"""Estimates from a common first pose: where each leaves the truth, by axis. A colour is an estimate of the plan."""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from vislam.experiment.report.plots import MAX_PANELS, PLAIN, WIDTH, titled_panels
from vislam.experiment.statistics import Group
from vislam.experiment.trials import BY_NAME, FROM_START, Trial
from vislam.runs.report.style import CODE, RC, svg

_COLORS = ("bad", "batch", "ekf", "live", "graph", "good", "warn", "muted")
_LINES = ("-", "--", ":")  # when the colours have been used up
_AROUND = 0.15  # of the truth's extent that is shown around it: what runs away leaves the picture
_OVER_TIME = (("x_m", "x [m]", 0.02), ("y_m", "y [m]", 0.02), ("yaw_deg", "yaw [°]", 0.2))  # linear below
_ROW = 0.62  # of a sequence's row, that its estimates share


def paths(trials: Sequence[Trial]) -> str:
    """Draw the truth and every estimate from above, one panel per sequence; the trials are those to show."""
    by_sequence, styles = _by_sequence(trials), _styles([trial.estimate for trial in trials])

    def draw(axes: Any, sequence: str) -> None:
        members = by_sequence[sequence]
        x, y = (np.array(members[0].start_curve[f"true_{axis}_m"]) for axis in "xy")
        axes.plot(x, y, color=CODE["truth"], linewidth=3.0, alpha=0.35, label="truth")
        for trial in members:
            curve = trial.start_curve
            axes.plot(curve["at_x_m"], curve["at_y_m"], linewidth=1.1, label=trial.estimate, **styles[trial.estimate])
        axes.plot(x[0], y[0], "o", color=CODE["truth"], markersize=5)
        around_m = _AROUND * max(np.ptp(x), np.ptp(y)) + 0.1
        axes.set(xlim=(x.min() - around_m, x.max() + around_m), ylim=(y.min() - around_m, y.max() + around_m))
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel("x [m]")
        axes.set_title(sequence, loc="left", fontsize=9)

    return titled_panels(list(by_sequence), draw, 3.4, "", "start-paths", "y [m]")


def errors_over_time(trials: Sequence[Trial]) -> str:
    """Draw the errors of x, y and yaw over time, a row per sequence; linear around zero and logarithmic beyond."""
    by_sequence, styles = _by_sequence(trials), _styles([trial.estimate for trial in trials])
    if not by_sequence:
        return ""
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH, 1.9 * len(by_sequence) + 0.5), layout="constrained")
        grid = figure.subplots(len(by_sequence), len(_OVER_TIME), squeeze=False)
        for row, (sequence, members) in zip(grid, by_sequence.items(), strict=True):
            for axes, (column, label, linear) in zip(row, _OVER_TIME, strict=True):
                for trial in members:
                    curve, style = trial.start_curve, styles[trial.estimate]
                    axes.plot(curve["t_s"], curve[column], linewidth=1.1, label=trial.estimate, **style)
                axes.axhline(0.0, color=CODE["truth"], linewidth=0.8)
                axes.set_yscale("symlog", linthresh=linear)
                axes.set_yticks(_ticks(axes.get_ylim(), linear), minor=False)
                axes.set_yticks([], minor=True)
                axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
                axes.set_ylabel(label)
            row[0].set_title(sequence, loc="left", fontsize=9)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        _legend(figure, grid[0, 0])
        return svg(figure, "compare-start-time")


def errors_by_axis(groups: Sequence[Group]) -> str:
    """Draw the RMS error of x, y, z and yaw of every estimate: median and range, a row per sequence and condition."""
    rows = list(dict.fromkeys((group.sequence, group.variant) for group in groups))[:MAX_PANELS]
    styles = _styles([group.estimate for group in groups])
    step = _ROW / max(len(styles) - 1, 1)
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH, 0.42 * len(rows) + 1.2), layout="constrained")
        grid = figure.subplots(1, len(FROM_START), sharey=True)
        for axes, name in zip(grid, FROM_START, strict=True):
            for group in groups:
                if (group.sequence, group.variant) in rows:
                    row = len(rows) - 1 - rows.index((group.sequence, group.variant))
                    _draw_group(axes, row + _ROW / 2 - step * list(styles).index(group.estimate), group, name, styles)
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(numticks=5))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter(PLAIN)
            axes.set_xlabel(BY_NAME[name].title)
            axes.grid(axis="y", visible=False)
            for line in range(1, len(rows)):
                axes.axhline(line - 0.5, color=CODE["line"], linewidth=0.6)
            axes.set_ylim(-0.5, len(rows) - 0.5)
        names = [", ".join([sequence, *(f"{axis} {value}" for axis, value in variant)]) for sequence, variant in rows]
        grid[0].set_yticks(range(len(rows)), names[::-1])
        _legend(figure, grid[0])
        return svg(figure, "compare-start-axes")


def _draw_group(axes: Any, y: float, group: Group, name: str, styles: dict[str, dict[str, Any]]) -> None:
    spread = group.spread(name)
    if spread is None or not math.isfinite(spread.median):
        return
    color = styles[group.estimate]["color"]
    high = spread.high if math.isfinite(spread.high) else spread.median
    axes.plot([spread.low, high], [y, y], color=color, linewidth=1.4)
    axes.plot([spread.median], [y], "o", color=color, markersize=4.5, label=group.estimate)


def _by_sequence(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    found: dict[str, list[Trial]] = {}
    for trial in trials:
        if trial.start_curve:
            found.setdefault(trial.job.sequence, []).append(trial)
    return dict(list(found.items())[:MAX_PANELS])


def _styles(estimates: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return how each estimate is drawn, in their order."""
    return {
        name: {
            "color": CODE[_COLORS[i % len(_COLORS)]],
            "linestyle": _LINES[i // len(_COLORS) % len(_LINES)],
        }
        for i, name in enumerate(dict.fromkeys(estimates))
    }


def _ticks(limits: tuple[float, float], linear: float) -> list[float]:
    """Return a few ticks of a symmetric logarithmic axis: zero, where it begins to be logarithmic, and decades."""
    top = max(abs(limits[0]), abs(limits[1]), linear)
    decades = [10.0**k for k in range(math.ceil(math.log10(5.0 * linear)), math.floor(math.log10(top)) + 1)]
    shown = [linear, *decades[:: len(decades) // 3 + 1]]
    return [0.0, *(tick for each in shown for tick in (-each, each) if limits[0] <= tick <= limits[1])]


def _legend(figure: Figure, axes: Any) -> None:
    found = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    if found:
        figure.legend(found.values(), found.keys(), loc="outside upper left", ncols=4)
