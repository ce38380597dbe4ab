"""The process of map, viewer and run folder: it follows front and back, and writes all files."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from vislam.config import Config
from vislam.core.clock import StageClock
from vislam.core.errors import DataError, HardwareError
from vislam.core.memory import GraphRecord, Learned, SlamMemory, StartFacts
from vislam.core.messages import Array, GraphUpdate
from vislam.core.progress import Progress
from vislam.core.recording import Recording
from vislam.live.beginning import Beginning
from vislam.live.handover import BackBegun, BackEnded, EndedGraph, FrontEnded, Seen
from vislam.live.map_rehearsal import rehearse_map
from vislam.live.notices import MapCells
from vislam.live.pace import MapPace
from vislam.live.processes.child import Life
from vislam.live.web.map_share import MapShare
from vislam.live.wire.mail import Inbox, Outbox
from vislam.mapping.depth.mono import SeenFrame
from vislam.mapping.mapper import Mapper
from vislam.mapping.stage import MapStage
from vislam.pipeline.back import MAX_SEEN, map_stage
from vislam.pipeline.front_report import FrontReport
from vislam.pipeline.in_map import Place
from vislam.pipeline.steps import Finish, KeyframeStep, Step, seen_between
from vislam.runs import Run, begun
from vislam.runs.folder import MapChoice
from vislam.runs.session import Session, SessionWriter
from vislam.runs.verdict import Evidence
from vislam.sensors import Suite
from vislam.trajectory import Trajectory

_LOG = logging.getLogger(__name__)
_WAIT_S = 0.05
_ALONE = "there was no camera and no further sensor: attitude alone was published, and there is no trajectory"
_EVERY_S = 0.5


class CellShare:
    """Owns the wires; a reader that is slow gets fewer grids, the newest next."""

    def __init__(self, wires: list[Connection]) -> None:
        """Take the wires, to be used in this process only."""
        self._boxes = [Outbox(wire, 1) for wire in wires]
        self._is_new, self._is_silent = False, not wires
        self._due_s = 0.0

    def take(self, is_changed: bool, mapper: Mapper | None) -> None:
        """Hand on the grid when it was changed and it is time."""
        self._is_new |= is_changed
        if self._is_silent or mapper is None or not self._is_new or time.monotonic() < self._due_s:
            return
        self._is_new, self._due_s = False, time.monotonic() + _EVERY_S
        try:
            grid = mapper.drive()
        except DataError as error:
            _LOG.warning("no map for those who drive by it: %s", error)
            self._is_silent = True
            return
        cells = MapCells(grid.states, grid.resolution_m, grid.origin_m, grid.floor_m, grid.body_m)
        for box in self._boxes:
            self._is_new |= not box.put(cells)


def run(
    life: Life, config: Config, recording: Recording, out: Path, source: str, command: list[str], frames: Connection,
    keyframes: Connection, beginning: Beginning | None, base: MapChoice | None, suite: Suite,
    web: Connection | None = None, drivers: Sequence[Connection] = (),
) -> None:  # fmt: skip
    """Follow the run until front and back have ended, then write the folder, as `vislam run` does.

    Args:
        life: of this process.
        config: of the run.
        recording: names the sensors; its truth, if any, is asked for at the end.
        out: an existing folder; that of the run itself where it is resumed.
        source: what was asked for.
        command: as it was typed.
        frames: `Seen` from the front process, then `FrontEnded`.
        keyframes: `BackBegun` if there is a `beginning`, `KeyframeStep` from the back process, then `BackEnded`.
        beginning: the session that the run goes on from.
        base: the map among them, if it is that of another run.
        suite: further sensors; with neither these nor a camera there is no trajectory, and none is asked for.
        web: the wire of the page that shows the run; None: there is none.
        drivers: wires to those who drive by the map.
    """
    rehearse_map(config, recording.rig)
    clock = StageClock()
    stage = map_stage(config, recording.rig, clock)
    pace = MapPace(config.live.map_age_s)
    pipeline = FollowedPipeline(life, clock, stage, Inbox(frames), Inbox(keyframes), pace)
    if beginning is not None:
        pipeline.wait_for_back()
    shares = None if web is None else MapShare(web, out), CellShare([*drivers])
    make = partial(_LiveRun, recording, config, out, pipeline, recording.rig.is_blind and not suite, shares)
    live: Run
    if beginning is not None and beginning.is_own:
        live = resumed = make(SessionWriter.reopen(out / "session.db"))
        resumed.go_on_from(beginning)
    else:
        live = begun(recording, config, out, source, command, base, make)
    life.ready()
    metrics = live.execute()
    life.note(metrics=metrics)


class _LiveRun(Run):
    """A run whose steps come from other processes."""

    def __init__(
        self, recording: Recording, config: Config, out: Path, followed: FollowedPipeline, is_alone: bool,
        shares: tuple[MapShare | None, CellShare], session: SessionWriter,
    ) -> None:  # fmt: skip
        super().__init__(recording, config, out, session, followed)
        self._followed = followed
        self._share, self._cells = shares
        self.wants_frames = not is_alone
        if is_alone:
            self.warnings.append(_ALONE)

    def go_on_from(self, beginning: Beginning) -> None:
        """Go on in the run's own session, whose map is the one to be found again: the cart may stand elsewhere."""
        with Session(beginning.session) as stored:
            self.go_on(stored)
        self.base = {"path": str(beginning.session), "keyframes": beginning.first_id, "localize_only": False}

    def _finish(self, start: float, is_brief: bool) -> dict[str, Any]:
        """Write all files; without map and pictures where the run has to end soon."""
        return super()._finish(start, is_brief or self._followed.life.is_brief)

    def _settle(self, update: GraphUpdate, record: GraphRecord) -> None:
        super()._settle(update, record)
        if self._share is not None:
            self._share.settle(update, record)

    def _feed(self, progress: Progress) -> None:
        for n, step in enumerate(self._followed.steps()):
            was_found = self.joined_t_ns is not None
            self._take(step)
            if n == 0:
                self._followed.life.note(zero_ns=self.log.zero_ns)
            if self._share is not None:
                self._share.take(step.keyframes, self._mapper)
            self._cells.take(bool(step.keyframes), self._mapper)
            if self.joined_t_ns is not None and not was_found:
                self._followed.life.note(found_in_map=True)
        self._followed.life.when_over()

    @property
    def _frames_due(self) -> int:
        """All frames; where the run has to end soon, those whose keyframes the graph had got by then."""
        back = self._followed.back
        if not self._followed.life.is_brief or back is None:
            return super()._frames_due
        return self.log.frames_up_to(max(back.graph.ids.tolist(), default=-1))

    def _evidence(self, report: FrontReport, final: Trajectory) -> Evidence:
        """Return what the pipeline has to say, and how the map kept up."""
        pace = self._followed.pace
        evidence = super()._evidence(report, final)
        return replace(evidence, map_left_out=pace.left_out, map_late_s=pace.latest_s)


