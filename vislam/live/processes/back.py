"""The process of loops and graph: as slow as it has to be, and no other process waits for it."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection

import cv2
import numpy as np

from vislam.config import Config
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.messages import Array
from vislam.imu import ImuNoise
from vislam.live.beginning import Beginning, recalled
from vislam.live.handover import BackBegun, BackEnded, EndedGraph, KeyframeOut
from vislam.live.notices import MapMoved
from vislam.live.processes.child import Life
from vislam.live.rehearsal import rehearse
from vislam.live.web.updates import Undo
from vislam.live.wire.mail import Inbox, Outbox
from vislam.pipeline.back import Back
from vislam.sensors import Suite

_WAIT_S = 0.1


def run(
    life: Life, config: Config, rig: Rig, noise: ImuNoise, keyframes: Connection, to_fast: Connection,
    to_map: Connection, beginning: Beginning | None, suite: Suite, web: Connection | None = None,
    guesses: Sequence[Connection] = (),
) -> None:  # fmt: skip
    """Take keyframes until the front process ends them; then finish the graph and hand it over.

    Args:
        life: of this process.
        config: of the run; the map belongs to another process.
        rig: the cameras.
        noise: of the IMU, as it is rehearsed with.
        keyframes: `KeyframeOut` from the front process, until it closes it or is killed.
        to_fast: `MapMoved`, one per revision, and one before them if there is a `beginning`.
        to_map: `BackBegun` if there is a `beginning`, `KeyframeStep`, then `BackEnded`.
        beginning: the session that the run goes on from.
        suite: further sensors, whose readings come with keyframes.
        web: `Undo` from the page that shows the run; None: there is none.
        guesses: wires from who may say where the body is in the map, `T_map_body` [4, 4].
    """
    cv2.setNumThreads(1)
    config = replace(config, map=replace(config.map, enabled=False))
    rehearse(config, rig, noise)
    clock = StageClock()
    back: Back | None = None
    inbox, outbox = Inbox(keyframes), Outbox(to_map, config.live.keyframe_queue)
    undone = _Undone(web)
    begins_recording = beginning is not None
    if beginning is not None:
        memory = recalled(beginning)
        back = Back(config, rig, noise, clock, memory.first_state, memory.T_start, suite)
        update = back.restore(memory)
        _send(to_fast, MapMoved(update.revision, np.eye(4), is_in_map=False))
        _put(life, outbox, BackBegun(update))
        del memory
    life.ready()
    while (keyframe := _next(life, inbox)) is not None:
        if life.is_brief:
            continue  # those that had to wait are left out
        if back is None:
            T_odom_body = keyframe.odometry.T_odom_body
            back = Back(config, rig, keyframe.noise, clock, keyframe.first_state, T_odom_body, suite)
        if begins_recording:
            begins_recording = not back.begin_recording(keyframe.first_state, keyframe.odometry.T_odom_body)
            if begins_recording:
                continue  # ended before gravity was known
        for T_map_body in _waiting(guesses):
            back.guess(T_map_body)
        step = back.add(keyframe.odometry, [], undone.take())
        update = step.update
        _send(to_fast, MapMoved(update.revision, update.T_map_odom, update.submaps.is_joined))
        _put(life, outbox, step)
    if back is None:
        ended = BackEnded(None, None, None, {}, clock.summary_ms())
    else:
        update = back.finish(undone.take())
        own = {name: found for name in suite.names if (found := back.graph.own(name)) is not None}
        sensed = {name: back.graph.sensed(name) for name in suite.names}
        graph = EndedGraph(
            back.graph.ids, back.graph.poses(), back.graph.states(), back.graph.edge_reports(), own, sensed
        )
        ended = BackEnded(graph, update, back.graph.take_record(), back.counters, clock.summary_ms())
    _put(life, outbox, ended)
    outbox.close()


class _Undone:
    """Hears which loops the page takes out; they go with the next keyframe."""

    def __init__(self, web: Connection | None) -> None:
        self._inbox = None if web is None else Inbox(web)

    def take(self) -> list[int]:
        asked: list[int] = []
        while self._inbox is not None and (message := self._inbox.get()) is not None:
            asked += [message.loop_id] if isinstance(message, Undo) else []
        return asked


def _next(life: Life, keyframes: Inbox) -> KeyframeOut | None:
    while not (keyframes.is_over or life.is_orphan):
        keyframe: KeyframeOut | None = keyframes.get(_WAIT_S)
        if keyframe is not None:
            return keyframe
    return None


def _waiting(wires: Sequence[Connection]) -> Iterator[Array]:
    """Yield what waits in wires; one whose other side has gone has nothing any more."""
    for wire in wires:
        with suppress(EOFError, OSError):
            while wire.poll():
                yield wire.recv()


def _send(to_fast: Connection, message: MapMoved) -> None:
    try:
        to_fast.send(message)
    except OSError:  # the pose is not published any more; the map is finished all the same
        return


def _put(life: Life, box: Outbox, value: object) -> None:
    while not (box.put(value, _WAIT_S) or life.is_orphan):
        continue
