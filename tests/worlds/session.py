"""Runs of a simulated world as factor logs: exact motion, landmarks seen with noise, outliers, true and false loops."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import gtsam
import numpy as np

from session_entries import decided, start_facts
from vislam.batch.bundle.adjust import solve
from vislam.batch.bundle.chain import Chain
from vislam.batch.bundle.loops import Loops
from vislam.config import Config
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert, se3_exp, se3_log, transform, transform_points
from vislam.core.memory import FrameEntry, GraphRecord, KeyframeEntry
from vislam.core.messages import Array, GraphUpdate, KeyframePacket, Observations
from vislam.factors.factor_log import FactorLog, LoggedEdge, LoggedKeyframe
from vislam.factors.keys import X
from vislam.runs.session import SessionWriter
from vislam.trajectory.frames import LoggedFrames
from worlds.lap import LAP_S, T_BODY_CAM0, World
from worlds.parts import rig_of

CAMERA = Camera(640, 480, 400.0, 398.0, 321.0, 238.0, 0.0, "radtan", (-0.2, 0.05, 2e-4, -1e-4))
BASELINE_M = 0.11
LANDMARKS = 2500
TRACK_KEYFRAMES = 12  # a tracker loses a corner at the latest after so many
MAX_SEEN = 60
Kind = Literal["stereo", "mono", "rgbd"]


@dataclass
class SimulatedRun:
    log: FactorLog
    truth: Array  # [K, 4, 4]
    world: World
    false_ids: set[int]

    def rmse_m(self, poses: Array) -> float:
        """Position error after moving the first pose onto the truth's, so that only what was measured counts."""
        moved = self.truth[0] @ invert(poses[0]) @ poses
        return float(np.sqrt(np.mean(np.sum((moved[:, :3, 3] - self.truth[:, :3, 3]) ** 2, axis=1))))

    @property
    def run_poses(self) -> Array:
        return np.array([k.T_map_body for k in self.log.keyframes])


def rig_for(kind: Kind) -> Rig:
    return rig_of(kind, CAMERA, T_BODY_CAM0, transform(np.eye(3), np.array([BASELINE_M, 0.002, -0.001])))


