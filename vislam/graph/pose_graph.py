"""PoseGraph: keyframes, odometry and loops in one iSAM2 graph, whose sole owner it is."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import GraphConfig, MachineConfig, WindowConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import invert
from vislam.core.memory import EdgeReport, GraphMemory, GraphRecord, LoopPlace, WindowRecord
from vislam.core.messages import Array, GraphUpdate, KeyframePacket, LoopEdge, NavState
from vislam.factors.builder import Step
from vislam.factors.journal import (
    KeyframeRecord,
    LoopRecord,
    Record,
    StartRecord,
    keyframe_record,
    start_record,
)
from vislam.factors.keys import X
from vislam.factors.loop import LoopModel
from vislam.factors.sensed import Covariance, Readings
from vislam.graph.belief import LoopSet
from vislam.graph.estimate import Ids
from vislam.graph.estimator import Estimator
from vislam.graph.joining import Joining, weak_link
from vislam.graph.restore import restored_journal, sort_loops
from vislam.graph.source import MotionSource, Source, WindowSource
from vislam.graph.travel import Travel
from vislam.imu import ImuNoise
from vislam.sensors import Suite

_START_SLACK_NS = 20_000_000  # the initial state must belong to keyframe 0
_UNKNOWN = (1.0, 1e4)  # variances in rad^2 and m^2 of the motion to a new submap: no loop may be tested against it
_MOVED_M = 0.001  # poses that moved less are not published again
_MOVED_DEG = 0.05


class Published:
    """Owns the poses as they were last published, where odom is in map, and the number of the last update."""

    def __init__(self) -> None:
        """Start with nothing published."""
        self._poses: Array = np.zeros((0, 4, 4))
        self.T_map_odom: Array = np.eye(4)
        self.revision = 0

    def place_odom(self, T_map_body: Array, T_odom_body: Array) -> None:
        """Take where the newest keyframe is in both."""
        self.T_map_odom = T_map_body @ invert(np.ascontiguousarray(T_odom_body, dtype=np.float64))

    def take(self, poses: Array, read: Ids, everything: bool) -> Ids:
        """Return which of the poses [M, 4, 4] that were read back have moved, or all; they count as published now."""
        known = self._poses
        ids = np.arange(len(poses), dtype=np.int64) if everything else read
        if (grown := len(poses) - len(known)) > 0:
            known = np.concatenate([known, np.full((grown + len(poses) // 2, 4, 4), np.inf)])
        fresh, old = poses[ids], known[ids]
        shift = np.linalg.norm(fresh[:, :3, 3] - old[:, :3, 3], axis=1)
        limit = 2.0 * np.sqrt(2.0) * np.sin(0.5 * np.deg2rad(_MOVED_DEG))  # the chord of that angle
        chord = np.linalg.norm(fresh[:, :3, :3] - old[:, :3, :3], axis=(1, 2))
        moved = ids[(shift > _MOVED_M) | (chord > limit) | everything]
        known[moved] = poses[moved]
        self._poses = known
        self.revision += 1
        return moved


class PoseGraph:
    """The back end: `initialise`, then `add` each keyframe packet with its loop edges, then `finish`.

    Coupling `loose`: motions of visual odometry and preintegrated IMU are its factors. Coupling `tight`: a sliding
    window optimises tracks and IMU of the newest keyframes, and its edges and tilts are the factors of poses alone.
    Bad input raises DataError before anything is touched. Whatever gtsam does, `add` returns an update; its note
    reports what was unusual. Lost vision, IMU outages and refused loops are values.
    """

    def __init__(
        self, config: GraphConfig, noise: ImuNoise | None, machine: MachineConfig, rig: Rig,
        window: WindowConfig, suite: Suite | None = None,
    ) -> None:  # fmt: skip
        """Set up for a rig; without `noise` there is no IMU and only poses are estimated.

        `suite` has the sensors whose readings become factors; `readings.counts` counts what became of them.
        """
        self._config = config
        self._noise = noise
        self._lever_m = _lever_m(rig)
        self._source = _source(config, noise, machine, rig, window)
        self.readings = Readings(suite or Suite(), config)
        self._estimator = Estimator(config, self._source.odometry, self.readings)
        self._start: StartRecord | None = None
        self._start_t_ns: int | None = None
        self._journal: list[Record] = []
        self._keyframes: list[KeyframeRecord] = []
        self._travel = Travel()
        self._loops = LoopSet(config, self._lever_m, self._estimator, self._travel)
        self._joining = Joining(config, self._source, self._estimator, self._loops, self._travel)
        self._published = Published()
        self._T_odom_last: Array | None = None
        self._said: WindowRecord | None = None
        self._newest: NavState | None = None

    @property
    def ids(self) -> NDArray[np.int64]:
        """Return the ids [M] of all keyframes."""
        return np.arange(len(self._keyframes), dtype=np.int64)

    @property
    def journal(self) -> list[Record]:
        """Return what was measured, as far as a rebuild needs it: plain records in the order of arrival."""
        return list(self._journal)

    def initialise(self, state: NavState | None, T_map_body: Array | None = None) -> None:
        """Set the state of keyframe 0 in map: gravity-aligned pose, velocity, biases; None without an IMU.

        Without an IMU keyframe 0 is put at `T_map_body` [4, 4], by default the identity.
        Raises DataError on numbers that cannot be used and UsageError when it does not fit the graph.
        """
        if self._keyframes:
            raise UsageError("the graph already has keyframes; initialise it once, before the first add")
        if (state is None) != (self._noise is None):
            have = "no IMU" if self._noise is None else "an IMU"
            raise UsageError(f"the graph was set up with {have}; initialise it with a state exactly when it has an IMU")
        self._start = start_record(state, T_map_body)
        self._source.begin(self._start, state)
        self._start_t_ns = None if state is None else state.t_ns

    def begin_recording(self, state: NavState | None, T_odom_body: Array) -> None:
        """Prepare for another recording after the keyframes that are there: its first keyframe begins a new submap.

        `state` is that of this keyframe, or None without an IMU; `T_odom_body` [4, 4] its pose in the new odom, whose
        axes are those of map until loops say otherwise. Raises as `initialise`.
        """
        if self._config.coupling != "tight":
            raise UsageError("a map is continued with tight coupling only; use --graph.coupling tight")
        self._source.begin_submap(start_record(state, T_odom_body), state)
        self._T_odom_last = self._estimator.poses[-1].copy()

    def hold(self, count: int | None = None) -> None:
        """Hold the first keyframes, by default all there are, where they are: the map of what comes does not change."""
        self._estimator.hold(self.ids[:count])

    def restore(self, memory: GraphMemory) -> GraphUpdate:
        """Take over the keyframes, loops and last estimate of an earlier run; return all poses.

        `initialise` comes before, with the first state of that run, and `go_on` or a new submap after.
        Raises DataError, and the graph cannot be used, when the memory contradicts itself.
        """
        if self._start is None or self._keyframes:
            raise UsageError("a graph is restored once, after initialise(...) and before the first keyframe")
        self._keyframes, self._journal = restored_journal(memory, self._config, self._noise is not None, self._start)
        guesses = self._source.restore(self._keyframes, memory)
        self.readings.recall(memory.own)
        for packet, record in zip(memory.packets, self._keyframes, strict=True):
            self.readings.append(record, packet.readings)
        for k, is_tied in [(record.id, record.is_tied) for record in self._keyframes if record.begins_submap]:
            self._joining.begin(k, is_tied)
            if not is_tied:
                self._source.odometry.relink(k, invert(memory.T_map_body[k - 1]) @ memory.T_map_body[k])
        models = [LoopModel(r, self._config, self._lever_m) for r in self._journal if isinstance(r, LoopRecord)]
        by_place = sort_loops(memory.loops, {m.id: m for m in models})
        in_graph, spare = by_place[LoopPlace.GRAPH], by_place[LoopPlace.SPARE]
        steps, note = self._estimator.restore(guesses, in_graph, spare, memory.vo_scale)
        for record, step in zip(self._keyframes[1:], steps, strict=True):
            T_map_before = memory.T_map_body[record.id - 1]
            self._travel.append(*_variances(record, step), invert(T_map_before) @ step.guess.T_map_body)
        self._loops.restore(models, by_place, memory.ties, memory.loops)
        self._joining.restore(by_place[LoopPlace.WAITING])
        note = "; ".join(n for n in (note, self._loops.freezer.all()) if n)
        self._published.revision, self._T_odom_last = memory.revision, memory.T_odom_body
        self._published.place_odom(self._estimator.poses[-1], memory.T_odom_body)
        update = self._publish([], [], note, everything=True)
        self.take_record()
        return update

    def go_on(self, packet: KeyframePacket, T_odom_body: Array | None = None) -> None:
        """Begin again at the newest keyframe of `restore`, seen again: its packet, without inertial data."""
        if not self._keyframes or packet.keyframe.id != self._keyframes[-1].id:
            raise UsageError(f"keyframe {packet.keyframe.id} is not the newest of the graph")
        self._source.go_on(packet, self._estimator.poses[-1], T_odom_body)

    def take_record(self) -> GraphRecord:
        """Return what `restore` will need of the last keyframe, beside what was measured and the poses."""
        states, loops = self._source.take_states(self._newest), self._loops.take_states(self._joining.waiting)
        own = self.readings.all_own(self._estimator.values)
        return GraphRecord(self._said, states, loops, self._loops.take_ties(), self._estimator.vo_scale, own)

    def add(
        self, packet: KeyframePacket, edges: Sequence[LoopEdge] = (), T_odom_body: Array | None = None,
        undo: Sequence[int] = (),
    ) -> GraphUpdate:  # fmt: skip
        """Add a keyframe and the loop edges that ended with it; return what changed.

        `T_odom_body` [4, 4] is the keyframe's pose in odom, from which T_map_odom follows; without it the last stays.
        `undo` are ids of loops that a user takes out for good, as far as they are held.
        Raises DataError, and changes nothing, on a packet that cannot be used.
        """
        if self._start is None:
            raise UsageError("the graph needs initialise(...) before the first keyframe")
        previous = self._keyframes[-1] if self._keyframes else None
        record = keyframe_record(packet, previous)
        _check_odom(record, T_odom_body)
        if previous is None:
            _check_start(record, self._start_t_ns)
        elif record.begins_submap:
            before, config = self._estimator.poses[-1], self._config
            record = weak_link(record, before, self._T_odom_last, T_odom_body, self._noise is not None, config)
        heard = self.readings.admission.for_window(packet.motions, record.id)
        said = self._source.add(packet, record, T_odom_body, heard)
        if self._config.coupling == "tight":
            record = replace(record, imu=None)  # the window has summarised it, and no rebuild asks for it
        self.readings.append(record, packet.readings)
        self._said = said[-1] if said else None
        self._journal += [self._start, record, *said] if previous is None else [record, *said]
        if previous is None:
            notes = [self._estimator.begin()]
        else:
            step, note = self._estimator.extend()
            self._travel.append(*_variances(record, step), _motion_to(record.id, self._estimator.poses))
            for older, variance_rad2, variance_m2 in self._source.odometry.amended(self._estimator.vo_scale):
                self._travel.amend(older, variance_rad2, variance_m2, _motion_to(older, self._estimator.poses))
            notes = [step.note, note]
        self._keyframes.append(record)
        if record.begins_submap:
            self._joining.begin(record.id, record.is_tied)
            notes.append(f"keyframe {record.id} begins submap {len(self._joining.submaps.groups) - 1}")
        self._T_odom_last = T_odom_body
        accepted, refused = self._close(edges, undo, notes)
        if T_odom_body is not None:
            self._published.place_odom(self._estimator.poses[-1], T_odom_body)
        return self._publish(accepted, refused, "; ".join(n for n in notes if n))

    def finish(self, undo: Sequence[int] = ()) -> GraphUpdate:
        """Iterate to convergence and return all poses; the note has costs and method. `undo` as for `add`."""
        if not self._keyframes:
            return GraphUpdate(self._published.revision, np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.eye(4), None)
        before, notes = self._estimator.poses[-1].copy(), list[str]()
        decided = self._loops.undo(undo, notes) + self._loops.finish(notes)
        notes.append(self._estimator.converge())
        self._published.T_map_odom = self._estimator.poses[-1] @ invert(before) @ self._published.T_map_odom
        return self._publish(*self._loops.ledger.split(decided), "; ".join(n for n in notes if n), everything=True)

    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4] of all keyframes, each as it was last read back from the solver."""
        return self._estimator.poses.copy()

    def states(self) -> list[NavState]:
        """Return the state of each keyframe with its marginal covariance, NaN where gtsam cannot give one.

        An error of scale that all measurements share is in it, as the window still doubts it or by its prior. As a
        variable it would keep that, for nothing here knows metres better, and would tie all factors to one.
        """
        states = [self._source.state(one.id, one.t_ns, self._estimator) for one in self._keyframes]
        return [_stretched(state, self._estimator.poses[0], self._source.scale_sigma) for state in states]

    def own(self, name: str) -> tuple[Array, Array] | None:
        """Return a sensor's own variables [V], in their order, and their sigmas [V], NaN where gtsam gives none.

        Those that walk are as with the newest reading. None while none of them has a factor.
        """
        return self.readings.own(name, self._estimator.values, self._estimator.joint_covariance)

    def joint_covariance(self, k: int, name: str) -> Array | None:
        """Return the joint covariance [6 + V, 6 + V] of keyframe k's pose and a sensor's own variables, see `own`.

        Of the pose rotation, then translation, in rad and m on the body side, without a shared error of scale. None
        where gtsam gives none, and while no variable has a factor. Raises IndexError for another keyframe.
        """
        if not 0 <= k < len(self._keyframes):
            raise IndexError(f"no keyframe {k}; the graph has {len(self._keyframes)}")
        return _in_units(self._estimator.joint_covariance, X(k), *self.readings.own_keys(name))

    def sensed(self, name: str) -> dict[str, int]:
        """Return what became of a sensor's readings, at the estimate as it is; see `Readings.counts_of`."""
        return self.readings.counts_of(name, self._estimator.values)

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j, perturbed at j; from summed odometry where gtsam cannot give it."""
        return self._loops.gate.relative_covariance(i, j)

    def edge_reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop, by loop id, with the weight it has now."""
        return self._loops.reports()

    def _close(self, edges: Sequence[LoopEdge], undo: Sequence[int], notes: list[str]) -> tuple[list[int], list[int]]:
        """Gate loops, accept them or keep them pending, and let the review work; return accepted and refused ids."""
        here, touched = list[LoopModel](), self._loops.undo(undo, notes)
        self._estimator.look_at([k for e in edges for k in (e.from_id, e.to_id) if 0 <= k < len(self._keyframes)])
        for edge in edges:
            model = self._loops.admit(edge, len(self._keyframes) - 1)
            touched.append(edge.id)
            if model is not None:
                self._journal.append(model.record)
                if self._joining.submaps.are_joined(edge.from_id, edge.to_id):
                    here.append(model)
                else:
                    touched += self._joining.wait(model)
        here += self._joining.join(touched, notes)
        passed, pending = self._loops.test(here)
        pending += self._loops.accept(passed, notes, "inside the gate")
        touched += self._loops.keep_pending(pending) + self._loops.review(notes)
        notes.append(self._loops.freezer.step())
        return self._loops.ledger.split(touched)

    def _publish(self, accepted: list[int], refused: list[int], note: str, everything: bool = False) -> GraphUpdate:
        """Return the poses that moved since they were last published, and remember them."""
        self._joining.count()
        poses, published = self._estimator.poses, self._published
        moved = published.take(poses, self._estimator.take_read(), everything)
        if self._noise is not None:
            self._newest = self._source.state(len(poses) - 1, self._keyframes[-1].t_ns, self._estimator)
        solver, vo_scale = self._estimator.solver_name, self._estimator.vo_scale
        details = {"solver": solver, "pending": self._loops.pending, "vo_scale": vo_scale, **self._source.details}
        return GraphUpdate(
            published.revision, moved, poses[moved], published.T_map_odom, self._newest,
            tuple(accepted), tuple(refused), note, details, self._joining.submaps,
        )  # fmt: skip


