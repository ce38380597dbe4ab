"""Gathers the evidence of a run for its verdict: from the front half, live or not, and from the whole at the end."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from math import isfinite
from typing import Any

import numpy as np

from vislam.config import Config, MachineConfig, VerdictConfig
from vislam.core.errors import VislamError
from vislam.core.memory import EdgeReport
from vislam.core.messages import Array, GraphUpdate, ImageU8, KeyframePacket, LoopDecision, NavState, Tracking
from vislam.core.recording import Recording
from vislam.core.streams import Happening, StreamEvent
from vislam.datasets.extrinsics import contradicted_extrinsics, misplaced_depth
from vislam.imu import Preintegrated, preintegrate
from vislam.pipeline.front_report import FrontReport
from vislam.runs.folder import RunLog
from vislam.runs.verdict import (
    LOST_S,
    Apart,
    Driven,
    Evidence,
    Moved,
    Trust,
    TurnStep,
    Verdict,
    force_agreement,
    judge,
    turn_agreement,
)
from vislam.trajectory import Trajectory, align, associate

_MIN_COMPARED = 10  # poses
_AT_ONCE_NS = 200_000_000
_OF_FRAMES = ("cam", "depth")  # begin the names of their streams: frames between are bridged by what was seen before
_EXPLAINED = 0.5  # of the turns of what drives, by the gyroscope's: else they show nothing
_MOST_SEEN = 11  # keyframes: half of them remain where one more comes
_SAMPLES = 4  # of a span, at least, for a judgement
_REFUSALS = ("gravity", "disagreement", "accel bias")  # of the start: sensors that contradict each other
_VISION = (("vo_accepted", "vo_gated", "vo_opposed"), ("tracks_used", "tracks_gated"), ("points_used", "points_gated"))


def front_evidence(report: FrontReport, machine: MachineConfig) -> Evidence:
    """Return what the front half has to say, at any time of a run."""
    counters = report.counters
    front, feed, ekf, live = (counters.get(name, {}) for name in ("front", "camera feed", "ekf", "live"))
    has_imu = report.condition is not None
    refusals = counters.get("initialisation refused", {})
    offered = [(ekf.get(first, 0), sum(ekf.get(name, 0) for name in others)) for first, *others in _VISION]
    evidence = Evidence(
        mode=report.mode,
        is_alone=report.mode == "none" and not report.sensors,
        frames=feed.get("frames", 0),
        frames_lost=front.get("frames_lost", 0),
        longest_loss_s=1e-3 * front.get("longest_loss_ms", 0),
        lost_reason=report.lost_reason,
        frames_degraded=front.get("frames_degraded", 0),
        frames_by_depth=front.get("frames_by_depth", 0),
        frames_missing=feed.get("missing", 0),
        frames_repeated=max(feed.get("frozen", 0) - _equal_in_the_dark(report.events), 0),
        dark_s=max((_lasted_s(e) for e in report.events if _is_dark(e)), default=0.0),
        frames_offered=live.get("frames_offered", 0),
        frames_dropped=live.get("frames_dropped", 0),
        frames_left_out=live.get("frames_left_out", 0),
        samples=live.get("samples", 0),
        samples_missed=live.get("samples_missed", 0),
        late_s=1e-3 * live.get("late_ms", 0),
        busy=0.01 * live.get("busy_percent", 0),
        core=0.01 * live.get("core_percent", 0),
        graph_late_s=1e-3 * live.get("back_late_ms", 0),
        has_imu=has_imu,
        is_started=not has_imu or report.start is not None,
        start_reason=report.refusal,
        start_failures=sum(refusals.get(name, 0) for name in _REFUSALS),
        starts_taken_back=counters.get("initialisation", {}).get("taken_back", 0),
        is_confirmed=report.is_confirmed,
        innovations=report.nis,
        shared_errors=report.shared_errors,
        keyframes=ekf.get("keyframes", 0),
        refused=sum(refused for _, refused in offered),
        offered=sum(taken + refused for taken, refused in offered),
        soft_resets=ekf.get("soft_resets", 0),
        regained={
            name: count for key, count in ekf.items() if (name := key.removesuffix("_regained")) != key and count
        },
        uniform_s=report.uniform_s,
        gravity_m_s2=machine.gravity_m_s2,
        max_gap_s=machine.max_gap_s,
        events=tuple(_together([e for e in report.events if _matters(e, machine.max_gap_s)], report.first_t_ns)),
        moving=tuple(_together([e for e in report.events if e.happening is Happening.MOVING], report.first_t_ns)),
        causes=tuple(_together([e for e in report.events if _may_explain(e)], report.first_t_ns)),
        driven=tuple(_driven(name, entry) for name, entry in report.sensors.items() if "stated" in entry),
        **_calibration(report.calibration),
    )
    condition, noise, given = report.condition, report.noise_ratios, report.stated_noise
    if condition is None or given is None:
        return evidence
    return replace(
        evidence,
        gyro_noise=None if noise is None else noise.gyro_quiet * given.gyroscope_noise_density,
        accel_noise=None if noise is None else noise.accel_quiet * given.accelerometer_noise_density,
        rate_hz=condition.rate_hz if np.isfinite(condition.rate_hz) else None,
        rate_told_hz=given.rate_hz,
        saturated=condition.saturated_axes,
        force_m_s2=condition.force_m_s2 if np.isfinite(condition.force_m_s2) else None,
    )


def _matters(event: StreamEvent, max_gap_s: float) -> bool:
    """Whether what happened in a stream leaves so much less to go on that the run is to be doubted."""
    if event.happening in (Happening.STUCK, Happening.UNUSABLE, Happening.HOLE, Happening.CONTRADICTING):
        return not event.stream.startswith(_OF_FRAMES) and _lasted_s(event) > max_gap_s
    return event.tears


def _may_explain(event: StreamEvent) -> bool:
    """Whether an event, no doubt by itself, may be the cause of others: a camera's hole, or its clock leapt."""
    return event.happening is Happening.HOLE and event.stream.startswith(_OF_FRAMES) and _lasted_s(event) > LOST_S


