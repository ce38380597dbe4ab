"""The report's pictures as inline SVG that follows the page's colours, light or dark."""

from collections.abc import Mapping

import numpy as np

from vislam.core.messages import Array, NavState
from vislam.runs.report.drawing import Axis, Kind, Lines, drawing, stacked
from vislam.runs.report.run_files import RunFiles
from vislam.runs.report.scene import Scene, loop_segments

_WIDTHS_PT = {"ekf": 1.3, "live": 1.0, "graph": 1.7, "batch": 1.3}
_STATE_COLORS = {"ok": "good", "degraded": "warn", "lost": "bad", "blind": "muted"}
_WIDE_PT = 806.0
_VIEW_PT = 338.0  # high
_MAX_STRETCH = 25.0  # of the vertical axis: more would turn millimetres into mountains
_MAX_REJECTED = 200  # loops drawn: more is a red cloud
_MAX_LOOP_LINES = 25
_MAX_POINTS = 1500  # per line: more cannot be seen and only makes the file heavy


def top_view(run: RunFiles, scene: Scene) -> str:
    """Draw all trajectories from above, with loops; equal scales."""
    lines = [*_loops(run, scene), *_paths(scene, [0, 1])]
    return drawing(lines, Axis("x [m]"), Axis("y [m]"), height_pt=_VIEW_PT, same_scale=True)


def side_view(scene: Scene) -> str:
    """Draw all trajectories from the side; the vertical scale is stretched where the motion is flat."""
    positions = np.concatenate([path.positions_m for path in [*scene.paths.values(), scene.truth] if path])
    low, high = positions.min(axis=0), positions.max(axis=0)
    along = 0 if high[0] - low[0] >= high[1] - low[1] else 1
    length, rise = high[along] - low[along], high[2] - low[2]
    x, lines = Axis(f"{'xy'[along]} [m]"), _paths(scene, [along, 2])
    if rise > 0.35 * length:
        return drawing(lines, x, Axis("z [m]"), height_pt=_VIEW_PT, same_scale=True)
    shown = max(1.3 * rise, length / _MAX_STRETCH, 1e-6)
    stretch = 0.8 * length / shown  # the frame is as much wider than high
    label = f"z [m], stretched {stretch:.0f}×" if stretch >= 1.5 else "z [m]"
    ends = (float(low[2] + high[2] - shown) / 2, float(low[2] + high[2] + shown) / 2)
    return drawing(lines, x, Axis(label, ends=ends), height_pt=_VIEW_PT)


def over_time(run: RunFiles, scene: Scene) -> str:
    """Draw errors, inliers and the tracking state over time, with a mark at every accepted loop."""
    closed = scene.seconds([loop.to_t_ns for loop in run.loops if loop.decision == "accepted" and loop.to_t_ns >= 0])
    panels: list[tuple[list[Lines], Axis, float]] = []
    for attribute, label, height_pt in (
        ("position_m", "position error [m]", 175.0),
        ("rotation_deg", "rotation error [°]", 110.0),
    ):
        lines = [
            _line(curve.t_s, getattr(curve, attribute), name, _WIDTHS_PT[name], "" if panels else scene.labels[name])
            for name in ("ekf", "live", "graph", "batch")
            if (curve := scene.errors.get(name)) is not None
        ]
        if lines:
            panels.append((*_marked(lines, closed, label), height_pt))
    if run.tracking is not None and len(run.tracking.t_ns):
        t, inliers = scene.seconds(run.tracking.t_ns), run.tracking.inliers.astype(np.float64)
        lines = [_band(t, np.zeros(len(t)), inliers, "muted", 0.18), _line(t, inliers, "muted", 0.8)]
        panels += [(*_marked(lines, closed, "inliers"), 90.0), (_states(run, t), Axis("", names=("state",)), 28.0)]
    if not panels:
        return ""
    ends, last = (0.0, max(scene.end_s, 1e-3)), len(panels) - 1
    parts = []
    for k, (lines, y, height_pt) in enumerate(panels):
        x = Axis("time [s]" if k == last else "", ends=ends)
        parts.append(drawing(lines, x, y, height_pt=height_pt + 29.0 * (k == last), width_pt=_WIDE_PT))
    return stacked(parts)