def _lever_m(rig: Rig) -> Array:
    """Return where cam0 is in the body [3]."""
    return np.array(rig.T_body_cam0[:3, 3], dtype=np.float64)


def _source(
    config: GraphConfig, noise: ImuNoise | None, machine: MachineConfig, rig: Rig, window: WindowConfig
) -> Source:
    """Return what feeds the graph with a kind of coupling."""
    if config.coupling == "loose":
        return MotionSource(config, noise, machine, _lever_m(rig))
    from vislam.window import SlidingWindow  # compiles a good deal, which loose coupling need not wait for

    return WindowSource(config, machine, SlidingWindow(window, rig, noise, machine))


def _stretched(state: NavState, T_map_first: Array, scale_sigma: float) -> NavState:
    """Return a state with the uncertainty that scale adds to its distance from the first keyframe."""
    way = state.T_world_body[:3, 3] - T_map_first[:3, 3]
    by_scale = scale_sigma * np.concatenate([way, state.velocity_world_m_s])
    covariance = state.covariance.copy()
    covariance[3:9, 3:9] += np.outer(by_scale, by_scale)
    return replace(state, covariance=covariance)


def _variances(record: KeyframeRecord, step: Step) -> tuple[float, float]:
    """Return the variances in rad^2 and m^2 of the motion to a keyframe, by habit across a loss of sight."""
    is_unknown = record.begins_submap and not record.is_tied
    return _UNKNOWN if is_unknown else (step.variance_rad2, step.variance_m2)


def _check_odom(record: KeyframeRecord, T_odom_body: Array | None) -> None:
    if T_odom_body is not None and not np.all(np.isfinite(T_odom_body)):
        raise DataError(f"keyframe {record.id}: its pose in odom holds NaN or infinity")


def _check_start(record: KeyframeRecord, start_t_ns: int | None) -> None:
    if start_t_ns is not None and abs(record.t_ns - start_t_ns) > _START_SLACK_NS:
        raise DataError(
            f"keyframe 0 at {record.t_ns} ns: the initial state is of {start_t_ns} ns; "
            "give the state at the time of keyframe 0"
        )


def _motion_to(k: int, poses: Array) -> Array:
    """Return the motion [4, 4] to keyframe k from the one before."""
    return invert(poses[k - 1]) @ poses[k]


def _in_units(covariance: Covariance, key: int, own: list[int], units: Array) -> Array | None:
    """Return the joint covariance of a pose and own variables, by their keys, in their units; None: there is none."""
    joint = covariance([key, *own]) if own else None
    scale = np.append(np.ones(6), units)
    return None if joint is None else joint * np.outer(scale, scale)
