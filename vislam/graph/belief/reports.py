"""What became of every loop that a graph was offered, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from vislam.core.memory import EdgeReport, OfferedLoop
from vislam.core.messages import LoopDecision
from vislam.factors.loop import LoopModel


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
