"""The report's pictures as inline SVG that follows the page's colours, light or dark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from vislam.core.messages import Array, NavState
from vislam.runs.report.run_files import RunFiles
from vislam.runs.report.scene import Scene, loop_segments
from vislam.runs.report.style import CODE, RC, svg

_WIDTHS = {"ekf": 1.3, "live": 1.0, "graph": 1.7, "batch": 1.3}
_STATE_COLORS = {"ok": "good", "degraded": "warn", "lost": "bad", "blind": "muted"}
_MAX_STRETCH = 25.0  # of the vertical axis: more would turn millimetres into mountains
_MAX_REJECTED = 200  # loops drawn: more is a red cloud
_MAX_LOOP_LINES = 25
_MAX_POINTS = 1500  # per line: more cannot be seen and only makes the file heavy


def top_view(run: RunFiles, scene: Scene) -> str:
    """Draw all trajectories from above, with loops; equal scales."""
    with mpl.rc_context(RC):
        figure = Figure(figsize=(5.5, 4.7), layout="constrained")
        axes = figure.add_subplot()
        _draw_paths(axes, scene, 0, 1)
        _draw_loops(axes, run, scene)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        _legend_above(axes, columns=3)
        return svg(figure, "top")


def side_view(scene: Scene) -> str:
    """Draw all trajectories from the side; the vertical scale is stretched where the motion is flat."""
    positions = np.concatenate([t.positions_m for t in _all_paths(scene).values()])
    extent = np.ptp(positions, axis=0)
    along = 0 if extent[0] >= extent[1] else 1
    with mpl.rc_context(RC):
        figure = Figure(figsize=(5.5, 4.7), layout="constrained")
        axes = figure.add_subplot()
        _draw_paths(axes, scene, along, 2)
        axes.set(xlabel=f"{'xy'[along]} [m]", ylabel="z [m]")
        if extent[2] > 0.35 * extent[along]:
            axes.set_aspect("equal", adjustable="datalim")
        else:
            middle = float(np.mean(axes.get_ylim()))
            half = max(0.65 * float(np.ptp(axes.get_ylim())), 0.5 * extent[along] / _MAX_STRETCH)
            axes.set_ylim(middle - half, middle + half)
            figure.draw_without_rendering()
            box = axes.get_window_extent()
            stretch = (box.height / np.ptp(axes.get_ylim())) / (box.width / np.ptp(axes.get_xlim()))
            axes.set_ylabel(f"z [m], stretched {stretch:.0f}×" if stretch >= 1.5 else "z [m]")
        _legend_above(axes, columns=4)
        return svg(figure, "side")


def over_time(run: RunFiles, scene: Scene) -> str:
    """Draw errors, inliers and the tracking state over time, with a mark at every accepted loop."""
    panels = [name for name, wanted in (("position", scene.errors), ("rotation", scene.errors)) if wanted]
    if run.tracking is not None and len(run.tracking.t_ns):
        panels += ["inliers", "state"]
    if not panels:
        return ""
    ratios = {"position": 3.0, "rotation": 1.8, "inliers": 1.3, "state": 0.35}
    heights = [ratios[name] for name in panels]
    closed = scene.seconds([loop.to_t_ns for loop in run.loops if loop.decision == "accepted" and loop.to_t_ns >= 0])
    with mpl.rc_context(RC):
        figure = Figure(figsize=(11.2, 0.75 * sum(heights) + 0.8), layout="constrained")
        grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights})
        for name, axes in zip(panels, grid[:, 0], strict=True):
            if name == "position":
                _draw_errors(axes, scene, "position_m", "position error [m]")
            elif name == "rotation":
                _draw_errors(axes, scene, "rotation_deg", "rotation error [°]")
            elif name == "inliers":
                _draw_inliers(axes, run, scene)
            else:
                _draw_state(axes, run, scene)
            if name != "state":
                _mark_loops(axes, closed)
        if scene.errors:
            _legend_above(grid[0, 0], columns=4)
        grid[-1, 0].set_xlabel("time [s]")
        grid[-1, 0].set_xlim(0.0, max(scene.end_s, 1e-3))
        figure.align_ylabels()
        return svg(figure, "time")


def timing(stages: Mapping[str, Mapping[str, float]], period_ms: float | None) -> str:
    """Draw p50, p95 and p99 of every stage on a logarithmic axis, with the time between two frames."""
    rows = [
        (name, stage) for name, stage in stages.items() if all(stage.get(p, 0.0) > 0.0 for p in ("p50", "p95", "p99"))
    ]
    if not rows:
        return ""
    with mpl.rc_context(RC):
        figure = Figure(figsize=(5.5, 0.3 * len(rows) + 0.95), layout="constrained")
        axes = figure.add_subplot()
        for k, (_, stage) in enumerate(rows):
            axes.plot([stage["p50"], stage["p99"]], [k, k], color=CODE["graph"], linewidth=1.2, alpha=0.45)
        for mark, key, size in (("o", "p50", 26), ("|", "p95", 46), (">", "p99", 16)):
            values = [stage[key] for _, stage in rows]
            axes.scatter(values, range(len(rows)), marker=mark, s=size, color=CODE["graph"], label=key, zorder=3)
        if period_ms:
            axes.axvline(period_ms, color=CODE["bad"], linewidth=0.9, linestyle=(0, (4, 3)), label="frame period")
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(numticks=12))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_yticks(range(len(rows)), [name for name, _ in rows])
        axes.tick_params(axis="y", labelcolor=CODE["ink"], length=0)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("milliseconds per call")
        _legend_above(axes, columns=4)
        return svg(figure, "timing")


def biases(states: Mapping[str, list[NavState]], scene: Scene) -> str:
    """Draw gyroscope and accelerometer biases of the graph with three sigma, and those of the EKF dashed."""
    states = {
        name: [s for s in of_one if np.isfinite(np.diag(s.covariance)[9:]).all()] for name, of_one in states.items()
    }
    if not any(states.values()):
        return ""  # without an IMU there are none
    with mpl.rc_context(RC):
        figure = Figure(figsize=(11.2, 2.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        for axes, attribute, first, unit in (
            (left, "gyro_bias_rad_s", 9, "gyroscope bias [mrad/s]"),
            (right, "accel_bias_m_s2", 12, "accelerometer bias [m/s²]"),
        ):
            factor = 1e3 if "mrad" in unit else 1.0
            for name, style in (("graph", "-"), ("ekf", "--")):
                if states.get(name):
                    _draw_bias(axes, states[name], scene, attribute, first, factor, style)
            axes.axhline(0.0, color=CODE["line"], linewidth=0.8, zorder=0.6)
            axes.set(ylabel=unit, xlabel="time [s]")
            axes.set_xlim(0.0, max(scene.end_s, 1e-3))
        _legend_above(left, columns=3)
        return svg(figure, "biases")


def _draw_bias(
    axes: Any, states: list[NavState], scene: Scene, attribute: str, first: int, factor: float, style: str
) -> None:
    fill = style == "-"
    t = scene.seconds(np.array([s.t_ns for s in states]))
    values = factor * np.array([getattr(s, attribute) for s in states])
    variances = np.array([np.diag(s.covariance)[first : first + 3] for s in states])
    band = 3.0 * factor * np.sqrt(np.maximum(variances, 0.0))
    for k, axis in enumerate("xyz"):
        color = CODE[f"axis-{axis}"]
        axes.plot(t, values[:, k], style, color=color, linewidth=1.4 if fill else 0.9, label=axis if fill else None)
        if fill:
            axes.fill_between(
                t, values[:, k] - band[:, k], values[:, k] + band[:, k], color=color, alpha=0.12, linewidth=0
            )
    if fill:  # the first sigmas are those of the prior and would flatten everything else
        late = slice(min(len(t) // 5, len(t) - 1), None)
        low, high = (values - band)[late].min(), (values + band)[late].max()
        low, high = min(low, values.min()), max(high, values.max())
        margin = 0.08 * max(high - low, 1e-9)
        axes.set_ylim(low - margin, high + margin)


def _all_paths(scene: Scene) -> dict[str, Any]:
    paths = {name: path for name, path in scene.paths.items() if len(path)}
    return paths if scene.truth is None else {"truth": scene.truth, **paths}


def _draw_paths(axes: Any, scene: Scene, horizontal: int, vertical: int) -> None:
    for name, path in _all_paths(scene).items():
        points = _thin(path.positions_m)
        if name == "truth":
            axes.plot(
                points[:, horizontal],
                points[:, vertical],
                color=CODE["truth"],
                linewidth=2.4,
                alpha=0.55,
                label=scene.labels["truth"],
            )
        elif name != "live" or "graph" not in scene.paths:
            # the causal path jumps at loops by design; drawn beside the final one it only hides it
            axes.plot(
                points[:, horizontal],
                points[:, vertical],
                color=CODE[name],
                linewidth=_WIDTHS[name],
                label=scene.labels[name],
            )
    best = next((scene.paths[name] for name in ("graph", "live", "ekf") if len(scene.paths.get(name, ()))), None)
    if best is not None:
        start = best.positions_m[0]
        axes.plot(
            start[horizontal], start[vertical], "o", markersize=5, markerfacecolor=CODE["paper"], color=CODE["ink"],
            markeredgewidth=1.1, label="start", zorder=5,
        )  # fmt: skip


def _draw_loops(axes: Any, run: RunFiles, scene: Scene) -> None:
    """Draw rejected loops faintly under everything, accepted ones above, with a dot where the loop was closed."""
    rejected = loop_segments(run, scene, "rejected")[:_MAX_REJECTED, :, :2]
    accepted = loop_segments(run, scene, "accepted")[:, :, :2]
    if len(rejected):
        axes.add_collection(LineCollection(list(rejected), colors=CODE["bad"], linewidths=0.5, alpha=0.2, zorder=1))
        axes.plot([], [], color=CODE["bad"], linewidth=0.7, label="loops rejected")
    if len(accepted):
        few = len(accepted) <= _MAX_LOOP_LINES
        width, size, order = (1.1, 5, 4) if few else (0.5, 2, 1.5)
        axes.add_collection(LineCollection(list(accepted), colors=CODE["good"], linewidths=width, zorder=order))
        axes.plot(*accepted[:, 1].T, ".", color=CODE["good"], markersize=size, zorder=order)  # many lines are short
        axes.plot([], [], ".-", color=CODE["good"], linewidth=1.1, markersize=5, label="loops accepted")


def _draw_errors(axes: Any, scene: Scene, attribute: str, label: str) -> None:
    for name in ("ekf", "live", "graph", "batch"):
        curve = scene.errors.get(name)
        if curve is not None:
            t, values = _thin(curve.t_s), _thin(getattr(curve, attribute))
            axes.plot(t, values, color=CODE[name], linewidth=_WIDTHS[name], label=scene.labels[name])
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel(label)


def _mark_loops(axes: Any, closed_s: Array) -> None:
    """Mark times by lines; where there are many, by short strokes at the top that leave the curves readable."""
    few = len(closed_s) <= _MAX_LOOP_LINES
    axes.vlines(
        closed_s, 0.0 if few else 0.95, 1.0, transform=axes.get_xaxis_transform(), color=CODE["good"],
        linewidth=0.7, alpha=0.5 if few else 0.9, zorder=0.5,
    )  # fmt: skip


def _draw_inliers(axes: Any, run: RunFiles, scene: Scene) -> None:
    assert run.tracking is not None
    t, inliers = scene.seconds(run.tracking.t_ns), run.tracking.inliers
    axes.fill_between(_thin(t), _thin(inliers), color=CODE["muted"], alpha=0.18, linewidth=0)
    axes.plot(_thin(t), _thin(inliers), color=CODE["muted"], linewidth=0.8)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("inliers")


def _draw_state(axes: Any, run: RunFiles, scene: Scene) -> None:
    assert run.tracking is not None
    t = scene.seconds(run.tracking.t_ns)
    states = run.tracking.tracking
    period = float(np.median(np.diff(t))) if len(t) > 1 else 0.1
    starts = [0, *(k for k in range(1, len(states)) if states[k] != states[k - 1] or t[k] - t[k - 1] > 5 * period)]
    for start, stop in zip(starts, [*starts[1:], len(states)], strict=True):
        end = t[stop - 1] + period
        axes.axvspan(t[start], end, color=CODE[_STATE_COLORS[states[start]]], alpha=0.8, linewidth=0)
    axes.set_yticks([])
    axes.set_ylabel("state", rotation=0, ha="right", va="center")
    axes.grid(visible=False)
    axes.spines[["left", "bottom"]].set_visible(False)


def _thin(values: Array) -> Array:
    return values[:: len(values) // _MAX_POINTS + 1]


def _legend_above(axes: Any, columns: int) -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2, columnspacing=1.4)
