"""The loops of a graph: tested, kept pending, let in, reviewed and taken out, each with a report that says why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vislam.config import GraphConfig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.memory import EdgeReport, LoopPlace, LoopState, OfferedLoop, Tied
from vislam.core.messages import Array, LoopDecision, LoopEdge
from vislam.factors.journal import loop_record
from vislam.factors.keys import X
from vislam.factors.loop import LOOP_MIN_WEIGHT, LoopModel, relative_covariance
from vislam.graph.belief.anchors import Anchors
from vislam.graph.belief.consensus import Consensus, Verdict
from vislam.graph.belief.gate import PendingLoops
from vislam.graph.belief.known import Known, worth_a_factor
from vislam.graph.estimator import Estimator
from vislam.graph.segments import Segment, segments
from vislam.graph.travel import Travel

_LOOP_BATCH_M = 1.0  # a larger correction starts from a batch solution instead of incremental steps
_LOOP_BATCH_DEG = 10.0
_ANCHOR_VARIANCE_MAX = 4.0  # times a loop's own variance: most that the way to its anchor may add
_VO_SCALE_MAX = 10.0  # most that loops may inflate the sigma of visual odometry, over a run
_DOUBTS = 100  # loops that are looked at again when a review is due
_FITS = 0.1  # weight above which one step under the kernel does, and what is left follows with the next keyframes


class LoopSet:
    """Decides which loops the estimator holds. Keyframes and odometry are the caller's, with the same estimator.

    A loop is tested against the estimate, kept pending where it does not fit, and weighed with all others now and
    then: what several witnesses say against one brings it in or puts it out.
    """

    def __init__(self, config: GraphConfig, lever_m: Array, estimator: Estimator[LoopModel], travel: Travel) -> None:
        """Start without loops; `travel` is the odometry between the estimator's keyframes."""
        self._config = config
        self._lever_m = lever_m
        self._estimator = estimator
        self._travel = travel
        self._pending = PendingLoops(config)
        self._consensus = Consensus(config)
        self._beyond_help: set[int] = set()  # loops that a review brought in and the graph contradicted
        self._anchors = Anchors()
        self._next_freeze = 0  # keyframe with which to look again for a segment to sum up
        self._next_doubt = 0  # where the next block of loops begins that are looked at again
        self._reports: dict[int, EdgeReport] = {}
        self._changed: dict[int, None] = {}  # ids of reports since `take_states`

    @property
    def pending(self) -> int:
        """Return how many loops are pending."""
        return len(self._pending.edges)

    @property
    def held(self) -> list[LoopModel]:
        """Return the loops that the graph holds, with a factor or in spare."""
        return [*self._estimator.loops.values(), *self._estimator.spare.values()]

    def reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop, by loop id, with the weight it has now."""
        out = []
        for loop_id in sorted(self._reports):
            edge = self._estimator.loops.get(loop_id)
            weight = 0.0 if edge is None else edge.weight(*self._ends(edge))
            out.append(replace(self._reports[loop_id], weight=weight))
        return out

    def take_states(self, waiting: Sequence[LoopModel]) -> tuple[LoopState, ...]:
        """Return where the loops are now that were decided about since the last call; some wait elsewhere."""
        apart = {model.record.id: LoopPlace.PENDING for model in self._pending.edges}
        apart |= {model.record.id: LoopPlace.WAITING for model in waiting}
        states = tuple(self._loop_state(n, apart) for n in self._changed)
        self._changed = {}
        return states

    def take_ties(self) -> tuple[Tied, ...]:
        """Return what became known of anchors since the last call."""
        return self._anchors.take_record()

    def restore(
        self, models: Sequence[LoopModel], by_place: dict[LoopPlace, list[LoopModel]], ties: Sequence[Tied]
    ) -> None:
        """Take over the loops of an earlier run; the estimator has those that it held."""
        for tied in ties:
            self._anchors.tie(tied)
        for model in by_place[LoopPlace.PENDING]:
            self._pending.add(model)
        apart = {model.id for place in (LoopPlace.WAITING, LoopPlace.UNDONE) for model in by_place[place]}
        for model in (m for m in models if m.id not in apart):
            self._consensus.offer(model, not self._hold(model.id), self._travel)

    def restore_reports(self, loops: Sequence[OfferedLoop]) -> None:
        """Take over what was reported of the loops of an earlier run."""
        self._reports = {loop.state.id: edge_report(loop) for loop in loops}

    def admit(self, edge: LoopEdge, newest_id: int) -> LoopModel | None:
        """Return an edge as the graph takes it; one that cannot be used is reported as rejected, not raised."""
        try:
            if edge.id in self._reports:
                raise DataError(f"loop {edge.id}: its id was used before")
            record = loop_record(edge, newest_id)
        except DataError as error:
            bad = EdgeReport(
                edge.id, edge.from_id, edge.to_id, float("nan"), 0.0, LoopDecision.REJECTED, str(error)
            )  # fmt: skip
            if edge.id not in self._reports:
                self._set_report(bad)
            return None
        return LoopModel(record, self._config, self._lever_m)

    def wait(self, model: LoopModel) -> None:
        """Report that a loop waits for others, outside of this set."""
        record = model.record
        reason = "between submaps that are not joined, waits for loops of other frames that agree"
        ends = record.from_id, record.to_id
        self._set_report(EdgeReport(record.id, *ends, float("nan"), 0.0, LoopDecision.PENDING, reason))

    def offer(self, model: LoopModel) -> None:
        """Give a loop that fits to the next review."""
        self._consensus.offer(model, False, self._travel)

    def keep_pending(self, models: Sequence[LoopModel]) -> list[int]:
        """Keep loops pending that do not fit; return the ids of those that had to leave for them."""
        gone = [evicted for model in models if (evicted := self._pending.add(model)) is not None]
        for model in gone:
            self.report(model, LoopDecision.REJECTED, "left the full list of pending loops")
        return [model.record.id for model in gone]

    def freeze(self) -> str:
        """Sum up the oldest segment of keyframes that many loops tie, now and then; return what went wrong."""
        newest = len(self._estimator.poses) - 1
        if newest < self._next_freeze:
            return ""
        segment = self._next_segment()
        if segment is None:
            self._next_freeze = newest + self._config.freeze_keyframes // 4
            return ""
        return self._estimator.freeze(segment)

    def freeze_all(self) -> str:
        """Sum up all old segments at once, as after a restart; return what went wrong."""
        notes: list[str] = []
        while not any(notes) and (segment := self._next_segment()) is not None:
            notes.append(self._estimator.freeze(segment))
        return "; ".join(note for note in notes if note)

    def _next_segment(self) -> Segment | None:
        """Return the oldest segment that can be summed up."""
        config, estimator = self._config, self._estimator
        if not self._are_many:
            return None
        last = len(estimator.poses) - 1 - config.freeze_after
        loops, frozen, pinned = estimator.solved_loops(), estimator.frozen, estimator.pinned
        found = segments(loops, config.freeze_keyframes, last, frozen=frozen, pinned=pinned)
        return next((segment for segment in found if estimator.can_freeze(segment)), None)

    def review(self, notes: list[str]) -> list[int]:
        """Let the review of all loops work for a while; return the ids about which it decided."""
        if self._consensus.is_due:
            self._look_for_doubts()
        verdict = self._consensus.step(self._travel, self._scale_left, self._hold)
        return [] if verdict is None else self._apply(verdict, notes)

    def finish(self, notes: list[str]) -> list[int]:
        """Review all loops to the end; return the ids about which it decided."""
        self._look_for_doubts(everywhere=True)
        verdict = self._consensus.finish(self._travel, self._scale_left, self._hold)
        return [] if verdict is None else self._apply(verdict, notes)

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j, perturbed at j; from summed odometry where gtsam cannot give it."""
        joint = self._estimator.joint_covariance([X(i), X(j)])
        if joint is None:
            return self._travel.relative_covariance(i, j)
        return relative_covariance(self._estimator.poses[i], self._estimator.poses[j], joint)

    def split(self, touched: list[int]) -> tuple[list[int], list[int]]:
        """Return the ids of accepted and of refused loops among those about which something was decided."""
        decided = sorted(set(touched))
        accepted = [n for n in decided if self._reports[n].decision is LoopDecision.ACCEPTED]
        return accepted, [n for n in decided if n not in accepted]

    def test(self, models: Sequence[LoopModel]) -> tuple[list[LoopModel], list[LoopModel]]:
        """Test loops against the current estimate, and give them to the next review.

        Returns those that are to enter the graph and those to be pending. Where loops are many, one that fits and tells
        the graph next to nothing is kept in spare.
        """
        if not models:
            return [], []
        known = self._known(models)
        inside, outside = list[LoopModel](), list[LoopModel]()
        for model in models:
            fits = self._gate(model, known)
            self._consensus.offer(model, not fits, self._travel)
            (inside if fits else outside).append(model)
        if known is None:
            return inside, outside
        worth = self._thinned(inside, known) if self._are_many else inside
        self._remember(worth, known)
        return worth, outside

    def accept(self, fresh: list[LoopModel], notes: list[str], reason: str) -> list[LoopModel]:
        """Put loops into the graph, take out again and return those that the optimised graph contradicts."""
        if not fresh:
            return []
        far = any(self._is_far(m) for m in fresh)
        fits = not far and all(m.weight(*self._ends(m)) >= _FITS for m in fresh)
        notes.append(self._estimator.close(fresh, batch=far, gentle=fits and self._are_many))
        contradicted = self._judge(fresh, reason)
        if contradicted:
            notes.append(self._estimator.drop(contradicted))
        return contradicted

    def report(self, model: LoopModel, decision: LoopDecision, reason: str) -> None:
        """Add a decision and its reason to what was reported of a loop."""
        old = self._reports[model.record.id]
        self._set_report(replace(old, decision=decision, reason=f"{old.reason}; {reason}"))

    @property
    def _scale_left(self) -> float:
        """Return by how much the sigmas of odometry may still be inflated."""
        return _VO_SCALE_MAX / self._estimator.vo_scale

    def _hold(self, loop_id: int) -> bool:
        """Return whether the graph holds a loop, with a factor or in spare."""
        return loop_id in self._estimator.loops or loop_id in self._estimator.spare

    def _ends(self, edge: LoopModel) -> tuple[Array, Array]:
        poses = self._estimator.poses
        return poses[edge.record.from_id], poses[edge.record.to_id]

    def _loop_state(self, loop_id: int, apart: dict[int, LoopPlace]) -> LoopState:
        report, estimator = self._reports[loop_id], self._estimator
        place, tie = apart.get(loop_id, LoopPlace.OUT), None
        if loop_id in estimator.loops:
            place, tie = LoopPlace.GRAPH, estimator.loops[loop_id].tie
        elif loop_id in estimator.spare:
            place = LoopPlace.SPARE
        return LoopState(loop_id, report.decision, report.reason, report.chi2, place, tie)

    @property
    def _are_many(self) -> bool:
        """Return whether there are so many loops that the work of an update has to be kept from growing with them."""
        estimator = self._estimator
        return estimator.is_long or bool(estimator.frozen) or len(estimator.loops) >= self._config.anchor_after

    def _known(self, models: Sequence[LoopModel]) -> Known | None:
        """Return what the graph knows of all ends of loops, and of the anchors near to them: one joint marginal."""
        ends = {k for m in models for k in (m.record.from_id, m.record.to_id)}
        near = [self._anchors.near(m.record.from_id) for m in models]
        ends |= {self._estimator.host(k) for k in ends}
        ids = sorted(ends | {tied.anchor_id for tied in near if tied is not None})
        joint = self._estimator.joint_covariance([X(k) for k in ids])
        if joint is None:
            return None
        self._estimator.look_at(ids)
        return Known({k: self._estimator.poses[k].copy() for k in ids}, joint)

    def _gate(self, model: LoopModel, known: Known | None) -> bool:
        """Test a loop against the current estimate and note the chi-square."""
        record = model.record
        relative = self._travel.relative_covariance if known is None else known.relative
        chi2 = model.chi2(*self._ends(model), relative(record.from_id, record.to_id))
        inside = bool(chi2 <= model.threshold)
        decision = LoopDecision.ACCEPTED if inside else LoopDecision.PENDING
        says, side = ("odometry allows it", "within") if inside else ("odometry speaks against it", "beyond")
        reason = f"{says}: chi2 {chi2:.1f} {side} {model.threshold:.1f}"
        self._set_report(EdgeReport(record.id, record.from_id, record.to_id, chi2, 0.0, decision, reason))
        return inside

    def _set_report(self, report: EdgeReport) -> None:
        self._reports[report.loop_id] = report
        self._changed[report.loop_id] = None

    def _judge(self, fresh: list[LoopModel], reason: str, reviewed: bool = False) -> list[LoopModel]:
        """Report on loops that were put into the graph; return those that the optimised graph contradicts."""
        contradicted = []
        for model in fresh:
            if not self._hold(model.id):
                self.report(model, LoopDecision.REJECTED, "the solver refused it")
            elif self._is_torn(model):
                contradicted.append(model)
                decision = LoopDecision.REJECTED if reviewed else LoopDecision.PENDING
                weight = model.weight(*self._ends(model))
                self.report(model, decision, f"contradicted by the rest of the graph: weight {weight:.3f}")
            else:
                way = "" if model.tie is None else f", by way of keyframe {model.tie.from_id}"
                self.report(model, LoopDecision.ACCEPTED, reason + way)
        return contradicted

    def _is_torn(self, model: LoopModel) -> bool:
        """Return whether the graph contradicts a loop that is in it."""
        return model.weight(*self._ends(model)) < LOOP_MIN_WEIGHT

    def _remember(self, models: Sequence[LoopModel], known: Known) -> None:
        """Take note of which anchor loops tie their newer ends to, and what is known of it before they do."""
        for model in models:
            older, newer = model.record.from_id, model.record.to_id
            anchor = older if model.tie is None else model.tie.from_id
            if anchor == older:
                self._anchors.tie(Tied(older, older, np.zeros((6, 6))))
            self._anchors.tie(Tied(newer, anchor, known.relative(anchor, newer)))

    def _thinned(self, models: Sequence[LoopModel], known: Known) -> list[LoopModel]:
        """Return the loops that are to enter the graph where they are many; what the graph knows already is spare.

        Work grows with the number of pairs that loops tie, so all loops of a keyframe tie to one anchor as far as they
        can, and are judged together: what each of many adds is little, and their sum is not.
        """
        anchors = [self._anchor(model) for model in models]
        often = sorted(anchors, key=lambda k: (-anchors.count(k), k))
        groups: dict[int, list[LoopModel]] = {}
        for model, own in zip(models, anchors, strict=True):
            model.tie = None
            held = next((k for k in (often[0], own) if self._tie(model, k, known)), None)
            held = self._tie_to_host(model, known) if held is None else held
            groups.setdefault(held, []).append(model)
        worth = worth_a_factor([groups[k] for k in sorted(groups)], known, self._config.loop_gain_min)
        chosen = {model.id for group in worth for model in group}
        for model in (m for m in models if m.id not in chosen):
            model.tie = None
            gain = known.gain([model])
            self._estimator.spare[model.id] = model
            self.report(model, LoopDecision.ACCEPTED, f"redundant, it would tell the graph {gain:.2f} nats")
        return [model for group in worth for model in group]

    def _anchor(self, model: LoopModel) -> int:
        """Return the anchor near to a loop's older end; this end where there is none."""
        older, newer = model.record.from_id, model.record.to_id
        near = self._anchors.near(older)
        return older if near is None or near.anchor_id == newer else near.anchor_id

    def _tie(self, model: LoopModel, anchor: int, known: Known) -> bool:
        """Let an anchor stand for the older end of a loop; return whether it does, or is that end itself."""
        older, newer = model.record.from_id, model.record.to_id
        if self._estimator.host(anchor) != anchor:
            return False
        if anchor in (older, newer) or len(self._estimator.loops) < self._config.anchor_after:
            return anchor == older
        T_map_anchor, T_map_older, T_map_newer = (self._estimator.poses[k] for k in (anchor, older, newer))
        T_anchor_older, T_older_newer = invert(T_map_anchor) @ T_map_older, invert(T_map_older) @ T_map_newer
        way = known.relative(anchor, older)
        return model.tie_to(anchor, T_anchor_older, way, T_older_newer, most=_ANCHOR_VARIANCE_MAX)

    def _tie_to_host(self, model: LoopModel, known: Known) -> int:
        """Tie a loop to the keyframe that the solver has for its older end; return it."""
        older, newer = model.record.from_id, model.record.to_id
        host = self._estimator.host(older)
        if host != older:
            T_older_newer = known.motion(older, newer)
            model.tie_to(host, known.motion(host, older), known.relative(host, older), T_older_newer, most=np.inf)
        return host

    def _is_far(self, model: LoopModel) -> bool:
        """Return whether a loop asks for a correction beyond what incremental steps should try."""
        residual, _ = model.residual(*self._ends(model))
        turn = float(np.linalg.norm(residual[:3])) > np.deg2rad(_LOOP_BATCH_DEG)
        return turn or (model.record.has_scale and float(np.linalg.norm(residual[3:])) > _LOOP_BATCH_M)

    def _apply(self, verdict: Verdict, notes: list[str]) -> list[int]:
        """Do as a review of all loops says; return the ids about which it decided something else than before."""
        estimator, newest = self._estimator, len(self._estimator.poses) - 1
        contradicted = [(m, chi2) for m, chi2 in verdict.put_out if self._hold(m.id)]
        out = [m for m, _ in contradicted]
        back = [m for m in verdict.let_in if not self._hold(m.id) and m.id not in self._beyond_help]
        for model, chi2 in contradicted:
            estimator.spare.pop(model.id, None)
            says = f"{verdict.places} place{'s say' if verdict.places > 1 else ' says'} otherwise, chi2 {chi2:.1f}"
            self.report(model, LoopDecision.REJECTED, f"taken out again at keyframe {newest}: {says}")
        if verdict.scale > 1.0 and back:  # several witnesses against the odometry say that it knows less than it says
            estimator.distrust_odometry(verdict.scale)
            self._travel.scale(verdict.scale)
        self._pending.remove(back)
        if out or verdict.scale > 1.0 or not self._let_in(back, notes):
            self._rebuild(out, back, notes)
        torn = self._judge(back, f"let in at keyframe {newest}: it agrees with {verdict.places} places", True)
        self._beyond_help |= {m.id for m in torn}
        if torn:
            notes.append(estimator.drop(torn))
        return [m.id for m in (*out, *back)]

    def _let_in(self, back: list[LoopModel], notes: list[str]) -> bool:
        """Put loops that fit into a solver that old keyframes have left; return False, and do nothing, where none has.

        What ends with a keyframe that left is kept in spare.
        """
        estimator = self._estimator
        if not estimator.frozen or any(m.weight(*self._ends(m)) < _FITS for m in back):
            return False
        known = self._known(back) if back else None
        if known is None:
            return not back
        late = [m for m in back if estimator.host(m.record.to_id) != m.record.to_id]
        fresh = [m for m in back if m not in late]
        for model in fresh:
            self._tie_to_host(model, known)
        estimator.spare |= {model.id: model for model in late}
        notes.append(estimator.close(fresh, batch=False) if fresh else "")
        return True

    def _look_for_doubts(self, everywhere: bool = False) -> None:
        """Tell the next review if loops that were let in do not fit any more: the kernel keeps them without a say.

        Those with and without a factor; a block of them in turn, so that the work does not grow with their number.
        """
        held = self.held
        block = held
        if len(held) > _DOUBTS and not everywhere:
            block = [held[n % len(held)] for n in range(self._next_doubt, self._next_doubt + _DOUBTS)]
            self._next_doubt = (self._next_doubt + _DOUBTS) % len(held)
        if any(m.chi2(*self._ends(m)) > m.threshold for m in block):
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


def edge_report(loop: OfferedLoop) -> EdgeReport:
    """Return what was reported of a loop."""
    state = loop.state
    return EdgeReport(state.id, loop.edge.from_id, loop.edge.to_id, state.chi2, 0.0, state.decision, state.reason)
