"""The process of map, viewer and run folder: it follows what front and back tell, and writes everything down."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from vislam.clock import StageClock
from vislam.config import Config
from vislam.errors import HardwareError
from vislam.front import FrontReport
from vislam.live.child import Life
from vislam.live.handover import BackEnded, EndedGraph, FrontEnded, Seen
from vislam.live.mail import Inbox
from vislam.mapping.mapper import Mapper
from vislam.memory import FrontNews, StartFacts
from vislam.messages import Array, GraphUpdate, Pieces
from vislam.recording import Recording
from vislam.run import Progress, Run, imu_noise
from vislam.runfolder import write_setup
from vislam.session import SessionWriter
from vislam.slam import Finish, KeyframeStep, Step, localised

_WAIT_S = 0.05


def run(
    life: Life, config: Config, recording: Recording, out: Path, source: str, command: list[str], frames: Connection,
    keyframes: Connection,
) -> None:  # fmt: skip
    """Follow the run until front and back have ended, then write the folder, as `vislam run` does.

    Args:
        life: of this process.
        config: of the run.
        recording: names the sensors; its truth, if any, is asked for at the end.
        out: an existing folder.
        source: what was asked for.
        command: as it was typed.
        frames: `Seen` from the front process, then `FrontEnded`.
        keyframes: `KeyframeStep` from the back process, then `BackEnded`.
    """
    noise = imu_noise(config.imu, recording.imu_noise)
    write_setup(out, config, source, command)
    info = {"source": source, "config": asdict(config)}
    session = SessionWriter(out / "session.db", info, recording.rig, noise, config.imu.gravity_m_s2)
    mapper = Mapper(config.map, recording.rig) if config.map.enabled else None
    pipeline = FollowedPipeline(life, mapper, Inbox(frames), Inbox(keyframes))
    live = _LiveRun(recording, config, out, session, pipeline, pipeline)
    life.ready()
    metrics = live.execute()
    life.note(metrics=metrics)


class _LiveRun(Run):
    """A run whose steps come from other processes."""

    def __init__(
        self, recording: Recording, config: Config, out: Path, session: SessionWriter, slam: Any,
        followed: FollowedPipeline,
    ) -> None:  # fmt: skip
        super().__init__(recording, config, out, session, slam)
        self._followed = followed

    def _feed(self, progress: Progress | None) -> None:
        for step in self._followed.steps():
            self._take(step)


class _Front:
    """What is known here of the front half."""

    def __init__(self) -> None:
        self.start: StartFacts | None = None
        self.news = FrontNews()
        self.ended: FrontEnded | None = None

    def report(self) -> FrontReport:
        """Return its last word, or that it died without one."""
        if self.ended is None:
            return FrontReport("unknown", None, self.start, "the front process died", {}, {}, [], 0.0, {})
        return self.ended.report


class _Back:
    """What is known here of the back end, and the map."""

    def __init__(self, mapper: Mapper | None) -> None:
        self.mapper = mapper
        self.graph = EndedGraph(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)), [], [])
        self._counters: dict[str, dict[str, int]] = {}

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of its rooms, and of the map here."""
        return self._counters | ({} if self.mapper is None else {"map": dict(self.mapper.counters)})

    def end(self, ended: BackEnded) -> None:
        """Take its last word."""
        self._counters = ended.counters
        if ended.graph is not None:
            self.graph = ended.graph


