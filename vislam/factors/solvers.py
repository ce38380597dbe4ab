"""Solvers of the graph: incremental (iSAM2), and batch for where incremental elimination fails.

gtsam 4.3.0 rejects some healthy systems, and an ISAM2 object that threw is unusable. Nothing here repairs one: an
exception passes through, and the owner builds a new solver from its journal.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, Protocol

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.messages import Array

RELINEARIZE_TRANSLATION_M = 0.005  # what a voxel map can see
_RELINEARIZE_VELOCITY_M_S = 0.01
# rad/s and m/s^2; preintegration's first-order correction is exact to far more
_RELINEARIZE_BIAS = 0.001
LOOP_ITERATIONS = 3  # extra Gauss-Newton steps after a loop is accepted; bounds the work of an update


Factorization = Literal["CHOLESKY", "QR"]
FAILURES = (RuntimeError, ValueError, IndexError, KeyError)  # what gtsam's bindings are known to raise

_BATCH_ITERATIONS = 20
RELINEARIZE_OWN = 0.02  # of a sensor's own variables, in units of how well they were known at first


class Solver(Protocol):
    """What the pose graph needs of a solver."""

    name: str
    reads_all: bool  # whether `estimate` always gives all variables

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, remove: list[int], last: int | None = None
    ) -> list[int]:
        """Add factors and new values, remove factors by slot, improve the estimate; return the slots of what is new.

        `last` is the variable to which the next factors will come, by default those of these factors.
        """

    def around(self, keys: list[int]) -> list[int]:
        """Return the slots of the factors that touch any of some variables, ascending."""

    def factors(self, slots: list[int]) -> gtsam.NonlinearFactorGraph:
        """Return the factors in some slots."""

    def iterate(self, count: int) -> None:
        """Improve the estimate by up to `count` steps."""

    def estimate(self, keys: list[int] | None = None) -> gtsam.Values:
        """Return the current estimate of variables, by default of all."""

    def cost(self) -> float:
        """Return half the squared sum of whitened errors at the estimate, as kernels count them."""

    def joint_covariance(self, keys: list[int]) -> Array:
        """Return the joint marginal covariance of variables, in the order of `keys`."""


class IncrementalSolver:
    """iSAM2 with Gauss-Newton steps and per-type relinearisation thresholds."""

    def __init__(self, config: GraphConfig, factorization: Factorization) -> None:
        """Start empty."""
        self.name = f"isam2-{factorization.lower()}"
        self.reads_all = False
        params = gtsam.ISAM2Params()
        params.setFactorization(factorization)
        params.relinearizeSkip = config.relinearize_skip
        params.findUnusedFactorSlots = True
        thresholds = gtsam.ISAM2ThresholdMap()
        pose = np.repeat([config.relinearize_rotation_rad, RELINEARIZE_TRANSLATION_M], 3)
        thresholds.insert(("x", pose))
        thresholds.insert(("v", np.full(3, _RELINEARIZE_VELOCITY_M_S)))
        thresholds.insert(("l", np.full(3, RELINEARIZE_TRANSLATION_M)))
        thresholds.insert(("b", np.full(6, _RELINEARIZE_BIAS)))
        for letter in "ow":
            thresholds.insert((letter, np.full(1, RELINEARIZE_OWN)))
        params.setRelinearizeThreshold(thresholds)
        self._isam = gtsam.ISAM2(params)

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, remove: list[int], last: int | None = None
    ) -> list[int]:
        """See Solver."""
        groups = None
        if last is not None:
            groups = gtsam.KeyGroupMap()
            groups.insert2(last, 1)
        result = self._isam.update(graph, values, remove, groups)
        return [int(slot) for slot in result.getNewFactorsIndices()]

    def around(self, keys: list[int]) -> list[int]:
        """See Solver."""
        index = self._isam.getVariableIndex()
        return sorted({int(slot) for key in keys for slot in index.at(key)})

    def factors(self, slots: list[int]) -> gtsam.NonlinearFactorGraph:
        """See Solver."""
        return graph_of(map(self._isam.getFactorsUnsafe().at, slots))

    def iterate(self, count: int) -> None:
        """See Solver."""
        for _ in range(count):
            self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], None, None, None, True)

    def estimate(self, keys: list[int] | None = None) -> gtsam.Values:
        """See Solver."""
        return self._isam.calculateEstimate() if keys is None else self._isam.calculateEstimate(keys)

    def cost(self) -> float:
        """See Solver."""
        return float(self._isam.getFactorsUnsafe().error(self._isam.calculateEstimate()))

    def joint_covariance(self, keys: list[int]) -> Array:
        """See Solver."""
        return np.asarray(self._isam.jointMarginalCovariance(keys).fullMatrix())


class BatchSolver:
    """Levenberg-Marquardt over the whole graph at each update: slow, but damping makes it hard to stop."""

    def __init__(self) -> None:
        """Start empty."""
        self.name = "batch-lm"
        self.reads_all = True
        self._graph = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._marginals: gtsam.Marginals | None = None  # of the estimate as it is

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, remove: list[int], last: int | None = None
    ) -> list[int]:
        """See Solver."""
        self._values.insert(values)
        first = self._graph.size()
        for slot in remove:
            self._graph.remove(slot)
        self._graph.push_back(graph)
        self.iterate(_BATCH_ITERATIONS)
        return list(range(first, self._graph.size()))

    def around(self, keys: list[int]) -> list[int]:
        """See Solver."""
        wanted, graph = set(keys), self._graph
        return [n for n in range(graph.size()) if graph.exists(n) and not wanted.isdisjoint(graph.at(n).keys())]

    def factors(self, slots: list[int]) -> gtsam.NonlinearFactorGraph:
        """See Solver."""
        return graph_of(map(self._graph.at, slots))

    def iterate(self, count: int) -> None:
        """See Solver; keeps the values it has when even LM fails."""
        self._marginals = None
        try:
            self._values = optimize(self._graph, self._values, count)
        except FAILURES:
            return

    def estimate(self, keys: list[int] | None = None) -> gtsam.Values:
        """See Solver; always all, for its update looks at all of them anyway."""
        return gtsam.Values(self._values)

    def cost(self) -> float:
        """See Solver."""
        return float(self._graph.error(self._values))

    def joint_covariance(self, keys: list[int]) -> Array:
        """See Solver."""
        if self._marginals is None:
            self._marginals = gtsam.Marginals(self._graph, self._values)
        return np.asarray(self._marginals.jointMarginalCovariance(keys).fullMatrix())


def optimize(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, iterations: int) -> gtsam.Values:
    """Return the values after Levenberg-Marquardt over the whole graph."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(1e-7)
    params.setlambdaUpperBound(1e9)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    """Return factors as a graph."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph
