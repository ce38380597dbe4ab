"""What a pose graph's solvers share: which poses are free, how they are eliminated, and room for the equations."""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import numpy as np

from vislam.batch.posegraph.arithmetic import Edges, Normal, linearise_2d, linearise_3d, retract_2d, retract_3d
from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.clusters import ClusteredSolver, Clusters, RigidMotions, multiply
from vislam.batch.posegraph.problem import Ids, Mask, PoseGraphProblem
from vislam.batch.posegraph.symbolic import FACTOR_MAX_BYTES, Symbolic, analyse
from vislam.core.errors import UsageError
from vislam.core.geometry import invert_many
from vislam.core.messages import Array

_WORK_PER_EDGE = 20_000  # multiplications over the size of a block, from which on conjugate gradients are faster
_STEP_TOLERANCE = 1e-3  # of a Newton step: what is missing of it costs the square of that

Equations = Literal["auto", "cholesky", "gradients"]
_HELD = 1.0  # information of a landmark's rotation, whose gradient is zero: it makes the equations definite


class Structure:
    """The anchors of a problem, its free poses, and the elimination or clusters that all its linear systems share."""

    def __init__(self, problem: PoseGraphProblem, equations: Equations = "auto") -> None:
        """Analyse the graph; the values of its measurements do not matter here.

        `equations`: "cholesky" factorises whatever the factor takes, "gradients" never does, "auto" does where the
        factor is small.
        """
        self.problem = problem
        self._equations = equations
        labels = problem.components()
        self.parts = int(labels.max(initial=-1)) + 1
        self.anchors = problem.anchors_of(labels)
        held = np.zeros(len(problem.ids), dtype=np.bool_)
        held[self.anchors] = True
        self.free: Ids = np.flatnonzero(~held)
        self.index = np.full(len(problem.ids), -1, dtype=np.int64)  # [N] place among the free poses
        self.index[self.free] = np.arange(len(self.free))
        self.ends = self.index[problem.edges]

    @cached_property
    def symbolic(self) -> Symbolic:
        """How a factor eliminates the free poses."""
        return analyse(len(self.free), *np.ascontiguousarray(self.ends.T))

    def factor(self, d: int) -> Factor:
        """Return a factor for blocks of size d. Raises UsageError where it does not fit into memory."""
        needed = self.symbolic.bytes(d)
        if needed > FACTOR_MAX_BYTES and self._equations != "cholesky":
            raise UsageError(
                f"the graph of {len(self.problem.ids)} poses and {len(self.problem.edges)} edges fills a factor of "
                f"{needed / 1e9:.1f} GB; covariances and the search for false edges need it to fit "
                f"{FACTOR_MAX_BYTES / 1e9:.1f} GB: leave edges out, or these"
            )
        return Factor(self.symbolic, d)

    def solver(self, d: int, tolerance: float = _STEP_TOLERANCE) -> Factor | ClusteredSolver:
        """Return what solves systems with blocks of size d, to a relative tolerance where it is not a factor."""
        if self.is_clustered(d):
            return ClusteredSolver(self.clusters, d, tolerance)
        return self.factor(d)

    def is_clustered(self, d: int) -> bool:
        """Return whether systems with blocks of size d are solved by conjugate gradients."""
        if self._equations != "auto":
            return self._equations == "gradients"
        slow = self.symbolic.work * d > _WORK_PER_EDGE * len(self.problem.edges)
        return slow or self.symbolic.bytes(d) > FACTOR_MAX_BYTES

    @cached_property
    def clusters(self) -> Clusters:
        """The poses in clusters, for conjugate gradients."""
        return Clusters(len(self.free), self.ends)


class NormalEquations:
    """The normal equations of a problem at some poses, in blocks: H = J^T W J and the gradient J^T W r."""

    def __init__(self, structure: Structure, solver: Factor | ClusteredSolver | RigidMotions) -> None:
        """Allocate room for them; `solver` is one of the structure's free poses, for blocks of the tangents' size."""
        self._structure, self._solver = structure, solver
        n, k, m = len(structure.free), structure.problem.tangent, len(structure.problem.edges)
        self.diagonal = np.zeros((n, k, k))
        self.off = np.zeros((m, k, k))
        self.gradient = np.zeros((n, k))
        self._linearise = linearise_2d if k == 3 else linearise_3d
        self._retract = retract_2d if k == 3 else retract_3d
        p = structure.problem
        self._positions = None if p.of_poses else PositionEdges(p, structure.index, solver.later_is_to)

    def linearise(self, poses: Array, weights: Array) -> float:
        """Form the equations at poses [N, d + 1, d + 1]; `weights` [E] multiply the edges. Return the cost."""
        s = self._structure
        p = s.problem
        self._poses = poses
        between = weights if self._positions is None else np.where(p.is_position, 0.0, weights)
        cost: float = self._linearise(
            Edges(p.edges, self._solver.later_is_to, p.measurements, p.information), s.index, poses, between,
            Normal(self.diagonal, self.off, self.gradient),
        )  # fmt: skip
        if self._positions is not None:
            cost += self._positions.add(poses, weights, self.diagonal, self.off, self.gradient)
        return cost

    def factorise(self, damping: float) -> bool:
        """Prepare to solve the equations, damped; False where they are not positive definite."""
        diagonal = self.damped(damping)
        if isinstance(self._solver, Factor):
            return self._solver.factorise(diagonal, self.off)
        clusters, at = self._solver.clusters, self._poses[self._structure.free]
        motions = adjoints(invert_many(at) @ at[clusters.first[clusters.of]])
        return self._solver.factorise(diagonal, self.off, motions)

    def step(self) -> Array:
        """Return the Newton step [n, k] of the equations as last prepared."""
        return self._solver.solve(-self.gradient)

    def rest(self, step: Array) -> Array:
        """Return what the solver adds to a step [n, k] that is no solution of the equations yet."""
        return self._solver.solve(-self.gradient - self.product(step))

    def damped(self, damping: float) -> Array:
        """Return the diagonal blocks [n, k, k], their diagonals enlarged by this share of themselves (Marquardt)."""
        if damping == 0.0:
            return self.diagonal
        out = self.diagonal.copy()
        k = out.shape[1]
        entries = out[:, np.arange(k), np.arange(k)]
        floor = 1e-6 * entries.max(initial=0.0)
        out[:, np.arange(k), np.arange(k)] = entries + damping * np.maximum(entries, floor)
        return out

    def product(self, step: Array) -> Array:
        """Return H @ step [n, k]."""
        s, out = self._structure, np.empty_like(step)
        both = np.flatnonzero((s.ends >= 0).all(axis=1))
        to = self._solver.later_is_to[both]
        later, earlier = np.where(to, s.ends[both, 1], s.ends[both, 0]), np.where(to, s.ends[both, 0], s.ends[both, 1])
        multiply(self.diagonal, self.off, later, earlier, both, step, out)
        return out

    def retract(self, poses: Array, step: Array, out: Array) -> None:
        """Write poses @ Exp(step) into out; step [n, k] is of the free poses."""
        self._retract(poses, self._structure.free, step, out)


