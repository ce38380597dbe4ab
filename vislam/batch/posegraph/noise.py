"""What residuals show of a pose graph's stated noise: per kind of edge, chi-square against degrees of freedom.

The degrees of freedom of an edge at the optimum are its redundancy: what the measurement has over what the solution
takes from it, k - trace(W S) with the information W and the covariance S of its relative pose. Summed over a kind, chi2
over redundancy estimates the factor by which its variances are stated wrongly (Foerstner's variance components;
Foerstner and Wrobel, "Photogrammetric Computer Vision", 2016, section 4.2.4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.structure import NormalEquations, Structure, adjoints
from vislam.core.errors import UsageError
from vislam.core.geometry import invert_many
from vislam.core.messages import Array

Mask = NDArray[np.bool_]

_REDUNDANCY_MIN = 10.0  # numbers; fewer say nothing about a scale
_SHARE_MIN = 0.02  # of the measured numbers of a kind; where nearly all are taken up by the solution, neither
_SAMPLE_MIN, _SAMPLE_MAX = 50, 1000  # edges of each kind whose covariances are computed
_ANY_HEADING = 3.0 / np.pi**2  # information of an angle that may be any: it is none
_TINY = 1e-10


@dataclass(frozen=True, slots=True)
class NoiseOfKind:
    """What the residuals of one kind of edge show."""

    kind: str  # "odometry" (successive ids) or "loops", of it "rotation" or "translation"
    edges: int
    numbers: int  # measured ones, those without information not counted
    chi2: float
    redundancy: float  # degrees of freedom
    factor: float  # variances are this many times those stated; nan where the redundancy is too small
    applied: float  # the factor that variances were multiplied by, 1 without --rescale-noise

    @property
    def text(self) -> str:
        """Return the finding in one line."""
        found = "too few" if np.isnan(self.factor) else f"{self.factor:.3g}"
        scaled = "" if self.applied == 1.0 else f", variances multiplied by {self.applied:.3g}"
        return (
            f"{self.kind}: chi2 {self.chi2:.6g} over {self.redundancy:.6g} degrees of freedom ({self.numbers} numbers "
            f"of {self.edges} edges) = {found}{scaled}"
        )


def covariances_of_edges(
    structure: Structure, problem: PoseGraphProblem, poses: Array, weights: Array, edges: Ids, inside: Mask,
    factor: Factor | None = None,
) -> tuple[Array, float]:  # fmt: skip
    """Return covariances [M, k, k] of the relative poses of `edges` (of `problem`), and the log-determinant of H.

    H are the normal equations of the structure's own problem at poses, its edges weighted by `weights`. Covariances are
    on the body side of the later end; of edges `inside` [M], which the structure has, of the error r itself, for where
    nothing else confirms a loop its redundancy is what rounding leaves of the difference between the two. `factor`:
    that of H, where it is there already. Raises UsageError where it does not fit into memory.
    """
    k = problem.tangent
    if factor is None:
        factor = structure.factor(k)
        equations = NormalEquations(structure, factor)
        equations.linearise(poses, weights)
        if not equations.factorise(1e-12) and not equations.factorise(1e-8):
            raise UsageError("the edges leave poses undetermined: their noise cannot be judged; give them information")
    ends = problem.edges[edges]
    jacobians = np.empty((len(ends), 2, k, k))
    jacobians[:, 1] = np.eye(k)
    jacobians[inside, 1] = _right_jacobian_inverse(problem.residuals(poses)[edges[inside]])
    between = invert_many(poses[ends[:, 1]]) @ poses[ends[:, 0]]
    jacobians[:, 0] = -jacobians[:, 1] @ adjoints(between)  # with Jr(r) = I for edges that are not in
    S = factor.edge_covariances(structure.index[ends], jacobians)
    return S, factor.log_determinant()


def _right_jacobian_inverse(r: Array) -> Array:
    """Return Jr(r)^-1 [M, k, k] of tangents r [M, k] by its series in ad(r): to 1e-6 below a radian, 1 % at pi."""
    k = r.shape[1]
    ad = np.zeros((len(r), k, k))
    if k == 3:
        ad[:, 1, 0], ad[:, 2, 0] = r[:, 2], -r[:, 1]
        ad[:, 1, 2], ad[:, 2, 1] = -r[:, 0], r[:, 0]
    else:
        ad[:, :3, :3] = ad[:, 3:, 3:] = np.cross(r[:, None, :3], np.eye(3), axisc=1)
        ad[:, 3:, :3] = np.cross(r[:, None, 3:], np.eye(3), axisc=1)
    square = ad @ ad
    fourth = square @ square
    return np.eye(k) + 0.5 * ad + square / 12.0 - fourth / 720.0 + fourth @ square / 30240.0


def noise_of_kinds(
    problem: PoseGraphProblem, poses: Array, weights: Array | None = None, factor: Factor | None = None
) -> tuple[NoiseOfKind, ...]:
    """Return what the edges with weight show at poses [N, d + 1, d + 1], the optimum: four kinds, those that exist.

    Chi-square is that of all edges, of redundancies the mean of as many as take about the time of the solution, every
    n-th of a kind. `factor`: as of `covariances_of_edges`. Raises UsageError where it does not fit.
    """
    used = np.arange(len(problem.edges)) if weights is None else np.flatnonzero(weights > 0.0)
    if not len(used):
        return ()
    structure = Structure(problem.with_edges(used))
    symbolic = structure.symbolic if factor is None else factor.symbolic
    most = int(np.clip(symbolic.affordable(), _SAMPLE_MIN, _SAMPLE_MAX))
    is_odometry = np.abs(problem.edges[:, 1] - problem.edges[:, 0]) == 1
    kinds = {"odometry": used[is_odometry[used]], "loops": used[~is_odometry[used]]}
    sample = np.concatenate([spread_out(edges, most) for edges in kinds.values()])
    inside = np.ones(len(sample), dtype=np.bool_)
    S, _ = covariances_of_edges(structure, problem, poses, np.ones(len(used)), sample, inside, factor)
    W, r = problem.information, problem.residuals(poses)
    turn = problem.tangent - problem.dimension
    measured = np.diagonal(W, axis1=1, axis2=2) > np.where(np.arange(problem.tangent) < turn, _ANY_HEADING, 0.0)
    chi2 = np.where(measured, r * np.einsum("eab,eb->ea", W, r), 0.0)
    taken = np.where(measured[sample], np.einsum("eab,eba->ea", W[sample], S), 0.0)
    found = []
    for name, edges in kinds.items():
        of_kind = is_odometry[sample] == (name == "odometry")
        for part, columns in (("rotation", slice(None, turn)), ("translation", slice(turn, None))):
            numbers = int(measured[edges, columns].sum())
            if not numbers:
                continue
            total = max(float(chi2[edges, columns].sum()), 0.0)
            share = float(taken[of_kind, columns].sum()) / max(int(measured[sample[of_kind], columns].sum()), 1)
            redundancy = max(numbers * (1.0 - share), 0.0)
            is_enough = redundancy >= max(_REDUNDANCY_MIN, _SHARE_MIN * numbers)
            times = max(total / redundancy, _TINY) if is_enough else float("nan")
            found.append(NoiseOfKind(f"{name} {part}", len(edges), numbers, total, redundancy, times, 1.0))
    return tuple(found)


def rescaled(problem: PoseGraphProblem, noise: tuple[NoiseOfKind, ...]) -> PoseGraphProblem:
    """Return the problem with variances multiplied by what each kind's residuals show, where they are enough."""
    factors = {kind.kind: kind.factor for kind in noise if np.isfinite(kind.factor)}
    odometry = np.abs(problem.edges[:, 1] - problem.edges[:, 0]) == 1
    scale, turn = np.ones((len(problem.edges), problem.tangent)), problem.tangent - problem.dimension
    for name, of_kind in (("odometry", odometry), ("loops", ~odometry)):
        scale[of_kind, :turn] = factors.get(f"{name} rotation", 1.0) ** -0.5
        scale[of_kind, turn:] = factors.get(f"{name} translation", 1.0) ** -0.5
    return replace(problem, information=problem.information * scale[:, :, None] * scale[:, None, :])


def spread_out(edges: Ids, most: int) -> Ids:
    """Return at most `most` of the edges, at equal distances."""
    return edges if len(edges) <= most else edges[np.linspace(0, len(edges) - 1, most).astype(np.int64)]
