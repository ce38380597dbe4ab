"""One recording through the pipeline into a run folder: the library's side of `vislam run`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.clock import StageClock
from vislam.config import Config, ImuConfig
from vislam.errors import DataError, TrackingLostError, UsageError, VislamError
from vislam.factor_log import rig_data
from vislam.factors.gate import EdgeReport
from vislam.front import FrontReport
from vislam.imu import ImuNoise
from vislam.loop.table import LoopRow, caption
from vislam.loop_gallery import LoopGallery
from vislam.mapping.map_pictures import write_pictures
from vislam.mapping.mapper import Mapper
from vislam.memory import FrontMemory, FrontNews, GraphNews, KeyframeEntry, SlamMemory, StartFacts
from vislam.messages import Array, Frame, ImuSample, Localisation, LoopDecision, MagSample, NavState, Tracking
from vislam.recording import Recording
from vislam.runfolder import MapChoice, RunLog, storage, write_json, write_setup
from vislam.session import Session, SessionWriter, has_begun, recall
from vislam.slam import Finish, KeyframeStep, Slam, Step
from vislam.trajectory import Trajectory, align, associate, evaluate
from vislam.viewer import NullViewer, open_viewer

if TYPE_CHECKING:
    from vislam.viewer.recording import RunViewer

Progress = Callable[[int, int, str], None]  # frames done, frames in all, a short note

_LOST_SIGMA_M = 1.0  # of the filter's position: no controller can use it, and a user must be told
_UNIFORM_S = 20.0  # after which the biases that hold the scale of one camera may have walked away
_GATED_SHARE = 0.1  # of the visual motions that the filter refused: more than outliers explain
_APART_M = 0.5  # rms between filter and graph that is no drift ...
_APART_SHARE = 0.05  # ... and the share of the way that is none either
_MIN_COMPARED = 10  # poses
_INERTIAL_BEFORE_NS = 1_000_000_000  # given again before the keyframe at which a run is resumed
_MIN_COVERAGE = 0.5  # of the frames that must have a pose for a run to count as a trajectory


def imu_noise(config: ImuConfig, recorded: ImuNoise | None) -> ImuNoise | None:
    """Return the recording's noise model with what the configuration overrides; None without an IMU or with it off."""
    if recorded is None or not config.enabled:
        return None
    overrides = {name: value for name in asdict(recorded) if (value := getattr(config, name, None)) is not None}
    return ImuNoise(**{**asdict(recorded), **overrides})


class FrontHalf(Protocol):
    """What a run asks of the front half, in this process or another."""

    @property
    def start(self) -> StartFacts | None:
        """How gravity was found."""
        ...

    @property
    def news(self) -> FrontNews:
        """What was learned so far."""
        ...

    def report(self) -> FrontReport:
        """Return what there is to say of the run."""
        ...


class FinalGraph(Protocol):
    """What a run asks of the graph when it is finished."""

    @property
    def ids(self) -> NDArray[np.int64]:
        """Keyframes [M]."""
        ...

    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4]."""
        ...

    def states(self) -> list[NavState]:
        """Return the states of the keyframes; empty without an IMU."""
        ...

    def edge_reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop."""
        ...


