"""One recording through the pipeline into a run folder: the library's side of `vislam run`."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vislam.config import Config, ImuConfig
from vislam.errors import DataError, TrackingLostError, VislamError
from vislam.imu import ImuNoise
from vislam.loop.table import LoopRow, caption
from vislam.loop_gallery import LoopGallery
from vislam.mapping.cloud import Cloud
from vislam.mapping.mapper import Mapper
from vislam.mapping.picture import Line, render_cloud, render_octree
from vislam.mapping.ply import read_ply
from vislam.messages import LoopDecision, Tracking
from vislam.recording import Recording
from vislam.runfolder import RunLog, storage, write_json, write_setup
from vislam.session import SessionWriter
from vislam.slam import KeyframeStep, Slam, Step
from vislam.trajectory import Trajectory, align, associate, evaluate
from vislam.viewer import open_viewer

Progress = Callable[[int, int, str], None]  # frames done, frames in all, a short note

_PATH_COLOR = (37, 99, 235)  # the blue that the report gives to the graph
_LOST_SIGMA_M = 1.0  # of the filter's position: no controller can use it, and a user must be told
_UNIFORM_S = 20.0  # after which the biases that hold the scale of one camera may have walked away
_GATED_SHARE = 0.1  # of the visual motions that the filter refused: more than outliers explain
_APART_M = 0.5  # rms between filter and graph that is no drift ...
_APART_SHARE = 0.05  # ... and the share of the way that is none either
_MIN_COMPARED = 10  # poses
_MIN_COVERAGE = 0.5  # of the frames that must have a pose for a run to count as a trajectory


def imu_noise(config: ImuConfig, recorded: ImuNoise | None) -> ImuNoise | None:
    """Return the recording's noise model with what the configuration overrides; None without an IMU or with it off."""
    if recorded is None or not config.enabled:
        return None
    overrides = {name: value for name in asdict(recorded) if (value := getattr(config, name, None)) is not None}
    return ImuNoise(**{**asdict(recorded), **overrides})


