"""What the numbers of a run say: its accuracy, what makes it doubtful, and whether it is a result at all."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.errors import DataError, TrackingLostError, VislamError
from vislam.core.messages import ImuSpan
from vislam.pipeline.front_report import FrontReport
from vislam.runs.folder import RunLog
from vislam.runs.pipeline import FinalGraph
from vislam.runs.verdict import Evidence, Trust, Verdict
from vislam.trajectory import Alignment, Trajectory, evaluate

_BEFORE = ("unusable", "too_early", "dropped", "beginning")  # readings that reached neither filter nor graph
_BY_FILTER = ("accepted", "gated", "refused", "waiting", "failed")
_BY_GRAPH = ("used", "in_window", "early")
_SAMPLES = ("t_ns", "gyro_rad_s", "accel_m_s2")
_NOT_IN_GRAPH = ("late", "unplaced", "crowded")


def accuracy(
    log: RunLog, final: Trajectory, truth: Trajectory | None, alignment: Alignment, problems: Iterable[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the errors of each trajectory and how good the truth is, and why some could not be compared with it."""
    errors: dict[str, Any] = {}
    warnings: list[str] = []
    if truth is not None and len(log):
        span = (int(log.stamps_ns[0]), int(log.stamps_ns[-1]))
        live = log.live_trajectory()  # empty where the run was not found in the map in which it began
        estimates = {"ekf": log.odometry_trajectory(), **({"live": live} if len(live) else {}), "graph": final}
        for name, estimate in estimates.items():
            try:
                errors[name] = evaluate(estimate, truth, alignment, span_ns=span)
            except VislamError as error:
                warnings.append(f"{name}: {error}")
    is_undone = any(kind.endswith(": undone") for kind in problems)  # before vision was simulated on that truth
    judged = {} if truth is None or is_undone else _truth_entry(log.inertial_spans(), truth, alignment)
    return {"accuracy": errors, "truth": judged}, warnings


def in_metres(final: Trajectory, from_ns: int, first_ns: int) -> tuple[Trajectory, str]:
    """Return what of a trajectory has metres, and what is said of the rest.

    One camera may see for a while before anybody knows how large that is.

    Args:
        final: the graph's, from the recording's first frame on.
        from_ns: when scale was known.
        first_ns: of the first frame.
    """
    keep, length_s = final.t_ns >= from_ns, (from_ns - first_ns) * 1e-9
    warning = (
        f"{int((~keep).sum())} frames in the first {length_s:.1f} s are not in trajectory_graph: scale was found "
        "later and does not reach back so far; begin at rest or with more acceleration"
    )
    return Trajectory(final.t_ns[keep], final.T_world_body[keep]), warning


def initialisation(front: FrontReport, first_ns: int | None) -> dict[str, Any]:
    """Return how gravity was found, or why not; its time counts from the first frame."""
    start = front.start
    if start is None or first_ns is None:
        return {
            "status": "none", "reason": front.refusal, "t_s": None, "settled_s": None, "scale_sigma": None,
            "excitation_m_s2": None,
        }  # fmt: skip
    return {
        "status": str(start.status),
        "reason": start.reason,
        "t_s": ((start.begun_t_ns or start.last.t_ns) - first_ns) * 1e-9,
        "settled_s": (start.last.t_ns - first_ns) * 1e-9 if front.is_confirmed else None,
        "scale_sigma": start.scale_sigma,
        "excitation_m_s2": start.excitation_m_s2,
    }


def verdict_entry(evidence: Evidence, verdict: Verdict) -> dict[str, Any]:
    """Return the verdict as metrics.json has it, with the evidence that it comes of."""
    return {
        "state": str(verdict.state),
        "reasons": list(verdict.reasons),
        "moved": list(verdict.moved),
        "evidence": asdict(evidence),
    }


