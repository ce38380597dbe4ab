"""Which loops of a pose graph are false: gates that narrow as loops are taken, then graduated non-convexity.

Graduated non-convexity alone, from odometry that drifted far, ends with false loops kept: the true ones pull as weakly
at first as the false ones. So loops enter first that odometry can judge, in the order of their evidence: each must pass
a chi-square gate of its innovation, and be far likelier true than a false loop, which may be anything in the space of
the trajectory. Every loop taken narrows the gates of the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.noise import covariances_of_edges
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import Progress, levenberg_marquardt
from vislam.batch.posegraph.starts import odometry_start
from vislam.batch.posegraph.structure import Structure
from vislam.core.chi_square import chi_square_limit
from vislam.core.messages import Array
from vislam.factors.loop_evidence import SOUND, entering, innovation, log_volume

Mask = NDArray[np.bool_]

_ROUNDS_MAX = 60
_CLOSEST = 0.1  # of the loops, taken as the closest fifth of true ones when half of all are false
_LOOPS_FOR_SCALE = 30  # from which on the cost per degree of freedom shows the scale
_SCALE_MIN = 1e-10
_INNER_TOLERANCE = 1e-6
_GROWTH = 1.4  # of the control parameter of graduated non-convexity per step, as in the paper
_STEPS_MAX = 60
_INNER = 2  # iterations of a step: the next one asks something else anyway
_LEAST_INFORMATION = 1e-9  # of the trace: what makes a matrix with unknown directions invertible
_NEAR = 25.0  # times the limit: rejected loops that graduated non-convexity looks at again
TAILS = 4.0  # times the limit at the end: errors of real loops have heavier tails than a Gaussian
_SETTLED = 1e-3  # weights this close to 0 or 1 are decided


def trusted_edges(problem: PoseGraphProblem, doubtful: Mask | None = None) -> Mask:
    """Return which edges [E] are not doubted; by default only those that do not join successive ids are.

    Where these leave the graph in parts, as few of the others as join it are believed, too.
    """
    trusted = np.abs(problem.edges[:, 1] - problem.edges[:, 0]) == 1 if doubtful is None else ~doubtful
    return trusted | joining_edges(problem, trusted)


def reject_false_edges(
    structure: Structure, trusted: Mask, probability: float, progress: Progress | None = None
) -> tuple[Array, Array]:
    """Return the weights [E] of edges, 1 kept, 0 rejected, and poses near their optimum.

    Edges `trusted` [E] are never doubted and join all poses.
    """
    problem = structure.problem
    limit = chi_square_limit(probability, problem.tangent)
    poses, candidates, scale = _gated(problem, trusted, limit, progress)
    weights = candidates.astype(np.float64)
    weights[candidates], poses = graduated_non_convexity(
        Structure(problem.with_edges(candidates)), poses, trusted[candidates], TAILS * limit * scale, progress
    )
    return weights, poses


def joining_edges(problem: PoseGraphProblem, trusted: Mask) -> Mask:
    """Return edges [E] that join what the trusted ones leave apart, in the order of the file."""
    labels = problem.with_edges(trusted).components()
    out = np.zeros(len(trusted), dtype=np.bool_)
    for e in np.flatnonzero(labels[problem.edges[:, 0]] != labels[problem.edges[:, 1]]).tolist():
        a, b = labels[problem.edges[e]].tolist()
        if a != b:
            labels[labels == b] = a
            out[e] = True
    return out


def _gated(
    problem: PoseGraphProblem, trusted: Mask, limit: float, progress: Progress | None
) -> tuple[Array, Mask, float]:
    """Return poses by the edges that passed the gates, these edges with others not far off, and the noise's scale.

    Many files state variances that are far too large, which would separate nothing. So all variances
    are multiplied by what the agreement of loops with odometry shows, and later the cost per degree of freedom; never
    by more than 1.
    """
    k = problem.tangent
    kept = trusted.copy()
    chain = problem.with_edges(trusted)
    poses = odometry_start(chain, chain.anchors())
    volume = log_volume(poses[:, :-1, -1])
    level, scale = 0, 0.0
    for _ in range(_ROUNDS_MAX):
        structure = Structure(problem.with_edges(kept))
        ones = np.ones(int(kept.sum()))
        poses = levenberg_marquardt(structure, poses, ones, iterations=10, tolerance=1e-4).poses
        cost = structure.problem.chi2(poses)
        if progress is not None:
            progress(0, cost)
        rest = np.flatnonzero(~kept)
        if not len(rest):
            break
        distance, log_density = _tested(structure, problem, poses, rest)
        loops = len(structure.problem.edges) - len(structure.free)
        if loops >= _LOOPS_FOR_SCALE:
            scale = cost / (k * loops)
        elif scale == 0.0:
            scale = float(np.quantile(distance, _CLOSEST) / chi_square_limit(2.0 * _CLOSEST, k))
        scale = min(1.0, max(scale, _SCALE_MIN))
        evidence = volume + log_density - 0.5 * (k * math.log(scale) + distance / scale)
        enters, level = entering(np.where(distance <= limit * scale, evidence, -np.inf), level, SOUND)
        if not enters.any():
            kept[rest[distance <= _NEAR * limit * scale]] = True
            break
        kept[rest[enters]] = True
    return poses, kept, scale or 1.0


def _tested(
    structure: Structure, problem: PoseGraphProblem, poses: Array, edges: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances of edges not in the structure, and the log-density at distance zero."""
    k, ones = problem.tangent, np.ones(len(structure.problem.edges))
    S, _ = covariances_of_edges(structure, problem, poses, ones, edges, np.zeros(len(edges), dtype=np.bool_))
    information = problem.information[edges]
    floor = _LEAST_INFORMATION * np.einsum("eii->e", information)
    noise = np.linalg.inv(information + floor[:, None, None] * np.eye(k))
    return innovation(problem.residuals(poses)[edges], S + noise)


