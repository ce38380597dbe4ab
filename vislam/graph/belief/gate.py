"""The gate: a chi-square test of a loop against the estimate, and the anchors to which loops tie.

Odometry covariances are optimistic, so a true loop can lie outside the gate, and a false one inside of a wide one:
`vislam.graph.belief.consensus` has the last word on both.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from vislam.config import GraphConfig
from vislam.core.geometry import invert
from vislam.core.memory import EdgeReport, Tied
from vislam.core.messages import Array, LoopDecision
from vislam.factors.keys import X
from vislam.factors.loop import LoopModel, relative_covariance
from vislam.graph.belief.held import HeldLoops, LoopReports
from vislam.graph.belief.known import Known
from vislam.graph.estimator import Estimator
from vislam.graph.travel import Travel

_ANCHOR_REACH = 10  # keyframes from one that is tied to an older one: a loop to it ties to that one, the anchor
_ANCHOR_VARIANCE_MAX = 4.0  # times a loop's own variance: most that the way to its anchor may add


class Anchors:
    """Remembers to which anchor accepted loops tie keyframes, and ties new ones to them.

    Loops from each visit of a place to any earlier one fill the factorised system with every visit; loops to the same
    old keyframe with one. The idea is that of the reduced pose graph (Johannsson et al., "Temporally scalable visual
    SLAM using a reduced pose graph", ICRA 2013), whose size follows the space explored and not the time.
    """

    def __init__(self, config: GraphConfig, estimator: Estimator) -> None:
        """Start without any."""
        self._config = config
        self._estimator = estimator
        self._tied: dict[int, Tied] = {}
        self._ids: list[int] = []  # keys of the above, ascending
        self._fresh: list[Tied] = []  # since `take_record`

    def near(self, k: int) -> Tied | None:
        """Return the tied keyframe nearest to k along the run; None when there is none in reach."""
        n = bisect_left(self._ids, k)
        around = [c for c in self._ids[max(n - 1, 0) : n + 1] if abs(c - k) <= _ANCHOR_REACH]
        return self._tied[min(around, key=lambda c: abs(c - k))] if around else None

    def tie(self, tied: Tied) -> None:
        """Take note of a keyframe; what is known of one stays."""
        if tied.id not in self._tied:
            self._tied[tied.id] = tied
            self._ids.insert(bisect_left(self._ids, tied.id), tied.id)
            self._fresh.append(tied)

    def remember(self, loops: Sequence[LoopModel], known: Known) -> None:
        """Take note of which anchor loops tie their newer ends to, and what is known of it before they do."""
        for loop in loops:
            older, newer = loop.record.from_id, loop.record.to_id
            anchor = older if loop.tie is None else loop.tie.from_id
            if anchor == older:
                self.tie(Tied(older, older, np.zeros((6, 6))))
            self.tie(Tied(newer, anchor, known.relative(anchor, newer)))

    def forget(self) -> None:
        """Let every keyframe stand for itself again: a loop was wrong, and how far that went is not known."""
        self._tied = {k: Tied(k, k, np.zeros((6, 6))) for k in self._ids}
        self._fresh = list(self._tied.values())

    def take_record(self) -> tuple[Tied, ...]:
        """Return what was tied since the last call."""
        fresh, self._fresh = tuple(self._fresh), []
        return fresh

    def grouped(self, loops: Sequence[LoopModel], known: Known) -> list[list[LoopModel]]:
        """Tie the loops of a keyframe to one anchor as far as they can; return them by the keyframe that holds them."""
        anchors = [self._anchor(loop) for loop in loops]
        often = sorted(anchors, key=lambda k: (-anchors.count(k), k))
        groups: dict[int, list[LoopModel]] = {}
        for loop, own in zip(loops, anchors, strict=True):
            loop.tie = None
            held = next((k for k in (often[0], own) if self._stands_for(loop, k, known)), None)
            held = self.tie_to_host(loop, known) if held is None else held
            groups.setdefault(held, []).append(loop)
        return [groups[k] for k in sorted(groups)]

    def tie_to_host(self, loop: LoopModel, known: Known) -> int:
        """Tie a loop to the keyframe that the solver has for its older end; return it."""
        older, newer = loop.record.from_id, loop.record.to_id
        host = self._estimator.summed_up.host(older)
        if host != older:
            T_older_newer = known.motion(older, newer)
            loop.tie_to(host, known.motion(host, older), known.relative(host, older), T_older_newer, most=np.inf)
        return host

    def _anchor(self, loop: LoopModel) -> int:
        """Return the anchor near to a loop's older end; this end where there is none."""
        older, newer = loop.record.from_id, loop.record.to_id
        near = self.near(older)
        return older if near is None or near.anchor_id == newer else near.anchor_id

    def _stands_for(self, loop: LoopModel, anchor: int, known: Known) -> bool:
        """Let an anchor stand for the older end of a loop; return whether it does, or is that end itself."""
        older, newer = loop.record.from_id, loop.record.to_id
        if self._estimator.summed_up.host(anchor) != anchor:
            return False
        if anchor in (older, newer) or len(self._estimator.loops) < self._config.anchor_after:
            return anchor == older
        T_map_anchor, T_map_older, T_map_newer = (self._estimator.poses[k] for k in (anchor, older, newer))
        T_anchor_older, T_older_newer = invert(T_map_anchor) @ T_map_older, invert(T_map_older) @ T_map_newer
        way = known.relative(anchor, older)
        return loop.tie_to(anchor, T_anchor_older, way, T_older_newer, most=_ANCHOR_VARIANCE_MAX)


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
        finding, side = ("odometry allows it", "within") if inside else ("odometry speaks against it", "beyond")
        reason = f"{finding}: chi2 {chi2:.1f} {side} {loop.threshold:.1f}"
        self._reports.begin(EdgeReport(record.id, record.from_id, record.to_id, chi2, 0.0, decision, reason))
        return inside
