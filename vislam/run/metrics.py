"""What the numbers of a run say: its accuracy, what makes it doubtful, and whether it is a result at all."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from vislam.errors import DataError, TrackingLostError, VislamError
from vislam.front import FrontReport
from vislam.runfolder import RunLog
from vislam.trajectory import Alignment, Trajectory, evaluate

_LOST_SIGMA_M = 1.0  # of the filter's position: no controller can use it, and a user must be told
_UNIFORM_S = 20.0  # after which the biases that hold the scale of one camera may have walked away
_GATED_SHARE = 0.1  # of the visual motions that the filter refused: more than outliers explain
_APART_M = 0.5  # rms between filter and graph that is no drift ...
_APART_SHARE = 0.05  # ... and the share of the way that is none either
_MIN_COMPARED = 10  # poses
_MIN_COVERAGE = 0.5  # of the frames that must have a pose for a run to count as a trajectory


def accuracy(
    log: RunLog, final: Trajectory, truth: Trajectory, alignment: Alignment
) -> tuple[dict[str, Any], list[str]]:
    """Return the errors of each trajectory by its name, and why some could not be compared with the truth."""
    errors, warnings = {}, []
    if len(log):
        span = (int(log.stamps_ns[0]), int(log.stamps_ns[-1]))
        estimates = {"ekf": log.odometry_trajectory(), "live": log.live_trajectory(), "graph": final}
        for name, estimate in estimates.items():
            try:
                errors[name] = evaluate(estimate, truth, alignment, span_ns=span)
            except VislamError as error:
                warnings.append(f"{name}: {error}")
    return errors, warnings


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
        "settled_s": (start.last.t_ns - first_ns) * 1e-9,
        "scale_sigma": start.scale_sigma,
        "excitation_m_s2": start.excitation_m_s2,
    }


def doubts(front: FrontReport, log: RunLog, final: Trajectory, has_imu: bool) -> list[str]:
    """Return what a user must be told: where the numbers of a run hold less than they seem to."""
    warnings = []
    if has_imu and (sigma_m := log.worst_position_sigma_m) > _LOST_SIGMA_M:
        warnings.append(
            f"the filter's position was uncertain by {sigma_m:.1f} m (1 sigma) at its worst: too long without "
            "vision, or without motion that shows scale"
        )
    if front.uniform_s > _UNIFORM_S:
        warnings.append(
            f"uniform motion for {front.uniform_s:.0f} s: the scale of one camera is held by the IMU's biases alone "
            "there, and may be off by more than its sigma; accelerate now and then, or use a second camera or depth"
        )
    warnings += _contradictions(front.counters.get("ekf", {}))
    if has_imu:
        warnings += _apart(log.odometry_trajectory(), final)
        if front.start is None and len(log):
            warnings.append(f"gravity was never found, vision alone gave the motion: {front.refusal}")
    return warnings


def judge(metrics: dict[str, Any], out: Path) -> None:
    """Raise DataError when a run had no frame, TrackingLostError when fewer than half of them got a pose."""
    if metrics["frames"] == 0:
        raise DataError(f"{metrics['name']}: not one usable frame; run `vislam doctor` on it")
    if metrics["coverage_frames"] < _MIN_COVERAGE:
        raise TrackingLostError(
            f"{metrics['name']}: only {metrics['coverage_frames']:.0%} of the frames have a pose "
            f"({metrics['initialisation']['reason']}); see tracking.csv and report.html in {out}"
        )


def _contradictions(ekf: dict[str, int]) -> list[str]:
    """Tell of vision that the filter did not believe, by the filter's counters."""
    warnings = []
    resets, gated, opposed, taken = (
        ekf.get(name, 0) for name in ("soft_resets", "vo_gated", "vo_opposed", "vo_accepted")
    )
    if resets:
        warnings.append(
            f"vision contradicted the filter for so long that its uncertainty was widened {resets} times: look at "
            "tracking.csv for something that moves through the image, and check calibration and time offset"
        )
    if (refused := gated + opposed) > _GATED_SHARE * (refused + taken):
        warnings.append(
            f"the filter refused {refused} of {refused + taken} visual motions as impossible: its pose is mostly "
            "inertial there; with one camera use --ekf.coupling tight"
        )
    return warnings


def _apart(odometry: Trajectory, final: Trajectory) -> list[str]:
    """Tell when filter and graph went different ways by more than drift explains: one of them is wrong."""
    if len(odometry) < _MIN_COMPARED or len(final) < _MIN_COMPARED:
        return []
    path_m = float(np.linalg.norm(np.diff(final.positions_m, axis=0), axis=1).sum())
    with suppress(VislamError):  # nothing in common to compare
        apart_m = evaluate(odometry, final, "yaw")["ate_rmse_m"]
        if apart_m > max(_APART_M, _APART_SHARE * path_m):
            return [
                f"filter and graph are {apart_m:.1f} m apart over {path_m:.0f} m of way: one of them is wrong; "
                "look at tracking.csv for lost or degraded frames, and for something that moves through the image"
            ]
    return []