class BackHalf(Protocol):
    """What a run asks of the back end, in this process or another."""

    @property
    def graph(self) -> FinalGraph:
        """The graph."""
        ...

    @property
    def mapper(self) -> Mapper | None:
        """The map; None where it is off."""
        ...

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of the rooms."""
        ...


class Pipeline(Protocol):
    """What a run asks of the pipeline beside its steps: `Slam`, or processes that do the same."""

    counters: dict[str, int]

    @property
    def clock(self) -> StageClock:
        """Durations of the stages of this process."""
        ...

    @property
    def front(self) -> FrontHalf:
        """The half at the rate of the sensors."""
        ...

    @property
    def back(self) -> BackHalf | None:
        """The half at the rate of keyframes; None before the first."""
        ...

    def finish(self) -> Finish:
        """Process what still waits and optimise a last time."""
        ...


class Run:
    """Drives the pipeline over one recording and keeps the run folder."""

    def __init__(
        self, recording: Recording, config: Config, out: Path, session: SessionWriter, slam: Pipeline | None = None
    ) -> None:
        """Open the outputs in an existing folder; `session` is a new one, or that of a run to `resume`.

        Without `slam` the pipeline is made here.
        """
        cv2.setNumThreads(1)  # replay must not depend on how OpenCV splits its work
        self.recording = recording
        self.config = config
        self.out = out
        self.noise = imu_noise(config.imu, recording.imu_noise)
        self.slam: Pipeline = Slam(config, recording.rig, self.noise) if slam is None else slam
        self.log = RunLog()
        self.gallery = LoopGallery()
        self.session = session
        self.resumed: list[dict[str, Any]] = []
        self._first_frame = 0  # that was not remembered from an earlier process
        self._from: FrontMemory | None = None
        self.viewer: RunViewer | NullViewer = NullViewer()
        self.base: dict[str, Any] | None = None  # the map in which the run began
        self.joined_t_ns: int | None = None  # when the recording was found in it
        self.warnings: list[str] = []

    def resume(self, stored: Session) -> bool:
        """Go on where a run ended, before `execute`; False when there is nothing yet to go on from.

        Raises UsageError when the run is finished or began with other settings.
        """
        info = stored.info()
        if info.get("finished"):
            raise UsageError(
                f"the run in {self.out} came to its end; there is nothing to resume (`vislam report` writes its report)"
            )
        if not _still(info.get("config") or {}, json.loads(json.dumps(asdict(self.config)))):
            raise UsageError(f"{self.out / 'config.json'} was changed since the run began; start a new run")
        memory = recall(stored)
        if memory is None:
            return False
        assert isinstance(self.slam, Slam)
        update = self.slam.resume(memory)
        self.base = info.get("map")
        self.log.restore(stored, memory)
        self.gallery.skip(self.log.candidates)
        front = memory.front
        self._first_frame, self._from = len(self.log), front
        t_s = (front.t_ns - int(self.log.stamps_ns[0])) * 1e-9
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self.resumed = [*info.get("resumed", []), {"keyframe": front.keyframe_id, "t_s": t_s, "utc": now}]
        self.session.tell({"resumed": self.resumed, "finished": False})
        self.session.move(update, GraphNews())
        self.warnings.append(
            f"resumed {len(self.resumed)} times, last at keyframe {front.keyframe_id}: timings, counters and "
            "real-time factor are those of the part since then"
        )
        return True

    def begin_in_map(self, memory: SlamMemory) -> None:
        """Begin in the map of another session, before `execute`."""
        assert isinstance(self.slam, Slam)
        update = self.slam.begin_in_map(memory)
        self.log.begin_in_map(memory)
        self.base = self.session.base()
        self.session.move(update, GraphNews())

    def execute(self, progress: Progress | None = None) -> dict[str, Any]:
        """Process the whole recording and write every file; return the metrics.

        What was computed is written whatever happens; the error is raised afterwards. Raises TrackingLostError when
        fewer than half of the frames got a pose.
        """
        start = time.perf_counter()
        self._open_viewer()
        failure: BaseException | None = None
        try:
            self._feed(progress)
        except (VislamError, KeyboardInterrupt) as error:
            failure = error
            self.warnings.append(f"stopped early: {error or 'interrupted'}")
        try:
            metrics = self._finish(start)
            self.session.close(finished=failure is None)
        except VislamError as error:
            raise failure or error from error
        if failure is not None:
            raise failure
        self._judge(metrics)
        return metrics

    def _open_viewer(self) -> None:
        """Open the Rerun recording; that of a run that is resumed goes on in another file."""
        rig, view, back = self.recording.rig, self.config.view, self.slam.back
        part = "" if not self.resumed else f"_{len(self.resumed) + 1}"
        self.viewer = open_viewer(self.out / f"run{part}.rrd", view.enabled, rig, view)
        if self._from is not None and back is not None:
            poses = dict(zip(back.graph.ids.tolist(), back.graph.poses(), strict=True))
            self.viewer.go_on(int(self.log.stamps_ns[0]), poses)

    def _feed(self, progress: Progress | None) -> None:
        assert isinstance(self.slam, Slam)
        clock = self.slam.clock
        values = iter(self._values())
        while True:
            with clock.measure("read"):
                value = next(values, None)
            if value is None:
                return
            for step in self.slam.feed(value):
                self._take(step)
                if progress is not None:
                    progress(len(self.log), self.recording.frame_count, str(step.front.track.vo.tracking))

    def _values(self) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield the recording, or what is left of it."""
        if self._from is None:
            yield from self.recording.events()
            return
        begin_ns = self._from.camera_t_ns
        samples_ns = min(begin_ns, self._from.t_ns) - _INERTIAL_BEFORE_NS
        begun = False
        for value in self.recording.events(begin_ns):
            if value.t_ns < (begin_ns if isinstance(value, Frame) else samples_ns):
                continue
            if isinstance(value, Frame) and not begun:
                if value.t_ns != begin_ns:
                    raise DataError(
                        f"{self.recording.name} has no frame at {begin_ns} ns, where the last keyframe of {self.out} "
                        "is; give the recording that the run began with"
                    )
                begun = True
            yield value

    def _take(self, step: Step) -> None:
        if self._from is not None and step.front.frame.t_ns <= self._from.t_ns:
            return  # the keyframe at which the run is resumed is remembered already
        self.session.add_frame(self.log.add(step))
        for keyframe in step.keyframes:
            self._store(keyframe)
        with self.slam.clock.measure("view"):
            self._show(step)

    def _store(self, step: KeyframeStep) -> None:
        with self.slam.clock.measure("store"):
            packet, front = step.odometry.packet, self.slam.front
            entry = KeyframeEntry(
                packet, step.odometry.T_odom_body, step.update, step.news, step.edges, step.candidates, step.retrieved,
                self.log.shifts(step.update.accepted_loop_ids), step.scans, step.words, step.tags, front.start,
                front.news, self.log.filter_state(packet.keyframe.id),
            )  # fmt: skip
            self.session.add(entry)
            self.gallery.add(step)
        if self.base is not None and self.joined_t_ns is None and step.update.pieces.group(packet.keyframe.id) == 0:
            self.joined_t_ns = packet.keyframe.t_ns

    def _show(self, step: Step) -> None:
        """Log a step for the viewer: the image with its tracks, the poses, what the back end did."""
        frame, track = step.front.frame, step.front.track
        self.viewer.log_frame(frame, track.observations, track.vo.tracking)
        if step.T_map_body is not None:
            self.viewer.log_pose("live", frame.t_ns, step.T_map_body)
        if step.front.T_odom_body is not None:
            self.viewer.log_pose("ekf", frame.t_ns, step.front.T_odom_body)
        self.viewer.log_scalars(frame.t_ns, _plotted(step))
        if step.localisation is Localisation.RELOCALISED:
            self.viewer.log_note(
                frame.t_ns, f"relocalised: piece {step.piece} of the trajectory is joined with the map"
            )
        if track.vo.tracking != Tracking.OK:
            self.viewer.log_note(frame.t_ns, f"{track.vo.tracking}: {track.reason}")
        for keyframe in step.keyframes:
            T_map_body = keyframe.update.T_map_odom @ keyframe.odometry.T_odom_body
            self.viewer.log_keyframe(keyframe.odometry.packet.keyframe, T_map_body)
            self.viewer.move(keyframe.update)
            for candidate in keyframe.candidates:
                self.viewer.log_loop(candidate)
            self._show_depth(keyframe)
        if step.keyframes:
            self._show_map(frame.t_ns)

    def _show_depth(self, step: KeyframeStep) -> None:
        """Show the points of keyframes whose depth did not come with the image: from two images, or from one, late."""
        mapper = None if self.slam.back is None else self.slam.back.mapper
        if (
            mapper is None
            or isinstance(self.viewer, NullViewer)
            or step.odometry.packet.keyframe.frame.depth_m is not None
        ):
            return
        for keyframe_id, scan in step.scans.items():
            if scan.depth_png:
                cloud = mapper.keyframe_cloud(keyframe_id)
                self.viewer.log_cloud(keyframe_id, cloud.points_m, cloud.colors)

    def _show_map(self, t_ns: int, is_last: bool = False) -> None:
        """Show octree and grid as they are now, if it is time for that."""
        mapper = None if self.slam.back is None else self.slam.back.mapper
        if mapper is None or not self.viewer.wants_map(t_ns, is_last):
            return
        with suppress(DataError):  # too many voxels, or too large a grid: said where they are exported
            octree = mapper.occupancy.max_likelihood_octree()
            self.viewer.log_octree(t_ns, octree.occupied_voxels(), octree.resolution_m)
            if self.slam.front.start is not None:  # else the map is not level
                grid = mapper.grid()
                self.viewer.log_grid(t_ns, grid.cells, grid.resolution_m, grid.origin_m, grid.floor_m)

    def _finish(self, start: float) -> dict[str, Any]:
        finish = self.slam.finish()
        for step in finish.steps:
            self._take(step)
        for keyframe in finish.keyframes:
            self.log.add_keyframe(keyframe)
            self._store(keyframe)
        if finish.update is not None and finish.news is not None:
            self.session.move(finish.update, finish.news)
            self.viewer.move(finish.update)
        final, rows, loops = self._write_estimates()
        self._explain(rows)
        truth = self._truth()
        self.log.write_trajectories(self.out, final, truth)
        if self.slam.back is not None and self.slam.back.mapper is not None:
            with self.slam.clock.measure("map export"):
                self.slam.back.mapper.export(self.out / "map")
            self.warnings += [f"no {name}: {reason}" for name, reason in self.slam.back.mapper.notes.items()]
        self._show_result(final, truth)
        wall_s = time.perf_counter() - start  # everything but pictures and report
        if self.slam.back is not None and self.slam.back.mapper is not None:
            is_level = self.slam.front.start is not None
            write_pictures(self.slam.back.mapper, self.out / "map", final.positions_m, is_level)
        metrics = self._metrics(final, truth, wall_s, loops)
        write_json(self.out / "metrics.json", metrics)
        return metrics

    def _write_estimates(self) -> tuple[Trajectory, list[LoopRow], dict[str, int]]:
        """Write states and tables; return the final trajectory, the loop candidates and the counts of decisions."""
        graph = None if self.slam.back is None else self.slam.back.graph
        if graph is None:
            nothing = self.log.final_trajectory([], np.zeros((0, 4, 4)), [], self.config.imu)
            return nothing, [], self.log.write_tables(self.out, [])
        ids = [int(i) for i in graph.ids]
        states = graph.states()
        self.log.write_states(self.out, ids, states)
        rows = self.log.loop_rows({report.loop_id: report for report in graph.edge_reports()})
        loops = self.log.write_tables(self.out, rows)
        return self.log.final_trajectory(ids, graph.poses(), states, self.config.imu), rows, loops

    def _explain(self, rows: list[LoopRow]) -> None:
        """Write the pictures of telling loop candidates, and show all as they were decided in the end."""
        for row, path in self.gallery.write(self.out, rows):
            self.viewer.log_loop_picture(row.to_t_ns, path.read_bytes(), caption(row))
        decided = {(row.from_id, row.to_id): LoopDecision(row.decision) for row in rows}  # the last word counts
        if decided:
            self.viewer.settle_loops(int(self.log.stamps_ns[-1]), decided)

    def _show_result(self, final: Trajectory, truth: Trajectory | None) -> None:
        self.viewer.log_path("graph", final.positions_m)
        if len(self.log):
            self._show_map(int(self.log.stamps_ns[-1]), is_last=True)
        if truth is not None and len(final):
            with suppress(VislamError):  # too little in common: metrics say so
                pairs = associate(truth, final)
                self.viewer.log_path("truth", pairs.aligned(align(pairs, "se3")).estimate[:, :3, 3])
        self.viewer.close()

    def _truth(self) -> Trajectory | None:
        try:
            return self.recording.truth()
        except DataError as error:
            self.warnings.append(f"no truth: {error}")
            return None

    def _metrics(
        self, final: Trajectory, truth: Trajectory | None, wall_s: float, loops: dict[str, int]
    ) -> dict[str, Any]:
        front, back = self.slam.front.report(), self.slam.back
        stamps = self.log.stamps_ns
        duration_s = float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) else 0.0
        part = stamps[self._first_frame :]
        part_s = float(part[-1] - part[0]) * 1e-9 if len(part) else 0.0
        counters: dict[str, Any] = {**front.counters, "localisation": dict(self.slam.counters)}
        if back is not None:
            counters |= back.counters
        if self.noise is not None:
            self.warnings += front.noise_warnings
            sigma_m = self.log.worst_position_sigma_m
            if sigma_m > _LOST_SIGMA_M:
                self.warnings.append(
                    f"the filter's position was uncertain by {sigma_m:.1f} m (1 sigma) at its worst: too long without "
                    "vision, or without motion that shows scale"
                )
        self._doubt_filter(front)
        self._compare_filter_and_graph(final)
        if self.noise is not None and front.start is None:
            self.warnings.append(f"gravity was never found, vision alone gave the motion: {front.refusal}")
        return {
            "name": self.recording.name,
            "mode": front.mode,
            "has_imu": self.noise is not None,
            "coupling": {
                "ekf": front.coupling,
                "graph": self.config.graph.coupling,
            },
            "frames": len(self.log),
            "frames_expected": self.recording.frame_count,
            "keyframes": self.log.keyframes,
            "duration_s": duration_s,
            "wall_s": wall_s,
            "realtime_factor": part_s / wall_s if wall_s > 0.0 else None,
            "resumed": self.resumed,
            "map": self._found_in_map(),
            "initialisation": {
                "status": "none" if front.start is None else str(front.start.status),
                "reason": front.refusal if front.start is None else front.start.reason,
                "t_s": None if front.start is None else (front.start.last.t_ns - int(stamps[0])) * 1e-9,
                "scale_sigma": None if front.start is None else front.start.scale_sigma,
                "excitation_m_s2": None if front.start is None else front.start.excitation_m_s2,
            },
            "calibration": front.calibration,
            "accuracy": self._accuracy(final, truth),
            "timing_ms": self.slam.clock.summary_ms(),
            "counters": counters,
            "nis": front.nis,
            "problems": dict(self.recording.problems),
            "loops": loops,
            "graph_revisions": self.log.revisions,
            "coverage_frames": len(final) / max(len(self.log), 1),
            "warnings": self.warnings,
        }

    def _doubt_filter(self, front: FrontReport) -> None:
        """Warn where the filter's numbers hold less than they seem to."""
        uniform_s = front.uniform_s
        if uniform_s > _UNIFORM_S:
            self.warnings.append(
                f"uniform motion for {uniform_s:.0f} s: the scale of one camera is held by the IMU's biases alone "
                "there, and may be off by more than its sigma; accelerate now and then, or use a second camera or depth"
            )
        ekf = front.counters.get("ekf", {})
        resets, gated, opposed, taken = (
            ekf.get(name, 0) for name in ("soft_resets", "vo_gated", "vo_opposed", "vo_accepted")
        )
        if resets:
            self.warnings.append(
                f"vision contradicted the filter for so long that its uncertainty was widened {resets} times: look at "
                "tracking.csv for something that moves through the image, and check calibration and time offset"
            )
        if (refused := gated + opposed) > _GATED_SHARE * (refused + taken):
            self.warnings.append(
                f"the filter refused {refused} of {refused + taken} visual motions as impossible: its pose is mostly "
                "inertial there; with one camera use --ekf.coupling tight"
            )

    def _found_in_map(self) -> dict[str, Any] | None:
        """Return in which map the run began, and when it was found there."""
        if self.base is None:
            return None
        if self.joined_t_ns is None:
            self.warnings.append(f"the recording was not found in the map {self.base['path']}: its poses begin anew")
            return {**self.base, "found_t_s": None}
        return {**self.base, "found_t_s": (self.joined_t_ns - int(self.log.stamps_ns[0])) * 1e-9}

    def _compare_filter_and_graph(self, final: Trajectory) -> None:
        """Warn when filter and graph went different ways by more than drift explains: one of them is wrong."""
        odometry = self.log.odometry_trajectory()
        if self.noise is None or len(odometry) < _MIN_COMPARED or len(final) < _MIN_COMPARED:
            return
        path_m = float(np.linalg.norm(np.diff(final.positions_m, axis=0), axis=1).sum())
        with suppress(VislamError):  # nothing in common to compare
            apart_m = evaluate(odometry, final, "yaw")["ate_rmse_m"]
            if apart_m > max(_APART_M, _APART_SHARE * path_m):
                self.warnings.append(
                    f"filter and graph are {apart_m:.1f} m apart over {path_m:.0f} m of way: one of them is wrong; "
                    "look at tracking.csv for lost or degraded frames, and for something that moves through the image"
                )

    def _accuracy(self, final: Trajectory, truth: Trajectory | None) -> dict[str, Any]:
        if truth is None:
            return {}
        stamps = self.log.stamps_ns
        accuracy = {}
        estimates = {"ekf": self.log.odometry_trajectory(), "live": self.log.live_trajectory(), "graph": final}
        for name, estimate in estimates.items():
            try:
                span = (int(stamps[0]), int(stamps[-1]))
                accuracy[name] = evaluate(estimate, truth, "se3", span_ns=span)
            except VislamError as error:
                self.warnings.append(f"{name}: {error}")
        return accuracy

    def _judge(self, metrics: dict[str, Any]) -> None:
        if metrics["frames"] == 0:
            raise DataError(f"{self.recording.name}: not one usable frame; run `vislam doctor` on it")
        if metrics["coverage_frames"] < _MIN_COVERAGE:
            raise TrackingLostError(
                f"{self.recording.name}: only {metrics['coverage_frames']:.0%} of the frames have a pose "
                f"({metrics['initialisation']['reason']}); see tracking.csv and report.html in {self.out}"
            )


