"""The run itself: the pipeline driven over one recording, and the run folder kept."""

from __future__ import annotations

import json
import logging
import time
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import Config, ImuConfig, recorded
from vislam.core import interrupts
from vislam.core.errors import DataError, UsageError, VislamError
from vislam.core.files import write_json
from vislam.core.memory import FrontMemory, GraphRecord, KeyframeEntry, SlamMemory
from vislam.core.messages import GraphUpdate, Localisation, LoopDecision, Submaps, Tracking
from vislam.core.progress import Progress, silent
from vislam.core.recording import Recording
from vislam.frontend.masks import mask_warnings
from vislam.imu import ImuNoise
from vislam.loop import LoopRow, caption
from vislam.mapping.mapper import Mapper
from vislam.mapping.pictures.of_map import write_pictures
from vislam.mapping.semantic.images import label_warnings
from vislam.pipeline.front_report import FrontReport
from vislam.pipeline.steps import KeyframeStep, Step
from vislam.runs.cost import CostMeter
from vislam.runs.evidence import KeyframeWitness, front_evidence, judged, whole_evidence
from vislam.runs.folder import RunLog
from vislam.runs.further_sensors import further_readings
from vislam.runs.geodetic_outputs import GeodeticOutputs, datums_of
from vislam.runs.levelled import Known, find_up
from vislam.runs.loop_gallery import LoopGallery
from vislam.runs.metrics import accuracy, in_metres, initialisation, refuse, sensors_entry, verdict_entry
from vislam.runs.pipeline import Pipeline
from vislam.runs.run_input import RunInput
from vislam.runs.session import Session, SessionWriter, recall
from vislam.runs.show import show_map, show_paths, show_step
from vislam.runs.sources import shaken, without_idle_cameras
from vislam.runs.verdict import Evidence
from vislam.runs.viewer import NullViewer, open_viewer
from vislam.slam import Slam
from vislam.trajectory import Trajectory

if TYPE_CHECKING:
    from vislam.runs.viewer.recording import RunViewer


_LOG = logging.getLogger(__name__)


def imu_noise(config: ImuConfig, recorded: ImuNoise | None) -> ImuNoise | None:
    """Return the recording's noise model with what is configured of it; None without an IMU or with it off."""
    if recorded is None or not config.enabled:
        return None
    overrides = {name: value for name in asdict(recorded) if (value := getattr(config, name, None)) is not None}
    noise = ImuNoise(**{**asdict(recorded), **overrides})
    gyro, accel = noise.gyroscope_scale_sigma, noise.accelerometer_scale_sigma
    return replace(
        noise,
        gyroscope_scale_sigma=config.gyro_scale_prior if gyro is None else gyro,
        accelerometer_scale_sigma=config.accel_scale_prior if accel is None else accel,
    )


