"""What a job is judged by: every number comes from the files that its run left, and from its own process."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError, VislamError
from vislam.frontend import knows_scale
from vislam.trajectory import (
    Alignment,
    Trajectory,
    align,
    associate,
    evaluate,
    gauge_alignment,
    read_states_csv,
    read_tum,
)
from vislam.trajectory.consistency import anees, chi_square_mean, stated_scale_sigma
from vislam.trajectory.truth_fit import TruthFit

_STATES = {"ekf": "states_ekf.csv", "graph": "states_graph.csv", "batch": "states_batch.csv"}
_STATES |= {name: f"states_{name}.csv" for name in ("causal", "final")}  # where an estimator by others gives them
_CURVE_POINTS = 240  # of each trajectory that are kept for pictures
SEGMENTS_M = (1, 5, 10)


def run_measures(metrics: dict[str, Any], latencies_s: Sequence[float]) -> dict[str, Any]:
    """Return what belongs to the run as a whole: time, memory, counts, and the filter's innovations."""
    timing, initialisation, cost = metrics["timing_ms"], metrics["initialisation"], metrics["cost"]
    p50_ms, p99_ms = np.percentile(np.array(latencies_s) * 1e3, (50, 99)) if len(latencies_s) else (None, None)
    duration_s = metrics["duration_s"]
    return {
        "mode": metrics["mode"],
        "has_imu": metrics["has_imu"],
        "frames": metrics["frames"],
        "keyframes": metrics["keyframes"],
        "loops": metrics["loops"]["accepted"],
        "injected_kept": metrics["loops"].get("injected_kept"),
        "initialisation": initialisation["status"],
        "initialisation_s": initialisation["t_s"],
        "start_scale_sigma": initialisation["scale_sigma"],
        "latency_p50_ms": _plain(p50_ms),
        "latency_p99_ms": _plain(p99_ms),
        "filter_p50_ms": timing.get("ekf", {}).get("p50"),
        "filter_p99_ms": timing.get("ekf", {}).get("p99"),
        "cpu_s_per_s": cost["cpu_s"] / duration_s if duration_s > 0.0 else None,
        **{name: cost[name] for name in ("cpu_ms_per_frame", "peak_memory_mb", "first_pose_s", "first_pose_cpu_s")},
        "nis": nis_measures(metrics.get("nis") or {}),
        "doubts": len(metrics["doubts"]),
        "warnings": metrics["warnings"],
    }


def output_measures(
    run: Path, outputs: Sequence[str], metrics: dict[str, Any], span_ns: tuple[int, int] | None
) -> dict[str, Any]:
    """Return accuracy and consistency of each trajectory that a run left; one that cannot be judged has the reason."""
    truth_file = run / "trajectory_truth.tum"
    truth = read_tum(truth_file) if truth_file.is_file() else None
    measures = {}
    for name in outputs:
        path = run / f"trajectory_{name}.tum"
        try:
            if truth is None:
                raise DataError("the recording has no truth to compare with")
            alignment = gauge_alignment(metrics["has_imu"], knows_scale(metrics["mode"]))
            measures[name] = _output(path, truth, alignment, span_ns)
        except VislamError as error:
            measures[name] = {"failure": str(error).replace(f"{run}/", "")}
            continue
        states = run / _STATES.get(name, "none")
        if metrics["has_imu"] and states.is_file():
            measures[name] |= _consistency(states, truth, metrics)
    return measures


def _output(path: Path, truth: Trajectory, alignment: Alignment, span_ns: tuple[int, int] | None) -> dict[str, Any]:
    estimate = read_tum(path)
    entry = evaluate(estimate, truth, alignment, span_ns=span_ns)
    segments = entry["rpe_segments"]
    scale = entry["scale"]
    return {
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "alignment": alignment,
        "ate_m": entry["ate_rmse_m"],
        "ate_max_m": entry["ate_max_m"],
        "rotation_deg": entry["rotation_rmse_deg"],
        "scale_error": None if scale is None else scale - 1.0,
        "completeness": entry["coverage"],
        "path_m": entry["path_m"],
        **{f"rpe_{length}m_percent": segments[str(length)]["percent"] for length in SEGMENTS_M},
        **{f"rpe_{length}m_deg_per_m": segments[str(length)]["deg_per_m"] for length in SEGMENTS_M},
        "curve": _curve(estimate, truth, alignment),
        **from_start(estimate, truth, alignment),
    }