def _plotted(step: Step) -> dict[str, float]:
    """Return the numbers of a step that the viewer draws over time."""
    track, state = step.front.track, step.front.state
    values = {"tracking/inliers": float(track.vo.inliers), "tracking/parallax_px": track.median_parallax_px}
    if state is not None:
        for name, bias in (("gyro_bias_rad_s", state.gyro_bias_rad_s), ("accel_bias_m_s2", state.accel_bias_m_s2)):
            values |= {f"{name}/{axis}": float(value) for axis, value in zip("xyz", bias, strict=True)}
    return values


def execute(
    recording: Recording,
    config: Config,
    out: Path,
    source: str,
    command: list[str],
    progress: Progress | None = None,
    base: MapChoice | None = None,
) -> dict[str, Any]:
    """Run a recording into the prepared folder `out` and return its metrics; see `Run.execute`.

    With `base` it begins in the map of another session, which stays as it is. Raises UsageError when that does not fit.
    """
    info = {"source": source, "config": asdict(config)}
    noise = imu_noise(config.imu, recording.imu_noise)
    path = out / "session.db"
    if base is None:
        write_setup(out, config, source, command)
        session = SessionWriter(path, info, recording.rig, noise, config.imu.gravity_m_s2)
        return Run(recording, config, out, session).execute(progress)
    stored = Session(base.path / "session.db" if base.path.is_dir() else base.path)
    try:
        memory = _map_of(stored, recording, config, noise)
        memory = replace(memory, held=len(memory.graph.packets) if base.localize_only else 0)
        write_setup(out, config, source, command, base)
        session = SessionWriter.in_map(path, stored, info, noise, base.localize_only)
    finally:
        stored.close()
    run = Run(recording, config, out, session)
    run.begin_in_map(memory)
    if not memory.scans and config.map.enabled:
        run.warnings.append(
            f"{stored.path} brings no clouds, or of another shape (--map.*): the map holds new ones only"
        )
    return run.execute(progress)


