"""The report: one HTML file made from nothing but the files of a run folder."""

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.files import storage, write_text
from vislam.runs.levelled import up_sentence
from vislam.runs.report import plots
from vislam.runs.report.drawing import as_file
from vislam.runs.report.html import (
    Cell,
    bullets,
    card,
    drawn,
    escape,
    folded,
    grid,
    note,
    number,
    percent,
    picture,
    preformatted,
    section,
    stylesheet,
    table,
    tile,
)
from vislam.runs.report.loop_section import loops_section
from vislam.runs.report.run_files import ESTIMATES, RunFiles, as_dict, as_list, read_run
from vislam.runs.report.scene import Scene, build_scene
from vislam.runs.report.sensor_section import sensors_section
from vislam.runs.report.view_data import view_data
from vislam.runs.report.view_page import view_elements, view_scripts, view_style
from vislam.runs.verdict import verdict_sentence


def write_report(run: Path) -> Path:
    """Write `report.html` into a run folder and return its path.

    A file that is absent leaves its section out, one that is damaged is named in the report. Raises DataError when the
    folder holds nothing of a run, StorageError when the report cannot be written.
    """
    files = read_run(run)
    scene = build_scene(files)
    data = view_data(files, scene)
    scripts, policy = view_scripts(data)
    body = "".join(
        (
            _head(files),
            view_elements(data),
            _map(files),
            _tiles(files, scene),
            _about(files),
            _problems(files, scene),
            _accuracy(files, scene),
            _trajectories(files, scene),
            _over_time(files, scene),
            _free_space(files),
            loops_section(files, scene),
            _timing(files),
            _biases(files, scene),
            sensors_section(files),
            _lost(files),
            _manifest(files),
        )
    )
    title = escape(f"vislam: {_name(files)}")
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">'
        f"<title>{title}</title><style>{stylesheet()}{view_style()}</style></head><body><main>{body}"
        f"<footer>Made by vislam from the files in this folder.</footer></main>{scripts}</body></html>\n"
    )
    path = run / "report.html"
    write_text(path, page)
    return path


def write_figures(run: Path, out: Path) -> list[Path]:
    """Write the report's line drawings as SVG files into a folder; return their paths. Raises as `write_report`."""
    files = read_run(run)
    scene = build_scene(files)
    biases = plots.biases(files.states, scene) or ("", "")
    drawings = {
        **dict(zip(("from_above", "from_the_side"), _views(files, scene), strict=True)),
        "over_time": plots.over_time(files, scene), "timing": _stage_times(files),
        "gyroscope_bias": biases[0], "accelerometer_bias": biases[1],
    }  # fmt: skip
    with storage(out):
        out.mkdir(parents=True, exist_ok=True)
    paths = {out / f"{name}.svg": drawing for name, drawing in drawings.items() if drawing}
    for path, drawing in paths.items():
        write_text(path, as_file(drawing))
    return list(paths)


def _name(run: RunFiles) -> str:
    return str(run.metrics.get("name") or run.folder.resolve().name)


def _head(run: RunFiles) -> str:
    """Return the name of the run and what it is worth, in one sentence."""
    verdict = as_dict(run.metrics, "verdict")
    said = f"{verdict_sentence(verdict)}." if verdict else ""
    worth = f'<p class="verdict {escape(verdict.get("state", ""))}">{escape(said)}</p>' if said else ""
    return f"<h1>{escape(_name(run))}</h1>{worth}"


def _about(run: RunFiles) -> str:
    m = run.metrics
    parts = []
    if m:
        parts.append(
            f"{number(m.get('frames'), 0)} frames and {number(m.get('keyframes'), 0)} keyframes, "
            f"{number(m.get('duration_s'), 1)} s of recording processed in {number(m.get('wall_s'), 1)} s."
        )
    if m.get("mode"):
        mode = m["mode"] if run.has_camera else "no camera"
        parts.append(f"Mode: {mode}{', inertial' if m.get('has_imu') else ''}.")
    start = as_dict(m, "initialisation")
    if start and m.get("has_imu") is not False:
        when = number(start.get("t_s"), 2, " s")
        reason = f" ({start['reason']})" if start.get("reason") else ""
        parts.append(f"Initialisation: {start.get('status', 'unknown')} at {when}{reason}.")
    mount = as_dict(m, "calibration")
    if "tilt_deg" in mount:
        values = [number(mount.get(name), 3) for name in ("height_m", "tilt_deg", "tilt_sigma_deg", "roll_deg")]
        parts.append(
            f"Over the floor: camera {values[0]} m high as given, tilted by {values[1]} ± {values[2]} deg and rolled "
            f"by {values[3]} deg as the floor shows."
        )
    for name, sensor in (("gyro", "Gyroscope"), ("accel", "Accelerometer")):
        noise = as_dict(m, "imu_noise", name)
        if noise:
            given, seen = number(noise.get("told"), 5), number(noise.get("typical"), 5)
            parts.append(f"{sensor}: white noise of {seen} in motion, {given} given (SI units per √Hz).")
    parts += [f"{up_sentence(up)}."] if (up := as_dict(m, "up")) else []
    parts += _track_noise(as_dict(m, "track_noise"))
    source = run.manifest.get("source")
    if source:
        parts.append(f"Source: {source}.")
    return f'<p class="lead">{escape(" ".join(parts))}</p>' if parts else ""