@lru_cache(maxsize=8)
def simulate(
    kind: Kind,
    *,
    imu: bool = True,
    duration_s: float = 22.0,
    sigma_px: float = 0.5,
    outliers: float = 0.0,
    true_loops: int = 6,
    false_loops: int = 0,
    readout_s: float = 0.0,
    seed: int = 3,
) -> SimulatedRun:
    """Return a run with its loosely coupled pose graph as the run's own estimate; false loops are among the offered."""
    world = World(duration_s=duration_s, keyframe_hz=4.0, seed=seed, mono=kind == "mono")
    rig = rig_for(kind)
    packets = [world.packet(k, imu=imu) for k in range(world.count)]
    seen = _Eyes(world, rig, kind, sigma_px, outliers, readout_s).observe()
    packets = [replace(p, observations=o) for p, o in zip(packets, seen, strict=True)]
    lap = round(LAP_S * world.keyframe_hz)
    pairs = [(i, i + lap) for i in range(world.count - lap)][:true_loops]
    edges = [LoggedEdge(world.loop(n, i, j), True) for n, (i, j) in enumerate(pairs)]
    false = set(range(len(edges), len(edges) + false_loops))
    for n in sorted(false):
        i = int(world.rng.integers(0, world.count // 2))
        edges.append(LoggedEdge(world.false_loop(n, i, i + world.count // 3), False))
    odom = world.dead_reckoning(packets) if kind != "mono" else _drifting(world)
    keyframes = [LoggedKeyframe(p, T, T, None, None, None) for p, T in zip(packets, odom, strict=True)]
    frames = LoggedFrames(
        np.array([p.keyframe.t_ns for p in packets]), np.arange(len(packets)), [np.eye(4)] * len(packets)
    )
    state = world.initial_state() if imu else None
    log = FactorLog(rig, world.noise if imu else None, 9.81, state, keyframes, edges, frames)
    return SimulatedRun(_with_pose_graph(log, false), world.truth, world, false)


def _drifting(world: World) -> Array:
    """Odometry as a filter gives it where vision has no scale: true motions with errors of 1 % and 0.2 degrees."""
    rng, T = np.random.default_rng(world.seed), [world.truth[0]]
    for a, b in zip(world.truth, world.truth[1:], strict=False):
        motion = invert(a) @ b
        motion[:3, 3] *= 1.0 + 0.01 * rng.normal()
        T.append(T[-1] @ motion)
    return np.stack(T)


def _with_pose_graph(log: FactorLog, false: set[int]) -> FactorLog:
    """Return the log with the optimum of IMU, odometry and true loops as the run's own poses."""
    config = Config()
    chain = Chain(log, config.graph, config.machine)
    loops = Loops([e for e in log.edges if e.edge.id not in false], chain, config.graph, T_BODY_CAM0[:3, 3])
    loops.choose(chain)
    values = chain.initial()
    for _ in range(2):
        factors, _ = chain.factors(values, np.zeros(len(chain.records), np.int64), 1)
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors + loops.factors(chain.poses):
            graph.add(factor)
        values = solve(graph, values, list(values.keys())).values
    poses = [values.atPose3(X(k)).matrix() for k in range(len(chain.records))]
    return replace(log, keyframes=[replace(k, T_map_body=T) for k, T in zip(log.keyframes, poses, strict=True)])


class _Eyes:
    """Sees landmarks of a box around the motion, as a tracker does that keeps a corner for some keyframes."""

    def __init__(self, world: World, rig: Rig, kind: Kind, sigma_px: float, outliers: float, readout_s: float) -> None:
        self.world, self.rig, self.kind, self.sigma_px = world, rig, kind, sigma_px
        self.outliers, self.readout_s = outliers, readout_s
        self.rng = np.random.default_rng(world.seed + 100)
        self.points = self.rng.uniform([-9, -9, -3], [9, 9, 3], (LANDMARKS, 3))
        self.ids = np.full(LANDMARKS, -1)
        self.age = np.zeros(LANDMARKS, int)
        self.wrong: dict[int, Array] = {}
        self.next_id = 0

    def observe(self) -> list[Observations]:
        return [self._at(k) for k in range(self.world.count)]

    def _at(self, k: int) -> Observations:
        T_cam = invert(self.world.truth[k] @ T_BODY_CAM0)
        p = transform_points(T_cam, self.points)
        pixels = self._project(k, p)
        visible = CAMERA.contains(pixels, 5.0) & (p[:, 2] > 0.8) & (p[:, 2] < 9.0)
        lost = ~visible | (self.age >= TRACK_KEYFRAMES)
        self.ids[lost], self.age[lost] = -1, 0
        kept = np.flatnonzero(visible & (self.ids >= 0))
        fresh = np.flatnonzero(visible & (self.ids < 0))[: max(MAX_SEEN - len(kept), 0)]
        for j in fresh:
            self.ids[j] = self.next_id
            if self.rng.uniform() < self.outliers:  # slides along an edge, or belongs to something that moves
                self.wrong[self.next_id] = self.rng.normal(size=2) * 15.0
            self.next_id += 1
        chosen = np.concatenate([kept, fresh])
        self.age[chosen] += 1
        ids = self.ids[chosen]
        slide = np.array([self.wrong.get(i, np.zeros(2)) * self.age[j] for i, j in zip(ids, chosen, strict=True)])
        noise = self.rng.normal(size=(len(chosen), 2)) * self.sigma_px
        seen = pixels[chosen] + noise + slide.reshape(-1, 2)
        right = depth = None
        if self.kind == "stereo":
            T_right = invert(self.world.truth[k] @ self.rig.T_body_cams[1])
            right = self.rig.cameras[1].project(transform_points(T_right, self.points[chosen]))
            right = right + noise + slide.reshape(-1, 2) + self.rng.normal(size=right.shape) * 0.3
        if self.kind == "rgbd":
            rho = 1.0 / p[chosen, 2] + 2e-3 * self.rng.normal(size=len(chosen))
            depth = np.where(self.rng.uniform(size=len(rho)) < 0.8, 1.0 / rho, np.nan)
        return Observations(ids.astype(np.int64), seen, right, depth)

    def _project(self, k: int, points_cam: Array) -> Array:
        """Return pixels, each row at its own time when the shutter rolls (the motion continued at constant speed)."""
        pixels = CAMERA.project(points_cam)
        if self.readout_s == 0.0:
            return pixels
        a, b = max(k - 1, 0), min(k + 1, self.world.count - 1)
        dt = (b - a) / self.world.keyframe_hz
        T_a, T_b = self.world.truth[a] @ T_BODY_CAM0, self.world.truth[b] @ T_BODY_CAM0
        twist = se3_log(invert(T_a) @ T_b) / dt
        for i in np.flatnonzero(np.isfinite(pixels).all(axis=1)):
            delay = (pixels[i, 1] / (CAMERA.height - 1) - 0.5) * self.readout_s
            pixels[i] = CAMERA.project(transform_points(se3_exp(-twist * delay), points_cam[i : i + 1]))[0]
        return pixels


def store(log: FactorLog, path: Path, info: dict | None = None, upto: int | None = None) -> SessionWriter:
    """Write a log as the session of a run; the caller closes it, or does not."""
    writer = SessionWriter.create(path, info or {"config": {}}, log.rig, log.noise, log.gravity_m_s2)
    for k, keyframe in enumerate(log.keyframes[:upto]):
        packet: KeyframePacket = keyframe.packet
        writer.add_frame(FrameEntry(packet.keyframe.t_ns, k, np.eye(4)))
        edges = [e for e in log.edges if e.edge.to_id == k]
        change = GraphUpdate(k + 1, np.array([k]), keyframe.T_map_body[None], np.eye(4), None)
        record = GraphRecord(loops=tuple(decided(e.edge.id, e.accepted) for e in edges))
        start = None if log.first_state is None else start_facts(log.first_state, log.noise)
        writer.add(KeyframeEntry(packet, keyframe.T_odom_body, change, record, [e.edge for e in edges], start=start))
    return writer
