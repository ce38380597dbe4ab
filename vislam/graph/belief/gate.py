"""Which loops may enter the graph at once: a chi-square gate, and those pending that it keeps out.

Odometry covariances are optimistic, so a true loop can lie outside the gate, and a false one inside of a wide one:
`vislam.graph.belief.consensus` has the last word on both.
"""

from __future__ import annotations

from vislam.config import GraphConfig
from vislam.factors.loop import LoopModel


class PendingLoops:
    """Loops that wait outside the gate, for the estimate to change or for a review to let them in."""

    def __init__(self, config: GraphConfig) -> None:
        """Start empty."""
        self._most = config.pending_max
        self._edges: list[LoopModel] = []

    @property
    def edges(self) -> list[LoopModel]:
        """Return the pending edges, oldest first."""
        return list(self._edges)

    def add(self, edge: LoopModel) -> LoopModel | None:
        """Add an edge; return the one that had to leave, if any."""
        self._edges.append(edge)
        return self._edges.pop(0) if len(self._edges) > self._most else None

    def remove(self, edges: list[LoopModel]) -> None:
        """Take edges out, those of them that are here."""
        gone = {edge.id for edge in edges}
        self._edges = [edge for edge in self._edges if edge.id not in gone]