def _track_noise(noise: dict[str, Any]) -> list[str]:
    parts = []
    for name in ("graph", "filter"):
        pixel = as_dict(noise, name)
        if pixel:
            used, given = number(pixel.get("used_px"), 2), number(pixel.get("told_px"), 2)
            parts.append(f"the {name} uses {used} px, {given} given")
    return [f"Tracks scatter by {number(noise.get('measured_px'), 2)} px; {', '.join(parts)}."] if parts else []


def _tiles(run: RunFiles, scene: Scene) -> str:
    m = run.metrics
    if not m:
        return ""
    graph, ekf, loops = as_dict(m, "accuracy", "graph"), as_dict(m, "accuracy", "ekf"), as_dict(m, "loops")
    tiles = []
    if graph:
        tiles.append(tile(number(graph.get("ate_rmse_m")), "m", "ATE of the final trajectory", "graph"))
    if ekf:
        tiles.append(tile(number(ekf.get("ate_rmse_m")), "m", f"ATE of the {scene.labels['ekf']}", "ekf"))
    tiles += _batch_tiles(m)
    if graph:
        covered = graph.get("coverage")
        full = isinstance(covered, int | float) and covered >= 0.95
        tiles.append(tile(percent(covered), "", "of the recording covered", "good" if full else "warn"))
    factor = m.get("realtime_factor")
    fast = isinstance(factor, int | float) and factor >= 1.0
    tiles.append(tile(number(factor, 2), "×", "real time", "good" if fast else "warn"))
    cost = as_dict(m, "cost")
    if cost:
        tiles.append(tile(number(cost.get("cpu_ms_per_frame"), 0), "ms", "of CPU per frame"))
        tiles.append(tile(number(cost.get("peak_memory_mb"), 0), "MB", "of memory at most"))
        tiles.append(tile(number(cost.get("first_pose_s"), 2), "s", "of recording until the first pose"))
    if run.has_camera:
        of = f"loops of {number(loops.get('candidates', 0), 0)} candidates"
        tiles.append(tile(number(loops.get("accepted", 0), 0), "", of))
    lost, spells = _lost_frames(run)
    label = "frames lost" if spells == 0 else f"frames lost, in {spells} outage{'s' if spells > 1 else ''}"
    if run.tracking is not None:
        tiles.append(tile(number(lost, 0), "", label, "good" if lost == 0 else "bad"))
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _batch_tiles(metrics: dict[str, Any]) -> list[str]:
    """Return what `vislam optimize` made of the run, under the name that it gives by itself."""
    accuracy, batch = as_dict(metrics, "accuracy", "batch"), as_dict(metrics, "batch", "batch")
    tiles = [tile(number(accuracy.get("ate_rmse_m")), "m", "ATE of the batch", "batch")] if accuracy else []
    if "cost_after" in batch:
        label = f"cost of the batch, {number(batch.get('cost_before'), 0)} before"
        tiles.append(tile(number(batch.get("cost_after"), 0), "", label, "batch"))
    return tiles


def _lost_frames(run: RunFiles) -> tuple[int, int]:
    """Return the number of lost frames and of contiguous spells of them."""
    states = run.tracking.tracking if run.tracking is not None else []
    lost = [state == "lost" for state in states]
    spells = sum(now and not before for now, before in zip(lost, [False, *lost], strict=False))
    return sum(lost), spells


def _problems(run: RunFiles, scene: Scene) -> str:
    lines = [str(moved) for moved in as_list(as_dict(run.metrics, "verdict").get("moved"))]
    lines += [str(warning) for warning in as_list(run.metrics.get("warnings"))]
    lines += scene.notes
    lines += [f"{name} left out: {reason}" for name, reason in run.unread.items()]
    return card(bullets(lines), kind="warnings", title="Worth knowing") if lines else ""