def _curve(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> dict[str, list[float]]:
    """Return the aligned path from above and its error over time, thinned out for pictures."""
    pairs = associate(estimate, truth)
    pairs = pairs.aligned(align(pairs, alignment))
    keep = np.unique(np.linspace(0, len(pairs) - 1, _CURVE_POINTS).astype(int))
    columns = {
        "t_s": (pairs.t_ns - truth.t_ns[0]) * 1e-9,
        "x_m": pairs.estimate[:, 0, 3],
        "y_m": pairs.estimate[:, 1, 3],
        "true_x_m": pairs.reference[:, 0, 3],
        "true_y_m": pairs.reference[:, 1, 3],
        "error_m": pairs.position_errors_m(),
    }
    return {name: np.round(values[keep], 4).tolist() for name, values in columns.items()}


def from_start(estimate: Trajectory, truth: Trajectory, alignment: Alignment) -> dict[str, Any]:
    """Return how an estimate leaves the truth from a common first pose: RMS by axis, and the way and errors over time.

    Dead reckoning is not judged by the best fit over all of it, which hides how it grows. Moved is what no sensor can
    know, as in `evaluate`, by the first pose that both have: yaw and position, or all of it without gravity; a scale is
    that of the best fit. Axes are those of the truth's world.
    """
    pairs = associate(estimate, truth)
    S = align(pairs, "first")
    if alignment == "yaw":
        S[:3, :3] = Rotation.from_euler("z", _yaw_rad(S[:3, :3])).as_matrix()
    elif alignment == "sim3":
        S[:3, :3] *= np.cbrt(np.linalg.det(align(pairs, "sim3")[:3, :3]))
    S[:3, 3] = pairs.reference[0, :3, 3] - S[:3, :3] @ pairs.estimate[0, :3, 3]
    moved = pairs.aligned(S)
    way = moved.estimate[:, :3, 3]
    errors_m = way - moved.reference[:, :3, 3]
    turned = moved.estimate[:, :3, :3] @ moved.reference[:, :3, :3].transpose(0, 2, 1)
    yaw_deg = np.rad2deg(np.unwrap(_yaw_rad(turned)))
    keep = np.unique(np.linspace(0, len(pairs) - 1, _CURVE_POINTS).astype(int))
    columns = {"t_s": (pairs.t_ns - truth.t_ns[0]) * 1e-9, "yaw_deg": yaw_deg}
    columns |= {f"{axis}_m": errors_m[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"at_{axis}_m": way[:, i] for i, axis in enumerate("xy")}
    columns |= {f"true_{axis}_m": pairs.reference[:, i, 3] for i, axis in enumerate("xy")}
    rms = {f"start_{axis}_m": _rms(errors_m[:, i]) for i, axis in enumerate("xyz")} | {"start_yaw_deg": _rms(yaw_deg)}
    return rms | {"start_curve": {name: np.round(values[keep], 4).tolist() for name, values in columns.items()}}


def _yaw_rad(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the turn about z of rotations [..., 3, 3]."""
    return np.arctan2(R[..., 1, 0], R[..., 0, 0])


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _consistency(states: Path, truth: Trajectory, metrics: dict[str, Any]) -> dict[str, Any]:
    try:
        read, fit = read_states_csv(states)[1], TruthFit.read(metrics.get("truth"))
        found = {name: asdict(value) for name, value in anees(read, truth, fit).items()}
        return {
            "anees": found,
            "judged_by": (metrics.get("truth") or {}).get("summary", ""),
            "end_scale_sigma": stated_scale_sigma(read),
        }
    except VislamError as error:
        return {"anees": {"failure": str(error)}}


def nis_measures(statistics: dict[str, Any]) -> dict[str, Any]:
    """Return the filter's innovations by kind as averages with bounds, from (count, sum, degrees of freedom in all)."""
    return {
        kind: asdict(chi_square_mean(float(total), 1, int(freedom))) | {"count": int(count)}
        for kind, (count, total, freedom) in statistics.items()
        if freedom > 0
    }


def _plain(value: Any) -> float | None:
    return None if value is None else float(value)