class _Front:
    """What is known here of the front half."""

    def __init__(self) -> None:
        self.start: StartFacts | None = None
        self.learned = Learned()
        self.ended: FrontEnded | None = None

    def report(self) -> FrontReport:
        """Return its last word, or that it died without one."""
        if self.ended is None:
            return FrontReport("unknown", None, self.start, "the front process died", {}, {}, [], {}, 0.0, {})
        return self.ended.report


class _Back:
    """What is known here of the back end, and the map."""

    def __init__(self, stage: MapStage | None, pace: MapPace) -> None:
        self.stage = stage
        self._pace = pace
        self.graph = EndedGraph(np.empty(0, dtype=np.int64), np.empty((0, 4, 4)), [], [])
        self._counters: dict[str, dict[str, int]] = {}

    @property
    def mapper(self) -> Mapper | None:
        """The map; None where it is off."""
        return None if self.stage is None else self.stage.mapper

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of its rooms, and of the map here."""
        if self.stage is None:
            return self._counters
        counters = self.stage.counters
        late = {"keyframes_left_out": self._pace.left_out, "late_ms": round(1e3 * self._pace.latest_s)}
        return {**self._counters, **counters, "map": {**counters["map"], **late}}

    def end(self, ended: BackEnded) -> None:
        """Take its last word."""
        self._counters = ended.counters
        if ended.graph is not None:
            self.graph = ended.graph


class FollowedPipeline:
    """The pipeline as the other processes report it; see `vislam.runs.Pipeline`.

    Keyframes come when the graph has them, later than their frames; the frame that is at hand then carries them.
    """

    def __init__(
        self, life: Life, clock: StageClock, stage: MapStage | None, frames: Inbox, keyframes: Inbox, pace: MapPace
    ) -> None:
        """Follow two queues, and feed a map as fast as it can."""
        self.clock = clock
        self._place = Place()
        self.counters = self._place.counters
        self.front = _Front()
        self.life = life
        self.pace = pace
        self._map = _Back(stage, pace)
        self._frames, self._keyframes = frames, keyframes
        self._late: deque[KeyframeStep] = deque()  # whose frame has not come yet
        self._back_ended: BackEnded | None = None
        self._begun: GraphUpdate | None = None
        self._newest_id = -1
        self._seen: deque[SeenFrame] = deque(maxlen=MAX_SEEN)  # whose keyframe has not come yet

    @property
    def back(self) -> _Back | None:
        """The back end; None before the first keyframe."""
        return self._map if self._newest_id >= 0 else None

    def wait_for_back(self) -> None:
        """Wait until the back process has taken over the earlier session; raises HardwareError when it died."""
        while self._begun is None:
            message = self._keyframes.get(_WAIT_S)
            if isinstance(message, BackBegun):
                self._begun = message.update
            elif self._keyframes.is_over or self.life.is_orphan:
                raise HardwareError("the back process died before it had read the earlier session")

    def begin_in_map(self, memory: SlamMemory) -> GraphUpdate:
        """Begin where the back process did; return all its poses."""
        assert self._begun is not None, "wait_for_back comes before"
        update, first_id = self._begun, memory.front.keyframe_id + 1
        if self._map.stage is not None:
            self._map.stage.restore(memory.scans, memory.graph.T_map_body, memory.held > 0)
            self._map.stage.move(update)
        self._map.graph = EndedGraph(update.ids, update.T_map_body, [], [])
        self._place.submaps = update.submaps.begun(first_id)
        self._newest_id = first_id - 1
        return update

    def resume(self, memory: SlamMemory) -> GraphUpdate:
        """Go on in an own session as in the map of another: where the cart is now, loops have to say."""
        return self.begin_in_map(memory)

    def steps(self) -> Iterator[Step]:
        """Yield a step per frame, until the front process ends."""
        while self.front.ended is None and not self.life.is_orphan:
            self._take_keyframes()
            message = self._frames.get(_WAIT_S)
            if message is None:
                if self._frames.is_over:
                    raise HardwareError("the front process died; what it had not handed on yet is lost")
                continue
            if isinstance(message, FrontEnded):
                self.front.ended, self.front.start, self.front.learned = message, message.start, message.learned
            else:
                yield self._step(message)

    def finish(self) -> Finish:
        """Wait for the back process's last word; return what came after the last frame."""
        while self._back_ended is None and not (self.life.is_orphan or self._keyframes.is_over):
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
        if ended.update is not None and self._map.stage is not None and not self.life.is_brief:
            self._map.stage.move(ended.update)
            self._map.stage.finish()
        return Finish([], keyframes, ended.update, ended.record)

    def _step(self, seen: Seen) -> Step:
        front = seen.step
        self.front.start, self.front.learned = seen.start, seen.learned
        self._newest_id = max(self._newest_id, front.keyframe_id)
        if self._map.stage is not None and self._map.stage.wants_frames:
            self._seen += seen_between(front)
        keyframes = self._ripe()
        localisation = self._place.localise(front.track.vo.tracking, keyframes)
        T_odom_body, T_map_odom = front.T_odom_body, seen.T_map_odom
        T_map_body = None if T_odom_body is None or T_map_odom is None else T_map_odom @ T_odom_body
        return Step(front, T_map_body, localisation, self._place.submap, keyframes)

    def _wants_mapped(self) -> bool:
        """Return whether the map takes the next keyframe; say when it leaves one out."""
        if self.life.is_brief:
            return False
        is_wanted = self.pace.wants(self._frames.age_s)
        if not is_wanted:
            if self.pace.left_out == 1:
                _LOG.warning("the map does not keep up with vision: it takes fewer keyframes until it does")
            self.life.note(map_left_out=self.pace.left_out)
        return is_wanted

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
        stage = self._map.stage
        if not ripe or stage is None:
            return ripe
        update, scans = coalesced([step.update for step in ripe]), []
        stage.move(update)
        poses = dict(zip(update.ids.tolist(), update.T_map_body, strict=True))
        for step in ripe:
            odometry, keyframe_id = step.odometry, step.odometry.packet.keyframe.id
            seen = []
            while self._seen and self._seen[0].keyframe_id < keyframe_id:
                seen.append(self._seen.popleft())
            T_map_body = poses.get(keyframe_id, update.T_map_odom @ odometry.T_odom_body)
            scans.append(stage.add(odometry, T_map_body, seen) if self._wants_mapped() else {})
        return [replace(step, scans=scan) for step, scan in zip(ripe, scans, strict=True)]


def coalesced(updates: list[GraphUpdate]) -> GraphUpdate:
    """Return one update for several, oldest first: the newest pose of every keyframe, and the newest revision."""
    poses: dict[int, Array] = {}
    for update in updates:
        poses.update(zip(update.ids.tolist(), update.T_map_body, strict=True))
    ids = np.array(sorted(poses), dtype=np.int64)
    T_map_body = np.array([poses[i] for i in ids.tolist()]).reshape(-1, 4, 4)
    return replace(updates[-1], ids=ids, T_map_body=T_map_body)