def timing(stages: Mapping[str, Mapping[str, float]], period_ms: float | None) -> str:
    """Draw p50, p95 and p99 of every stage on a logarithmic axis, with the time between two frames."""
    keys = ("p50", "p95", "p99")
    rows = [(name, stage) for name, stage in stages.items() if all(stage.get(key, 0.0) > 0.0 for key in keys)]
    if not rows:
        return ""
    at = np.arange(len(rows), dtype=np.float64)
    p50, p95, p99 = (np.array([stage[key] for _, stage in rows]) for key in keys)
    ends = (len(rows) - 0.4, -0.6)
    lines = [
        Lines(_upright(p50, at, p99, at), "graph", 1.2, 0.45),
        Lines(_upright(p50, at, p50, at), "graph", 5.0, label="p50"),
        Lines(_upright(p95, at - 0.25, p95, at + 0.25), "graph", 1.2, label="p95"),
        Lines(_upright(p99, at, p99, at), "graph", 3.0, label="p99"),
    ]
    if period_ms:
        period = np.array([period_ms])
        lines.append(Lines(_upright(period, *ends[:1], period, *ends[1:]), "bad", 0.9, 1.0, "frame period", "dashed"))
    y = Axis("", ends=ends, names=tuple(name for name, _ in rows))
    return drawing(lines, Axis("milliseconds per call", log=True), y, height_pt=21.6 * len(rows) + 68.0)


def biases(states: Mapping[str, list[NavState]], scene: Scene) -> tuple[str, str] | None:
    """Draw gyroscope and accelerometer biases of the graph with three sigma, and those of the EKF dashed.

    None without an IMU, which has them.
    """
    states = {
        name: [s for s in of_one if np.isfinite(np.diag(s.covariance)[9:]).all()] for name, of_one in states.items()
    }
    if not any(states.values()):
        return None
    return (
        _bias(states, scene, "gyro_bias_rad_s", 9, 1e3, "gyroscope bias [mrad/s]"),
        _bias(states, scene, "accel_bias_m_s2", 12, 1.0, "accelerometer bias [m/s²]"),
    )


