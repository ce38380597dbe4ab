"""A stored session as a part of a pose graph: keyframes, odometry and accepted loops, as its own graph had them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vislam.batch.bundle.chain import Chain
from vislam.batch.bundle.loops import loop_edges
from vislam.batch.posegraph.problem import RelativePoses
from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.memory import LoopPlace, SlamMemory
from vislam.core.messages import Array, Submaps
from vislam.factors import (
    LoopModel,
    WindowOdometry,
    checked_covariance,
    checked_pose,
    conditioned,
    loop_record,
)
from vislam.runs.session import Session, recall
from vislam.trajectory.frames import LoggedFrames

_HELD = (LoopPlace.GRAPH, LoopPlace.SPARE)  # where accepted loops are


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
    edges: RelativePoses  # odometry, then loops

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
    if memory.graph.windows:
        odometry = _of_window(memory, config, begins)
    else:
        odometry = Chain(log, config.graph, config.machine).odometry()  # loose coupling has no window
    models = [LoopModel(record, config.graph, log.rig.T_body_cam0[:3, 3]) for record in records]
    edges = RelativePoses.joined([odometry, loop_edges(models, memory.graph.T_map_body)])
    return SessionPart(path, name, config, rig, log.rig, memory, log.frames, first_id, submaps, edges)


def _of_window(memory: SlamMemory, config: Config, begins: list[int]) -> RelativePoses:
    """Return odometry as the window of tight coupling summarised it."""
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
    return RelativePoses.of([(k - 1, k) for k in range(1, len(poses))], out)
