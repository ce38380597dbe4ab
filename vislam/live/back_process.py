"""The process of loops and graph: as slow as it has to be, and nobody waits for it."""

from __future__ import annotations

from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.queues import Queue
from queue import Empty, Full
from typing import Any

import cv2

from vislam.camera import Rig
from vislam.clock import StageClock
from vislam.config import Config
from vislam.imu import ImuNoise
from vislam.live.child import Life
from vislam.live.handover import BackEnded, EndedGraph, KeyframeOut
from vislam.live.messages import MapMoved
from vislam.live.rehearsal import rehearse
from vislam.slam import Back

_WAIT_S = 0.1


def run(
    life: Life, config: Config, rig: Rig, noise: ImuNoise, keyframes: Queue[Any], to_fast: Connection,
    to_map: Queue[Any],
) -> None:  # fmt: skip
    """Take keyframes until the front process ends them; then finish the graph and hand it over.

    Args:
        life: of this process.
        config: of the run; the map belongs to another process.
        rig: the cameras.
        noise: of the IMU, as it is rehearsed with.
        keyframes: `KeyframeOut` from the front process, None at the end.
        to_fast: `MapMoved`, one per revision.
        to_map: `KeyframeStep`, then `BackEnded`; bounded.
    """
    cv2.setNumThreads(1)
    config = replace(config, map=replace(config.map, enabled=False))
    rehearse(config, rig, noise)
    life.ready()
    clock = StageClock()
    back: Back | None = None
    while (keyframe := _next(life, keyframes)) is not None:
        if back is None:
            back = Back(config, rig, keyframe.noise, clock, keyframe.first_state, keyframe.odometry.T_odom_body)
        step = back.add(keyframe.odometry, [])
        _tell(to_fast, MapMoved(step.update.revision, step.update.T_map_odom))
        _put(life, to_map, step)
    if back is None:
        _put(life, to_map, BackEnded(None, None, None, {}, clock.summary_ms()))
        return
    update = back.finish()
    graph = EndedGraph(back.graph.ids, back.graph.poses(), back.graph.states(), back.graph.edge_reports())
    _put(life, to_map, BackEnded(graph, update, back.graph.take_news(), back.counters, clock.summary_ms()))


def _next(life: Life, keyframes: Queue[Any]) -> KeyframeOut | None:
    while not life.is_orphan:
        try:
            keyframe: KeyframeOut | None = keyframes.get(timeout=_WAIT_S)
            return keyframe
        except Empty:
            if life.is_dead("front"):
                return None
    return None


def _tell(to_fast: Connection, message: MapMoved) -> None:
    try:
        to_fast.send(message)
    except OSError:  # the pose is not published any more; the map is finished all the same
        return


def _put(life: Life, queue: Queue[Any], value: object) -> None:
    while not life.is_orphan:
        try:
            queue.put(value, timeout=_WAIT_S)
            return
        except Full:
            continue