def _is_dark(event: StreamEvent) -> bool:
    """Whether an event is that vision has nothing to see; of a second camera, or of depth, it goes on without."""
    return event.happening is Happening.DARK and event.stream == "cam0"


def _lasted_s(event: StreamEvent) -> float:
    return (event.to_ns - event.from_ns) * 1e-9


def _equal_in_the_dark(events: Sequence[StreamEvent]) -> int:
    """Return how many images equal the one before because both are dark: no driver is stuck."""
    dark = [event for event in events if _is_dark(event)]
    equal = (event for event in events if event.happening is Happening.REPEATED and event.stream == "cam0")
    return sum(e.rows for e in equal if any(d.from_ns <= e.from_ns and e.to_ns <= d.to_ns for d in dark))


def _together(events: Sequence[StreamEvent], begin_ns: int) -> Iterator[str]:
    """Yield events in words, what happened to several streams at once as one."""
    groups: dict[tuple[str, int], list[StreamEvent]] = {}
    for event in events:
        near = (k for k in groups if k[0] == event.happening and abs(k[1] - event.from_ns) < _AT_ONCE_NS)
        groups.setdefault(next(near, (event.happening, event.from_ns)), []).append(event)
    for some in groups.values():
        yield replace(some[0], stream=", ".join(event.stream for event in some)).words(begin_ns)


def _driven(name: str, entry: dict[str, Any]) -> Driven:
    """Return what was found of a sensor of what drives; its turns where these explain most of what it measured."""
    turns, found = entry.get("turns", {}), entry.get("filter", {"values": (), "sigmas": ()})
    own = {
        variable: (start, prior, Moved.measured(value - start, sigma, prior))
        for (variable, (start, prior)), value, sigma in zip(
            entry["stated"].items(), found["values"], found["sigmas"], strict=False
        )
    }
    if turns.get("explained", 0.0) < _EXPLAINED:
        return Driven(name, own)
    turn = Moved(turns["factor"] - 1.0, turns["factor_sigma"])
    return Driven(name, own, turn, turns["slip"], Moved(turns["delay_s"], turns["delay_sigma_s"]))


