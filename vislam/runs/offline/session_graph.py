"""A stored session as a part of a pose graph: keyframes, odometry and accepted loops, as its own graph had them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vislam.batch.bundle.chain import Chain
from vislam.batch.bundle.loops import UNSCALED_ODOMETRY_SIGMA, loop_factor
from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.config import Config, GraphConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.memory import LoopPlace, SlamMemory
from vislam.core.messages import Array, Submaps
from vislam.factors import (
    FactorLog,
    LoopRecord,
    WindowOdometry,
    checked_covariance,
    checked_pose,
    conditioned,
    loop_record,
    measurement_of,
)
from vislam.runs.session import Session, recall
from vislam.trajectory.frames import LoggedFrames

_HELD = (LoopPlace.GRAPH, LoopPlace.SPARE)  # where accepted loops are


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Relative poses between keyframes, tangents as in `PoseGraphProblem`."""

    ends: Ids  # [E, 2]
    T_from_to: Array  # [E, 4, 4]
    information: Array  # [E, 6, 6]


@dataclass(frozen=True, slots=True, eq=False)
class SessionPart:
    """What joining takes from a session; ids of its keyframes are 0, 1, 2, ... here."""

    path: Path
    name: str
    config: Config
    rig_data: Any
    rig: Rig
    memory: SlamMemory
    frames: LoggedFrames
    first_id: int  # the first keyframe of its own recording
    submaps: Submaps  # joined as its loops join them
    edges: Edges  # odometry, then loops

    @property
    def has_gravity(self) -> bool:
        """Whether an IMU showed which way is up."""
        return self.memory.first_state is not None

    @property
    def poses(self) -> Array:
        """The poses [M, 4, 4] of the keyframes in the session's own map."""
        return self.memory.graph.T_map_body


def read_part(path: Path, name: str) -> SessionPart:
    """Read a run folder or session file, which is only read.

    Raises DataError where it is no session, holds no map, or has no scale.
    """
    with Session(path / "session.db" if path.is_dir() else path) as session:
        config, memory, log = session.config(), recall(session), session.factor_log()
        rig, first_id = session.info()["rig"], session.first_id
    if memory is None:
        raise DataError(f"{session.path} holds no map: not one keyframe, or gravity was not found")
    packets = memory.graph.packets
    if memory.first_state is None and not all(p.vo.has_scale for p in packets[1:] if not p.begins_submap):
        raise DataError(f"{session.path} is of one camera without an IMU: nothing in it shows scale")
    begins = [p.keyframe.id for p in packets if p.begins_submap and p.keyframe.id]
    submaps = Submaps()
    for k in begins:
        submaps = submaps.begun(k)
    records = [loop_record(o.edge, len(packets) - 1) for o in memory.graph.loops if o.state.place in _HELD]
    submaps = submaps.joined_by((r.from_id, r.to_id) for r in records)
    odometry = _of_window(memory, config, begins) if memory.graph.windows else _of_chain(log, config)
    poses, lever_m = memory.graph.T_map_body, log.rig.T_body_cam0[:3, 3]
    steps = [(k - 1, k) for k in range(1, len(packets))]
    edges = together([edges_of(steps, odometry), loop_edges(records, poses, config.graph, lever_m)])
    return SessionPart(path, name, config, rig, log.rig, memory, log.frames, first_id, submaps, edges)


def edges_of(ends: list[tuple[int, int]], measured: list[tuple[Array, Array]]) -> Edges:
    """Return the edges of ends and measurements with their information."""
    return Edges(
        np.array(ends, dtype=np.int64).reshape(-1, 2),
        np.array([T for T, _ in measured], dtype=np.float64).reshape(-1, 4, 4),
        np.array([information for _, information in measured], dtype=np.float64).reshape(-1, 6, 6),
    )


def loop_edges(records: list[LoopRecord], poses: Array, config: GraphConfig, lever_m: Array) -> Edges:
    """Return loops as edges; see `loop_factor`."""
    factors = [loop_factor(record, poses, config, lever_m, robust=False) for record in records]
    return edges_of([(r.from_id, r.to_id) for r in records], [measurement_of(factor) for factor in factors])


def weak_links(submaps: Submaps) -> list[int]:
    """Return the keyframes before which nothing was measured."""
    return [k for k in submaps.first_ids if k]


def problem_of(poses: Array, edges: Edges) -> PoseGraphProblem:
    """Return the pose graph of keyframes 0..M-1 at poses [M, 4, 4]."""
    count = len(poses)
    return PoseGraphProblem(
        3, np.arange(count), np.ascontiguousarray(poses), np.zeros(count, np.bool_), np.ascontiguousarray(edges.ends),
        np.ascontiguousarray(edges.T_from_to), np.ascontiguousarray(edges.information),
    )  # fmt: skip


def together(parts: list[Edges]) -> Edges:
    """Return edges one after another."""
    return Edges(
        np.concatenate([e.ends for e in parts]),
        np.concatenate([e.T_from_to for e in parts]),
        np.concatenate([e.information for e in parts]),
    )


def _of_window(memory: SlamMemory, config: Config, begins: list[int]) -> list[tuple[Array, Array]]:
    """Return odometry and its information as the window of tight coupling summarised it."""
    odometry = WindowOdometry(config.graph, config.machine)
    for window in memory.graph.windows:
        odometry.append(window)
    poses = memory.graph.T_map_body
    out: list[tuple[Array, Array]] = []
    for k in range(1, len(poses)):
        what = f"the window's edge to keyframe {k}"
        edge = odometry.edge(k)
        if edge is None:
            raise DataError(f"{what} is missing; run the recording again")
        covariance = checked_covariance(odometry.covariance(edge, memory.graph.vo_scale), 6, what)
        covariance = conditioned(covariance, config.graph.covariance_ratio_max)
        measured = invert(poses[k - 1]) @ poses[k] if k in begins else edge.T_previous_body
        T = checked_pose(measured, what)
        out.append((T, np.asarray(np.linalg.inv(covariance))))
    return out


def _of_chain(log: FactorLog, config: Config) -> list[tuple[Array, Array]]:
    """Return odometry and its information as vision measured it: loose coupling has no window."""
    factors = Chain(log, config.graph, config.machine).odometry_edges(UNSCALED_ODOMETRY_SIGMA)
    return [measurement_of(factor) for factor in factors]
