"""Which loops may enter the graph at once: a chi-square gate, and a car park for those that it keeps out.

Odometry covariances are optimistic, so a true loop can lie outside the gate, and a false one inside of a wide one:
`vislam.factors.consensus` has the last word on both.
"""

from __future__ import annotations

from dataclasses import dataclass

from vislam.config import GraphConfig
from vislam.factors.loop import LoopModel
from vislam.messages import LoopDecision


@dataclass(frozen=True, slots=True, eq=False)
class EdgeReport:
    """What became of one offered loop edge."""

    loop_id: int
    from_id: int
    to_id: int
    chi2: float  # at the gate, NaN when it was not reached
    weight: float  # of the Cauchy kernel at the current estimate, 0 when not in the graph
    decision: LoopDecision
    reason: str


class CarPark:
    """Loops that wait outside the gate, for the estimate to change or for a review to let them in."""

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._most = config.parked_max
        self._edges: list[LoopModel] = []

    @property
    def edges(self) -> list[LoopModel]:
        """Return the parked edges, oldest first."""
        return list(self._edges)

    def park(self, edge: LoopModel) -> LoopModel | None:
        """Add an edge; return the one that had to leave, if any."""
        self._edges.append(edge)
        return self._edges.pop(0) if len(self._edges) > self._most else None

    def remove(self, edges: list[LoopModel]) -> None:
        """Take edges out, those of them that are here."""
        gone = {edge.id for edge in edges}
        self._edges = [edge for edge in self._edges if edge.id not in gone]