def _bias(
    states: Mapping[str, list[NavState]], scene: Scene, attribute: str, first: int, factor: float, label: str
) -> str:
    lines: list[Lines] = []
    ends = None
    for name in ("graph", "ekf"):
        of_one = states.get(name)
        if not of_one:
            continue
        t = scene.seconds(np.array([s.t_ns for s in of_one]))
        values = factor * np.array([getattr(s, attribute) for s in of_one])
        variances = np.array([np.diag(s.covariance)[first : first + 3] for s in of_one])
        band = 3.0 * factor * np.sqrt(np.maximum(variances, 0.0))
        for k, axis in enumerate("xyz"):
            color = f"axis-{axis}"
            if name == "ekf":
                lines.append(_line(t, values[:, k], color, 0.9, kind="dashed"))
                continue
            lines += [
                _band(t, values[:, k] - band[:, k], values[:, k] + band[:, k], color, 0.12),
                _line(t, values[:, k], color, 1.4, axis),
            ]
        if name == "graph":  # the first sigmas are those of the prior and would flatten everything else
            late = slice(min(len(t) // 5, len(t) - 1), None)
            low = min((values - band)[late].min(), values.min(), 0.0)
            high = max((values + band)[late].max(), values.max(), 0.0)
            margin = 0.08 * max(high - low, 1e-9)
            ends = (float(low - margin), float(high + margin))
    end_s = max(scene.end_s, 1e-3)
    zero = Lines(np.array([[[0.0, 0.0], [end_s, 0.0]]]), "line", 0.8)
    x, y = Axis("time [s]", ends=(0.0, end_s)), Axis(label, ends=ends)
    return drawing([zero, *lines], x, y, height_pt=209.0)


def _paths(scene: Scene, axes: list[int]) -> list[Lines]:
    """Return the trajectories along two axes of the map."""
    lines = []
    if scene.truth is not None and len(scene.truth):
        lines.append(_path(scene.truth.positions_m[:, axes], "truth", 2.4, 0.55, scene.labels["truth"]))
    for name, path in scene.paths.items():
        # the causal path jumps at loops by design; drawn beside the final one it only hides it
        if len(path) and (name != "live" or "graph" not in scene.paths):
            lines.append(_path(path.positions_m[:, axes], name, _WIDTHS_PT[name], 1.0, scene.labels[name]))
    best = next((scene.paths[name] for name in ("graph", "live", "ekf") if len(scene.paths.get(name, ()))), None)
    if best is not None:
        start = np.repeat(best.positions_m[None, :1, axes], 2, axis=1)
        lines += [Lines(start, "ink", 5.5, label="start"), Lines(start, "paper", 3.0)]
    return lines


def _loops(run: RunFiles, scene: Scene) -> list[Lines]:
    """Return rejected loops, faint, and accepted ones, with a dot where the loop was closed."""
    rejected = loop_segments(run, scene, "rejected")[:_MAX_REJECTED, :, :2]
    accepted = loop_segments(run, scene, "accepted")[:, :, :2]
    few = len(accepted) <= _MAX_LOOP_LINES
    return [
        Lines(rejected, "bad", 0.5, 0.2, "loops rejected"),
        Lines(accepted, "good", 1.1 if few else 0.5, 1.0, "loops accepted"),
        Lines(accepted[:, [1, 1]], "good", 3.5 if few else 1.4),  # many lines are short
    ]


def _marked(lines: list[Lines], closed_s: Array, label: str) -> tuple[list[Lines], Axis]:
    """Return lines from zero on over times marked by strokes, and their axis.

    Where there are many strokes, they are short ones at the top that leave the curves readable.
    """
    top = 1.05 * max((float(np.nanmax(group.points[..., 1], initial=0.0)) for group in lines), default=0.0)
    top = top if np.isfinite(top) and top > 0.0 else 1.0
    few = len(closed_s) <= _MAX_LOOP_LINES
    strokes = Lines(_upright(closed_s, 0.0 if few else 0.95 * top, closed_s, top), "good", 0.7, 0.5 if few else 0.9)
    return [strokes, *lines], Axis(label, ends=(0.0, top))


def _states(run: RunFiles, t: Array) -> list[Lines]:
    """Return a bar for each spell of one tracking state."""
    assert run.tracking is not None
    states = run.tracking.tracking
    period = float(np.median(np.diff(t))) if len(t) > 1 else 0.1
    starts = [0, *(k for k in range(1, len(states)) if states[k] != states[k - 1] or t[k] - t[k - 1] > 5 * period)]
    return [
        _band(np.array([t[a], t[b - 1] + period]), np.full(2, -0.5), np.full(2, 0.5), _STATE_COLORS[states[a]], 0.8)
        for a, b in zip(starts, [*starts[1:], len(states)], strict=True)
    ]


def _upright(x0: Array, y0: Array | float, x1: Array, y1: Array | float) -> Array:
    """Return lines [N, 2, 2] between points."""
    ends = np.broadcast_arrays(x0, y0, x1, y1)
    return np.stack(ends, axis=-1).reshape(-1, 2, 2)


def _line(t: Array, values: Array, color: str, width_pt: float, label: str = "", kind: Kind = "solid") -> Lines:
    return _path(np.column_stack((t, values)), color, width_pt, 1.0, label, kind)


def _path(points: Array, color: str, width_pt: float, opacity: float, label: str, kind: Kind = "solid") -> Lines:
    return Lines(points[:: len(points) // _MAX_POINTS + 1][None], color, width_pt, opacity, label, kind)


def _band(t: Array, low: Array, high: Array, color: str, opacity: float) -> Lines:
    every = slice(None, None, len(t) // _MAX_POINTS + 1)
    t, low, high = t[every], low[every], high[every]
    around = np.column_stack((np.concatenate((t, t[::-1])), np.concatenate((low, high[::-1]))))
    return Lines(around[None], color, 0.0, opacity, kind="filled")
