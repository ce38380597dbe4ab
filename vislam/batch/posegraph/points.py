"""Edges that measure a position alone: of a landmark from a pose, or of a pose or landmark in the world.

Their error is the translation of Z^-1 @ T_i^-1 @ T_j as it is, r = R_Z^T (R_i^T (t_j - t_i) - t_Z), without the
logarithm that edges between poses take: g2o's EdgeSE2PointXY, EdgeSE3PointXYZ, EdgeSE2XYPrior and EdgeSE3XYZPrior.
Landmarks are poses whose rotation, the identity, nothing measures and nothing moves.
"""

from __future__ import annotations

import numpy as np

from vislam.batch.posegraph.problem import Ids, Mask, PoseGraphProblem
from vislam.core.messages import Array

_HELD = 1.0  # information of a landmark's rotation, whose gradient is zero: it makes the equations definite


class PositionEdges:
    """The position edges of a problem, added to what compiled code makes of the others."""

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
