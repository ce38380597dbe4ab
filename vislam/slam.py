"""The reference pipeline, on one thread: measurements go in by `Slam.feed`, one `Step` per frame comes out.

inertial sample -> EKF                                  -> pose in odom, at IMU rate
frame           -> front end -> EKF                     -> keyframe?
keyframe        -> loop detector -> graph -> mapper     -> poses in map, T_map_odom, map
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vislam import collector
from vislam.camera import Rig
from vislam.clock import StageClock
from vislam.config import Config
from vislam.continuity import Continuity
from vislam.errors import UsageError
from vislam.front import Front, FrontStep
from vislam.frontend import lasting_scale_sigma, mode_for
from vislam.graph import PoseGraph
from vislam.imu import ImuNoise
from vislam.loop.detector import LoopDetector
from vislam.loop.injection import FalseLoops, as_candidate
from vislam.mapping.mapper import Mapper
from vislam.mapping.monodepth import SeenFrame
from vislam.mapping.stage import MapStage
from vislam.memory import GraphNews, PackedScan, SlamMemory, TagSighting, WordsMemory
from vislam.messages import (
    Array,
    Frame,
    GraphUpdate,
    ImuSample,
    Localisation,
    LoopCandidate,
    LoopEdge,
    MagSample,
    NavState,
    Pieces,
    RetrievedKeyframe,
    Tracking,
)
from vislam.odometry_keyframe import OdometryKeyframe

MAX_SEEN = 120  # frames kept between two keyframes: 2 s at 60 Hz, 40 MB


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeStep:
    """What the back end did with one keyframe."""

    odometry: OdometryKeyframe
    update: GraphUpdate
    edges: list[LoopEdge]
    candidates: list[LoopCandidate]
    retrieved: list[RetrievedKeyframe]
    news: GraphNews  # what the graph has to remember
    scans: dict[int, PackedScan]  # what came into the map with it: its own scan, or depth that came late
    words: WordsMemory | None  # the vocabulary, when it is new
    tags: tuple[TagSighting, ...]  # that it saw


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """The answer to one frame: what the front half saw, the causal pose, and the keyframes that went to the back."""

    front: FrontStep
    T_map_body: Array | None  # None: no pose yet
    localisation: Localisation
    piece: int  # of the trajectory, from 0
    keyframes: list[KeyframeStep]


@dataclass(frozen=True, slots=True, eq=False)
class Finish:
    """What came when the recording ended."""

    steps: list[Step]
    keyframes: list[KeyframeStep]  # those that had waited for gravity until the end
    update: GraphUpdate | None  # None: not one keyframe reached the back end
    news: GraphNews | None


class Back:
    """What runs at the rate of keyframes: loop detector, graph, mapper."""

    def __init__(
        self,
        config: Config,
        rig: Rig,
        noise: ImuNoise | None,
        clock: StageClock,
        first_state: NavState | None,
        T_map_body: Array,
    ) -> None:
        """Build the stages for a first keyframe at `T_map_body`; `first_state` is None where no IMU tells gravity."""
        self._has_gravity = has_gravity = first_state is not None
        readout_s = config.frontend.readout_s if config.window.readout_s is None else config.window.readout_s
        window = replace(config.window, readout_s=readout_s)
        scale_sigma = float(np.hypot(config.graph.scale_sigma, lasting_scale_sigma(config.frontend, rig, noise)))
        by_imu = has_gravity and not rig.is_stereo and not rig.has_depth
        graph = replace(config.graph, scale_sigma=scale_sigma, edges_share_scale=by_imu)
        self.graph = PoseGraph(graph, noise if has_gravity else None, config.imu.gravity_m_s2, rig, window)
        self.graph.initialise(first_state, T_map_body)
        self.loops = LoopDetector(config.loop, rig, config.seed, has_gravity) if config.loop.enabled else None
        self._false = None
        if config.loop.inject_share > 0.0:
            self._false = FalseLoops(config.loop.inject_share, config.loop.inject_group, config.seed)
        self.map = map_stage(config, rig, clock)
        self.clock = clock
        self.T_map_odom = np.eye(4)
        self._words_revision = 0

    @property
    def mapper(self) -> Mapper | None:
        """The map; None where it is off."""
        return None if self.map is None else self.map.mapper

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of the rooms that there are."""
        loops = {} if self.loops is None else {"loop": dict(self.loops.counters)}
        return {**loops, **({} if self.map is None else self.map.counters)}

    @collector.paused()
    def restore(self, memory: SlamMemory) -> GraphUpdate:
        """Take over an earlier run; return all its poses. Raises UsageError where loops are made up on purpose."""
        if self._false is not None:
            raise UsageError("what loop.inject_share made up is not remembered: such a run cannot be gone on with")
        graph = memory.graph
        update = self.graph.restore(graph)
        if self.loops is not None:
            self.loops.restore(memory.places)
            self._words_revision = self.loops.words_revision
        if self.map is not None:
            self.map.restore(memory.scans, graph.T_map_body, memory.held > 0)
        self._follow(update)
        if memory.held:
            self.graph.hold(memory.held)
        return update

    def begin_recording(self, state: NavState | None, T_odom_body: Array) -> bool:
        """Prepare for the first keyframe of a new recording, whose axes are those of map until loops say otherwise.

        False, and nothing begins, where the map knows gravity and the recording ended or gave up before it did.
        """
        if state is None and self._has_gravity:
            return False
        self.graph.begin_recording(state, T_odom_body)
        self.T_map_odom = np.eye(4)
        return True

    def add(self, odometry: OdometryKeyframe, seen: list[SeenFrame]) -> KeyframeStep:
        """Take one keyframe and the frames before it in: find its loops, optimise, follow with the map."""
        keyframe = odometry.packet.keyframe
        edges: list[LoopEdge] = []
        candidates: list[LoopCandidate] = []
        if self.loops is not None:
            with self.clock.measure("loop"):
                edges, candidates = self.loops.detect(
                    keyframe, self.T_map_odom @ odometry.T_odom_body, odometry.packet.begins_piece
                )
        if self._false is not None:
            false = self._false.add(odometry.T_odom_body, edges)
            edges, candidates = edges + false, candidates + [as_candidate(edge) for edge in false]
        with self.clock.measure("graph"):
            update = self.graph.add(odometry.packet, edges, odometry.T_odom_body)
        self._follow(update)
        scans = {} if self.map is None else self.map.add(odometry, self.T_map_odom @ odometry.T_odom_body, seen)
        retrieved, tags = ([], ()) if self.loops is None else (self.loops.retrieved, self.loops.tags(keyframe.id))
        news, words = self.graph.take_news(), self._new_words()
        return KeyframeStep(odometry, update, edges, candidates, retrieved, news, scans, words, tags)

    def finish(self) -> GraphUpdate:
        """Optimise to convergence and bring the map to the final poses."""
        if self.loops is not None:
            self.loops.close()
        with self.clock.measure("graph finish"):
            update = self.graph.finish()
        self._follow(update)
        if self.map is not None:
            self.map.finish()
        return update

    def _new_words(self) -> WordsMemory | None:
        """Return the vocabulary if it is new since the last call."""
        if self.loops is None or self.loops.words_revision == self._words_revision:
            return None
        self._words_revision = self.loops.words_revision
        return self.loops.words()

    def _follow(self, update: GraphUpdate) -> None:
        self.T_map_odom = update.T_map_odom
        if self.loops is not None:
            self.loops.move(update)
        if self.map is not None:
            self.map.move(update)


