"""What a pose graph's solvers share: which poses are free, how they are eliminated, and room for the equations."""

from __future__ import annotations

import numpy as np

from vislam.batch.graph_cholesky import Factor
from vislam.batch.graph_kernels import linearise_2d, linearise_3d, retract_2d, retract_3d
from vislam.batch.graph_problem import Ids, PoseGraphProblem
from vislam.batch.graph_symbolic import analyse
from vislam.messages import Array


class Structure:
    """The anchors of a problem, its free poses, and the elimination that all its linear systems share."""

    def __init__(self, problem: PoseGraphProblem) -> None:
        """Analyse the graph; the values of its measurements do not matter here."""
        self.problem = problem
        labels = problem.components()
        self.parts = int(labels.max(initial=-1)) + 1
        self.anchors = problem.anchors_of(labels)
        held = np.zeros(len(problem.ids), dtype=np.bool_)
        held[self.anchors] = True
        self.free: Ids = np.flatnonzero(~held)
        self.index = np.full(len(problem.ids), -1, dtype=np.int64)  # [N] place among the free poses
        self.index[self.free] = np.arange(len(self.free))
        self.ends = self.index[problem.edges]
        self.symbolic = analyse(len(self.free), *np.ascontiguousarray(self.ends.T))

    def factor(self, d: int) -> Factor:
        """Return a factor for blocks of size d."""
        return Factor(self.symbolic, d)

    def directed(self, blocks: Array) -> Array:
        """Return what `Factor` takes as off-diagonal, from the blocks [E, d, d] of rows `to` and columns `from`.

        Where the pose `from` is the later one, the block there is the transposed one.
        """
        return np.where(self.symbolic.later_is_to[:, None, None], blocks.transpose(0, 2, 1), blocks)


class NormalEquations:
    """The normal equations of a problem at some poses, in blocks: H = J^T W J and the gradient J^T W r."""

    def __init__(self, structure: Structure) -> None:
        """Allocate room for them."""
        self._structure = structure
        n, k, m = len(structure.free), structure.problem.tangent, len(structure.problem.edges)
        self.diagonal = np.zeros((n, k, k))
        self.off = np.zeros((m, k, k))
        self.gradient = np.zeros((n, k))
        self._linearise = linearise_2d if k == 3 else linearise_3d
        self._retract = retract_2d if k == 3 else retract_3d

    def linearise(self, poses: Array, weights: Array) -> float:
        """Form the equations at poses [N, d + 1, d + 1]; `weights` [E] multiply the edges. Return the cost."""
        s = self._structure
        p = s.problem
        cost: float = self._linearise(
            p.edges, s.index, s.symbolic.later_is_to, poses, p.measurements, p.information, weights,
            self.diagonal, self.off, self.gradient,
        )  # fmt: skip
        return cost

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

    def curvature(self, step: Array) -> float:
        """Return step^T H step of a step [n, k]."""
        s = self._structure
        total = float(np.einsum("na,nab,nb->", step, self.diagonal, step, optimize=True))
        both = np.flatnonzero((s.ends >= 0).all(axis=1))
        later = np.where(s.symbolic.later_is_to[both], s.ends[both, 1], s.ends[both, 0])
        earlier = np.where(s.symbolic.later_is_to[both], s.ends[both, 0], s.ends[both, 1])
        cross = np.einsum("eb,eba,ea->", step[earlier], self.off[both], step[later], optimize=True)
        return total + 2.0 * float(cross)

    def retract(self, poses: Array, step: Array, out: Array) -> None:
        """Write poses @ Exp(step) into out; step [n, k] is of the free poses."""
        self._retract(poses, self._structure.free, step, out)
