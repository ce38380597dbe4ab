"""Is a pose-graph solution the best there is? What can be proven, and of which cost.

The proof is SE-Sync's (see `graph_isotropic`), and it is one about a cost with isotropic weights and chordal distances
between rotations. Two costs of that kind say something about chi2, which `vislam optimize` minimises:

- The isotropic problem has the weights that SE-Sync gives a file. Newton's method goes from the solution to the
  nearest minimum of it, and where that is not the global one the Riemannian staircase (`graph_staircase`) goes on to a
  lower one. If it is proven to be the global minimum, and if minimising chi2 from there ends at no lower chi2 than the
  solution has, the solution is certified. For isotropic information and small residuals both costs are nearly the
  same; for other information this is strong evidence, not a proof.
- The bounding problem has weights so small that it is nowhere above chi2: with the residual r = (w, v) of an edge,
  |R_j - R_i Z|_F^2 <= 2 |w|^2 and |t_j - t_i - R_i z| <= |v|, so diag(2 kappa, tau) <= W suffices. What is proven of
  its minimum is a lower bound of chi2 itself, whatever the information: no poses cost less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vislam.batch.posegraph.isotropic import IsotropicGraph, Spectrum
from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.solver import levenberg_marquardt
from vislam.batch.posegraph.staircase import Climb, climb, minimise, tangent
from vislam.batch.posegraph.starts import harmonic_means
from vislam.batch.posegraph.structure import Structure
from vislam.batch.posegraph.symbolic import FACTOR_MAX_BYTES
from vislam.core.messages import Array

_GAP = 1e-6  # of the cost: a solution so near to the proven bound is the minimum
_SAME = 1e-6  # of chi2: two solutions that differ by less cost the same
_NOTHING = 1e-9  # chi2 counts squares of standard deviations; measurements without errors leave rounding alone
_ROUNDING = 1e-9  # relative, of weights
_STEPS, _CONVERGED = 200, 1e-9  # of the descent that compares: well beyond the line before


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """What is proven about a solution, and with which numbers."""

    certified: bool
    reason: str  # one sentence, what it rests on or what is missing
    chi2: float  # of the solution
    chi2_bound: float  # no poses have a lower chi2 than this
    isotropic_cost: float  # SE-Sync's cost at the minimum of it that the solution leads to
    isotropic_bound: float  # no poses have a lower SE-Sync cost than this
    least_eigenvalue: float  # of the certificate matrix there, by Lanczos
    proven_eigenvalue: float  # no eigenvalue is below this
    tolerance: float  # the eigenvalue must not be below minus this: 1e-6 of the cost in all
    spectral_gap: float  # first eigenvalue that is not zero by construction: near 0, the minimum is not unique
    better: Array | None  # poses [N, d + 1, d + 1] of lower chi2, where the check came across some

    @property
    def word(self) -> str:
        """Return "certified" or "not certified"."""
        return "certified" if self.certified else "not certified"

    @property
    def text(self) -> str:
        """Return the verdict with its numbers, in one line."""
        least = "" if np.isnan(self.least_eigenvalue) else f"; least eigenvalue {self.least_eigenvalue:.2g}"
        allowed = "" if np.isnan(self.tolerance) else f" (down to -{self.tolerance:.2g} is zero)"
        return f"{self.word}: {self.reason}{least}{allowed}; chi2 of any solution is at least {self.chi2_bound:.9g}"


def certify(problem: PoseGraphProblem, poses: Array, weights: Array | None = None) -> Certificate:
    """Return what can be proven about poses [N, d + 1, d + 1], which should be at a minimum of chi2.

    With `weights` [E], edges of weight 0 (rejected ones) do not count, and the others do as if they never were.
    """
    if weights is not None:
        problem = problem.with_edges(weights != 0.0)
    chi2 = problem.chi2(poses)
    if not problem.of_poses:
        return _unproven(chi2, "there are landmarks or priors; the proof is for poses and relative poses alone")
    if (fixed := _tied(problem)) > 0:
        return _unproven(chi2, f"{fixed} poses are fixed, two or more in one part; the proof is for free poses")
    of_cost = isotropic_weights(problem)
    graph = IsotropicGraph(problem, *of_cost)
    needed = graph.bytes_of(tangent(problem.dimension, problem.dimension))
    if needed > FACTOR_MAX_BYTES:
        return _unproven(chi2, f"its factor takes {needed / 1e9:.1f} GB, more than is allowed")
    at, _ = minimise(graph, poses[:, :-1])
    spectrum = graph.spectrum(at)
    if not np.isfinite(spectrum.proven):
        return _unproven(chi2, "measurements leave translations of a part of the graph without any information")
    climbed = None
    if spectrum.proven > _tolerance(graph, at, spectrum):
        climbed = climb(graph, at, problem.components(), _tolerance(graph, at, spectrum))
        if graph.value(climbed.X) < graph.value(at):
            at = climbed.X
            spectrum = graph.spectrum(at)
    cost, tolerance = graph.value(at), _tolerance(graph, at, spectrum)
    least = spectrum.proven <= tolerance
    better = _descended(problem, at, poses) if least or climbed is not None else None
    if better is not None and problem.chi2(better) >= chi2 * (1.0 - _SAME) - _NOTHING:
        better = None
    if not least:
        assert climbed is not None
        reason = _left_open(climbed, cost)
    elif better is not None:
        reason = f"from the global minimum of the isotropic cost chi2 goes down to {problem.chi2(better):.8g}"
    else:
        reason = "the global minimum of the isotropic cost leads to this solution or to one of the same chi2"
    proven = cost - problem.dimension * len(poses) * spectrum.proven
    isotropic_bound = max(proven, 0.0 if climbed is None else climbed.bound, 0.0)
    of_bound = bounding_weights(problem)
    # as of isotropic information in space: what is proven of this cost is of chi2, too
    is_below = all(np.all(a <= (1.0 + _ROUNDING) * b) for a, b in zip(of_cost, of_bound, strict=True))
    bound = isotropic_bound / (1.0 + _ROUNDING) if is_below else _bound(problem, poses, *of_bound)
    return Certificate(
        certified=least and better is None,
        reason=reason,
        chi2=chi2,
        chi2_bound=min(bound, chi2),
        isotropic_cost=cost,
        isotropic_bound=isotropic_bound,
        least_eigenvalue=spectrum.least,
        proven_eigenvalue=-spectrum.proven,
        tolerance=tolerance,
        spectral_gap=spectrum.gap,
        better=better,
    )


def _tolerance(graph: IsotropicGraph, X: Array, spectrum: Spectrum) -> float:
    return max(_GAP * graph.value(X) / (X.shape[1] * len(X)), 10.0 * spectrum.rounding)


def _left_open(climbed: Climb, cost: float) -> str:
    """Return why the staircase, too, did not settle it."""
    if climbed.solved:
        return (
            f"no poses have an isotropic cost below {climbed.bound:.8g}, the best found have {cost:.8g}: the "
            f"relaxation has its minimum in {climbed.rank} dimensions, and what lies between is open"
        )
    return (
        "the isotropic cost may be lower elsewhere: its certificate matrix has a negative eigenvalue, also where the "
        f"search ended in {climbed.rank} dimensions, with a gradient of {climbed.gradient:.2g}"
    )


def isotropic_weights(problem: PoseGraphProblem) -> tuple[Array, Array]:
    """Return kappa [E] and tau [E] as SE-Sync takes them from a file: from harmonic means of the information.

    In the plane SE-Sync takes the information of the angle itself for kappa, which weighs rotations twice; it is done
    here too, so that its published costs are comparable.
    """
    d = problem.dimension
    k = d * (d - 1) // 2
    tau = harmonic_means(problem.information[:, k:, k:])
    kappa = harmonic_means(problem.information[:, :k, :k])
    return (kappa if d == 2 else 0.5 * kappa), tau


def bounding_weights(problem: PoseGraphProblem) -> tuple[Array, Array]:
    """Return kappa [E] and tau [E] as large as chi2 allows everywhere: diag(2 kappa, tau) <= information."""
    d = problem.dimension
    k = d * (d - 1) // 2
    W = problem.information
    turn, move = np.linalg.eigvalsh(W[:, :k, :k])[:, 0], np.linalg.eigvalsh(W[:, k:, k:])[:, 0]
    turn, move = np.maximum(turn, 0.0), np.maximum(move, 0.0)
    weights = np.sqrt(np.column_stack([turn] * k + [move] * d))
    with np.errstate(over="ignore"):
        scaled = W / np.maximum(weights[:, :, None] * weights[:, None, :], np.finfo(float).tiny)
    crossed = np.abs(W[:, :k, k:]).max(axis=(1, 2)) > 0.0
    share = np.ones(len(W))
    known = np.isfinite(scaled).all(axis=(1, 2))  # else a weight is zero but for rounding, and the other is nothing
    share[crossed & ~known] = 0.0
    share[crossed & known] = np.clip(np.linalg.eigvalsh(scaled[crossed & known])[:, 0], 0.0, 1.0)
    return 0.5 * share * turn, share * move


def _bound(problem: PoseGraphProblem, poses: Array, kappa: Array, tau: Array) -> float:
    graph = IsotropicGraph(problem, kappa, tau)
    at, _ = minimise(graph, poses[:, :-1])
    proven = graph.spectrum(at).proven
    return max(graph.value(at) - problem.dimension * len(poses) * proven, 0.0)


def _descended(problem: PoseGraphProblem, X: Array, poses: Array) -> Array:
    """Return the minimum of chi2 that [R t], X [N, d, d + 1], lead to, the anchor of each part where `poses` have it.

    Where both have the same residuals, but for what is nothing beside their chi2, it leads to `poses`.
    """
    ones, anchors, start = np.ones(len(problem.edges)), problem.anchors(), np.zeros_like(poses)
    start[:, :-1], start[:, -1, -1] = X, 1.0
    labels = problem.components()
    held = np.empty(len(anchors), dtype=np.int64)
    held[labels[anchors]] = anchors
    moved = (poses[held] @ np.linalg.inv(start[held]))[labels] @ start
    moved[anchors] = poses[anchors]
    off = problem.residuals(moved) - problem.residuals(poses)
    if np.einsum("ea,eab,eb->", off, problem.information, off, optimize=True) <= _SAME * problem.chi2(poses):
        return poses
    return levenberg_marquardt(Structure(problem), moved, ones, iterations=_STEPS, tolerance=_CONVERGED).poses


def _tied(problem: PoseGraphProblem) -> int:
    """Return how many poses are fixed, 0 where none shares its part with another one."""
    parts = problem.components()[problem.fixed]
    return len(parts) if len(np.unique(parts)) < len(parts) else 0


def _unproven(chi2: float, reason: str) -> Certificate:
    nan = float("nan")
    return Certificate(False, reason, chi2, 0.0, nan, 0.0, nan, -np.inf, nan, nan, None)