class Run:
    """Drives the pipeline over one recording and keeps the run folder."""

    def __init__(
        self, recording: Recording, config: Config, out: Path, session: SessionWriter, slam: Pipeline | None = None
    ) -> None:
        """Open the outputs in a folder; `session` is new or of a run to `resume`, `slam` is made here where None."""
        cv2.setNumThreads(1)  # replay must not depend on how OpenCV splits its work
        self.recording = shaken(without_idle_cameras(recording, config), config.imu.vibration)
        further = None if slam else further_readings(recording, config.sensors, config.seed)
        self._input = RunInput(self.recording, further, out)
        self.config = config
        self.out = out
        self.noise = imu_noise(config.imu, recording.imu_noise)
        self.slam: Pipeline = Slam(config, recording.rig, self.noise, self._input.suite) if slam is None else slam
        self._geodetic = GeodeticOutputs(datums_of(config.sensors))
        self.log = RunLog()
        self.cost = CostMeter()
        self.gallery = LoopGallery()
        self.witness = KeyframeWitness(config)
        self._submaps = Submaps()
        self.session = session
        self.resumed: list[dict[str, Any]] = []
        self._first_frame = 0  # that was not remembered from an earlier process
        self._from: FrontMemory | None = None
        self.viewer: RunViewer | NullViewer = NullViewer()
        self.base: dict[str, Any] | None = None  # the map in which the run began
        self.joined_t_ns: int | None = None  # when the recording was found in it
        self.warnings: list[str] = []
        self.wants_frames = True  # a run without one has failed

    def resume(self, stored: Session) -> bool:
        """Go on where a run ended, before `execute`; False when there is nothing yet to go on from.

        Raises UsageError when the run is finished or began with other settings.
        """
        info = stored.info()
        if info.get("finished"):
            raise UsageError(
                f"the run in {self.out} came to its end; there is nothing to resume (`vislam report` writes its report)"
            )
        return self.go_on(stored)

    def go_on(self, stored: Session) -> bool:
        """Go on after the last keyframe, as `resume`, though the run may have come to its end."""
        info = stored.info()
        if not _still(
            recorded(info.get("config") or {}, str(stored.path)), json.loads(json.dumps(asdict(self.config)))
        ):
            raise UsageError(f"{self.out / 'config.json'} was changed since the run began; start a new run")
        memory = recall(stored)
        if memory is None:
            return False
        update = self.slam.resume(memory)
        self.base = info.get("map")
        self.log.restore(stored, memory)
        self.gallery.skip(self.log.candidates)
        front = memory.front
        self._first_frame, self._from = len(self.log), front
        t_s = (front.t_ns - int(self.log.stamps_ns[0])) * 1e-9
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self.resumed = [*info.get("resumed", []), {"keyframe": front.keyframe_id, "t_s": t_s, "utc": now}]
        self.session.set_info({"resumed": self.resumed, "finished": False})
        self.session.move(update, GraphRecord())
        self.warnings.append(
            f"resumed {len(self.resumed)} times, last at keyframe {front.keyframe_id}: timings, counters and "
            "real-time factor are those of the part since then"
        )
        return True

    def begin_in_map(self, memory: SlamMemory) -> None:
        """Begin in the map of another session, before `execute`."""
        update = self.slam.begin_in_map(memory)
        self.log.begin_in_map(memory)
        self.base = self.session.base()
        self.session.move(update, GraphRecord())

    def execute(self, progress: Progress = silent) -> dict[str, Any]:
        """Process the whole recording and write every file; return the metrics.

        Whatever happens, what was computed is written, after an interrupt without map and pictures; then the error is
        raised. Raises TrackingLostError when the verdict is that it is lost.
        """
        start = time.perf_counter()
        _LOG.info("%s, %s frames", self.recording.name, self.recording.frame_count or "unknown")
        self._open_viewer()
        failure: VislamError | KeyboardInterrupt | None = None
        try:
            self._feed(progress)
        except (VislamError, KeyboardInterrupt) as error:
            failure = error
            self.warnings.append(f"stopped early: {error or 'interrupted'}")
        try:
            metrics = self._finish(start, isinstance(failure, KeyboardInterrupt))
            self.session.close(finished=failure is None)
        except VislamError as error:
            raise failure or error from error
        finally:
            self.viewer.close()
        if failure is not None:
            raise failure
        if self.wants_frames:
            refuse(metrics, self.out)
        return metrics

    @property
    def _mapper(self) -> Mapper | None:
        return None if self.slam.back is None else self.slam.back.mapper

    def _open_viewer(self) -> None:
        """Open the Rerun recording; that of a run that is resumed goes on in another file."""
        rig, view, back = self.recording.rig, self.config.view, self.slam.back
        part = "" if not self.resumed else f"_{len(self.resumed) + 1}"
        self.viewer = open_viewer(self.out / f"run{part}.rrd", view.enabled, rig, view)
        if self._from is not None and back is not None:
            poses = dict(zip(back.graph.ids.tolist(), back.graph.poses(), strict=True))
            self.viewer.go_on(int(self.log.stamps_ns[0]), poses)

    def _feed(self, progress: Progress) -> None:
        assert isinstance(self.slam, Slam)
        values = self._input.values(self._from)
        with interrupts.counted() as asked:
            while not asked.count:
                with self.slam.clock.measure("read"):
                    value = next(values, None)
                if value is None:
                    return
                for step in self.slam.feed(value):
                    self._take(step)
                    progress(len(self.log), self.recording.frame_count, str(step.front.track.vo.tracking))
        raise KeyboardInterrupt  # between two values, where the pipeline is whole

    def _take(self, step: Step) -> None:
        if self._from is not None and step.front.frame.t_ns <= self._from.t_ns:
            return  # the keyframe at which the run is resumed is remembered already
        self.cost.take(step)
        before = self.log.newest_tracking
        self.session.add_frame(self.log.add(step))
        _log_changes(step, before, self.log.zero_ns)
        for keyframe in step.keyframes:
            self._store(keyframe)
        with self.slam.clock.measure("view"):
            show_step(self.viewer, step, self._mapper, self.slam.front.start is not None)

    def _store(self, step: KeyframeStep) -> None:
        with self.slam.clock.measure("store"):
            packet, front = step.odometry.packet, self.slam.front
            entry = KeyframeEntry(
                packet, step.odometry.T_odom_body, step.update, step.record, step.edges, step.candidates,
                step.retrieved, self.log.shifts(step.update.accepted_loop_ids), step.scans, step.words, step.tags,
                front.start, front.learned, self.log.filter_state(packet.keyframe.id),
            )  # fmt: skip
            self.session.add(entry)
            self.gallery.add(step)
            self.witness.add(packet, step.update)
            self._submaps = step.update.submaps
            for loop_id in step.update.accepted_loop_ids:
                _LOG.info("keyframe %d: loop %d is in the graph", packet.keyframe.id, loop_id)
        if self.base is not None and self.joined_t_ns is None and step.update.submaps.group(packet.keyframe.id) == 0:
            self.joined_t_ns = packet.keyframe.t_ns

    def _finish(self, start: float, is_brief: bool) -> dict[str, Any]:
        mapper, self.witness.is_hurried = None if is_brief else self._mapper, is_brief
        finish = self.slam.finish()
        for step in finish.steps:
            self._take(step)
        for keyframe in finish.keyframes:
            self.log.add_keyframe(keyframe)
            self._store(keyframe)
        if finish.update is not None and finish.record is not None:
            self._settle(finish.update, finish.record)
        final, rows, loops = self._write_estimates()
        self._explain([] if is_brief else rows)
        truth = self._truth()
        known = Known(final, mapper, self.slam.front, self.base, self.joined_t_ns is not None)
        level = find_up(self.recording, self.config, known)
        self.warnings += level.warnings
        level_path = level.trajectory(final)
        self.log.write_trajectories(self.out, level_path, truth)
        if mapper is not None:
            with self.slam.clock.measure("map export"):
                level_map = level.in_map.export(mapper, self.out / "map")
            self.warnings += [f"no {name}: {reason}" for name, reason in level_map.notes.items()]
        if self.slam.back is not None:
            self.warnings += label_warnings(self.slam.back.counters.get("map", {}))
        self.warnings += mask_warnings(self.slam.front.report().counters.get("masks", {}))
        show_paths(self.viewer, final, truth, self.slam.front.report().alignment)
        if mapper is not None and len(self.log):
            show_map(self.viewer, int(self.log.stamps_ns[-1]), mapper, self.slam.front.start is not None, is_last=True)
        self.warnings += filter(None, [self.viewer.close()])
        wall_s = time.perf_counter() - start  # everything but pictures and report
        if mapper is not None:
            with self.slam.clock.measure("pictures"):
                write_pictures(level_map, self.out / "map", level_path.positions_m, level.in_map.is_level)
        metrics = self._metrics(level_path, truth, wall_s, loops)
        if up := level.entry(final, self.recording.rig):
            self.session.set_info({} if level.of_map else up)
            metrics |= up
        estimates = {"filter": self.log.odometry_trajectory(), "graph": final}
        if (datum := self._geodetic.write(self.out, metrics["sensors"], estimates)) is not None:
            self.session.set_info({"datum": datum})
        write_json(self.out / "metrics.json", metrics)
        for warning in metrics["warnings"]:
            _LOG.warning("%s", warning)
        _LOG.info("%d frames, %d keyframes, %s", metrics["frames"], metrics["keyframes"], metrics["verdict"]["state"])
        return metrics

    def _settle(self, update: GraphUpdate, record: GraphRecord) -> None:
        """Bring everything to the final poses."""
        self.session.move(update, record)
        self.viewer.move(update)

    def _write_estimates(self) -> tuple[Trajectory, list[LoopRow], dict[str, int]]:
        """Write states and tables; return the final trajectory, the loop candidates and the counts of decisions."""
        graph = None if self.slam.back is None else self.slam.back.graph
        if graph is None:
            nothing = self.log.final_trajectory([], np.zeros((0, 4, 4)), [], self.config.machine)
            return nothing, [], self.log.write_tables(self.out, [])
        ids = [int(i) for i in graph.ids]
        states = graph.states()
        self.log.write_states(self.out, ids, states)
        rows = self.log.loop_rows({report.loop_id: report for report in graph.edge_reports()})
        loops = self.log.write_tables(self.out, rows)
        final = self.log.final_trajectory(ids, graph.poses(), states, self.config.machine)
        from_ns = self.slam.front.report().scaled_from_ns
        if from_ns is not None:
            final, warning = in_metres(final, from_ns, int(self.log.stamps_ns[0]))
            self.warnings.append(warning)
        return final, rows, loops

    def _explain(self, rows: list[LoopRow]) -> None:
        """Write the pictures of the loop candidates worth seeing, and show all as they were decided in the end."""
        for row, path in self.gallery.write(self.out, rows):
            self.viewer.log_loop_picture(row.to_t_ns, path.read_bytes(), caption(row))
        decided = {(row.from_id, row.to_id): LoopDecision(row.decision) for row in rows}  # the last word counts
        if decided:
            self.viewer.settle_loops(int(self.log.stamps_ns[-1]), decided)

    def _truth(self) -> Trajectory | None:
        try:
            return self.recording.truth()
        except DataError as error:
            self.warnings.append(f"no truth: {error}")
            return None

    def _metrics(
        self, final: Trajectory, truth: Trajectory | None, wall_s: float, loops: dict[str, int]
    ) -> dict[str, Any]:
        front, back = self._input.among(self.slam.front.report()), self.slam.back
        stamps, timing_ms = self.log.stamps_ns, self.slam.clock.summary_ms()
        part = stamps[self._first_frame :]
        counters: dict[str, Any] = {**front.counters, "localisation": dict(self.slam.counters)}
        if back is not None:
            counters |= back.counters
        gathered = self._evidence(front, final)
        evidence, verdict = judged(gathered, self.config.verdict, self.recording, self.witness.seen, front.turns)
        self.warnings += front.noise_warnings
        found = self._found_in_map()
        by_truth, not_compared = accuracy(self.log, final, truth, front.alignment, self._input.problems)
        self.warnings += not_compared
        return {
            "name": self.recording.name,
            "verdict": verdict_entry(evidence, verdict),
            "mode": front.mode,
            "has_imu": self.noise is not None,
            "coupling": {"ekf": front.coupling, "graph": self.config.graph.coupling},
            "frames": len(self.log),
            "frames_expected": self.recording.frame_count,
            "keyframes": self.log.keyframes,
            "duration_s": _length_s(stamps),
            "wall_s": wall_s,
            "realtime_factor": _length_s(part) / wall_s if wall_s > 0.0 else None,
            "resumed": self.resumed,
            "map": found,
            "initialisation": initialisation(front, int(stamps[0]) if len(stamps) else None),
            "calibration": front.calibration,
            "imu_noise": front.imu_noise,
            "track_noise": front.track_noise,
            **by_truth,
            "timing_ms": timing_ms,
            "cost": self.cost.entry(timing_ms),
            "counters": counters,
            "nis": front.nis,
            "sensors": sensors_entry(front.sensors, front.counters, None if back is None else back.graph),
            "problems": self._input.problems,
            "events": [event.entry(front.first_t_ns) for event in front.events],
            "loops": loops,
            "graph_revisions": self.log.revisions,
            "coverage_frames": evidence.coverage,
            "doubts": list(verdict.reasons),
            "warnings": self.warnings,
        }

    def _evidence(self, report: FrontReport, final: Trajectory) -> Evidence:
        """Gather what speaks for and against the run."""
        front = front_evidence(report, self.config.machine)
        graph = None if self.slam.back is None else self.slam.back.graph
        if graph is None:
            return whole_evidence(front, self.log, final, self._frames_due, [], {}, 0, {})
        ids, states = graph.ids.tolist(), graph.states()
        by_keyframe = dict(zip(ids, states, strict=True)) if states else {}
        apart = len({*self._submaps.groups}) - 1
        keyframes = self.witness.evidence(ids, graph.poses(), states)
        reports = graph.edge_reports()
        return whole_evidence(front, self.log, final, self._frames_due, reports, by_keyframe, apart, keyframes)

    @property
    def _frames_due(self) -> int:
        """How many frames the final trajectory ought to have poses of."""
        return len(self.log)

    def _found_in_map(self) -> dict[str, Any] | None:
        """Return in which map the run began, and when it was found there."""
        if self.base is None:
            return None
        if self.joined_t_ns is None:
            where = self.base["path"]
            self.warnings.append(f"the recording was not found in the map {where}: its poses begin at a new origin")
            return {**self.base, "found_t_s": None}
        return {**self.base, "found_t_s": (self.joined_t_ns - int(self.log.stamps_ns[0])) * 1e-9}


def _log_changes(step: Step, before: Tracking | None, zero_ns: int) -> None:
    """Log when vision is lost or found again, and when the place in the map is."""
    track, t_s = step.front.track, (step.front.frame.t_ns - zero_ns) * 1e-9
    if track.vo.tracking is not before:
        _LOG.info("frame at %.3f s: tracking is %s; %s", t_s, track.vo.tracking, track.reason or "all is well")
    if step.localisation is Localisation.RELOCALISED:
        _LOG.info("frame at %.3f s: found in the map", t_s)


def _length_s(stamps_ns: NDArray[np.int64]) -> float:
    return float(stamps_ns[-1] - stamps_ns[0]) * 1e-9 if len(stamps_ns) else 0.0


def _still(began: Any, now: Any) -> bool:
    """Return whether settings are what they were; those that a newer version has besides are at their defaults."""
    if isinstance(began, dict) and isinstance(now, dict):
        return all(name in now and _still(value, now[name]) for name, value in began.items())
    return bool(began == now)
