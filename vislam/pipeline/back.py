"""The back half of the pipeline: what runs at the rate of keyframes, loop detector, graph and map."""

from collections import deque
from collections.abc import Sequence
from functools import partial

import numpy as np

from vislam.config import Config
from vislam.core import collector
from vislam.core.blas import on_one_blas_thread
from vislam.core.camera import Rig
from vislam.core.clock import StageClock
from vislam.core.errors import UsageError
from vislam.core.imu_noise import ImuNoise
from vislam.core.memory import GraphRecord, SlamMemory, WordsMemory
from vislam.core.messages import (
    Array,
    GraphUpdate,
    LoopCandidate,
    LoopEdge,
    NavState,
)
from vislam.graph import PoseGraph
from vislam.loop import FalseLoops, LoopCloser, as_candidate
from vislam.mapping.depth.mono import SeenFrame
from vislam.mapping.mapper import Mapper
from vislam.mapping.semantic.images import Labeller
from vislam.mapping.stage import MapStage
from vislam.pipeline.depth_in_map import DepthInMap
from vislam.pipeline.front import Front
from vislam.pipeline.settings import makes_depth, without_gravity
from vislam.pipeline.steps import FrontStep, KeyframeStep, seen_between
from vislam.sensors import Suite
from vislam.trajectory.odometry_keyframe import OdometryKeyframe

MAX_SEEN = 120  # frames kept between two keyframes: 2 s at 60 Hz, 40 MB


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
        suite: Suite | None = None,
        labeller: Labeller | None = None,
    ) -> None:
        """Build the stages for a first keyframe at `T_map_body`; `first_state` is None where gravity is unknown.

        `config` is as `settings.derived` gives it; `suite` has the sensors whose readings the graph takes; `labeller`
        gives the labels of keyframes; None: they are read from the folder in the settings, if there is one.
        """
        self._has_gravity = has_gravity = first_state is not None
        graph = config.graph if has_gravity else without_gravity(config.graph, rig)
        self.graph = PoseGraph(graph, noise if has_gravity else None, config.machine, rig, config.window, suite)
        self.graph.initialise(first_state, T_map_body)
        self.loops = LoopCloser(config.loop, rig, config.seed, has_gravity) if config.loop.enabled else None
        self._false = None
        if config.loop.inject_share > 0.0:
            self._false = FalseLoops(config.loop.inject_share, config.loop.inject_group, config.seed)
        self.map = map_stage(config, rig, clock, labeller)
        self._by_depth: DepthInMap | None = None
        self._config, self._rig = config, rig
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
        depth = {} if self._by_depth is None else {"depth in map": dict(self._by_depth.counters)}
        return {**loops, **depth, **({} if self.map is None else self.map.counters)}

    @collector.paused()
    def restore(self, memory: SlamMemory) -> GraphUpdate:
        """Take over an earlier run; return all its poses. Raises UsageError where loops are made up on purpose."""
        if self._false is not None:
            raise UsageError("what loop.inject_share made up is not remembered: such a run cannot be gone on with")
        asks_depth = memory.map_keyframes > 0 and self._rig.has_depth and self._config.loop.depth_in_map
        update = self.graph.restore(memory.graph)
        if self.loops is not None:
            self.loops.restore(memory.places)
            self._words_revision = self.loops.words_revision
        if self.map is not None:
            self.map.restore(memory.scans, memory.graph.T_map_body, memory.held > 0)
        if asks_depth:
            self._by_depth = DepthInMap(self._config, self._rig, memory, update.submaps)
        self._follow(update)
        if memory.held:
            self.graph.hold(memory.held)
        return update

    def guess(self, T_map_body: Array) -> None:
        """Take where the body is about now in the map of another run, [4, 4]: depth is asked whether that is so."""
        if self._by_depth is not None:
            self._by_depth.guess(T_map_body)

    def begin_recording(self, state: NavState | None, T_odom_body: Array) -> bool:
        """Prepare for the first keyframe of a new recording, whose axes are those of map until loops say otherwise.

        False, and nothing begins, where the map knows gravity and the recording ended or gave up before it did.
        """
        if state is None and self._has_gravity:
            return False
        self.graph.begin_recording(state, T_odom_body)
        self.T_map_odom = np.eye(4)
        return True

    @on_one_blas_thread
    def add(self, odometry: OdometryKeyframe, seen: list[SeenFrame], undo: Sequence[int] = ()) -> KeyframeStep:
        """Take one keyframe and the frames before it in: find its loops, optimise, follow with the map.

        `undo` are ids of loops that a user takes out.
        """
        keyframe = odometry.packet.keyframe
        edges: list[LoopEdge] = []
        candidates: list[LoopCandidate] = []
        if self.loops is not None:
            with self.clock.measure("loop"):
                edges, candidates = self.loops.detect(
                    keyframe,
                    self.T_map_odom @ odometry.T_odom_body,
                    odometry.packet.begins_submap,
                    is_tied=odometry.packet.is_tied,
                )
            if self._by_depth is not None:
                with self.clock.measure("depth in map"):
                    found = self._by_depth.look(odometry, self.T_map_odom, self.graph.relative_covariance, edges)
                if found is not None:
                    by_depth, offered = self.loops.offer(found[0], keyframe.id, found[1])
                    edges, candidates = edges + by_depth, [*candidates, offered]
        if self._false is not None:
            false = self._false.add(odometry.T_odom_body, edges)
            edges, candidates = edges + false, candidates + [as_candidate(edge) for edge in false]
        with self.clock.measure("graph"):
            update = self.graph.add(odometry.packet, edges, odometry.T_odom_body, undo)
        self._follow(update)
        scans = {} if self.map is None else self.map.add(odometry, self.T_map_odom @ odometry.T_odom_body, seen)
        retrieved, tags = ([], ()) if self.loops is None else (self.loops.retrieved, self.loops.tags(keyframe.id))
        record, words = self.graph.take_record(), self._new_words()
        return KeyframeStep(odometry, update, edges, candidates, retrieved, record, scans, words, tags)

    @on_one_blas_thread
    def finish(self, undo: Sequence[int] = ()) -> GraphUpdate:
        """Optimise to convergence and bring the map to the final poses; `undo` as for `add`."""
        if self.loops is not None:
            self.loops.close()
        with self.clock.measure("graph finish"):
            update = self.graph.finish(undo)
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
        if self._by_depth is not None:
            self._by_depth.move(update)
        if self.map is not None:
            self.map.move(update)