class FollowedPipeline:
    """The pipeline as the other processes tell it; see `vislam.run.Pipeline`.

    Keyframes come when the graph has them, later than their frames; the frame that is at hand then carries them.
    """

    def __init__(self, life: Life, mapper: Mapper | None, frames: Inbox, keyframes: Inbox) -> None:
        """Follow two queues, and feed a map."""
        self.clock = StageClock()
        self.counters = {"frames_lost": 0, "relocalised": 0}
        self.front = _Front()
        self._life = life
        self._map = _Back(mapper)
        self._frames, self._keyframes = frames, keyframes
        self._late: deque[KeyframeStep] = deque()  # whose frame has not come yet
        self._back_ended: BackEnded | None = None
        self._pieces = Pieces()
        self._newest_id = -1

    @property
    def back(self) -> _Back | None:
        """The back end; None before the first keyframe."""
        return self._map if self._newest_id >= 0 else None

    def steps(self) -> Iterator[Step]:
        """Yield a step per frame, until the front process ends."""
        while self.front.ended is None and not self._life.is_orphan:
            self._take_keyframes()
            message = self._frames.get(_WAIT_S)
            if message is None:
                if self._frames.is_over:
                    raise HardwareError("the front process died; what it had not told yet is lost")
                continue
            if isinstance(message, FrontEnded):
                self.front.ended, self.front.start, self.front.news = message, message.start, message.news
            else:
                yield self._step(message)

    def finish(self) -> Finish:
        """Wait for the back process's last word; return what came after the last frame."""
        while self._back_ended is None and not (self._life.is_orphan or self._keyframes.is_over):
            self._take_keyframes(_WAIT_S)
        ended = self._back_ended
        self._newest_id = 1 << 62
        keyframes = self._ripe()
        timings = {} if self.front.ended is None else self.front.ended.timings
        if ended is None or ended.graph is None:
            self._newest_id = -1  # there is no graph to ask
        if ended is None:
            self.clock.add(timings)
            return Finish([], keyframes, None, None)
        self.clock.add(timings | ended.timings)
        if ended.update is not None and self._map.mapper is not None:
            with self.clock.measure("map finish"):
                self._map.mapper.move(ended.update)
                self._map.mapper.finish()
        return Finish([], keyframes, ended.update, ended.news)

    def _step(self, seen: Seen) -> Step:
        front = seen.step
        self.front.start, self.front.news = seen.start, seen.news
        self._newest_id = max(self._newest_id, front.keyframe_id)
        keyframes = self._ripe()
        before = self._pieces
        if keyframes:
            self._pieces = keyframes[-1].update.pieces
        localisation = localised(before, self._pieces, front.track.vo.tracking, self.counters)
        T_map_body = None if front.T_odom_body is None else seen.T_map_odom @ front.T_odom_body
        return Step(front, T_map_body, localisation, len(self._pieces.groups) - 1, keyframes)

    def _take_keyframes(self, wait_s: float = 0.0) -> None:
        while self._back_ended is None and (message := self._keyframes.get(wait_s)) is not None:
            if isinstance(message, BackEnded):
                self._back_ended = message
                self._map.end(message)
            else:
                self._late.append(message)
            wait_s = 0.0

    def _ripe(self) -> list[KeyframeStep]:
        """Return the keyframes whose frames are known, after the map has them; poses that moved twice move once."""
        ripe = []
        while self._late and self._late[0].odometry.packet.keyframe.id <= self._newest_id:
            ripe.append(self._late.popleft())
        mapper = self._map.mapper
        if not ripe or mapper is None:
            return ripe
        for step in ripe:
            with self.clock.measure("map"):
                mapper.add(step.odometry.packet.keyframe, step.update.T_map_odom @ step.odometry.T_odom_body)
        with self.clock.measure("map move"):
            mapper.move(coalesced([step.update for step in ripe]))
        packed = [(step, mapper.packed(step.odometry.packet.keyframe.id)) for step in ripe]
        return [
            step if scan is None else replace(step, scans={step.odometry.packet.keyframe.id: scan})
            for step, scan in packed
        ]


def coalesced(updates: list[GraphUpdate]) -> GraphUpdate:
    """Return one update for several, oldest first: the newest pose of every keyframe, and the newest revision."""
    poses: dict[int, Array] = {}
    for update in updates:
        poses.update(zip(update.ids.tolist(), update.T_map_body, strict=True))
    ids = np.array(sorted(poses), dtype=np.int64)
    T_map_body = np.array([poses[i] for i in ids.tolist()]).reshape(-1, 4, 4)
    return replace(updates[-1], ids=ids, T_map_body=T_map_body)
