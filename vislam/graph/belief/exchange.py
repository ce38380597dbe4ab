"""Loops into a solver and out of it again, where several change at once."""

from __future__ import annotations

from vislam.factors.loop import LoopModel
from vislam.graph.belief.anchors import Anchors
from vislam.graph.belief.gate import Gate
from vislam.graph.belief.held import HeldLoops
from vislam.graph.belief.reports import LoopReports
from vislam.graph.estimator import Estimator


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
