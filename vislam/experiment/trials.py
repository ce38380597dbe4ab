"""What the jobs of a plan gave, one value per compared trajectory, and the table of what is measured."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from vislam.experiment.identity import sha256_of
from vislam.experiment.jobs import Job
from vislam.experiment.plan import Plan

_MIN_COMPLETE = 0.5  # of the recording's time; below, a small error only means that little was estimated
CAUSAL = ("ekf", "live", "causal")  # known when the frame came; the others know the whole recording
OUTPUT_TITLES = {
    "ekf": "filter, causal", "live": "graph, causal", "causal": "causal",
    "graph": "graph, final", "batch": "batch, final", "final": "final",
}  # fmt: skip

Kind = Literal["error", "share", "signed", "ratio", "cost", "count"]


@dataclass(frozen=True, slots=True)
class Metric:
    """One measured number; of an "error" less is better and a failure is the worst."""

    name: str
    title: str
    kind: Kind
    digits: int
    scale: float = 1.0  # from the stored number to the shown one


METRICS: tuple[Metric, ...] = (
    Metric("ate_m", "ATE [m]", "error", 4),
    Metric("ate_max_m", "ATE max [m]", "error", 3),
    Metric("start_x_m", "x from the start [m]", "error", 3),
    Metric("start_y_m", "y from the start [m]", "error", 3),
    Metric("start_z_m", "z from the start [m]", "error", 3),
    Metric("start_yaw_deg", "yaw from the start [°]", "error", 2),
    Metric("rotation_deg", "rotation [°]", "error", 2),
    Metric("scale_error", "scale error [%]", "signed", 2, 100.0),
    Metric("start_scale_sigma", "scale sigma at the start [%]", "share", 2, 100.0),
    Metric("end_scale_sigma", "scale sigma in the end [%]", "share", 2, 100.0),
    Metric("rpe_1m_percent", "RPE 1 m [%]", "error", 2),
    Metric("rpe_5m_percent", "RPE 5 m [%]", "error", 2),
    Metric("rpe_10m_percent", "RPE 10 m [%]", "error", 2),
    Metric("rpe_1m_deg_per_m", "RPE 1 m [°/m]", "error", 3),
    Metric("rpe_5m_deg_per_m", "RPE 5 m [°/m]", "error", 3),
    Metric("rpe_10m_deg_per_m", "RPE 10 m [°/m]", "error", 3),
    Metric("completeness", "complete [%]", "share", 1, 100.0),
    Metric("anees_position", "ANEES position", "ratio", 2),
    Metric("anees_rotation", "ANEES rotation", "ratio", 2),
    Metric("anees_velocity", "ANEES velocity", "ratio", 2),
    Metric("initialisation_s", "initialised after [s]", "cost", 2),
    Metric("doubts", "doubts reported", "count", 0),
    Metric("latency_p50_ms", "frame p50 [ms]", "cost", 1),
    Metric("latency_p99_ms", "frame p99 [ms]", "cost", 1),
    Metric("filter_p50_ms", "filter p50 [ms]", "cost", 2),
    Metric("filter_p99_ms", "filter p99 [ms]", "cost", 2),
    Metric("first_pose_s", "first pose after [s]", "cost", 2),
    Metric("first_pose_cpu_s", "first pose after [CPU s]", "cost", 2),
    Metric("cpu_ms_per_frame", "CPU per frame [ms]", "cost", 1),
    Metric("cpu_s_per_s", "CPU s per s", "cost", 2),
    Metric("peak_memory_mb", "memory [MB]", "cost", 0),
    Metric("keyframes", "keyframes", "count", 0),
    Metric("loops", "loops", "count", 0),
    Metric("injected_kept", "false loops kept", "count", 0),
)
FROM_START = ("start_x_m", "start_y_m", "start_z_m", "start_yaw_deg")
BY_NAME: dict[str, Metric] = {metric.name: metric for metric in METRICS}


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One trajectory of one job against the truth."""

    job: Job
    output: str
    failure: str  # empty: none
    values: dict[str, float]  # by metric; what could not be measured is not in it
    bounds: dict[str, tuple[float, float]]  # 95 % bounds of the ratios
    sha256: str  # of the trajectory file; empty after a failure
    curve: dict[str, list[float]]
    start_curve: dict[str, list[float]] = field(default_factory=dict)  # from a common first pose

    @property
    def estimate(self) -> str:
        """What is compared: estimator and output; without an IMU the fast path is no filter."""
        title = OUTPUT_TITLES[self.output]
        if self.output == "ekf" and not self.job.config.get("imu", {}).get("enabled", True):
            title = "odometry, causal"
        return f"{self.job.estimator} {title}"


def estimates(plan: Plan) -> list[tuple[str, str]]:
    """Return the (estimator, output) pairs of a plan: causal ones first."""
    pairs = [(e.name, output) for e in plan.estimators for output in e.compared]
    return sorted(pairs, key=lambda pair: pair[1] not in CAUSAL)


def trials(plan: Plan, jobs: Sequence[Job], results: Mapping[str, dict[str, Any]]) -> list[Trial]:
    """Return every trajectory that the plan compares, for the jobs that have a result."""
    outputs = {estimator.name: estimator.compared for estimator in plan.estimators}
    return [
        _trial(job, output, results[job.key])
        for job in jobs
        if job.key in results
        for output in sorted(outputs[job.estimator], key=list(OUTPUT_TITLES).index)
    ]


def table_sha256(found: Sequence[Trial]) -> str:
    """Return the SHA-256 of all that a plan's results state, wherever they were computed, in whatever order.

    Every trajectory counts by its own SHA-256, and every number but what time and memory were used: those are never
    twice the same. Nor do errors from the start count, which came later and follow from the trajectory: tables from
    before them are still to be recognised.
    """
    timed = {metric.name for metric in METRICS if metric.kind == "cost"} | {*FROM_START}
    rows = [
        [
            t.job.sequence, t.job.variant, t.job.estimator, t.output, t.job.seed, t.job.member,
            bool(t.failure), t.sha256,
            sorted((name, value) for name, value in t.values.items() if name not in timed),
        ]
        for t in found
    ]  # fmt: skip
    return sha256_of(sorted(rows, key=repr))


def _trial(job: Job, output: str, result: dict[str, Any]) -> Trial:
    entry = result["outputs"].get(output, {})
    numbers = {**result["run"], **entry}
    values = {m.name: float(numbers[m.name]) for m in METRICS if _is_number(numbers.get(m.name))}
    bounds = {}
    ratios = {f"anees_{name}": value for name, value in entry.get("anees", {}).items()}
    if output == "ekf":
        ratios |= {f"nis_{name}": value for name, value in result["run"].get("nis", {}).items()}
    for name, value in ratios.items():
        if isinstance(value, dict):
            values[name], bounds[name] = value["mean"], (value["low"], value["high"])
    if output == "batch" and "batch_failure" in result:
        entry = {"failure": result["batch_failure"]}
    failure = result["reason"] if result["status"] != "ok" else entry.get("failure", "" if entry else "no trajectory")
    if not failure and values.get("completeness", 0.0) < _MIN_COMPLETE:
        failure = f"covers {values.get('completeness', 0.0):.0%} of the recording"
    return Trial(
        job,
        output,
        failure,
        values,
        bounds,
        entry.get("sha256", ""),
        entry.get("curve", {}),
        entry.get("start_curve", {}),
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
