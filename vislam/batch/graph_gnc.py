"""Graduated non-convexity on pose graphs: which loops to believe, decided together with the poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vislam.batch.graph_solver import Descent, Progress, levenberg_marquardt
from vislam.batch.graph_starts import odometry_start
from vislam.batch.graph_structure import Structure
from vislam.config import PoseGraphConfig
from vislam.messages import Array

_GROWTH = 1.4  # of the control parameter per step, as in the paper
_STEPS_MAX = 100
_INNER = 3  # iterations of a step: the next one asks something else anyway
_SETTLED = 1e-3  # weights this close to 0 or 1 are decided


@dataclass(frozen=True, slots=True, eq=False)
class Robust:
    """Poses and which edges they rest on."""

    descent: Descent
    weights: Array  # [E] 1 kept, 0 rejected


def doubtful_edges(structure: Structure) -> NDArray[np.bool_]:
    """Return which edges [E] may be false: those that do not join successive ids."""
    edges = structure.problem.edges
    return np.abs(edges[:, 1] - edges[:, 0]) != 1


def reject_false_edges(structure: Structure, config: PoseGraphConfig, progress: Progress | None = None) -> Array:
    """Return the weights [E] that graduated non-convexity from odometry gives: 1 kept, 0 rejected."""
    start = odometry_start(structure.problem)
    return graduated_non_convexity(
        structure, start, probability=config.inlier_probability, iterations=config.iterations,
        tolerance=config.tolerance, progress=progress,
    ).weights  # fmt: skip


def graduated_non_convexity(
    structure: Structure,
    poses: Array,
    *,
    probability: float,
    iterations: int,
    tolerance: float,
    progress: Progress | None = None,
) -> Robust:
    """Minimise the truncated least squares of the doubtful edges from `poses`, which are best those of odometry.

    An edge is rejected when its chi2 is beyond the quantile `probability` of its dimension. Yang, Antonante, Tzoumas,
    Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, section IV.
    """
    problem = structure.problem
    doubtful = doubtful_edges(structure)
    limit = float(chi2.ppf(probability, problem.tangent))
    weights = np.ones(len(problem.edges))
    errors = problem.edge_chi2(poses)
    worst = float(errors[doubtful].max(initial=0.0))
    control = limit / max(2.0 * worst - limit, 1e-300)
    if worst > limit:
        for _ in range(_STEPS_MAX):
            weights[doubtful] = _weights(errors[doubtful], limit, control)
            poses = levenberg_marquardt(structure, poses, weights, iterations=_INNER, tolerance=tolerance).poses
            errors = problem.edge_chi2(poses)
            if progress is not None:
                progress(0, float(np.minimum(errors, limit)[doubtful].sum() + errors[~doubtful].sum()))
            undecided = (weights > _SETTLED) & (weights < 1.0 - _SETTLED)
            if not undecided.any() and control > 1.0:
                break
            control *= _GROWTH
    weights[doubtful] = errors[doubtful] <= limit
    descent = levenberg_marquardt(
        structure, poses, weights, iterations=iterations, tolerance=tolerance, progress=progress
    )  # fmt: skip
    return Robust(descent, weights)


def _weights(errors: Array, limit: float, control: float) -> Array:
    """Return the weights of truncated least squares at a control parameter (equation 14 of the paper)."""
    upper, lower = (control + 1.0) / control * limit, control / (control + 1.0) * limit
    between = np.sqrt(limit * control * (control + 1.0) / np.maximum(errors, 1e-300)) - control
    return np.where(errors >= upper, 0.0, np.where(errors <= lower, 1.0, np.clip(between, 0.0, 1.0)))
