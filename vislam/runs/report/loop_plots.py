"""Pictures of how good loops are: precision over recall per stage, and the errors of the edges."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from vislam.core.files import replacing
from vislam.runs.report.style import CODE, RC, light, svg

STAGES = {
    "appearance": "muted",
    "hindsight": "truth",
    "normalised": "bad",
    "temporal": "warn",
    "geometry": "live",
    "checks": "ekf",
    "graph": "graph",
}
_TITLES = {
    "appearance": "appearance",
    "hindsight": "in hindsight",
    "normalised": "normalised",
    "temporal": "+ temporal",
    "geometry": "+ geometry",
    "checks": "+ checks",
    "graph": "+ graph",
}


def loop_quality(answer: dict[str, Any]) -> str:
    """Return the pictures of one evaluation as SVG."""
    with mpl.rc_context(RC):
        return svg(_figure({"": answer}, CODE), "loop-quality")


def write_loop_plot(path: Path, answers: Mapping[str, dict[str, Any]]) -> None:
    """Write the pictures of evaluations as one PNG, a row per evaluation; the same ones give the same bytes."""
    colors, rc = light()
    with mpl.rc_context(rc), replacing(path) as file:
        _figure(answers, colors).savefig(
            file, format="png", dpi=110, facecolor=colors["paper"], metadata={"Software": None}
        )


def _figure(answers: Mapping[str, dict[str, Any]], colors: Mapping[str, str]) -> Figure:
    figure = Figure(figsize=(11.2, 3.6 * len(answers)), layout="constrained")
    grid = figure.subplots(len(answers), 2, squeeze=False)
    for (left, right), (name, answer) in zip(grid, answers.items(), strict=True):
        _draw_curves(left, answer, colors)
        _draw_errors(right, answer, colors)
        if name:
            left.set_title(name, loc="left", fontsize=9)
    return figure


def _draw_curves(axes: Any, answer: dict[str, Any], colors: Mapping[str, str]) -> None:
    """Draw precision over recall; a dot marks the recall at full precision, a bar its interval."""
    for row, (name, color) in enumerate(STAGES.items()):
        stage = answer["stages"].get(name)
        if stage is None or not stage["curve"]["recall"]:
            continue
        recall, precision = stage["curve"]["recall"], stage["curve"]["precision"]
        full = stage["recall_at_full_precision"]
        label = f"{_TITLES[name]}: {full:.2f} at 100 %"
        axes.plot([0.0, *recall], [precision[0], *precision], color=colors[color], linewidth=1.5, label=label)
        axes.plot([full], [1.0], "o", color=colors[color], markersize=5, zorder=4, clip_on=False)
        low, high = stage["interval"]
        if low is not None and np.isfinite(low):
            height = 1.015 + 0.014 * row
            axes.plot([low, high], [height, height], color=colors[color], linewidth=1.5, alpha=0.6, clip_on=False)
    axes.set(xlabel="recall of true revisits", ylabel="precision")
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.09)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="best")


def _draw_errors(axes: Any, answer: dict[str, Any], colors: Mapping[str, str]) -> None:
    """Draw which share of the edges in the graph has a smaller error, with the line beyond which it is gross."""
    edges, rule = answer["edges"], answer["rule"]
    errors = np.maximum(np.array(edges["errors_m"], dtype=np.float64), 1e-4)
    if len(errors):
        share = (np.arange(len(errors)) + 1) / len(errors)
        axes.step(errors, share, where="post", color=colors["graph"], linewidth=1.5)
    axes.axvline(rule["gross_m"], color=colors["bad"], linewidth=0.9, linestyle=(0, (4, 3)), label="gross")
    axes.set_xscale("log")
    axes.set_xlim(1e-3, max(2.0, float(errors.max(initial=1.0)) * 1.5))
    axes.set_ylim(0.0, 1.02)
    axes.set(xlabel="error of an accepted edge's translation [m]", ylabel="share of the edges")
    axes.legend(loc="lower right")