class KeyframeIntake:
    """Hands keyframes to the stages of a run, which begin with the first one or with an earlier run."""

    def __init__(
        self, rig: Rig, front: Front, clock: StageClock, suite: Suite | None = None, labeller: Labeller | None = None
    ) -> None:
        """Wait for the first keyframe of `front`; `suite` has the sensors whose readings come with keyframes.

        `labeller` as for `Back`.
        """
        self._front = front
        self._make = partial(Back, front.config, rig, suite=suite, labeller=labeller)
        self._clock = clock
        self._seen: deque[SeenFrame] = deque(maxlen=MAX_SEEN)  # since the newest keyframe
        self._seen_again: int | None = None  # the keyframe at which an earlier run is resumed
        self._begins_recording = False  # in a map, with the next keyframe
        self.stages: Back | None = None

    def resume(self, memory: SlamMemory) -> GraphUpdate:
        """Go on where an earlier run was; return all its poses. Raises as `Back.restore`."""
        self._seen_again = memory.front.keyframe_id
        return self._restore(memory)

    def begin_in_map(self, memory: SlamMemory) -> GraphUpdate:
        """Begin in the map of earlier runs; return its poses. Raises as `Back.restore`."""
        self._begins_recording = True
        return self._restore(memory)

    def see(self, front: FrontStep) -> None:
        """Keep what depth from one camera can use of a frame."""
        if self.stages is not None and self.stages.map is not None and self.stages.map.wants_frames:
            self._seen += seen_between(front)

    def add(self, keyframes: list[OdometryKeyframe]) -> list[KeyframeStep]:
        """Take keyframes in; the one at which an earlier run is resumed is there already."""
        steps = []
        for odometry in keyframes:
            if odometry.packet.keyframe.id == self._seen_again and self.stages is not None:
                self.stages.graph.go_on(odometry.packet, odometry.T_odom_body)
            elif self._enters(odometry):
                steps.append(self._add_new(odometry))
        return steps

    def finish(self) -> tuple[GraphUpdate | None, GraphRecord | None]:
        """Optimise to convergence; None where no keyframe came."""
        if self.stages is None:
            return None, None
        return self.stages.finish(), self.stages.graph.take_record()

    def _restore(self, memory: SlamMemory) -> GraphUpdate:
        self.stages = self._make(self._front.noise, self._clock, memory.first_state, memory.T_start)
        return self.stages.restore(memory)

    def _enters(self, odometry: OdometryKeyframe) -> bool:
        """Return whether a keyframe can be added; into a map that knows gravity only if the recording does."""
        if self._begins_recording and self.stages is not None:
            self._begins_recording = not self.stages.begin_recording(
                self._front.begun.first_state, odometry.T_odom_body
            )
        return not self._begins_recording

    def _add_new(self, odometry: OdometryKeyframe) -> KeyframeStep:
        if self.stages is None:
            self.stages = self._make(
                self._front.noise, self._clock, self._front.begun.first_state, odometry.T_odom_body
            )
        seen = list(self._seen)
        self._seen.clear()
        step = self.stages.add(odometry, seen)
        self._front.feed_back(step.update)
        return step


def map_stage(config: Config, rig: Rig, clock: StageClock, labeller: Labeller | None = None) -> MapStage | None:
    """Return the map of a pipeline; None where it is off."""
    return MapStage(config.map, rig, makes_depth(config, rig), clock, labeller) if config.map.enabled else None