def _calibration(learned: dict[str, float]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if "camera_offset_s" in learned:
        found["clock"] = Moved(learned["camera_offset_s"], learned["camera_offset_sigma_s"])
    if "camera_turn_deg" in learned:
        names = ("camera_turn_deg", "camera_turn_sigma_deg", "camera_turn_prior_deg")
        found["rotation"] = Moved.measured(*(learned[name] for name in names))
    return found


class KeyframeWitness:
    """Owns what keyframes bring that only a comparison of sensors asks for: turns by vision, inertial steps, images.

    Attributes:
        is_hurried: whether the run has to end soon: what takes seconds is not asked then.
    """

    def __init__(self, config: Config) -> None:
        """Start empty."""
        self._config = config
        self._turns: list[TurnStep] = []
        self._inertial: dict[int, Preintegrated] = {}  # by the keyframe at their end
        self._rotation: Moved | None = None
        self._scale_sigma = 0.0
        self._seen: list[tuple[ImageU8, ...]] = []
        self._every, self._keyframes = 1, 0
        self.is_hurried = False

    @property
    def seen(self) -> Sequence[tuple[ImageU8, ...]] | None:
        """Images of some keyframes that several cameras saw, spread over the run; None: nothing is to be asked."""
        return None if self.is_hurried else self._seen

    def _look(self, images: tuple[ImageU8, ...]) -> None:
        if len(images) > 1 and self._keyframes % self._every == 0:
            self._seen.append(images)
            if len(self._seen) > _MOST_SEEN:
                del self._seen[1::2]
                self._every *= 2
        self._keyframes += 1

    def add(self, packet: KeyframePacket, update: GraphUpdate) -> None:
        """Take a keyframe and what the graph made of it."""
        span, vo = packet.imu, packet.vo
        self._look(packet.keyframe.frame.images)
        if update.details is not None and update.newest is not None:
            self._scale_sigma = float(update.details.get("scale_sigma") or 0.0)
            self._rotation = _window_turn(update.details.get("calibration"), self._config.window.rotation_sigma_deg)
        if span is None or packet.begins_submap or len(span.t_ns) < _SAMPLES:
            return
        if float(np.diff(span.t_ns).max()) * 1e-9 > self._config.machine.max_gap_s:
            return
        inertial = preintegrate(span)
        self._inertial[packet.keyframe.id] = inertial
        is_seen = vo.tracking is Tracking.OK and vo.T_keyframe_body is not None and not packet.at_rest
        if is_seen and vo.keyframe_id == packet.keyframe.id - 1 and vo.T_keyframe_body is not None:
            self._turns.append(TurnStep(inertial, np.ascontiguousarray(vo.T_keyframe_body[:3, :3])))

    def evidence(self, ids: list[int], T_map_body: Array, states: Sequence[NavState]) -> dict[str, Any]:
        """Return the fields of `Evidence` that come of it, for the final poses [M, 4, 4] of the keyframes."""
        found: dict[str, Any] = {"turns": turn_agreement(self._turns), "scale_sigma": self._scale_sigma}
        if self._rotation is not None:
            found["rotation"] = self._rotation
        if len(states) != len(ids):
            return found
        bias = {i: state.gyro_bias_rad_s for i, state in zip(ids, states, strict=True)}
        steps = [self._without_bias(k, bias.get(k)) for k in ids[1:]]
        gravity_m_s2 = self._config.machine.gravity_m_s2
        sigma = self._config.verdict.accel_bias_sigma_m_s2
        found["forces"] = force_agreement(T_map_body, steps, gravity_m_s2, sigma)
        return found

    def _without_bias(self, keyframe_id: int, gyro_bias: Array | None) -> Preintegrated | None:
        inertial = self._inertial.get(keyframe_id)
        if inertial is None or gyro_bias is None:
            return None
        dR, dv, dp = inertial.corrected(gyro_bias, np.zeros(3))
        return replace(inertial, dR=dR, dv_m_s=dv, dp_m=dp)


def _window_turn(calibration: Any, prior_deg: float) -> Moved | None:
    """Return by how much a window turned the camera, in degrees; None where it does not estimate that."""
    if calibration is None or not np.all(calibration.R_cam_sigma > 0.0):
        return None
    turn = calibration.R_cam_correction
    angle = float(np.linalg.norm(turn))
    sigma = float(np.sqrt(np.sum((turn / max(angle, 1e-12) * calibration.R_cam_sigma) ** 2)))
    return Moved.measured(float(np.rad2deg(angle)), float(np.rad2deg(sigma)), prior_deg)


def whole_evidence(
    front: Evidence, log: RunLog, final: Trajectory, frames_due: int, reports: Sequence[EdgeReport],
    states: dict[int, NavState], submaps_apart: int, keyframes: dict[str, Any],
) -> Evidence:  # fmt: skip
    """Return the evidence of a whole run.

    Args:
        front: that of the front half.
        log: of the run.
        final: the final trajectory.
        frames_due: how many frames it ought to have poses of.
        reports: what became of the loops that were offered to the graph.
        states: of the graph, by keyframe.
        submaps_apart: submaps that are joined with nothing.
        keyframes: see `KeyframeWitness.evidence`.
    """
    return replace(
        front,
        coverage=len(final) / max(frames_due, 1),
        submaps_apart=submaps_apart,
        apart_reason=next((r.reason for r in reversed(reports) if _waits(r)), ""),
        sigma_m=log.worst_position_sigma_m,
        apart=_apart(log, final, states) if front.has_imu and front.is_started else None,
        loops_accepted=sum(report.decision is LoopDecision.ACCEPTED for report in reports),
        loops_contradicting=contradicting(reports),
        **keyframes,
    )


def _waits(report: EdgeReport) -> bool:
    """Whether a loop waits for its submap; what the graph tested has a distance."""
    return report.decision is LoopDecision.PENDING and not isfinite(report.chi2)


def contradicting(reports: Sequence[EdgeReport]) -> int:
    """Return how many loops the graph tested and does not believe; those that wait for their submap were not tested."""
    refused = [report for report in reports if report.decision is not LoopDecision.ACCEPTED]
    return sum(report.decision is LoopDecision.REJECTED or isfinite(report.chi2) for report in refused)


def _apart(log: RunLog, final: Trajectory, states: dict[int, NavState]) -> Apart | None:
    """Compare filter and graph at the keyframes, each with the sigmas that it admits."""
    odometry = log.odometry_trajectory()
    if len(odometry) < _MIN_COMPARED or len(final) < _MIN_COMPARED:
        return None
    with suppress(VislamError):  # nothing in common to compare
        pairs = associate(odometry, final)
        errors = pairs.aligned(align(pairs, "yaw")).position_errors_m()
        rms_m = float(np.sqrt(np.mean(errors**2)))
        path_m = float(np.linalg.norm(np.diff(final.positions_m, axis=0), axis=1).sum())
        admitted = [
            np.trace(state.covariance[3:6, 3:6]) + np.trace(log.filter_state(k).covariance[3:6, 3:6])  # type: ignore[union-attr]
            for k, state in states.items()
            if log.filter_state(k) is not None
        ]
        if admitted:
            return Apart(rms_m, rms_m / max(float(np.sqrt(np.mean(admitted))), 1e-9), path_m)
    return None


def judged(
    evidence: Evidence,
    config: VerdictConfig,
    recording: Recording,
    seen: Sequence[tuple[ImageU8, ...]] | None,
    turns: Sequence[tuple[Array, Array]] = (),
) -> tuple[Evidence, Verdict]:
    """Return evidence and verdict; of a run that is not trusted with what contradicts its extrinsics.

    They are the usual cause of a run that fails from its first frame on. Depth of another lens is smooth and agrees
    with itself, so it is asked of every run. `seen` and `turns` are as for `contradicted_extrinsics`; with None nothing
    is asked.
    """
    if seen is not None and recording.rig.has_depth:
        evidence = replace(evidence, misplaced_depth=misplaced_depth(recording))
    verdict = judge(evidence, config)
    if verdict.state is not Trust.TRUSTED and seen is not None:
        evidence = replace(evidence, causes=contradicted_extrinsics(recording, seen, turns) + evidence.causes)
        verdict = judge(evidence, config)
    return evidence, verdict
