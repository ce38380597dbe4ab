"""Any pose graph, keyframe by keyframe, through the transactional estimate: edges as they come, without a gate.

For graphs from elsewhere, where nobody can say how a loop was found: every edge is taken under a Gaussian model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.messages import Array
from vislam.factors.builder import Guess, Label, Step
from vislam.factors.journal import checked_pose
from vislam.factors.keys import X, bias_of, nearest_rigid
from vislam.factors.noise_models import checked_covariance, gaussian
from vislam.factors.visual import pose_factor
from vislam.graph.estimator import Estimator

_RATIO_MAX = 1e12  # an edge is taken as it is said to be; this only keeps its information finite


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """A relative pose of two keyframes, in either direction."""

    id: int  # unique in a graph
    from_id: int
    to_id: int
    T_from_to: Array  # [4, 4]
    covariance: Array  # [6, 6] perturbed on the side of `to_id`

    def factor(self, robust: bool, as_measured: bool = False) -> gtsam.NonlinearFactor:
        """Return the factor; it has no kernel, whatever `robust` says, and is always as measured."""
        return pose_factor(X(self.from_id), X(self.to_id), self.T_from_to, gaussian(self.covariance, _RATIO_MAX))


class EdgeGraph:
    """A pose graph of edges alone: `add` each keyframe with its odometry and the edges to older ones, then `finish`.

    Bad edges raise DataError before anything is touched; whatever gtsam does, `add` returns, with a note.
    """

    def __init__(self, config: GraphConfig, T_first: Array | None = None) -> None:
        """Put keyframe 0 at `T_first` [4, 4], by default the identity."""
        self._chain = _Chain(config, np.eye(4) if T_first is None else checked_pose(T_first, "first pose"))
        self._estimator: Estimator[Between] = Estimator(config, self._chain)
        self._ids: set[int] = set()
        self._estimator.begin()

    @property
    def poses(self) -> Array:
        """Return the poses [M, 4, 4] of all keyframes, each as it was last read back from the solver."""
        return self._estimator.poses.copy()

    @property
    def solver_name(self) -> str:
        """Return which solver is at work."""
        return self._estimator.solver_name

    def add(self, odometry: Between, loops: Sequence[Between] = ()) -> str:
        """Add the next keyframe, tied to the one before by `odometry`; return what went wrong, normally nothing."""
        k = len(self._estimator.poses)
        if {odometry.from_id, odometry.to_id} != {k - 1, k}:
            raise DataError(f"edge {odometry.id}: odometry must tie keyframes {k - 1} and {k}")
        odometry = self._checked(odometry)
        fresh = [self._checked(loop) for loop in loops]
        for loop in fresh:
            if max(loop.from_id, loop.to_id) > k or min(loop.from_id, loop.to_id) < 0 or loop.from_id == loop.to_id:
                raise DataError(f"edge {loop.id}: {loop.from_id} to {loop.to_id} must be two different ones of 0..{k}")
            if loop.id in self._ids:
                raise DataError(f"edge {loop.id}: its id was used before")
        self._ids |= {loop.id for loop in fresh}
        self._chain.edges.append(odometry)
        _, note = self._estimator.extend()
        closing = self._estimator.close(fresh, batch=False) if fresh else ""
        return "; ".join(n for n in (note, closing) if n)

    def finish(self) -> str:
        """Iterate to convergence; return how it was reached, with the costs."""
        return self._estimator.converge()

    @staticmethod
    def _checked(edge: Between) -> Between:
        what = f"edge {edge.id} from {edge.from_id} to {edge.to_id}"
        covariance = checked_covariance(edge.covariance, 6, what)
        return Between(edge.id, edge.from_id, edge.to_id, checked_pose(edge.T_from_to, what), covariance)


class _Chain:
    """The edge with which each keyframe came, as odometry of an estimator."""

    has_imu = False

    def __init__(self, config: GraphConfig, T_first: Array) -> None:
        self.edges: list[Between | None] = [None]
        sigmas = np.repeat([config.gauge_sigma_rad, config.gauge_sigma_m], 3)
        self._prior = gtsam.PriorFactorPose3(X(0), gtsam.Pose3(T_first), gaussian(np.diag(sigmas**2), _RATIO_MAX))
        self._T_first = T_first

    def start(self) -> tuple[list[gtsam.NonlinearFactor], Guess]:
        return [self._prior], _guess(self._T_first)

    def step(self, k: int, before: Guess, T_map_earlier: Array | None, vo_scale: float) -> Step:
        edge = self.edges[k]
        assert edge is not None
        moved = edge.T_from_to if edge.from_id == k - 1 else invert(edge.T_from_to)
        return Step([edge.factor(robust=False)], _guess(nearest_rigid(before.T_map_body @ moved)), 0.0, 0.0, "")

    def changed(self, vo_scale: float) -> dict[Label, gtsam.NonlinearFactor]:
        return {}

    def reach_m(self, k: int) -> float:
        return float("inf")

    def shared_error(self, ids: list[int], poses: Array) -> Array | None:
        return None


def _guess(T: Array) -> Guess:
    return Guess(T, np.zeros(3), bias_of(np.zeros(3), np.zeros(3)))