class Run:
    """Drives the pipeline over one recording and keeps the run folder."""

    def __init__(self, recording: Recording, config: Config, out: Path, source: str, command: list[str]) -> None:
        """Open the outputs in an existing, empty folder."""
        cv2.setNumThreads(1)  # replay must not depend on how OpenCV splits its work
        self.recording = recording
        self.config = config
        self.out = out
        write_setup(out, config, source, command)
        self.noise = imu_noise(config.imu, recording.imu_noise)
        self.slam = Slam(config, recording.rig, self.noise)
        self.log = RunLog()
        self.gallery = LoopGallery()
        info = {"source": source, "config": asdict(config)}
        gravity_m_s2 = config.imu.gravity_m_s2
        self.session = SessionWriter(out / "session.db", info, recording.rig, self.noise, gravity_m_s2)
        self.viewer = open_viewer(out / "run.rrd", config.view.enabled, recording.rig, config.view)
        self.warnings: list[str] = []

    def execute(self, progress: Progress | None = None) -> dict[str, Any]:
        """Process the whole recording and write every file; return the metrics.

        What was computed is written whatever happens; the error is raised afterwards. Raises TrackingLostError when
        fewer than half of the frames got a pose.
        """
        start = time.perf_counter()
        failure: BaseException | None = None
        try:
            self._feed(progress)
        except (VislamError, KeyboardInterrupt) as error:
            failure = error
            self.warnings.append(f"stopped early: {error or 'interrupted'}")
        try:
            metrics = self._finish(start)
        except VislamError as error:
            raise failure or error from error
        if failure is not None:
            raise failure
        self._judge(metrics)
        return metrics

    def _feed(self, progress: Progress | None) -> None:
        clock = self.slam.clock
        values = iter(self.recording.events())
        while True:
            with clock.measure("read"):
                value = next(values, None)
            if value is None:
                return
            for step in self.slam.feed(value):
                self._take(step)
                if progress is not None:
                    progress(len(self.log), self.recording.frame_count, str(step.front.track.vo.tracking))

    def _take(self, step: Step) -> None:
        self.log.add(step)
        self.session.add_frame(step.front.frame.t_ns, step.front.keyframe_id, step.front.T_keyframe_body)
        for keyframe in step.keyframes:
            self._store(keyframe)
        with self.slam.clock.measure("view"):
            self._show(step)

    def _store(self, step: KeyframeStep) -> None:
        with self.slam.clock.measure("store"):
            odometry = step.odometry
            first_state = self.slam.front.first_state
            self.session.add(odometry.packet, odometry.T_odom_body, step.update, step.edges, first_state)
            self.gallery.add(step)

    def _show(self, step: Step) -> None:
        """Log a step for the viewer: the image with its tracks, the poses, what the back end did."""
        frame, track = step.front.frame, step.front.track
        self.viewer.log_frame(frame, track.observations, track.vo.tracking)
        if step.T_map_body is not None:
            self.viewer.log_pose("live", frame.t_ns, step.T_map_body)
        if step.front.T_odom_body is not None:
            self.viewer.log_pose("ekf", frame.t_ns, step.front.T_odom_body)
        self.viewer.log_scalars(frame.t_ns, _plotted(step))
        if track.vo.tracking != Tracking.OK:
            self.viewer.log_note(frame.t_ns, f"{track.vo.tracking}: {track.reason}")
        for keyframe in step.keyframes:
            T_map_body = keyframe.update.T_map_odom @ keyframe.odometry.T_odom_body
            self.viewer.log_keyframe(keyframe.odometry.packet.keyframe, T_map_body)
            self.viewer.move(keyframe.update)
            for candidate in keyframe.candidates:
                self.viewer.log_loop(candidate)

    def _finish(self, start: float) -> dict[str, Any]:
        finish = self.slam.finish()
        for step in finish.steps:
            self._take(step)
        for keyframe in finish.keyframes:
            self.log.add_keyframe(keyframe)
            self._store(keyframe)
        if finish.update is not None:
            self.session.move(finish.update)
            self.viewer.move(finish.update)
        self.session.close()
        final, rows, loops = self._write_estimates()
        self._explain(rows)
        truth = self._truth()
        self.log.write_trajectories(self.out, final, truth)
        if self.slam.back is not None and self.slam.back.mapper is not None:
            with self.slam.clock.measure("map export"):
                self.slam.back.mapper.export(self.out / "map")
        self._show_result(final, truth)
        wall_s = time.perf_counter() - start  # everything but pictures and report
        if self.slam.back is not None and self.slam.back.mapper is not None:
            self._write_pictures(self.slam.back.mapper, final)
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

    def _write_pictures(self, mapper: Mapper, final: Trajectory) -> None:
        """Write the pictures of the map that the report shows; an empty map has none."""
        path = [Line(final.positions_m, _PATH_COLOR)]
        points, colors = read_ply(self.out / "map" / "cloud.ply")
        octree = mapper.occupancy.max_likelihood_octree()
        pictures = {}
        if len(points):
            pictures["picture_cloud.png"] = render_cloud(Cloud(points, colors), path, octree=octree)
        if len(octree.occupied_voxels()):
            pictures["picture_octree.png"] = render_octree(octree, path)
        for name, image in pictures.items():
            with storage(self.out / "map" / name):
                (self.out / "map" / name).write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())

    def _show_result(self, final: Trajectory, truth: Trajectory | None) -> None:
        self.viewer.log_path("graph", final.positions_m)
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
        front, back = self.slam.front, self.slam.back
        stamps = self.log.stamps_ns
        duration_s = float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) else 0.0
        counters: dict[str, Any] = {**front.all_counters}
        if back is not None:
            rooms = {"loop": back.loops, "map": back.mapper}
            counters |= {name: dict(room.counters) for name, room in rooms.items() if room is not None}
        found = front.initialisation
        if self.noise is not None:
            self.warnings += front.envelope.warnings(self.config.imu.noise_tolerance)
            sigma_m = self.log.worst_position_sigma_m
            if sigma_m > _LOST_SIGMA_M:
                self.warnings.append(
                    f"the filter's position was uncertain by {sigma_m:.1f} m (1 sigma) at its worst: too long without "
                    "vision, or without motion that shows scale"
                )
        self._doubt_filter(counters)
        self._compare_filter_and_graph(final)
        if self.noise is not None and found is None:
            self.warnings.append(f"gravity was never found, vision alone gave the motion: {front.last_refusal}")
        return {
            "name": self.recording.name,
            "mode": front.frontend.mode,
            "has_imu": self.noise is not None,
            "coupling": {
                "ekf": None if self.noise is None else front.ekf_coupling,
                "graph": self.config.graph.coupling,
            },
            "frames": len(self.log),
            "frames_expected": self.recording.frame_count,
            "keyframes": self.log.keyframes,
            "duration_s": duration_s,
            "wall_s": wall_s,
            "realtime_factor": duration_s / wall_s if wall_s > 0.0 else None,
            "initialisation": {
                "status": "none" if found is None else str(found.status),
                "reason": front.last_refusal if found is None else found.reason,
                "t_s": None if found is None or found.last is None else (found.last.t_ns - int(stamps[0])) * 1e-9,
                "scale_sigma": None if found is None else found.scale_sigma,
                "excitation_m_s2": None if found is None else found.excitation_m_s2,
            },
            "accuracy": self._accuracy(final, truth),
            "timing_ms": self.slam.clock.summary_ms(),
            "counters": counters,
            "nis": front.nis_statistics,
            "problems": dict(self.recording.problems),
            "loops": loops,
            "graph_revisions": self.log.revisions,
            "coverage_frames": len(final) / max(len(self.log), 1),
            "warnings": self.warnings,
        }

    def _doubt_filter(self, counters: dict[str, Any]) -> None:
        """Warn where the filter's numbers hold less than they seem to."""
        uniform_s = self.slam.front.uniform.longest_s
        if uniform_s > _UNIFORM_S:
            self.warnings.append(
                f"uniform motion for {uniform_s:.0f} s: the scale of one camera is held by the IMU's biases alone "
                "there, and may be off by more than its sigma; accelerate now and then, or use a second camera or depth"
            )
        ekf = counters.get("ekf", {})
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
    recording: Recording, config: Config, out: Path, source: str, command: list[str], progress: Progress | None = None
) -> dict[str, Any]:
    """Run a recording into the prepared folder `out` and return its metrics; see `Run.execute`."""
    return Run(recording, config, out, source, command).execute(progress)
