"""The loops that a graph holds, at its estimate as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from vislam.config import GraphConfig
from vislam.core.memory import EdgeReport, OfferedLoop
from vislam.core.messages import Array, LoopDecision
from vislam.factors.loop import LOOP_MIN_WEIGHT, LoopModel
from vislam.graph.estimator import Estimator

_LOOP_BATCH_M = 1.0  # a larger correction starts from a batch solution instead of incremental steps
_LOOP_BATCH_DEG = 10.0
_FITS = 0.1  # weight
_DOUBTS = 100  # loops that are looked at again when a review is due


class HeldLoops:
    """What a graph holds of loops, with a factor or in spare, and how well they fit it."""

    def __init__(self, config: GraphConfig, estimator: Estimator) -> None:
        """Look at the loops of an estimator."""
        self._config = config
        self._estimator = estimator
        self._next_doubt = 0  # where the next block of loops begins that are looked at again

    def __contains__(self, loop_id: int) -> bool:
        return loop_id in self._estimator.loops or loop_id in self._estimator.spare

    def all(self) -> list[LoopModel]:
        """Return the loops."""
        return [*self._estimator.loops.values(), *self._estimator.spare.values()]

    @property
    def are_many(self) -> bool:
        """Return whether loops are too many for the work of an update to grow with their number."""
        estimator = self._estimator
        are_summed_up = bool(estimator.summed_up.firsts)
        return estimator.is_long or are_summed_up or len(estimator.loops) >= self._config.anchor_after

    def ends(self, loop: LoopModel) -> tuple[Array, Array]:
        """Return the poses [4, 4] of both ends of a loop."""
        poses = self._estimator.poses
        return poses[loop.record.from_id], poses[loop.record.to_id]

    def weight(self, loop: LoopModel) -> float:
        """Return the weight, 0 to 1, that the Cauchy kernel leaves a loop."""
        return loop.weight(*self.ends(loop))

    def fits(self, loop: LoopModel) -> bool:
        """Return whether one step under the kernel brings a loop in; what is left follows with the next keyframes."""
        return self.weight(loop) >= _FITS

    def is_torn(self, loop: LoopModel) -> bool:
        """Return whether the graph contradicts a loop that is in it."""
        return self.weight(loop) < LOOP_MIN_WEIGHT

    def is_far(self, loop: LoopModel) -> bool:
        """Return whether a loop asks for a correction beyond what incremental steps should try."""
        residual, _ = loop.residual(*self.ends(loop))
        turn = float(np.linalg.norm(residual[:3])) > np.deg2rad(_LOOP_BATCH_DEG)
        return turn or (loop.record.has_scale and float(np.linalg.norm(residual[3:])) > _LOOP_BATCH_M)

    def has_doubts(self, everywhere: bool = False) -> bool:
        """Return whether loops that were let in do not fit any more: the kernel keeps them without a say.

        Those with and without a factor; a block of them in turn, so that the work does not grow with their number.
        """
        block = held = self.all()
        if len(held) > _DOUBTS and not everywhere:
            block = [held[n % len(held)] for n in range(self._next_doubt, self._next_doubt + _DOUBTS)]
            self._next_doubt = (self._next_doubt + _DOUBTS) % len(held)
        return any(m.chi2(*self.ends(m)) > m.threshold for m in block)


class LoopReports:
    """Owns a report of each loop; reasons add up as one decision follows the other."""

    def __init__(self) -> None:
        """Start empty."""
        self._reports: dict[int, EdgeReport] = {}
        self._changed: dict[int, None] = {}  # ids since `take_changed`

    def __contains__(self, loop_id: int) -> bool:
        return loop_id in self._reports

    def __getitem__(self, loop_id: int) -> EdgeReport:
        return self._reports[loop_id]

    def restore(self, loops: Sequence[OfferedLoop]) -> None:
        """Take over what was reported of the loops of an earlier run."""
        for loop in loops:
            state, edge = loop.state, loop.edge
            self._reports[state.id] = EdgeReport(
                state.id, edge.from_id, edge.to_id, state.chi2, 0.0, state.decision, state.reason
            )

    def begin(self, report: EdgeReport) -> None:
        """Take the first report of a loop, or one that replaces all before."""
        self._reports[report.loop_id] = report
        self._changed[report.loop_id] = None

    def add(self, loop: LoopModel, decision: LoopDecision, reason: str) -> None:
        """Add a decision and its reason to what was reported of a loop."""
        old = self._reports[loop.record.id]
        self.begin(replace(old, decision=decision, reason=f"{old.reason}; {reason}"))

    def touch(self, loop_id: int) -> None:
        """Take note that where a loop is has changed, though no decision has."""
        self._changed[loop_id] = None

    def take_changed(self) -> list[int]:
        """Return the ids of the loops about which something changed since the last call."""
        changed, self._changed = list(self._changed), {}
        return changed

    def all(self, weight: Callable[[int], float]) -> list[EdgeReport]:
        """Return the reports by loop id, each with the weight that the loop has now."""
        return [replace(self._reports[n], weight=weight(n)) for n in sorted(self._reports)]

    def split(self, touched: Sequence[int]) -> tuple[list[int], list[int]]:
        """Return the ids of accepted and of refused loops among those about which something was decided."""
        decided = sorted(set(touched))
        accepted = [n for n in decided if self._reports[n].decision is LoopDecision.ACCEPTED]
        return accepted, [n for n in decided if n not in accepted]