def map_stage(config: Config, rig: Rig, clock: StageClock) -> MapStage | None:
    """Return the map of a pipeline; None where it is off."""
    return MapStage(config.map, rig, makes_depth(config, rig), clock) if config.map.enabled else None


def makes_depth(config: Config, rig: Rig) -> bool:
    """Whether the map takes depth from one moving camera."""
    return config.map.enabled and config.map.mono_depth.enabled and mode_for(config.frontend, rig) == "mono"


def seen_between(front: FrontStep) -> list[SeenFrame]:
    """Return what depth from one camera can use of a step: a frame between keyframes of which odometry knows where."""
    frame, T = front.frame, front.T_keyframe_body
    is_known = T is not None and front.track.vo.tracking is not Tracking.LOST
    if front.track.keyframe is not None or not is_known or not frame.images:
        return []
    assert T is not None
    return [SeenFrame(frame.t_ns, frame.images[0], front.keyframe_id, T)]


def localised(before: Pieces, after: Pieces, tracking: Tracking, counters: dict[str, int]) -> Localisation:
    """Return whether the place in the map is known after a frame that changed the pieces so, and count it."""
    is_joined = after.groups[-1] == 0
    if is_joined and before.groups[-1] != 0:
        counters["relocalised"] += 1
        return Localisation.RELOCALISED
    is_lost = tracking is Tracking.LOST or not is_joined
    counters["frames_lost"] += is_lost
    return Localisation.LOST if is_lost else Localisation.TRACKING


