"""How certain a pose-graph solution is: covariances of poses, of pairs of them, and their ellipses.

Covariances are the inverse of the normal equations at the solution, relative to the poses that the solver held: the
anchor of each connected part. Tangents are as everywhere: rotation, then translation, on the body side.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.problem import Ids, PoseGraphProblem
from vislam.batch.posegraph.sightings import undetermined_landmarks, undetermined_message
from vislam.batch.posegraph.structure import NormalEquations, Structure, adjoints
from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import invert_many
from vislam.core.messages import Array

_OUTLINE_POINTS = 48  # of an ellipse


class Uncertainty:
    """The covariance of a solution, kept as a factor; it answers for single poses, for all and for pairs."""

    def __init__(self, problem: PoseGraphProblem, poses: Array, weights: Array | None = None) -> None:
        """Factorise at poses [N, d + 1, d + 1]; edges with `weights` [E] of 0 (rejected ones) do not count.

        Raises DataError where the measurements leave a pose undetermined, UsageError where the factor is too large.
        """
        self._problem = problem if weights is None else problem.with_edges(weights != 0.0)
        self._poses = np.ascontiguousarray(poses, dtype=np.float64)
        self._structure = Structure(self._problem)
        self.factor = self._structure.factor(problem.tangent)
        equations = NormalEquations(self._structure, self.factor)
        equations.linearise(self._poses, np.ones(len(self._problem.edges)))
        if not equations.factorise(0.0):
            free = undetermined_landmarks(self._problem, self._poses, np.ones(len(self._problem.edges)))
            if len(free):
                raise DataError(f"{undetermined_message(free)}; so there is no covariance")
            raise DataError("measurements leave a pose undetermined, so there is no covariance; give its edges more")

    def of(self, ids: Ids) -> Array:
        """Return the covariances [M, k, k] of poses, zero for anchors. Raises UsageError for an unknown id."""
        at, k = self._places(ids), self._problem.tangent
        ends = np.column_stack([self._structure.index[at], np.full(len(at), -1)])
        return self.factor.edge_covariances(ends, np.tile(np.eye(k), (len(at), 2, 1, 1)))

    def of_all(self) -> Array:
        """Return the covariances [N, k, k] of all poses, zero for anchors."""
        out = np.zeros((len(self._poses), self._problem.tangent, self._problem.tangent))
        inverse = inverse_diagonal(self.factor)
        out[self._structure.free] = 0.5 * (inverse + inverse.transpose(0, 2, 1))
        return out

    def relative(self, pairs: Ids) -> Array:
        """Return the covariances [M, k, k] of T_i^-1 @ T_j, on the side of j, for pairs of ids [M, 2].

        Raises UsageError for an id that is not there and for a pair that no measurements connect.
        """
        at = self._places(np.asarray(pairs).reshape(-1)).reshape(-1, 2)
        parts = self._problem.components()
        if len(apart := np.flatnonzero(parts[at[:, 0]] != parts[at[:, 1]])):
            i, j = self._problem.ids[at[apart[0]]].tolist()
            raise UsageError(f"no measurements connect the poses {i} and {j}; their relative motion is unknown")
        between = invert_many(self._poses[at[:, 1]]) @ self._poses[at[:, 0]]
        turned = np.tile(np.eye(self._problem.tangent), (len(at), 2, 1, 1))
        turned[:, 0] = -adjoints(between)
        return self.factor.edge_covariances(self._structure.index[at], turned)

    def _places(self, ids: Ids) -> Ids:
        ids = np.asarray(ids, dtype=np.int64)
        at = np.minimum(np.searchsorted(self._problem.ids, ids), len(self._problem.ids) - 1)
        if len(missing := np.flatnonzero(self._problem.ids[at] != ids)):
            raise UsageError(f"there is no pose {ids[missing[0]]} in the graph")
        return at


def uncertainty_if_any(problem: PoseGraphProblem, poses: Array, weights: Array) -> Uncertainty | None:
    """Return the uncertainty of a solution; None where a pose is undetermined, or the factor too large."""
    try:
        return Uncertainty(problem, poses, weights)
    except (DataError, UsageError):
        return None


def ellipses(
    poses: Array, covariances: Array, probability: float = 0.95, axes: tuple[int, int] = (0, 1), enlarged: float = 1.0
) -> Array:
    """Return outlines [M, P, 2] of where poses [M, d + 1, d + 1] are with a probability, seen along the third axis.

    `axes` are the two coordinates of the picture, `enlarged` multiplies the radii.
    """
    d = poses.shape[1] - 1
    R = poses[:, :d, :d]
    spread = (R @ covariances[:, -d:, -d:] @ R.transpose(0, 2, 1))[:, axes][:, :, axes]
    eigenvalues, directions = np.linalg.eigh(spread)
    radii = enlarged * np.sqrt(chi_square_limit(probability, 2) * np.maximum(eigenvalues, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_POINTS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    centre = poses[:, axes, d]
    return centre[:, None] + circle @ (directions * radii[:, None]).transpose(0, 2, 1)


def inverse_diagonal(factor: Factor) -> Array:
    """Return the diagonal blocks [n, d, d] of the inverse of what a factor holds.

    Only the entries of the inverse where the factor has some are computed, front by front from the roots: with the
    pivots' triangle L and the rows B beneath, U = B L^-1 and Z the inverse among those rows, it is -Z U beneath and
    L^-T L^-1 + U^T Z U among the pivots (Takahashi et al. 1973; Lin et al., "SelInv", 2011).
    """
    s, d = factor.symbolic, factor.d
    out = np.empty((s.count, d, d))
    fronts: dict[int, Array] = {}
    waiting = np.bincount(s.parent[s.parent >= 0], minlength=len(s.parent))
    within = np.arange(d)
    for f in range(len(s.parent) - 1, -1, -1):
        L, B = factor.panel(f)
        width = len(L)
        inverse = solve_triangular(L, np.eye(width), lower=True)
        full = np.empty((width + len(B), width + len(B)))
        full[:width, :width] = inverse.T @ inverse
        if len(B):
            up = int(s.parent[f])
            rows = (s.target[s.row_begin[f] : s.row_begin[f + 1], None] * d + within).ravel()
            Z, U = fronts[up][np.ix_(rows, rows)], B @ inverse
            full[width:, width:] = Z
            full[width:, :width] = -Z @ U
            full[:width, width:] = full[width:, :width].T
            full[:width, :width] -= U.T @ full[width:, :width]
            waiting[up] -= 1
            if waiting[up] == 0:
                del fronts[up]
        if waiting[f]:
            fronts[f] = full
        for k in range(width // d):
            out[factor.node[s.first[f] + k]] = full[k * d : (k + 1) * d, k * d : (k + 1) * d]
    return out
