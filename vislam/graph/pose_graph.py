"""PoseGraph: keyframes, odometry and loops in one iSAM2 graph, whose sole owner it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vislam.camera import Rig
from vislam.config import GraphConfig, WindowConfig
from vislam.errors import DataError, UsageError
from vislam.factors.anchors import Anchors
from vislam.factors.builder import Step
from vislam.factors.consensus import Consensus, Verdict
from vislam.factors.estimator import Estimator
from vislam.factors.gate import CarPark, EdgeReport
from vislam.factors.journal import (
    KeyframeRecord,
    LoopRecord,
    Record,
    StartRecord,
    keyframe_record,
    loop_record,
    start_record,
)
from vislam.factors.keys import X
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.factors.travel import Travel
from vislam.geometry import invert, se3_adjoint
from vislam.graph.joining import Placement, Waiting, relinked, weak_link
from vislam.graph.restore import edge_report, restored_journal, sort_loops
from vislam.graph.source import MotionSource, Source, WindowSource
from vislam.imu import ImuNoise
from vislam.memory import GraphMemory, GraphNews, LoopPlace, LoopState, Tied, WindowRecord
from vislam.messages import Array, GraphUpdate, KeyframePacket, LoopDecision, LoopEdge, NavState, Pieces

_START_SLACK_NS = 20_000_000  # the initial state must belong to keyframe 0
_FITS = 0.1  # weight above which one step under the kernel does, and what is left follows with the next keyframes
_UNKNOWN = (1.0, 1e4)  # variances in rad^2 and m^2 of the motion to a new piece: no loop may be tested against it
_NEAR_KEYFRAMES = 10  # between which summed odometry bounds what is known well enough


class PoseGraph:
    """The back end: `initialise`, then `add` each keyframe packet with its loop edges, then `finish`.

    Coupling `loose`: motions of visual odometry and preintegrated IMU are its factors. Coupling `tight`: a sliding
    window optimises tracks and IMU of the newest keyframes, and its edges and tilts are the factors of poses alone.
    Bad input raises DataError before anything is touched. Whatever gtsam does, `add` returns an update; its note says
    what happened when a plain one was not possible. Lost vision, IMU outages and refused loops are values.
    """

    def __init__(
        self, config: GraphConfig, noise: ImuNoise | None, gravity_m_s2: float, rig: Rig, window: WindowConfig
    ) -> None:
        """Set up for a rig; without `noise` there is no IMU and only poses are estimated."""
        self._config = config
        self._noise = noise
        self._lever_m = np.array(rig.T_body_cams[0][:3, 3], dtype=np.float64)
        self._source: Source
        if config.coupling == "tight":
            from vislam.window import SlidingWindow  # compiles a good deal, which loose coupling need not wait for

            self._source = WindowSource(config, SlidingWindow(window, rig, noise, gravity_m_s2))
        else:
            self._source = MotionSource(config, noise, gravity_m_s2, self._lever_m)
        self._estimator: Estimator[LoopModel] = Estimator(config, self._source.odometry)
        self._start: StartRecord | None = None
        self._start_t_ns: int | None = None
        self._journal: list[Record] = []
        self._keyframes: list[KeyframeRecord] = []
        self._travel = Travel()
        self._park = CarPark(config)
        self._consensus = Consensus(config)
        self._beyond_help: set[int] = set()  # loops that a review brought in and the graph contradicted
        self._anchors = Anchors(config)
        self._reports: dict[int, EdgeReport] = {}
        self._pieces = Pieces()
        self._waiting = Waiting(config)
        self._T_odom_last: Array | None = None
        self._changed: dict[int, None] = {}  # ids of reports since `take_news`
        self._said: WindowRecord | None = None
        self._newest: NavState | None = None
        self._published: Array = np.zeros((0, 4, 4))
        self._T_map_odom: Array = np.eye(4)
        self._revision = 0

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

        Then `T_map_body` [4, 4] says where keyframe 0 is put, by default at the identity.
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
        """Prepare for another recording after the keyframes that are there: its first keyframe begins a new piece.

        `state` is that of this keyframe, or None without an IMU; `T_odom_body` [4, 4] its pose in the new odom, whose
        axes are those of map until loops say otherwise. Raises as `initialise`.
        """
        if self._config.coupling != "tight":
            raise UsageError("a map is continued with tight coupling only; use --graph.coupling tight")
        start = start_record(state, T_odom_body)
        self._source.begin_piece(start, state)
        self._T_odom_last = self._estimator.poses[-1].copy()

    def hold(self, count: int | None = None) -> None:
        """Hold the first keyframes, by default all there are, where they are: the map of what comes does not change."""
        self._estimator.hold(self.ids[:count])

    def restore(self, memory: GraphMemory) -> GraphUpdate:
        """Take over the keyframes, loops and last estimate of an earlier run; return all poses.

        `initialise` comes before, with the first state of that run, and `go_on` or a new piece after.
        Raises DataError, and the graph cannot be used, when the memory contradicts itself.
        """
        if self._start is None or self._keyframes:
            raise UsageError("a graph is restored once, after initialise(...) and before the first keyframe")
        has_gravity = self._noise is not None
        self._keyframes, self._journal = restored_journal(memory, self._config, has_gravity, self._start)
        guesses = self._source.restore(self._keyframes, memory)
        for k in [record.id for record in self._keyframes if record.begins_piece]:
            self._pieces = self._pieces.begun(k)
            self._source.relink(k, invert(memory.T_map_body[k - 1]) @ memory.T_map_body[k])
        models = [LoopModel(r, self._config, self._lever_m) for r in self._journal if isinstance(r, LoopRecord)]
        by_place = sort_loops(memory.loops, {m.id: m for m in models})
        steps, note = self._estimator.restore(
            guesses, by_place[LoopPlace.GRAPH], by_place[LoopPlace.SPARE], memory.vo_scale
        )
        poses = self._estimator.poses
        for record, step in zip(self._keyframes[1:], steps, strict=True):
            T_map_before = memory.T_map_body[record.id - 1]
            self._travel.append(*_variances(record, step), invert(T_map_before) @ step.guess.T_map_body)
        for tied in memory.ties:
            self._anchors.tie(tied)
        for model in by_place[LoopPlace.PARKED]:
            self._park.park(model)
        apart = {model.id for place in (LoopPlace.WAITING, LoopPlace.UNDONE) for model in by_place[place]}
        for model in (m for m in models if m.id not in apart):
            self._consensus.offer(model, model.id not in self._held, self._travel)
        for model in by_place[LoopPlace.WAITING]:
            self._waiting.add(model)
        self._count_joined()
        self._reports = {loop.state.id: edge_report(loop) for loop in memory.loops}
        self._revision, self._T_odom_last = memory.revision, memory.T_odom_body
        self._T_map_odom = poses[-1] @ invert(memory.T_odom_body)
        update = self._publish([], [], note, everything=True)
        self.take_news()
        return update

    def go_on(self, packet: KeyframePacket, T_odom_body: Array | None = None) -> None:
        """Begin anew at the newest keyframe of `restore`, seen again: its packet, without inertial data."""
        if not self._keyframes or packet.keyframe.id != self._keyframes[-1].id:
            raise UsageError(f"keyframe {packet.keyframe.id} is not the newest of the graph")
        self._source.go_on(packet, self._estimator.poses[-1], T_odom_body)

    def take_news(self) -> GraphNews:
        """Return what `restore` will need of the last keyframe, beside what was measured and the poses."""
        apart = {model.record.id: LoopPlace.PARKED for model in self._park.edges}
        apart |= {model.record.id: LoopPlace.WAITING for model in self._waiting.edges}
        loops = tuple(self._loop_state(n, apart) for n in self._changed)
        self._changed = {}
        states = self._source.take_states(self._newest)
        return GraphNews(self._said, states, loops, self._anchors.take_news(), self._estimator.vo_scale)

    def _loop_state(self, loop_id: int, apart: dict[int, LoopPlace]) -> LoopState:
        report, estimator = self._reports[loop_id], self._estimator
        place, tie = apart.get(loop_id, LoopPlace.OUT), None
        if loop_id in estimator.loops:
            place, tie = LoopPlace.GRAPH, estimator.loops[loop_id].tie
        elif loop_id in estimator.spare:
            place = LoopPlace.SPARE
        return LoopState(loop_id, report.decision, report.reason, report.chi2, place, tie)

    def add(
        self, packet: KeyframePacket, edges: Sequence[LoopEdge] = (), T_odom_body: Array | None = None
    ) -> GraphUpdate:
        """Add a keyframe and the loop edges that ended with it; return what changed.

        `T_odom_body` [4, 4] is the keyframe's pose in odom, from which T_map_odom follows; without it the last stays.
        Raises DataError, and changes nothing, on a packet that cannot be used.
        """
        if self._start is None:
            raise UsageError("the graph needs initialise(...) before the first keyframe")
        previous = self._keyframes[-1] if self._keyframes else None
        record = keyframe_record(packet, previous)
        if T_odom_body is not None and not np.all(np.isfinite(T_odom_body)):
            raise DataError(f"keyframe {record.id}: its pose in odom holds NaN or infinity")
        if previous is None:
            self._check_start(record)
        elif record.begins_piece:
            before, config = self._estimator.poses[-1], self._config
            record = weak_link(record, before, self._T_odom_last, T_odom_body, self._noise is not None, config)
        said = self._source.add(packet, record, T_odom_body)
        if self._config.coupling == "tight":
            record = replace(record, imu=None)  # the window has summarised it, and no rebuild asks for it
        self._said = said[-1] if said else None
        self._journal += [self._start, record, *said] if previous is None else [record, *said]
        if previous is None:
            notes = [self._estimator.begin()]
        else:
            step, note = self._estimator.extend()
            self._travel.append(*_variances(record, step), self._motion(record.id))
            for older, variance_rad2, variance_m2 in self._source.amended(self._estimator.vo_scale):
                self._travel.amend(older, variance_rad2, variance_m2, self._motion(older))
            notes = [step.note, note]
        self._keyframes.append(record)
        if record.begins_piece:
            self._pieces = self._pieces.begun(record.id)
            notes.append(f"keyframe {record.id} begins piece {len(self._pieces.groups) - 1} of the trajectory")
        self._T_odom_last = T_odom_body
        accepted, refused = self._close(edges, notes)
        if T_odom_body is not None:
            self._T_map_odom = self._estimator.poses[-1] @ invert(np.ascontiguousarray(T_odom_body, dtype=np.float64))
        return self._publish(accepted, refused, "; ".join(n for n in notes if n))

    def finish(self) -> GraphUpdate:
        """Iterate to convergence and return all poses; the note tells the cost and how it was reached."""
        if not self._keyframes:
            return GraphUpdate(self._revision, np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.eye(4), None)
        before = self._estimator.poses[-1].copy()
        notes: list[str] = []
        self._look_for_doubts()
        verdict = self._consensus.finish(self._travel, self._scale_left, self._held)
        decided = [] if verdict is None else self._apply(verdict, notes)
        notes.append(self._estimator.converge())
        self._T_map_odom = self._estimator.poses[-1] @ invert(before) @ self._T_map_odom
        return self._publish(*self._split(decided), "; ".join(n for n in notes if n), everything=True)

    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4] of all keyframes, each as it was last read back from the solver."""
        return self._estimator.poses.copy()

    def states(self) -> list[NavState]:
        """Return the state of each keyframe with its marginal covariance, NaN where gtsam cannot give one."""
        return [self._state(k) for k in range(len(self._keyframes))]

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j, perturbed at j; from summed odometry where gtsam cannot give it."""
        joint = self._estimator.joint_covariance([X(i), X(j)])
        if joint is None:
            return self._travel.relative_covariance(i, j)
        return relative_covariance(self._estimator.poses[i], self._estimator.poses[j], joint)

    def edge_reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop, by loop id, with the weight it has now."""
        out = []
        for loop_id in sorted(self._reports):
            edge = self._estimator.loops.get(loop_id)
            weight = 0.0 if edge is None else edge.weight(*self._ends(edge))
            out.append(replace(self._reports[loop_id], weight=weight))
        return out

    def _check_start(self, record: KeyframeRecord) -> None:
        if self._start_t_ns is not None and abs(record.t_ns - self._start_t_ns) > _START_SLACK_NS:
            raise DataError(
                f"keyframe 0 at {record.t_ns} ns: the initial state is of {self._start_t_ns} ns; "
                "give the state at the time of keyframe 0"
            )

    def _motion(self, k: int) -> Array:
        """Return the motion [4, 4] to keyframe k from the one before."""
        return invert(self._estimator.poses[k - 1]) @ self._estimator.poses[k]

    @property
    def _scale_left(self) -> float:
        """Return by how much the sigmas of odometry may still be inflated."""
        return self._config.vo_scale_max / self._estimator.vo_scale

    @property
    def _held(self) -> set[int]:
        """Return the ids of the loops that the graph holds, with a factor or in spare."""
        return self._estimator.loops.keys() | self._estimator.spare.keys()

    def _ends(self, edge: LoopModel) -> tuple[Array, Array]:
        poses = self._estimator.poses
        return poses[edge.record.from_id], poses[edge.record.to_id]

    def _close(self, edges: Sequence[LoopEdge], notes: list[str]) -> tuple[list[int], list[int]]:
        """Gate loops, accept or park them, and let the review work; return accepted and refused ids."""
        passed: list[LoopModel] = []
        parked: list[LoopModel] = []
        touched: list[int] = []
        self._estimator.look_at([k for e in edges for k in (e.from_id, e.to_id) if 0 <= k < len(self._keyframes)])
        for edge in edges:
            model = self._admit(edge)
            touched.append(edge.id)
            if model is None:
                continue
            if not self._pieces.are_joined(edge.from_id, edge.to_id):
                touched += self._wait(model)
            else:
                (passed if self._test(model) else parked).append(model)
        for model in self._join(touched, notes):
            (passed if self._test(model) else parked).append(model)
        if passed:
            parked += self._accept(passed, notes, "inside the gate")
        for model in parked:
            evicted = self._park.park(model)
            if evicted is not None:
                self._report(evicted, LoopDecision.REJECTED, "left the full car park")
                touched.append(evicted.record.id)
        if self._consensus.is_due:
            self._look_for_doubts()
        verdict = self._consensus.step(self._travel, self._scale_left, self._held)
        if verdict is not None:
            touched += self._apply(verdict, notes)
        return self._split(touched)

    def _split(self, touched: list[int]) -> tuple[list[int], list[int]]:
        """Return the ids of accepted and of refused loops among those about which something was decided."""
        decided = sorted(set(touched))
        accepted = [n for n in decided if self._reports[n].decision is LoopDecision.ACCEPTED]
        return accepted, [n for n in decided if n not in accepted]

    def _wait(self, model: LoopModel) -> list[int]:
        """Let a loop between pieces that are not joined wait for other frames; return the ids of those that left."""
        record = model.record
        reason = "between pieces that are not joined, waits for loops of other frames that agree"
        ends = record.from_id, record.to_id
        self._set_report(EdgeReport(record.id, *ends, float("nan"), 0.0, LoopDecision.PARKED, reason))
        gone = self._waiting.add(model)
        if gone is None:
            return []
        self._report(gone, LoopDecision.REJECTED, "too many newer ones wait")
        return [gone.record.id]

    def _join(self, touched: list[int], notes: list[str]) -> list[LoopModel]:
        """Join pieces as far as loops between them agree; return those that waited and can be gated now."""
        while (found := self._waiting.place(self._pieces, self._estimator.poses, self._between)) is not None:
            touched += [m.record.id for m in found.agreeing]
            self._bring(found, notes)
            witnesses = f"{len(found.agreeing)} loops of {len({m.record.to_id for m in found.agreeing})} frames"
            for model in self._accept(found.agreeing, notes, f"joins two pieces, as {witnesses} say"):
                self._report(model, LoopDecision.REJECTED, "though it was to join two pieces")
            for model in found.agreeing:
                self._consensus.offer(model, False, self._travel)
            kept = [m for m in found.agreeing if m.record.id in self._estimator.loops]
            if len({m.record.to_id for m in kept}) < self._config.join_frames:
                for model in kept:
                    self._report(model, LoopDecision.REJECTED, "its witnesses against one another do not hold")
                notes.append(self._estimator.drop(kept))
            self._count_joined()
        ready = self._waiting.take_joined(self._pieces)
        touched += [m.record.id for m in ready]
        return ready

    def _bring(self, found: Placement, notes: list[str]) -> None:
        """Move a group of pieces to where loops say that it is, with the weak links that it has to others."""
        ids = self.ids[self._pieces.groups_of(self.ids) == found.group]
        self._estimator.look_at(self.ids.tolist())
        poses = self._estimator.poses.copy()
        poses[ids] = found.T_map_moved @ poses[ids]
        for k in relinked(self._pieces, ids):
            self._source.relink(k, invert(poses[k - 1]) @ poses[k])
        notes.append(self._estimator.move(ids, found.T_map_moved))
        notes.append(
            f"piece {found.group}, {len(ids)} keyframes with what it was joined with before, joins an older one"
        )

    def _count_joined(self) -> None:
        """Find out which pieces are joined, by the loops that the graph holds now."""
        if len(self._pieces.groups) > 1:
            held = [*self._estimator.loops.values(), *self._estimator.spare.values()]
            self._pieces = self._pieces.joined_by((m.record.from_id, m.record.to_id) for m in held)

    def _between(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j: by summed odometry, an upper bound, where that is short."""
        if abs(i - j) <= _NEAR_KEYFRAMES and self._pieces.of(i) == self._pieces.of(j):
            return self._travel.relative_covariance(i, j)
        return self.relative_covariance(i, j)

    def _admit(self, edge: LoopEdge) -> LoopModel | None:
        """Journal an edge; one that cannot be used is reported as rejected, not raised."""
        try:
            if edge.id in self._reports:
                raise DataError(f"loop {edge.id}: its id was used before")
            record = loop_record(edge, len(self._keyframes) - 1)
        except DataError as error:
            bad = EdgeReport(
                edge.id, edge.from_id, edge.to_id, float("nan"), 0.0, LoopDecision.REJECTED, str(error)
            )  # fmt: skip
            if edge.id not in self._reports:
                self._set_report(bad)
            return None
        self._journal.append(record)
        return LoopModel(record, self._config, self._lever_m)

    def _test(self, model: LoopModel) -> bool:
        """Test an edge against the current estimate, and give it to the next review."""
        inside = self._gate(model)
        self._consensus.offer(model, not inside, self._travel)
        return inside

    def _gate(self, model: LoopModel) -> bool:
        """Test an edge against the current estimate and note the chi-square.

        On long runs one that passes, and of whose relative pose the graph is as sure as the loop, is kept in spare.
        """
        record = model.record
        to_anchor = self._tie(model)
        if model.tie is None or to_anchor is None:
            known = self.relative_covariance(record.from_id, record.to_id)
        else:  # an upper bound, as if the two ways shared nothing
            T_map_older, T_map_newer = self._ends(model)
            carry = se3_adjoint(invert(T_map_newer) @ T_map_older)
            known = self.relative_covariance(model.tie.from_id, record.to_id) + carry @ to_anchor @ carry.T
        chi2 = model.chi2(*self._ends(model), known)
        inside = bool(chi2 <= model.threshold)
        decision = LoopDecision.ACCEPTED if inside else LoopDecision.PARKED
        reason = f"chi2 {chi2:.1f} {'within' if inside else 'beyond'} {model.threshold:.1f}"
        self._set_report(EdgeReport(record.id, record.from_id, record.to_id, chi2, 0.0, decision, reason))
        gain = model.gain(known)
        if inside and self._estimator.is_long and gain < self._config.loop_gain_min:
            self._estimator.spare[record.id] = model
            self._report(model, decision, f"redundant, the graph has {gain:.2f} times its variance")
        return inside

    def _report(self, model: LoopModel, decision: LoopDecision, reason: str) -> None:
        old = self._reports[model.record.id]
        self._set_report(replace(old, decision=decision, reason=f"{old.reason}; {reason}"))

    def _set_report(self, report: EdgeReport) -> None:
        self._reports[report.loop_id] = report
        self._changed[report.loop_id] = None

    def _accept(self, fresh: list[LoopModel], notes: list[str], reason: str) -> list[LoopModel]:
        """Put loops into the graph, take out again and return those that the optimised graph contradicts."""
        fresh = [m for m in fresh if m.record.id not in self._estimator.spare]
        if not fresh:
            return []
        far = any(self._is_far(m) for m in fresh)
        fits = not far and all(m.weight(*self._ends(m)) >= _FITS for m in fresh)
        notes.append(self._estimator.close(fresh, batch=far, gentle=fits and self._estimator.is_long))
        contradicted = self._judge(fresh, reason)
        if contradicted:
            notes.append(self._estimator.drop(contradicted))
        return contradicted

    def _judge(self, fresh: list[LoopModel], reason: str, reviewed: bool = False) -> list[LoopModel]:
        """Report on loops that were put into the graph; return those that the optimised graph contradicts."""
        contradicted = []
        for model in fresh:
            if model.record.id not in self._estimator.loops:
                self._report(model, LoopDecision.REJECTED, "the solver refused it")
            elif self._is_torn(model):
                contradicted.append(model)
                decision = LoopDecision.REJECTED if reviewed else LoopDecision.PARKED
                weight = model.weight(*self._ends(model))
                self._report(model, decision, f"contradicted by the graph, weight {weight:.3f}")
            else:
                way = "" if model.tie is None else f", by way of keyframe {model.tie.from_id}"
                self._report(model, LoopDecision.ACCEPTED, reason + way)
                self._remember(model)
        return contradicted

    def _is_torn(self, model: LoopModel) -> bool:
        """Return whether the graph contradicts a loop that is in it."""
        return model.weight(*self._ends(model)) < self._config.loop_min_weight

    def _remember(self, model: LoopModel) -> None:
        """Take note of which anchor an accepted loop ties its newer end to."""
        older, newer = model.record.from_id, model.record.to_id
        if not model.record.has_scale:
            return
        anchor = self._anchors.of(older) if model.tie is None else model.tie.from_id
        if anchor == older:
            self._anchors.tie(Tied(older, older, np.zeros((6, 6))))
        self._anchors.tie(Tied(newer, anchor, self.relative_covariance(anchor, newer)))

    def _tie(self, model: LoopModel) -> Array | None:
        """Where loops are many, let an anchor stand for the older end; return the covariance [6, 6] of T_anchor_older.

        Otherwise each visit of a place would tie to all others, and the work of an update would grow with their number.
        What was known when the older end was tied does mostly; an exact marginal takes long where loops are many.
        """
        model.tie = None
        older = model.record.from_id
        near = self._anchors.near(older) if len(self._estimator.loops) >= self._config.anchor_after else None
        if near is None or near.anchor_id in (older, model.record.to_id):
            return None
        anchor = near.anchor_id
        self._estimator.look_at([anchor, near.id])
        T_map_anchor, T_map_near, T_map_older = (self._estimator.poses[k] for k in (anchor, near.id, older))
        carry = se3_adjoint(invert(T_map_older) @ T_map_near)
        covariance = carry @ near.covariance @ carry.T
        if near.id != older:
            covariance += self._travel.relative_covariance(near.id, older)
        if not model.tie_to(anchor, invert(T_map_anchor) @ T_map_older, covariance):
            covariance = self.relative_covariance(anchor, older)
            model.tie_to(anchor, invert(T_map_anchor) @ T_map_older, covariance)
        return None if model.tie is None else covariance

    def _is_far(self, model: LoopModel) -> bool:
        """Return whether a loop asks for a correction beyond what incremental steps should try."""
        residual, _ = model.residual(*self._ends(model))
        turn = float(np.linalg.norm(residual[:3])) > np.deg2rad(self._config.loop_batch_deg)
        return turn or (model.record.has_scale and float(np.linalg.norm(residual[3:])) > self._config.loop_batch_m)

    def _apply(self, verdict: Verdict, notes: list[str]) -> list[int]:
        """Do as a review of all loops says; return the ids about which it decided something else than before."""
        estimator, newest, held = self._estimator, len(self._keyframes) - 1, self._held
        out = [m for m, _ in verdict.put_out if m.id in held]
        back = [m for m in verdict.let_in if m.id not in held and m.id not in self._beyond_help]
        for model, chi2 in verdict.put_out:
            if model.id in held:
                estimator.spare.pop(model.id, None)
                says = f"{verdict.places} places say otherwise, chi2 {chi2:.1f}"
                self._report(model, LoopDecision.REJECTED, f"taken out again at keyframe {newest}: {says}")
        if verdict.scale > 1.0 and back:  # several witnesses against the odometry say that it knows less than it says
            estimator.distrust_odometry(verdict.scale)
            self._travel.scale(verdict.scale)
        self._park.remove(back)
        self._rebuild(out, back, notes)
        torn = self._judge(back, f"let in at keyframe {newest}: it agrees with {verdict.places} places", True)
        self._beyond_help |= {m.id for m in torn}
        if torn:
            notes.append(estimator.drop(torn))
        return [m.id for m in (*out, *back)]

    def _look_for_doubts(self) -> None:
        """Tell the next review if loops that were let in do not fit any more: the kernel keeps them without a say."""
        if any(m.chi2(*self._ends(m)) > m.threshold for m in self._estimator.loops.values()):
            self._consensus.doubt()

    def _rebuild(self, out: list[LoopModel], back: list[LoopModel], notes: list[str]) -> None:
        """Take loops out of the graph and others into it.

        Where one is out, places may have been tied together that are not the same: all loops are as measured again.
        """
        estimator = self._estimator
        tied = [m for m in (*estimator.loops.values(), *back) if m.tie is not None]
        for model in tied if out or back else []:
            model.tie = None
            self._changed[model.id] = None
        if out:
            self._anchors.forget()
        held = [m for m in out if m.id in estimator.loops]
        if back or (held and tied):
            notes.append(estimator.revise(held, back))
        elif held:
            notes.append(estimator.drop(held))

    def _state(self, k: int) -> NavState:
        return self._source.state(k, self._keyframes[k].t_ns, self._estimator)

    def _publish(self, accepted: list[int], refused: list[int], note: str, everything: bool = False) -> GraphUpdate:
        """Return the poses that moved since they were last published, and remember them."""
        self._count_joined()
        poses, known = self._estimator.poses, self._published
        ids = self._estimator.take_read()
        if everything:
            ids = self.ids
        grown = len(poses) - len(known)
        if grown > 0:
            known = np.concatenate([known, np.full((grown + len(poses) // 2, 4, 4), np.inf)])
        fresh, old = poses[ids], known[ids]
        shift = np.linalg.norm(fresh[:, :3, 3] - old[:, :3, 3], axis=1)
        chord = np.linalg.norm(fresh[:, :3, :3] - old[:, :3, :3], axis=(1, 2))  # 2 sqrt(2) sin(angle / 2)
        limit = 2.0 * np.sqrt(2.0) * np.sin(0.5 * np.deg2rad(self._config.moved_deg))
        moved = ids[(shift > self._config.moved_m) | (chord > limit) | everything]
        known[moved] = poses[moved]
        self._published = known
        self._revision += 1
        newest = self._newest = self._state(len(poses) - 1) if self._noise is not None else None
        details = {
            "solver": self._estimator.solver_name,
            "parked": len(self._park.edges),
            "vo_scale": self._estimator.vo_scale,
            **self._source.details,
        }
        return GraphUpdate(
            self._revision,
            moved,
            poses[moved],
            self._T_map_odom,
            newest,
            tuple(accepted),
            tuple(refused),
            note,
            details,
            self._pieces,
        )


def _variances(record: KeyframeRecord, step: Step) -> tuple[float, float]:
    """Return the variances in rad^2 and m^2 of the motion to a keyframe."""
    return _UNKNOWN if record.begins_piece else (step.variance_rad2, step.variance_m2)
