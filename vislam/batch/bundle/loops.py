"""Which loops of a run to believe, decided over the whole run at once, and their factors."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.batch.bundle.chain import Chain
from vislam.batch.posegraph.auto import decide
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.config import GraphConfig, PoseGraphConfig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.factors.factor_log import LoggedEdge
from vislam.factors.journal import LoopRecord, loop_record
from vislam.factors.keys import X
from vislam.factors.loop import LOOP_CAUCHY_K, LOOP_MIN_WEIGHT
from vislam.factors.noise_models import DIRECTION_FLOOR_DEG, DIRECTION_SOFT_M, cauchy, gaussian, inflated
from vislam.factors.visual import direction_as_pose, pose_factor

_LOOP_PROBABILITY = 0.9999  # chi-square of a true loop in the judging of all of them
# one camera: relative, on the steps of the run's own odometry among the loops
UNSCALED_ODOMETRY_SIGMA = 0.1
_UNSCALED_SIGMA = 5.0  # relative, of the length of a loop without scale: wide, for its length was not measured


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
        self._config = config
        self._lever_m = lever_m
        self._records: list[LoopRecord] = []
        self._in_run = {logged.edge.id: logged.accepted for logged in edges}
        self.verdicts: dict[int, LoopVerdict] = {}
        for logged in edges:
            edge = logged.edge
            try:
                self._records.append(loop_record(edge, len(chain.records) - 1))
            except DataError as error:
                verdict = LoopVerdict(edge.id, edge.from_id, edge.to_id, logged.accepted, False, str(error))
                self.verdicts[edge.id] = verdict
        self.kept: list[LoopRecord] = []

    def choose(self, chain: Chain) -> str:
        """Decide as `vislam optimize --robust auto` does, on the run's odometry and all its loops.

        Odometry is never doubted. Returns what could not be decided, "" where all was.
        """
        if not self._records:
            return ""
        edges = chain.odometry_edges(UNSCALED_ODOMETRY_SIGMA)
        edges += [self._factor(record, chain.poses, robust=False) for record in self._records]
        decided = decide(_as_problem(edges, chain.poses), PoseGraphConfig(inlier_probability=_LOOP_PROBABILITY))
        first = len(edges) - len(self._records)
        undecided = set(decided.undecided.tolist())
        for e, record in enumerate(self._records, start=first):
            kept = bool(decided.weights[e] > 0.0)
            reason = "agrees with odometry and the other loops" if kept else "contradicts odometry or the other loops"
            if e in undecided:
                reason = "undecided: too little speaks for it or against it"
            self._judge(record, kept, reason)
            if kept:
                self.kept.append(record)
        return decided.warning

    def factors(self, poses: Array) -> list[gtsam.NonlinearFactor]:
        """Return the factors of the kept loops under a kernel; `poses` [K, 4, 4] lend length to unscaled ones."""
        return [self._factor(record, poses, robust=True) for record in self.kept]

    def drop_contradicted(self, poses: Array) -> int:
        """Let go of loops that the bundle adjustment contradicts; return how many."""
        contradicted = []
        for record in self.kept:
            chi2 = 2.0 * self._factor(record, poses, robust=False).error(_pair(record, poses))
            weight = LOOP_CAUCHY_K**2 / (LOOP_CAUCHY_K**2 + chi2)
            if weight < LOOP_MIN_WEIGHT:
                contradicted.append(record)
                self._judge(record, False, f"contradicted by the bundle adjustment, chi2 {chi2:.1f}")
        self.kept = [record for record in self.kept if not any(record is c for c in contradicted)]
        return len(contradicted)

    def _judge(self, record: LoopRecord, kept: bool, reason: str) -> None:
        in_run = self._in_run[record.id]
        self.verdicts[record.id] = LoopVerdict(record.id, record.from_id, record.to_id, in_run, kept, reason)

    def _factor(self, record: LoopRecord, poses: Array, robust: bool) -> gtsam.BetweenFactorPose3:
        return loop_factor(record, poses, self._config, self._lever_m, robust)


def loop_factor(
    record: LoopRecord, poses: Array, config: GraphConfig, lever_m: Array, robust: bool
) -> gtsam.BetweenFactorPose3:
    """Return a loop as a metric relative pose; `poses` [K, 4, 4] lend length to one without scale.

    `lever_m` [3] is cam0 in the body; `robust`: under a Cauchy kernel.
    """
    T, floor_rad = record.T_from_to, np.deg2rad(config.loop_floor_deg)
    if record.has_scale:
        covariance = inflated(record.covariance, 1.0, floor_rad, config.loop_floor_m)
    else:
        moved = invert(poses[record.from_id]) @ poses[record.to_id]
        step_m = float(np.linalg.norm(moved[:3, 3] + moved[:3, :3] @ lever_m - lever_m))
        T, covariance = direction_as_pose(
            T, inflated(record.covariance, 1.0, floor_rad, 0.0), lever_m, max(step_m, DIRECTION_SOFT_M),
            floor_rad=np.deg2rad(DIRECTION_FLOOR_DEG), scale_sigma=_UNSCALED_SIGMA,
        )  # fmt: skip
    model: gtsam.noiseModel.Base = gaussian(covariance, config.covariance_ratio_max)
    if robust:
        model = cauchy(model, LOOP_CAUCHY_K)
    return pose_factor(X(record.from_id), X(record.to_id), T, model)


def _as_problem(edges: list[gtsam.BetweenFactorPose3], poses: Array) -> PoseGraphProblem:
    """Return the pose graph of edges between poses [K, 4, 4], the keyframes."""
    n = len(poses)
    keys = [list(edge.keys()) for edge in edges]
    pairs = np.array([[gtsam.Symbol(key).index() for key in pair] for pair in keys], dtype=np.int64)
    measurements = np.array([edge.measured().matrix() for edge in edges])
    information = np.array([_information(edge.noiseModel()) for edge in edges])
    return PoseGraphProblem(
        3, np.arange(n), np.ascontiguousarray(poses), np.zeros(n, dtype=np.bool_), pairs, measurements, information
    )


def _information(model: gtsam.noiseModel.Base) -> Array:
    assert isinstance(model, gtsam.noiseModel.Gaussian)
    return np.asarray(model.information())


def _pair(record: LoopRecord, poses: Array) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X(record.from_id), gtsam.Pose3(poses[record.from_id]))
    values.insert(X(record.to_id), gtsam.Pose3(poses[record.to_id]))
    return values
