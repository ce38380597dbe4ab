"""The loops of a graph: tested, kept pending, let in, reviewed and taken out, each reported with the reason."""

from __future__ import annotations

from collections.abc import Sequence

from vislam.config import GraphConfig
from vislam.core.errors import DataError
from vislam.core.memory import EdgeReport, LoopPlace, LoopState, OfferedLoop, Tied
from vislam.core.messages import Array, LoopDecision, LoopEdge
from vislam.factors.journal import loop_record
from vislam.factors.loop import LoopModel
from vislam.graph.belief.consensus import Consensus, Verdict
from vislam.graph.belief.gate import Anchors, Gate
from vislam.graph.belief.held import HeldLoops, LoopReports
from vislam.graph.belief.known import Known, worth_a_factor
from vislam.graph.estimator import Estimator
from vislam.graph.segments import Segment, segments
from vislam.graph.travel import Travel

_VO_SCALE_MAX = 10.0  # most that loops may inflate the sigma of visual odometry, over a run


class Freezer:
    """Looks now and then for a segment that can be summed up."""

    def __init__(self, config: GraphConfig, estimator: Estimator, held: HeldLoops) -> None:
        """Look at the keyframes and loops of an estimator."""
        self._config = config
        self._estimator = estimator
        self._held = held
        self._next = 0  # keyframe with which to look again

    def step(self) -> str:
        """Sum up the oldest segment of keyframes that many loops tie, now and then; return what went wrong."""
        newest = len(self._estimator.poses) - 1
        if newest < self._next:
            return ""
        segment = self._segment()
        if segment is None:
            self._next = newest + self._config.freeze_keyframes // 4
            return ""
        return self._estimator.freeze(segment)

    def all(self) -> str:
        """Sum up all old segments at once, as after a restart; return what went wrong."""
        notes: list[str] = []
        while not any(notes) and (segment := self._segment()) is not None:
            notes.append(self._estimator.freeze(segment))
        return "; ".join(note for note in notes if note)

    def _segment(self) -> Segment | None:
        """Return the oldest segment that can be summed up."""
        config, estimator = self._config, self._estimator
        if not self._held.are_many:
            return None
        last, summed_up = len(estimator.poses) - 1 - config.freeze_after, estimator.summed_up
        found = segments(
            estimator.solved_loops(), config.freeze_keyframes, last, frozen=summed_up.firsts, pinned=summed_up.pinned
        )
        return next((segment for segment in found if estimator.can_freeze(segment)), None)


class Exchange:
    """Does what a review, or a user, decided about loops; why is reported elsewhere."""

    def __init__(
        self, estimator: Estimator, held: HeldLoops, gate: Gate, anchors: Anchors, ledger: LoopReports
    ) -> None:
        """Exchange the loops of an estimator."""
        self._estimator, self._held, self._gate = estimator, held, gate
        self._anchors, self._ledger = anchors, ledger

    def let_in(self, back: list[LoopModel], notes: list[str]) -> bool:
        """Put loops that fit into a solver that old keyframes have left; return False, and do nothing, where none has.

        What ends with a keyframe that left is kept in spare.
        """
        estimator = self._estimator
        if not estimator.summed_up.firsts or not all(self._held.fits(m) for m in back):
            return False
        known = self._gate.known(back, self._anchors) if back else None
        if known is None:
            return not back
        late = [m for m in back if estimator.summed_up.host(m.record.to_id) != m.record.to_id]
        fresh = [m for m in back if m not in late]
        for model in fresh:
            self._anchors.tie_to_host(model, known)
        estimator.spare |= {model.id: model for model in late}
        notes.append(estimator.close(fresh, batch=False) if fresh else "")
        return True

    def rebuild(self, out: list[LoopModel], back: list[LoopModel], notes: list[str]) -> None:
        """Take loops out of the graph and others into it.

        Where one is out, places may have been tied together that are not the same: all loops are as measured again.
        """
        estimator = self._estimator
        tied = [m for m in (*estimator.loops.values(), *back) if m.tie is not None]
        for model in tied if out or back else []:
            model.tie = None
            self._ledger.touch(model.id)
        if out:
            self._anchors.forget()
        held = [m for m in out if m.id in estimator.loops]
        if back or (held and tied):
            notes.append(estimator.revise(held, back))
        elif held:
            notes.append(estimator.drop(held))