def _accuracy(run: RunFiles, scene: Scene) -> str:
    accuracy = as_dict(run.metrics, "accuracy")
    rows: list[list[str | Cell]] = []
    for name in ESTIMATES:
        entry = as_dict(accuracy, name)
        if entry:
            keys = ("ate_rmse_m", "ate_mean_m", "ate_median_m", "ate_max_m", "rpe_1s_m")
            rows.append(
                [
                    Cell(scene.labels[name], mark=name),
                    *(number(entry.get(key)) for key in keys),
                    number(entry.get("rpe_1s_deg"), 2),
                    number(entry.get("scale"), 4),
                    percent(entry.get("coverage")),
                ]
            )
    if not rows:
        reason = "This run has no true trajectory to compare with." if run.truth is None else ""
        return section("Accuracy", note(reason)) if reason and run.metrics else ""
    head = ["", "ATE RMSE [m]", "mean", "median", "max", "RPE 1 s [m]", "[°]", "scale", "coverage"]
    graph = as_dict(accuracy, "graph") or as_dict(accuracy, "ekf")
    causal = f"{scene.labels['ekf']} and live"
    truth = str(as_dict(run.metrics, "truth").get("summary", ""))
    text = (
        f"Alignment {graph.get('alignment', 'unknown')} over a path of {number(graph.get('path_m'), 1)} m. "
        "Scale is the factor that would fit the estimate to the truth best. "
        f"{causal} are causal; the graph is the final answer after all loops. {truth}"
    )
    return section("Accuracy", card(table(head, rows)), note(text), _consistency(scene))


def _consistency(scene: Scene) -> str:
    rows: list[list[str | Cell]] = []
    for name, values in scene.nees.items():
        row: list[str | Cell] = [Cell(scene.labels[name], mark=name), number(len(values["position"]), 0)]
        for part in ("rotation", "position"):
            finite = values[part][np.isfinite(values[part])]
            row += [
                number(float(finite.mean()), 1) if len(finite) else "–",
                number(float(np.median(finite)), 1) if len(finite) else "–",
            ]
        rows.append(row)
    if not rows:
        return ""
    head = ["", "keyframes", "rotation mean", "median", "position mean", "median"]
    text = (
        f"Normalised estimation error squared of the keyframes, the first of which stands at its true position and "
        f"{'heading' if scene.has_gravity else 'attitude'}. An estimator that knows its own "
        "uncertainty has a mean of 3; a larger number means that it is too sure of itself. Known errors "
        "of the truth are taken into account."
    )
    return card(table(head, rows), title="Consistency (NEES, expected 3)") + note(text)


def _trajectories(run: RunFiles, scene: Scene) -> str:
    above, aside = _views(run, scene)
    if not above:
        return ""
    views = grid(card(drawn(above), title="From above", kind="from-above"), card(drawn(aside), title="From the side"))
    tilted = not scene.has_gravity and scene.truth is None and not as_dict(run.metrics, "up").get("direction")
    text = "There is no IMU to show what is up: z is that of the first camera." if tilted else ""
    return section("Trajectories", views, note(text) if text else "", kind="still of-map")


def _views(run: RunFiles, scene: Scene) -> tuple[str, str]:
    if not any(len(path) > 1 for path in scene.paths.values()):
        return "", ""
    return plots.top_view(run, scene), plots.side_view(scene)


def _over_time(run: RunFiles, scene: Scene) -> str:
    figure = plots.over_time(run, scene)
    if not figure:
        return ""
    text = "Green strokes are accepted loops. State: green ok, yellow degraded, red lost."
    words = note(text) if run.has_camera else ""
    return section("Over time", card(drawn(figure)), words, kind="still")


def _map(run: RunFiles) -> str:
    cards = [_picture(path) for path in run.pictures if not _is_plan(path)]
    return section("Map", *cards if len(cards) == 1 else (grid(*cards),), kind="still of-map")


def _free_space(run: RunFiles) -> str:
    """Return what the view in 3-D does not have: where there is room, and what is in the way."""
    cards = [_picture(path) for path in run.pictures if _is_plan(path)]
    return section("Free space", *cards if len(cards) == 1 else (grid(*cards),), kind="of-map")


def _is_plan(path: Path) -> bool:
    return path.stem in ("picture_octree", "picture_where_to_drive")


def _picture(path: Path) -> str:
    caption = path.stem.removeprefix("picture").strip("-_ ").replace("_", " ") or "The map"
    return picture(path, caption, kind="plan" if _is_plan(path) else "")


def _stages(run: RunFiles) -> dict[str, dict[str, float]]:
    return {
        name: {key: float(value) for key, value in stage.items() if isinstance(value, int | float)}
        for name, stage in as_dict(run.metrics, "timing_ms").items()
        if isinstance(stage, dict)
    }