def _still(began: Any, now: Any) -> bool:
    """Return whether settings are what they were; those that a newer version has besides are at their defaults."""
    if isinstance(began, dict) and isinstance(now, dict):
        return all(name in now and _still(value, now[name]) for name, value in began.items())
    return bool(began == now)


def _map_of(stored: Session, recording: Recording, config: Config, noise: ImuNoise | None) -> SlamMemory:
    """Return the map of a session; raises UsageError when a recording cannot go on in it, DataError without one."""
    info = stored.info()
    settings, sensors = info.get("config") or {}, json.loads(json.dumps(rig_data(recording.rig)))
    if settings.get("graph", {}).get("coupling") != "tight" or config.graph.coupling != "tight":
        raise UsageError("a map is made and continued with tight coupling only; use --graph.coupling tight for both")
    if info.get("rig") != sensors:
        raise UsageError(f"{stored.path} was made with other cameras, or another calibration, than {recording.name}")
    if (info.get("imu_noise") is None) != (noise is None):
        raise UsageError(f"{stored.path} and {recording.name} must both have an IMU, or both none")
    memory = recall(stored)
    if memory is None:
        raise DataError(f"{stored.path} holds no map: not one keyframe, or gravity was not found")
    if settings.get("map") != json.loads(json.dumps(asdict(config.map))):
        return replace(memory, scans={})  # of another shape
    return memory


def resume(
    recording: Recording,
    config: Config,
    out: Path,
    source: str,
    command: list[str],
    progress: Progress | None = None,
    base: MapChoice | None = None,
) -> dict[str, Any]:
    """Go on with the run in `out` after its last stored keyframe and return the metrics of the whole.

    A run that had no keyframe yet, or had not found gravity, begins again, in the map `base` if it began there. Raises
    UsageError when it is finished or `config` is not what it began with, DataError when its session is damaged or the
    recording is another one.
    """
    path = out / "session.db"
    if has_begun(path):
        session = SessionWriter.reopen(path)
        run = Run(recording, config, out, session)
        stored = Session(path)
        try:
            is_begun = run.resume(stored)
        finally:
            stored.close()
        if is_begun:
            return run.execute(progress)
        session.close()
    with storage(path):
        for name in ("session.db", "session.db-wal", "session.db-shm"):
            (out / name).unlink(missing_ok=True)
    return execute(recording, config, out, source, command, progress, base)
