"""A finished run estimated again in batch, and what its folder gets of it: the library's side of `vislam optimize`."""

import re
import time
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from vislam.batch import BatchResult, optimize_run
from vislam.config import BatchConfig, Config, from_data
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.core.files import write_json
from vislam.core.messages import NavState
from vislam.factors import FactorLog
from vislam.runs.folder import read_metrics, recorded_alignment
from vislam.runs.further_sensors import suite_of
from vislam.runs.levelled import Levelled, stored_level
from vislam.runs.session import Session
from vislam.sensors import Suite
from vislam.trajectory import Alignment, Trajectory, evaluate, read_tum, write_states_csv, write_tum

_TAKEN = ("ekf", "live", "graph", "truth")  # names of trajectories that the run itself wrote
_SECTIONS = ("frontend", "graph", "imu", "sensors")  # of the run's settings that batch uses


def optimize(run: Path, config: BatchConfig, name: str = "batch") -> dict[str, Any]:
    """Estimate a run folder again and write trajectory_NAME.tum, states_NAME.csv and the entry in metrics.json.

    Returns the entry: cost, what was used and refused, accuracy where the run has truth. Everything is computed before
    anything is written. Raises UsageError for what is no run folder, DataError for one that cannot be used.
    """
    _check(run, name)
    start = time.perf_counter()
    log, settings, level = _read(run, config)
    suite, problems = _suite(settings, log)
    result = optimize_run(log, settings, suite)
    trajectory = level.trajectory(_placed(log, result.states, settings.machine.max_gap_s))
    metrics = read_metrics(run)
    entry = _entry(result, log, trajectory, problems)
    entry["sensors"] = _sensors(result, suite)
    alignment = recorded_alignment(metrics)  # so that the batch's errors stand beside the run's
    accuracy = _accuracy(run, trajectory, log, alignment, entry["warnings"])
    entry |= {"accuracy": accuracy, "wall_s": time.perf_counter() - start, "config": asdict(config)}
    if accuracy:
        metrics.setdefault("accuracy", {})[name] = accuracy[alignment]
    metrics.setdefault("batch", {})[name] = entry
    write_tum(trajectory, run / f"trajectory_{name}.tum")
    write_states_csv(run / f"states_{name}.csv", range(len(result.states)), level.states(result.states))
    write_json(run / "metrics.json", metrics)
    return entry


def _placed(log: FactorLog, states: Sequence[NavState], max_gap_s: float) -> Trajectory:
    """Return the pose of every frame: by the IMU between keyframes, else by the motion that the run measured."""
    spans = {k.packet.keyframe.id: k.packet.imu for k in log.keyframes if k.packet.imu is not None}
    frames = log.frames.carried_by_imu(states, spans, log.gravity_m_s2, max_gap_s, measured_too=True)
    times = {k: int(state.t_ns) for k, state in enumerate(states)}
    return frames.placed(times, {k: state.T_world_body for k, state in enumerate(states)})


def _check(run: Path, name: str) -> None:
    if run.suffix == ".g2o" or run.is_file():
        raise UsageError(f"{run} is a file; `vislam posegraph FILE` and `optimize_graph_file` take pose graphs")
    if not run.is_dir():
        raise DataError(f"{run} is no run folder; `vislam run SOURCE --out {run}` makes one")
    if not re.fullmatch(r"[a-z0-9_]+", name) or name in _TAKEN:
        raise UsageError(f"--out-name '{name}': small letters, digits and _ only, and none of {', '.join(_TAKEN)}")


def _read(run: Path, config: BatchConfig) -> tuple[FactorLog, Config, Levelled]:
    """Return the factor log, the settings (of those stored, the ones that this version knows), and which way is up."""
    with Session(run / "session.db") as session:
        info = session.info()
        stored, level = info.get("config"), stored_level(info)
        log = session.factor_log()
    data: dict[str, Any] = {"batch": asdict(config)}
    for section in _SECTIONS:
        known = {f.name for f in fields(getattr(Config(), section))}
        values = stored.get(section) if isinstance(stored, dict) else None
        if isinstance(values, dict):
            data[section] = {key: value for key, value in values.items() if key in known}
    try:
        return log, from_data(data, source=str(run / "session.db")), level
    except UsageError as error:
        raise DataError(f"{error}; the settings stored with the run are damaged, run the recording again") from error


def _suite(settings: Config, log: FactorLog) -> tuple[Suite | None, list[str]]:
    """Return the further sensors of the run, and why some of their readings are left out."""
    suite, why = None, "the run was given no file of them"
    try:
        suite = suite_of(settings.sensors)
    except UsageError as error:
        why = str(error)
    known = () if suite is None else suite.names
    used = {placed.reading.sensor for k in log.keyframes for placed in k.packet.readings}
    left_out = sorted(used.difference(known))
    return suite, [f"the batch goes without the readings of {', '.join(left_out)}: {why}"] if left_out else []


def _sensors(result: BatchResult, suite: Suite | None) -> dict[str, Any]:
    """Return own variables and what became of readings, by sensor."""
    out: dict[str, Any] = {}
    for name, readings in result.readings.items():
        assert suite is not None
        out[name] = {"variables": [variable.name for variable in suite[name].variables], "readings": readings}
        if (own := result.own.get(name)) is not None:
            out[name] |= {"values": own[0].tolist(), "sigmas": own[1].tolist()}
    return out


def _entry(result: BatchResult, log: FactorLog, trajectory: Trajectory, problems: list[str]) -> dict[str, Any]:
    refused = [verdict for verdict in result.loops if verdict.in_run and not verdict.kept]
    admitted = [verdict for verdict in result.loops if verdict.kept and not verdict.in_run]
    warnings = [result.note] if result.note else []
    warnings += problems
    for verdict in refused:
        warnings.append(f"loop {verdict.from_id}-{verdict.to_id}, which the run had accepted: {verdict.reason}")
    return {
        "keyframes": len(log.keyframes),
        "frames": len(trajectory),
        "landmarks": result.landmarks,
        "observations": result.observations,
        "rejected_observations": result.rejected_observations,
        "rejected_depths": result.rejected_depths,
        "cost_before": result.cost_before,
        "cost_after": result.cost_after,
        "iterations": result.iterations,
        "pixel_sigma_px": result.sigma_px,
        "depth_sigma_factor": result.depth_factor,
        "readout_s": result.readout_s,
        "calibration": dict(zip(("focal", "metres"), result.calibration.T.tolist(), strict=True)),
        "loops": {
            "offered": len(result.loops),
            "kept": sum(verdict.kept for verdict in result.loops),
            "refused": [[v.from_id, v.to_id, v.reason] for v in refused],
            "admitted": [[v.from_id, v.to_id, v.reason] for v in admitted],
        },
        "tied_by_odometry": result.tied_by_odometry,
        "warnings": warnings,
    }


def _accuracy(
    run: Path, trajectory: Trajectory, log: FactorLog, alignment: Alignment, warnings: list[str]
) -> dict[str, Any]:
    """Return the errors against the run's truth under the run's alignment and the usual ones; empty without truth."""
    path = run / "trajectory_truth.tum"
    if not path.is_file():
        return {}
    truth, stamps = read_tum(path), log.frames.t_ns
    span = (int(np.min(stamps)), int(np.max(stamps))) if len(stamps) else None
    modes: dict[Alignment, None] = dict.fromkeys(("se3", "yaw", alignment))
    try:
        return {mode: evaluate(trajectory, truth, mode, span_ns=span) for mode in modes}
    except VislamError as error:
        warnings.append(f"accuracy: {error}")
        return {}
