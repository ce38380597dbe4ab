"""The gate: a chi-square test of a loop against the estimate, and the loops that it keeps out for now.

Odometry covariances are optimistic, so a true loop can lie outside the gate, and a false one inside of a wide one:
`vislam.graph.belief.consensus` has the last word on both.
"""

from __future__ import annotations

from collections.abc import Sequence

from vislam.config import GraphConfig
from vislam.core.memory import EdgeReport
from vislam.core.messages import Array, LoopDecision
from vislam.factors.keys import X
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.graph.belief.anchors import Anchors
from vislam.graph.belief.held import HeldLoops, LoopReports
from vislam.graph.belief.known import Known
from vislam.graph.estimator import Estimator
from vislam.graph.travel import Travel


class Gate:
    """Lets in what the graph does not contradict. Where it cannot say how well it knows two poses, odometry does."""

    def __init__(self, estimator: Estimator, travel: Travel, held: HeldLoops, reports: LoopReports) -> None:
        """Test against an estimator, whose odometry is in `travel`; tests are reported."""
        self._estimator = estimator
        self._travel = travel
        self._held = held
        self._reports = reports

    def known(self, loops: Sequence[LoopModel], anchors: Anchors) -> Known | None:
        """Return what the graph knows of all ends of loops, and of the anchors near to them: one joint marginal."""
        ends = {k for m in loops for k in (m.record.from_id, m.record.to_id)}
        near = [anchors.near(m.record.from_id) for m in loops]
        ends |= {self._estimator.summed_up.host(k) for k in ends}
        ids = sorted(ends | {tied.anchor_id for tied in near if tied is not None})
        joint = self._estimator.joint_covariance([X(k) for k in ids])
        if joint is None:
            return None
        self._estimator.look_at(ids)
        return Known({k: self._estimator.poses[k].copy() for k in ids}, joint)

    def relative_covariance(self, i: int, j: int) -> Array:
        """Return the covariance [6, 6] of T_i_j, perturbed at j; from summed odometry where gtsam cannot give it."""
        joint = self._estimator.joint_covariance([X(i), X(j)])
        if joint is None:
            return self._travel.relative_covariance(i, j)
        return relative_covariance(self._estimator.poses[i], self._estimator.poses[j], joint)

    def lets_in(self, loop: LoopModel, known: Known | None) -> bool:
        """Return whether the estimate allows a loop; the chi-square is reported."""
        record = loop.record
        relative = self._travel.relative_covariance if known is None else known.relative
        chi2 = loop.chi2(*self._held.ends(loop), relative(record.from_id, record.to_id))
        inside = bool(chi2 <= loop.threshold)
        decision = LoopDecision.ACCEPTED if inside else LoopDecision.PENDING
        says, side = ("odometry allows it", "within") if inside else ("odometry speaks against it", "beyond")
        reason = f"{says}: chi2 {chi2:.1f} {side} {loop.threshold:.1f}"
        self._reports.begin(EdgeReport(record.id, record.from_id, record.to_id, chi2, 0.0, decision, reason))
        return inside


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