def sensors_entry(
    reported: dict[str, dict[str, Any]], counters: dict[str, dict[str, int]], graph: FinalGraph | None
) -> dict[str, dict[str, Any]]:
    """Return what is known of further sensors, `reported` by the front half, with their own variables in the graph.

    And what became of their readings: all that came, and where each is in the filter and in the graph.
    """
    out = {}
    for name, entry in with_own_of_graph(reported, graph).items():
        queued, since = int(entry.get("queued", 0)), int(entry.get("since_keyframe", 0))
        came = counters.get(f"sensor {name}", {})
        both = {end: came.get(end, 0) for end in _BEFORE} | {"queued": queued}
        both |= {"slipped": came["slipped"]} if "slipped" in came else {}
        readings = {
            "came": came.get("readings", 0),
            "filter": both | _in_filter(name, came, counters.get("ekf", {})),
            "graph": both | _slipped(came) | _in_graph(came, {} if graph is None else graph.sensed(name), since),
        }
        shown = {key: value for key, value in entry.items() if key not in {"queued", "since_keyframe"}}
        out[name] = {**shown, "readings": readings}
    return out


def with_own_of_graph(sensors: dict[str, dict[str, Any]], graph: FinalGraph | None) -> dict[str, dict[str, Any]]:
    """Return entries of sensors with their own variables as a graph has them now."""
    found = {name: graph.own(name) for name, entry in sensors.items() if graph is not None and entry.get("variables")}
    return {
        name: entry if (own := found.get(name)) is None else entry | {
            "graph": {"values": own[0].tolist(), "sigmas": own[1].tolist()}
        }
        for name, entry in sensors.items()
    }  # fmt: skip


def _truth_entry(spans: Sequence[ImuSpan], truth: Trajectory, alignment: Alignment) -> dict[str, Any]:
    """Return how good a truth is by inertial samples; empty without samples, or where it has positions only."""
    if not spans or not truth.has_rotation:
        return {}
    from vislam.trajectory.truth_fit import fit_truth  # takes its time to be loaded

    t_ns, gyro, accel = (np.concatenate([getattr(s, name) for s in spans]) for name in _SAMPLES)
    first = np.unique(t_ns, return_index=True)[1]  # each span begins where the one before ended
    return fit_truth(t_ns[first], gyro[first], accel[first], truth).entry(truth, alignment)


def _in_filter(name: str, came: dict[str, int], ekf: dict[str, int]) -> dict[str, int]:
    """Return what the filter did with readings; `outside` are older than its history, or not its time yet."""
    did = {end: ekf.get(f"{name}_{end}", 0) for end in _BY_FILTER}
    return did | {"outside": max(came.get("told", 0) - sum(did.values()), 0)}


def _slipped(came: dict[str, int]) -> dict[str, int]:
    """Return how many readings of wheels that slip were kept from the graph; empty where none did."""
    slipped = came.get("slipped", 0) + came.get("slip_began", 0)
    return {"slipped": slipped} if slipped else {}


def _in_graph(came: dict[str, int], did: dict[str, int], since: int) -> dict[str, int]:
    """Return what the graph did with readings; those `after` its last keyframe hang on nothing."""
    used = {end: did.get(end, 0) for end in _BY_GRAPH} | {"at_submap": did.get("dropped", 0)}
    unusable = came.get("unusable", 0) + did.get("unusable", 0)
    never = {end: came.get(end, 0) for end in _NOT_IN_GRAPH}
    of_used = {end: did.get(end, 0) for end in ("outliers", "failed")}
    return {**never, "after": since, **used, "unusable": unusable, **of_used}


def refuse(metrics: dict[str, Any], out: Path) -> None:
    """Raise DataError when a run had no frame, TrackingLostError when its verdict is that it is lost."""
    if metrics["frames"] == 0:
        why = max(metrics["problems"].items(), key=lambda item: item[1], default=("", 0))[0]
        raise DataError(f"{metrics['name']}: not one usable frame{why and f': {why}'}; run `vislam doctor` on it")
    if metrics["verdict"]["state"] == Trust.LOST:
        why = "; ".join(metrics["verdict"]["reasons"][:3])  # a cause comes before what it leads to
        raise TrackingLostError(f"{metrics['name']}: {why}; see tracking.csv and report.html in {out}")