def graduated_non_convexity(
    structure: Structure, poses: Array, trusted: Mask, limit: float | Array, progress: Progress | None = None
) -> tuple[Array, Array]:
    """Return the weights [E], 0 or 1, that minimise the least squares, truncated at `limit`, of what is not trusted.

    With them the poses that the last step ended with.

    `limit` is one for all edges or has one for each [E].

    Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, section IV.
    """
    problem = structure.problem
    weights = np.ones(len(problem.edges))
    if trusted.all():
        return weights, poses
    errors = problem.edge_chi2(poses)
    limits = np.broadcast_to(np.asarray(limit, dtype=np.float64), errors.shape)[~trusted]
    control = float(np.min(limits / np.maximum(2.0 * errors[~trusted] - limits, limits)))
    for _ in range(_STEPS_MAX):
        weights[~trusted] = _weights(errors[~trusted], limits, control)
        descent = levenberg_marquardt(structure, poses, weights, iterations=_INNER, tolerance=_INNER_TOLERANCE)
        poses, errors = descent.poses, problem.edge_chi2(descent.poses)
        if progress is not None:
            progress(0, descent.costs[-1])
        if control > 1.0 and np.all((weights < _SETTLED) | (weights > 1.0 - _SETTLED)):
            break
        control *= _GROWTH
    weights[~trusted] = errors[~trusted] <= limits
    return weights, poses


def _weights(errors: Array, limit: Array, control: float) -> Array:
    """Return the weights of truncated least squares at a control parameter (equation 14 of the paper)."""
    upper, lower = (control + 1.0) / control * limit, control / (control + 1.0) * limit
    between = np.sqrt(limit * control * (control + 1.0) / np.maximum(errors, 1e-300)) - control
    return np.where(errors >= upper, 0.0, np.where(errors <= lower, 1.0, np.clip(between, 0.0, 1.0)))