class LoopSet:
    """Decides which loops the estimator holds. Keyframes and odometry are the caller's, with the same estimator.

    A loop is tested against the estimate, kept pending where it does not fit, and weighed with all others now and
    then: what several witnesses say against one brings it in or puts it out.
    """

    def __init__(self, config: GraphConfig, lever_m: Array, estimator: Estimator, travel: Travel) -> None:
        """Start without loops; `travel` is the odometry between the estimator's keyframes."""
        self._config = config
        self._lever_m = lever_m
        self._estimator = estimator
        self._travel = travel
        self._held = HeldLoops(config, estimator)
        self.ledger = LoopReports()
        self.gate = Gate(estimator, travel, self._held, self.ledger)
        self._pending: dict[int, LoopModel] = {}  # that wait outside the gate, by id, oldest first
        self._anchors = Anchors(config, estimator)
        self._exchange = Exchange(estimator, self._held, self.gate, self._anchors, self.ledger)
        self._consensus = Consensus(config)
        self._beyond_help: set[int] = set()  # loops that a review brought in and the graph contradicted
        self.freezer = Freezer(config, estimator, self._held)
        self._undone: set[int] = set()  # loops that the user took out

    @property
    def pending(self) -> int:
        """Return how many loops are pending."""
        return len(self._pending)

    @property
    def held(self) -> list[LoopModel]:
        """Return the loops that the graph holds, with a factor or in spare."""
        return self._held.all()

    def reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop, by loop id, with the weight it has now."""
        loops = self._estimator.loops
        return self.ledger.all(lambda n: self._held.weight(loops[n]) if n in loops else 0.0)

    def take_states(self, waiting: Sequence[LoopModel]) -> tuple[LoopState, ...]:
        """Return where the loops are now that were decided about since the last call; some wait elsewhere."""
        apart = dict.fromkeys(self._pending, LoopPlace.PENDING)
        apart |= {model.record.id: LoopPlace.WAITING for model in waiting}
        apart |= dict.fromkeys(self._undone, LoopPlace.UNDONE)
        return tuple(self._loop_state(n, apart) for n in self.ledger.take_changed())

    def take_ties(self) -> tuple[Tied, ...]:
        """Return what became known of anchors since the last call."""
        return self._anchors.take_record()

    def restore(
        self,
        models: Sequence[LoopModel],
        by_place: dict[LoopPlace, list[LoopModel]],
        ties: Sequence[Tied],
        loops: Sequence[OfferedLoop],
    ) -> None:
        """Take over the loops of an earlier run and what was reported of them; the estimator has those that it held."""
        self.ledger.restore(loops)
        for tied in ties:
            self._anchors.tie(tied)
        self.keep_pending(by_place[LoopPlace.PENDING])
        self._undone = {model.id for model in by_place[LoopPlace.UNDONE]}
        apart = {model.id for place in (LoopPlace.WAITING, LoopPlace.UNDONE) for model in by_place[place]}
        for model in (m for m in models if m.id not in apart):
            self._consensus.offer(model, model.id not in self._held, self._travel)

    def admit(self, edge: LoopEdge, newest_id: int) -> LoopModel | None:
        """Return an edge as the graph takes it; one that cannot be used is reported as rejected, not raised."""
        try:
            if edge.id in self.ledger:
                raise DataError(f"loop {edge.id}: its id was used before")
            record = loop_record(edge, newest_id)
        except DataError as error:
            if edge.id not in self.ledger:
                ends = edge.from_id, edge.to_id
                self.ledger.begin(EdgeReport(edge.id, *ends, float("nan"), 0.0, LoopDecision.REJECTED, str(error)))
            return None
        return LoopModel(record, self._config, self._lever_m)

    def wait(self, model: LoopModel, undecided: str = "") -> None:
        """Report that a loop waits for others, outside of this set; `undecided` is between what, if some agree."""
        record = model.record
        reason = f"between submaps that are not joined, {undecided or 'waits for loops of other frames that agree'}"
        ends = record.from_id, record.to_id
        self.ledger.begin(EdgeReport(record.id, *ends, float("nan"), 0.0, LoopDecision.PENDING, reason))

    def offer(self, model: LoopModel) -> None:
        """Give a loop that fits to the next review."""
        self._consensus.offer(model, False, self._travel)

    def keep_pending(self, models: Sequence[LoopModel]) -> list[int]:
        """Keep loops pending that do not fit; return the ids of those that had to leave for them."""
        gone = []
        for model in models:
            self._pending[model.id] = model
            if len(self._pending) > self._config.pending_max:
                gone.append(self._pending.pop(next(iter(self._pending))))
                self.ledger.add(gone[-1], LoopDecision.REJECTED, "left the full list of pending loops")
        return [model.id for model in gone]

    def undo(self, loop_ids: Sequence[int], notes: list[str]) -> list[int]:
        """Take loops out for good, as far as the graph holds them; return the ids of those."""
        out = [m for m in self.held if m.id in loop_ids]
        for model in out:
            self._estimator.spare.pop(model.id, None)
            self.ledger.add(model, LoopDecision.REJECTED, "undone by the user")
        if out:
            self._undone |= {m.id for m in out}
            self._exchange.rebuild(out, [], notes)
            self._consensus = self._consensus.without(self._undone, self._held.__contains__, self._travel)
        return [m.id for m in out]

    def review(self, notes: list[str]) -> list[int]:
        """Let the review of all loops work for a while; return the ids about which it decided."""
        if self._consensus.is_due and self._held.has_doubts():
            self._consensus.doubt()
        verdict = self._consensus.step(self._travel, self._scale_left, self._held.__contains__)
        return [] if verdict is None else self._apply(verdict, notes)

    def finish(self, notes: list[str]) -> list[int]:
        """Review all loops to the end; return the ids about which it decided."""
        if self._held.has_doubts(everywhere=True):
            self._consensus.doubt()
        verdict = self._consensus.finish(self._travel, self._scale_left, self._held.__contains__)
        return [] if verdict is None else self._apply(verdict, notes)

    def test(self, models: Sequence[LoopModel]) -> tuple[list[LoopModel], list[LoopModel]]:
        """Test loops against the current estimate, and give them to the next review.

        Returns those that are to enter the graph and those to be pending. Where loops are many, one that fits and adds
        little information is kept in spare.
        """
        if not models:
            return [], []
        known = self.gate.known(models, self._anchors)
        inside, outside = list[LoopModel](), list[LoopModel]()
        for model in models:
            fits = self.gate.lets_in(model, known)
            self._consensus.offer(model, not fits, self._travel)
            (inside if fits else outside).append(model)
        if known is None:
            return inside, outside
        worth = self._thinned(inside, known) if self._held.are_many else inside
        self._anchors.remember(worth, known)
        return worth, outside

    def _thinned(self, models: Sequence[LoopModel], known: Known) -> list[LoopModel]:
        """Return the loops that are to enter the graph where they are many; what the graph knows already is spare.

        Work grows with the number of pairs that loops tie, so all loops of a keyframe tie to one anchor as far as they
        can, and are judged together: what each of many adds is little, and their sum is not.
        """
        worth = worth_a_factor(self._anchors.grouped(models, known), known, self._config.loop_gain_min)
        chosen = {model.id for group in worth for model in group}
        for model in (m for m in models if m.id not in chosen):
            model.tie = None
            gain = known.gain([model])
            self._estimator.spare[model.id] = model
            self.ledger.add(model, LoopDecision.ACCEPTED, f"redundant, it would tell the graph {gain:.2f} nats")
        return [model for group in worth for model in group]

    def accept(self, fresh: list[LoopModel], notes: list[str], reason: str) -> list[LoopModel]:
        """Put loops into the graph, take out again and return those that the optimised graph contradicts."""
        if not fresh:
            return []
        far = any(self._held.is_far(m) for m in fresh)
        fits = not far and all(self._held.fits(m) for m in fresh)
        notes.append(self._estimator.close(fresh, batch=far, gentle=fits and self._held.are_many))
        contradicted = self._judge(fresh, reason)
        if contradicted:
            notes.append(self._estimator.drop(contradicted))
        return contradicted

    @property
    def _scale_left(self) -> float:
        """Return by how much the sigmas of odometry may still be inflated."""
        return _VO_SCALE_MAX / self._estimator.vo_scale

    def _loop_state(self, loop_id: int, apart: dict[int, LoopPlace]) -> LoopState:
        report, estimator = self.ledger[loop_id], self._estimator
        place, tie = apart.get(loop_id, LoopPlace.OUT), None
        if loop_id in estimator.loops:
            place, tie = LoopPlace.GRAPH, estimator.loops[loop_id].tie
        elif loop_id in estimator.spare:
            place = LoopPlace.SPARE
        return LoopState(loop_id, report.decision, report.reason, report.chi2, place, tie)

    def _judge(self, fresh: list[LoopModel], reason: str, reviewed: bool = False) -> list[LoopModel]:
        """Report on loops that were put into the graph; return those that the optimised graph contradicts."""
        contradicted = []
        for model in fresh:
            if model.id not in self._held:
                self.ledger.add(model, LoopDecision.REJECTED, "the solver refused it")
            elif self._held.is_torn(model):
                contradicted.append(model)
                decision = LoopDecision.REJECTED if reviewed else LoopDecision.PENDING
                weight = self._held.weight(model)
                self.ledger.add(model, decision, f"contradicted by the rest of the graph: weight {weight:.3f}")
            else:
                way = "" if model.tie is None else f", by way of keyframe {model.tie.from_id}"
                self.ledger.add(model, LoopDecision.ACCEPTED, reason + way)
        return contradicted

    def _apply(self, verdict: Verdict, notes: list[str]) -> list[int]:
        """Apply a review of all loops; return the ids about which it decided something else than before."""
        estimator, newest = self._estimator, len(self._estimator.poses) - 1
        contradicted = [(m, chi2) for m, chi2 in verdict.put_out if m.id in self._held]
        out = [m for m, _ in contradicted]
        back = [m for m in verdict.let_in if m.id not in self._held and m.id not in self._beyond_help]
        for model, chi2 in contradicted:
            estimator.spare.pop(model.id, None)
            against = f"{verdict.places} place{'s say' if verdict.places > 1 else ' says'} otherwise, chi2 {chi2:.1f}"
            self.ledger.add(model, LoopDecision.REJECTED, f"taken out again at keyframe {newest}: {against}")
        if verdict.scale > 1.0 and back:  # several witnesses show that odometry's sigmas are too small
            estimator.distrust_odometry(verdict.scale)
            self._travel.scale(verdict.scale)
        for model in back:
            self._pending.pop(model.id, None)
        if out or verdict.scale > 1.0 or not self._exchange.let_in(back, notes):
            self._exchange.rebuild(out, back, notes)
        torn = self._judge(back, f"let in at keyframe {newest}: it agrees with {verdict.places} places", True)
        self._beyond_help |= {m.id for m in torn}
        if torn:
            notes.append(estimator.drop(torn))
        return [m.id for m in (*out, *back)]
