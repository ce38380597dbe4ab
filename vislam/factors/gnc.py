"""Graduated non-convexity: which loops of a whole graph agree with its odometry, decided together."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from vislam.errors import DataError, UsageError
from vislam.factors.solver import FAILURES
from vislam.messages import Array


def gnc_loops(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    known_inliers: Sequence[int],
    *,
    inlier_probability: float = 0.9999,
) -> tuple[gtsam.Values, Array]:
    """Return the optimum under truncated least squares and the weight [N] of each factor: 1 kept, 0 left out.

    Args:
        graph: factors in slots 0..N-1 without gaps; gtsam takes robust kernels off, for this method replaces them.
        values: where to start; odometry is good enough.
        known_inliers: slots of factors that are never left out: priors, odometry, IMU.
        inlier_probability: a factor is left out when its chi-square is beyond this quantile of its dimension. At the
            usual 0.99, up to 8 % of true loops went, for a residual lacks the odometry's share; false ones are far off.

    Raises UsageError on slots that do not exist and DataError when the graph cannot be optimised.
    Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020.
    """
    count = graph.size()
    inliers = sorted(set(known_inliers))
    if count != graph.nrFactors():
        raise UsageError(f"the graph has {count - graph.nrFactors()} empty slots; give one without gaps")
    if inliers and not 0 <= inliers[0] <= inliers[-1] < count:
        raise UsageError(f"known inliers must be slots of the graph's {count} factors, got {inliers[0]}..{inliers[-1]}")
    try:
        params = gtsam.GncLMParams()
        params.setLossType(gtsam.GncLossType.TLS)
        params.setKnownInliers(inliers)
        optimizer = gtsam.GncLMOptimizer(graph, values, params)
        optimizer.setInlierCostThresholdsAtProbability(inlier_probability)
        optimum = optimizer.optimize()
        weights = np.asarray(optimizer.getWeights(), dtype=np.float64)
        cost = float(graph.error(optimum))
    except FAILURES as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise DataError(
            f"GNC over {count} factors failed ({lines[0][:80]}); known inliers must tie all variables to a prior"
        ) from error
    if not (np.isfinite(cost) and np.all(np.isfinite(weights))):
        raise DataError(f"GNC over {count} factors ended without a finite cost; check the measurements for NaN")
    return optimum, weights
