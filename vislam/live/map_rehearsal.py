"""The map process's part of a rehearsal: map, viewer and what is written at the end, of a made-up wall."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vislam.config import Config, LabelConfig
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.messages import (
    Array,
    Frame,
    GraphUpdate,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    Tracking,
    VoMeasurement,
    no_observations,
)
from vislam.live.rehearsal import made_up
from vislam.mapping.pictures.of_map import write_pictures
from vislam.mapping.stage import MapStage
from vislam.pipeline.back import map_stage
from vislam.runs.evidence import KeyframeWitness
from vislam.runs.show import show_map
from vislam.runs.viewer import open_viewer
from vislam.trajectory import Trajectory, align, associate
from vislam.trajectory.odometry_keyframe import OdometryKeyframe

_EVERY = 4  # frames that one keyframe is of
_STEP_M = 0.2  # between keyframes
_WALL_M, _FLOOR_M = 2.0, -0.6
_POINTS = 200
_CORRECTED_M = 0.5  # what a loop moves all by: everything is integrated again


def rehearse_map(config: Config, rig: Rig) -> None:
    """Run the map, the viewer and their files once, in a folder that is thrown away."""
    config = replace(config, map=replace(config.map, labels=LabelConfig()))  # label images are not of what is made up
    frames = [value for value in made_up(config, rig) if isinstance(value, Frame)][::_EVERY]
    T_map_body = np.tile(np.eye(4), (len(frames), 1, 1))
    T_map_body[:, 0, 3] = _STEP_M * np.arange(len(frames))
    stage, witness = map_stage(config, rig, StageClock()), KeyframeWitness(config)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with open_viewer(folder / "run.rrd", config.view.enabled, rig, config.view) as viewer:
            for k, frame in enumerate(frames):
                odometry = OdometryKeyframe(_packet(k, frame, config.machine.gravity_m_s2), T_map_body[k])
                update = GraphUpdate(k, np.array([k]), T_map_body[k : k + 1], np.eye(4), None)
                witness.add(odometry.packet, update)
                viewer.log_frame(frame, no_observations(), Tracking.OK)
                viewer.log_pose("live", frame.t_ns, T_map_body[k])
                viewer.log_keyframe(odometry.packet.keyframe, T_map_body[k])
                viewer.move(update)
                if stage is not None:
                    stage.move(update)
                    stage.add(odometry, T_map_body[k], [])
                    show_map(viewer, frame.t_ns, stage.mapper, is_level=True, is_last=k == 0)
        _end(stage, T_map_body, np.array([frame.t_ns for frame in frames]), folder)


def _end(stage: MapStage | None, T_map_body: Array, t_ns: NDArray[np.int64], folder: Path) -> None:
    """Do what the end of a run does with keyframes at their poses [M, 4, 4] and times [M]."""
    path = Trajectory(t_ns, T_map_body)
    pairs = associate(path, path)
    pairs.aligned(align(pairs, "yaw"))
    if stage is None:
        return
    moved = T_map_body.copy()
    moved[:, 1, 3] += _CORRECTED_M
    stage.move(GraphUpdate(len(moved), np.arange(len(moved)), moved, np.eye(4), None))
    stage.finish()
    stage.mapper.export(folder)
    write_pictures(stage.mapper, folder, moved[:, :3, 3], is_level=True)


def _packet(k: int, frame: Frame, gravity_m_s2: float) -> KeyframePacket:
    """Return keyframe k, which sees a wall ahead and a floor."""
    rng = np.random.default_rng(k)
    side, height = rng.uniform(-1.5, 1.5, _POINTS), rng.uniform(_FLOOR_M, 1.0, _POINTS)
    points = np.stack([np.full(_POINTS, _WALL_M), side, height], axis=1)
    points[::2, 0], points[::2, 2] = rng.uniform(0.5, _WALL_M, len(points[::2])), _FLOOR_M
    size = np.array(frame.images[0].shape[::-1] if frame.images else (8, 8))
    keyframe = Keyframe(
        k, frame.t_ns, replace(frame, index=k), rng.uniform(0.0, size - 1.0, (_POINTS, 2)),
        rng.integers(0, 255, (_POINTS, 32), np.uint8), points,
    )  # fmt: skip
    step = np.eye(4)
    step[0, 3] = _STEP_M
    vo = VoMeasurement(frame.t_ns, max(k - 1, 0), step, np.eye(6) * 1e-6, True, Tracking.OK, _POINTS)
    samples_ns = frame.t_ns + np.arange(10, dtype=np.int64) * 5_000_000
    span = ImuSpan(samples_ns, np.zeros((10, 3)), np.tile([0.0, 0.0, gravity_m_s2], (10, 1)))
    return KeyframePacket(keyframe, vo, no_observations(), span)