class Slam:
    """Camera and IMU in, poses and map out; deterministic, one thread, two doors: an inertial sample and a frame."""

    def __init__(self, config: Config, rig: Rig, noise: ImuNoise | None = None) -> None:
        """Build the pipeline for a rig; without `noise` there is no IMU."""
        self.clock = StageClock()
        self.front = Front(config, rig, noise, self.clock)
        self.back: Back | None = None  # begins with the first keyframe, when gravity is known
        self._make_back = partial(Back, config, rig)
        self._frames: deque[Frame] = deque()
        self._pieces = Pieces()
        self.counters = {"frames_lost": 0, "relocalised": 0}
        self._published = Continuity(config.publish)
        self._T_map_odom = np.eye(4)  # at the last frame
        self._seen: deque[SeenFrame] = deque(maxlen=MAX_SEEN)  # since the newest keyframe
        self._seen_again: int | None = None  # the keyframe at which an earlier run is resumed
        self._begins_recording = False  # in a map, with the next keyframe

    def resume(self, memory: SlamMemory) -> GraphUpdate:
        """Go on where an earlier run was, before the first value; return all its poses.

        The first frame has to be that of its newest keyframe, `memory.front.camera_t_ns`, with the inertial samples
        around it. Raises DataError when the memory contradicts itself.
        """
        self.front.resume(memory.front)
        self.back = self._make_back(self.front.noise, self.clock, memory.first_state, memory.T_start)
        self._seen_again = memory.front.keyframe_id
        update = self.back.restore(memory)
        self._pieces = update.pieces
        return update

    def begin_in_map(self, memory: SlamMemory) -> GraphUpdate:
        """Begin in the map of earlier runs, before the first value; return its poses.

        What is recorded now is a new piece of trajectory until loops join it with the map. Raises DataError when the
        memory contradicts itself.
        """
        self.front.begin_in_map(memory.front.keyframe_id + 1, memory.front.news.next_track_id)
        self.back = self._make_back(self.front.noise, self.clock, memory.first_state, memory.T_start)
        self._begins_recording = True
        update = self.back.restore(memory)
        self._pieces = update.pieces.begun(memory.front.keyframe_id + 1)
        return update

    def feed(self, value: ImuSample | MagSample | Frame) -> list[Step]:
        """Take one measurement; return a step for every frame that could be processed with it.

        A frame waits until one inertial sample newer than it has come, so that its span ends exactly at its time.
        """
        if isinstance(value, Frame):
            self._frames.append(value)
        else:
            self.front.add(value)
        steps = []
        while self._frames and self.front.is_ready(self._frames[0].t_ns, self._frames[-1].t_ns):
            steps.append(self._step(self._frames.popleft()))
        return steps

    def finish(self) -> Finish:
        """Process the frames that still wait and optimise a last time."""
        steps = [self._step(self._frames.popleft()) for _ in range(len(self._frames))]
        keyframes = self._add(self.front.give_up_waiting())
        if self.back is None:
            return Finish(steps, keyframes, None, None)
        return Finish(steps, keyframes, self.back.finish(), self.back.graph.take_news())

    def _add(self, keyframes: list[OdometryKeyframe]) -> list[KeyframeStep]:
        """Hand keyframes to the back end; the one at which an earlier run is resumed is there already."""
        steps = []
        for odometry in keyframes:
            if odometry.packet.keyframe.id == self._seen_again and self.back is not None:
                self.back.graph.go_on(odometry.packet, odometry.T_odom_body)
            elif self._enters(odometry):
                steps.append(self._add_new(odometry))
        return steps

    def _enters(self, odometry: OdometryKeyframe) -> bool:
        """Return whether a keyframe can be added; into a map that knows gravity only if the recording does."""
        if self._begins_recording and self.back is not None:
            self._begins_recording = not self.back.begin_recording(self.front.first_state, odometry.T_odom_body)
        return not self._begins_recording

    def _add_new(self, odometry: OdometryKeyframe) -> KeyframeStep:
        if self.back is None:
            self.back = self._make_back(self.front.noise, self.clock, self.front.first_state, odometry.T_odom_body)
        seen = list(self._seen)
        self._seen.clear()
        step = self.back.add(odometry, seen)
        self.front.feed_back(step.update)
        return step

    def _step(self, frame: Frame) -> Step:
        front = self.front.process(frame)
        keyframes = self._add(front.keyframes)
        if self.back is not None and self.back.map is not None and self.back.map.wants_frames:
            self._seen += seen_between(front)
        T_map_body = self._publish(front)
        localisation = self._localisation(front.track.vo.tracking, keyframes)
        return Step(front, T_map_body, localisation, len(self._pieces.groups) - 1, keyframes)

    def _publish(self, front: FrontStep) -> Array | None:
        """Return the pose in map; what the graph corrected since the last frame is taken in as the body moves."""
        if self.back is None or front.estimate is None:
            return None
        estimate, T_before = front.estimate, self._T_map_odom
        T_map_odom = self._T_map_odom = self.back.T_map_odom
        before, after = T_before @ estimate.T_odom_before, T_map_odom @ estimate.T_odom_body
        return self._published.follow(front.frame.t_ns, before, after, estimate.rate_sigma_rad_s)

    def _localisation(self, tracking: Tracking, keyframes: list[KeyframeStep]) -> Localisation:
        """Return whether the place in the map is known after a frame."""
        before = self._pieces
        if keyframes:
            self._pieces = keyframes[-1].update.pieces
        return localised(before, self._pieces, tracking, self.counters)