def adjoints(T: Array) -> Array:
    """Return the adjoints [M, k, k] of poses [M, d + 1, d + 1]."""
    d = T.shape[1] - 1
    turn = 3 * (d - 1) - d
    out = np.zeros((len(T), turn + d, turn + d))
    out[:, turn:, turn:] = T[:, :d, :d]
    if d == 2:
        out[:, 0, 0] = 1.0
        out[:, 1, 0], out[:, 2, 0] = T[:, 1, 2], -T[:, 0, 2]
        return out
    out[:, :3, :3] = T[:, :3, :3]
    out[:, 3:, :3] = np.cross(T[:, None, :3, 3], T[:, :3, :3], axisa=2, axisb=1, axisc=1)
    return out


class PositionEdges:
    """The edges that measure a position alone, added to what compiled code makes of the others.

    Their error is the translation of Z^-1 @ T_i^-1 @ T_j as it is, r = R_Z^T (R_i^T (t_j - t_i) - t_Z), without the
    logarithm of edges between poses: EdgeSE2PointXY, EdgeSE3PointXYZ, EdgeSE2XYPrior and EdgeSE3XYZPrior of g2o.
    Landmarks are poses whose rotation, the identity, nothing measures and nothing moves.
    """

    def __init__(self, problem: PoseGraphProblem, index: Ids, later_is_to: Mask) -> None:
        """`index` [N] are places among the free poses (-1: held), `later_is_to` [E] how a factor orders blocks."""
        self.at: Ids = np.flatnonzero(problem.is_position)
        self._problem, self._index = problem, index
        self._later_is_to = later_is_to[self.at]
        self._points = index[np.flatnonzero(problem.is_point)]
        self._points = self._points[self._points >= 0]

    def add(self, poses: Array, weights: Array, diagonal: Array, off: Array, gradient: Array) -> float:
        """Add to normal equations at poses [N, d + 1, d + 1]; return the cost. `weights` [E] multiply the edges."""
        p, d = self._problem, self._problem.dimension
        turn = diagonal.shape[1] - d
        ends, W = p.edges[self.at], weights[self.at, None, None] * p.information[self.at, turn:, turn:]
        Ti, Tj = poses[ends[:, 0]], poses[ends[:, 1]]
        r = p.residuals(poses)[self.at, turn:]
        R_back = p.measurements[self.at, :d, :d].transpose(0, 2, 1)
        to_from = Ti[:, :d, :d].transpose(0, 2, 1)
        seen = np.einsum("eab,eb->ea", to_from, Tj[:, :d, d] - Ti[:, :d, d])
        J_i = np.concatenate([R_back @ turned_by(seen), -R_back], axis=2)
        J_j = np.concatenate([np.zeros((len(ends), d, turn)), R_back @ to_from @ Tj[:, :d, :d]], axis=2)
        i, j = self._index[ends].T
        for J, place in ((J_i, i), (J_j, j)):
            here = place >= 0
            WJ = (W @ J)[here]
            np.add.at(diagonal, place[here], J[here].transpose(0, 2, 1) @ WJ)
            np.add.at(gradient, place[here], np.einsum("eba,eb->ea", WJ, r[here]))
        cross = J_i.transpose(0, 2, 1) @ W @ J_j
        later = self._later_is_to[:, None, None]
        both = (i >= 0) & (j >= 0)
        off[self.at[both]] = np.where(later, cross, cross.transpose(0, 2, 1))[both]
        diagonal[self._points[:, None], range(turn), range(turn)] += _HELD
        return float(np.einsum("ea,eab,eb->", r, W, r))


def turned_by(points: Array) -> Array:
    """Return the derivatives [M, d, turn] of Exp(-w) @ points [M, d] by w at zero."""
    out = np.zeros((len(points), points.shape[1], 1 if points.shape[1] == 2 else 3))
    if points.shape[1] == 2:
        out[:, 0, 0], out[:, 1, 0] = points[:, 1], -points[:, 0]
        return out
    x, y, z = points.T
    out[:, 0, 1], out[:, 0, 2] = -z, y
    out[:, 1, 0], out[:, 1, 2] = z, -x
    out[:, 2, 0], out[:, 2, 1] = -y, x
    return out
