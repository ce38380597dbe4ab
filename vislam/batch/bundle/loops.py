"""Which loops of a run to believe, decided over the whole run at once, and their factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam

from vislam.batch.bundle.chain import Chain
from vislam.batch.posegraph.auto import decide
from vislam.batch.posegraph.problem import RelativePoses
from vislam.config import GraphConfig, PoseGraphConfig
from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.factors.factor_log import LoggedEdge
from vislam.factors.journal import loop_record
from vislam.factors.loop import LOOP_MIN_WEIGHT, LoopModel
from vislam.factors.visual import measurement_of

_LOOP_PROBABILITY = 0.9999  # chi-square of a true loop in the judging of all of them


@dataclass(frozen=True, slots=True, eq=False)
class LoopVerdict:
    """What batch decided about one offered loop edge."""

    id: int
    from_id: int
    to_id: int
    in_run: bool  # the run's graph held it
    kept: bool
    reason: str


class Loops:
    """The loop edges of a run: judged once on the pose graph, then kept as relative pose factors."""

    def __init__(self, edges: list[LoggedEdge], chain: Chain, config: GraphConfig, lever_m: Array) -> None:
        """Check the edges; one that cannot be used is refused with its reason."""
        self._offered: list[LoopModel] = []
        self._in_run = {logged.edge.id: logged.accepted for logged in edges}
        self.verdicts: dict[int, LoopVerdict] = {}
        for logged in edges:
            edge = logged.edge
            try:
                record = loop_record(edge, len(chain.records) - 1)
                self._offered.append(LoopModel(record, config, lever_m))
            except DataError as error:
                verdict = LoopVerdict(edge.id, edge.from_id, edge.to_id, logged.accepted, False, str(error))
                self.verdicts[edge.id] = verdict
        self.kept: list[LoopModel] = []

    def choose(self, chain: Chain) -> str:
        """Decide as `vislam optimize --robust auto` does, on the run's odometry and all its loops.

        Odometry is never doubted. Returns what could not be decided, "" where all was.
        """
        if not self._offered:
            return ""
        odometry = chain.odometry()
        edges = RelativePoses.joined([odometry, loop_edges(self._offered, chain.poses)])
        decided = decide(edges.problem(chain.poses), PoseGraphConfig(inlier_probability=_LOOP_PROBABILITY))
        undecided = set(decided.undecided.tolist())
        for e, model in enumerate(self._offered, start=len(odometry.ends)):
            kept = bool(decided.weights[e] > 0.0)
            reason = "agrees with odometry and the other loops" if kept else "contradicts odometry or the other loops"
            if e in undecided:
                reason = "undecided: too little speaks for it or against it"
            self._judge(model, kept, reason)
            if kept:
                self.kept.append(model)
        return decided.warning

    def factors(self, poses: Array) -> list[gtsam.NonlinearFactor]:
        """Return the factors of the kept loops under a kernel; `poses` [K, 4, 4] lend length to unscaled ones."""
        return [model.between(poses, robust=True) for model in self.kept]

    def drop_contradicted(self, poses: Array) -> None:
        """Let go of loops that the bundle adjustment contradicts."""
        held, self.kept = self.kept, []
        for model in held:
            ends = poses[model.record.from_id], poses[model.record.to_id]
            if model.weight(*ends) < LOOP_MIN_WEIGHT:
                self._judge(model, False, f"contradicted by the bundle adjustment, chi2 {model.chi2(*ends):.1f}")
            else:
                self.kept.append(model)

    def _judge(self, model: LoopModel, kept: bool, reason: str) -> None:
        record, in_run = model.record, self._in_run[model.id]
        self.verdicts[record.id] = LoopVerdict(record.id, record.from_id, record.to_id, in_run, kept, reason)


def loop_edges(models: Sequence[LoopModel], poses: Array) -> RelativePoses:
    """Return loops as metric relative poses; `poses` [K, 4, 4] lend length to those without scale."""
    ends = [(m.record.from_id, m.record.to_id) for m in models]
    return RelativePoses.of(ends, [measurement_of(m.between(poses, robust=False)) for m in models])