def _stage_times(run: RunFiles) -> str:
    frames, duration = run.metrics.get("frames"), run.metrics.get("duration_s")
    both = isinstance(frames, int) and isinstance(duration, int | float) and frames > 1
    return plots.timing(_stages(run), 1e3 * duration / (frames - 1) if both else None)  # type: ignore[operator]


def _timing(run: RunFiles) -> str:
    stages, figure = _stages(run), _stage_times(run)
    if not stages:
        return ""
    total = sum(stage.get("total_s", 0.0) for stage in stages.values())
    rows: list[list[str | Cell]] = []
    for name, stage in sorted(stages.items(), key=lambda item: -item[1].get("total_s", 0.0)):
        share = stage.get("total_s", 0.0) / total if total > 0.0 else None
        quantiles = [number(stage.get(key), 2) for key in ("p50", "p95", "p99")]
        rows.append(
            [name, *quantiles, number(stage.get("count"), 0), number(stage.get("total_s"), 2), percent(share, 0)]
        )
    head = ["stage", "p50 [ms]", "p95", "p99", "calls", "total [s]", "share"]
    return section("Time", grid(card(drawn(figure)) if figure else "", card(table(head, rows))), _cost(run))


def _cost(run: RunFiles) -> str:
    """Return what the run cost in CPU time, stage by stage; empty for a run that did not measure it."""
    cost = as_dict(run.metrics, "cost")
    stages = [
        (name, ms)
        for name, ms in as_dict(cost, "stages_cpu_ms_per_frame").items()
        if isinstance(ms, int | float) and not isinstance(ms, bool)
    ]
    if not stages:
        return ""
    whole_ms = sum(ms for _, ms in stages)
    rows: list[list[str | Cell]] = [
        [name, number(ms, 2), percent(ms / whole_ms if whole_ms > 0.0 else None, 0)]
        for name, ms in sorted(stages, key=lambda stage: -stage[1])
    ]
    text = (
        f"{number(cost.get('cpu_s'), 1)} s of CPU in all, beside {number(cost.get('compile_cpu_s'), 1)} s of "
        f"compilation; {number(cost.get('first_pose_cpu_s'), 1)} s of it until the first pose. "
        "Threads that read ahead are in “decode”, others (Rerun's, for one) and what lies between stages in “other”."
    )
    return card(table(["stage", "CPU [ms/frame]", "share"], rows), title="CPU time", kind="list") + note(text)


def _biases(run: RunFiles, scene: Scene) -> str:
    figures = plots.biases(run.states, scene)
    if figures is None:
        return ""
    text = "Solid: graph with ±3σ. Dashed: EKF."
    return section("Inertial biases", grid(*(card(drawn(figure)) for figure in figures)), note(text))


def _lost(run: RunFiles) -> str:
    """Return everything that was skipped, lost or refused, room by room; zeros are left out."""
    rows: list[list[str | Cell]] = []
    for room, counters in [*as_dict(run.metrics, "counters").items(), ("recording", as_dict(run.metrics, "problems"))]:
        for name, count in as_dict(counters).items():
            if isinstance(count, int | float) and count:
                rows.append([str(room), Cell(str(name).replace("_", " "), kind="text"), number(count, 0)])
    reasons: Counter[str] = Counter()
    if run.tracking is not None:
        for state, reason in zip(run.tracking.tracking, run.tracking.reason, strict=True):
            if state != "ok" and reason:
                reasons[f"{state}: " + re.sub(r"\d+(\.\d+)?", "…", reason)] += 1
    why: list[list[str | Cell]] = [[Cell(reason, kind="text long"), str(n)] for reason, n in reasons.most_common(10)]
    cards = [
        card(table(["room", "what", "count"], rows, text_columns=(0, 1)), title="Counters", kind="list")
        if rows
        else "",
        card(table(["why", "frames"], why), title="Frames that were not ok") if why else "",
    ]
    if not rows and not why:
        return section("What was lost or rejected", note("Nothing.")) if run.metrics else ""
    return section("What was lost or rejected", grid(*cards))


def _manifest(run: RunFiles) -> str:
    def text(data: dict[str, Any]) -> str:
        return json.dumps(data, indent=2, ensure_ascii=False)

    parts = [
        folded(name, preformatted(text(data)))
        for name, data in (("Configuration", run.config), ("Manifest", run.manifest))
        if data
    ]
    command = run.manifest.get("command")
    line = " ".join(str(part) for part in command) if isinstance(command, list) else command
    again = card(preformatted(line), title="Command") if line else ""
    return section("How it was made", again, *parts)
