"""PoseGraphProblem: poses to estimate and relative measurements between them, as pose-graph files hold them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vislam.batch.posegraph.arithmetic import chi2_2d, chi2_3d, errors_2d, errors_3d
from vislam.core.errors import DataError
from vislam.core.messages import Array

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]


def _none() -> Mask:
    return np.zeros(0, dtype=np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphProblem:
    """A pose graph in the plane (d = 2, tangents of k = 3) or in space (d = 3, k = 6): measurements and a start.

    Tangents and information matrices are ordered rotation, then translation (2D: angle, x, y), on the body side.
    The error of an edge from i to j with measurement Z is r = Log(Z^-1 @ T_world_i^-1 @ T_world_j), the logarithm of
    SE(2) or SE(3). The cost is chi2 = sum of r^T @ information @ r, without a prior and without a factor 1/2: twice the
    error that gtsam 4.3 gives for the same file. Every array is C-contiguous.
    """

    dimension: int  # 2 or 3
    ids: Ids  # [N] ascending, as the file names the poses; never negative
    poses: Array  # [N, d + 1, d + 1] T_world_pose to start from; all NaN where there is none
    fixed: NDArray[np.bool_]  # [N] poses that keep their value
    edges: Ids  # [E, 2] indices (not ids) of the poses from and to
    measurements: Array  # [E, d + 1, d + 1] T_from_to
    information: Array  # [E, k, k] symmetric, positive semidefinite
    passed_lines: tuple[str, ...] = ()  # of landmarks and parameters: kept, never optimised
    notes: tuple[str, ...] = field(default=())  # what a reader found odd and how it went about it
    is_point: Mask = field(default_factory=_none)  # [N] landmarks: poses whose rotation means nothing
    is_position: Mask = field(default_factory=_none)  # [E] edges that measure a position alone, see `graph_points`
    world: int = -1  # the pose (index) at the origin, in no file, of which priors are edges; -1: there are none

    def __post_init__(self) -> None:
        d, n, m = self.dimension, len(self.ids), len(self.edges)
        k = 3 * (d - 1)
        for name, count in (("is_point", n), ("is_position", m)):
            if not getattr(self, name).any():  # of any length, so that edges can be replaced where there are none
                object.__setattr__(self, name, np.zeros(count, dtype=np.bool_))
        shapes = {"poses": (n, d + 1, d + 1), "fixed": (n,), "edges": (m, 2), "is_point": (n,), "is_position": (m,)}
        shapes |= {"measurements": (m, d + 1, d + 1), "information": (m, k, k)}
        wrong = {name: getattr(self, name).shape for name in shapes if getattr(self, name).shape != shapes[name]}
        if d not in (2, 3) or wrong:
            raise DataError(f"a pose graph of dimension {d}, {n} poses and {m} edges cannot have the shapes {wrong}")
        if n and (self.ids[0] < 0 or np.any(np.diff(self.ids) <= 0)):
            raise DataError("the ids of a pose graph must ascend, without repetition, from 0 at least")
        if m and (self.edges.min() < 0 or self.edges.max() >= n or np.any(self.edges[:, 0] == self.edges[:, 1])):
            raise DataError(f"an edge must join two different poses of the {n} that there are")

    def __repr__(self) -> str:
        return f"PoseGraphProblem({len(self.ids)} poses of dimension {self.dimension}, {len(self.edges)} edges)"

    def noted(self, notes: tuple[str, ...]) -> PoseGraphProblem:
        """Return the problem with more notes."""
        return replace(self, notes=self.notes + notes)

    def with_edges(self, edges: Ids | Mask) -> PoseGraphProblem:
        """Return the problem with some of its edges, by index or by a mask [E]."""
        if edges.dtype == np.bool_ and edges.all():
            return self
        return replace(
            self, edges=self.edges[edges], measurements=self.measurements[edges], information=self.information[edges],
            is_position=self.is_position[edges],
        )  # fmt: skip

    @property
    def is_pose(self) -> Mask:
        """Which poses [N] are poses of the file: neither landmarks nor the world."""
        out = ~self.is_point
        if self.world >= 0:
            out[self.world] = False
        return out

    @property
    def of_poses(self) -> bool:
        """Whether all is poses and relative poses: no landmark, no prior."""
        return self.world < 0 and not self.is_point.any() and not self.is_position.any()

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """Which poses [N] have an initial value."""
        return ~np.isnan(self.poses[:, 0, 0])

    @property
    def tangent(self) -> int:
        """Dimension of a pose's tangent: 3 in the plane, 6 in space."""
        return 3 * (self.dimension - 1)

    def chi2(self, poses: Array, weights: Array | None = None) -> float:
        """Return the cost (see the class) of poses [N, d + 1, d + 1]; `weights` [E] multiply the edges' terms."""
        return float(np.dot(self.edge_chi2(poses), np.ones(len(self.edges)) if weights is None else weights))

    def edge_chi2(self, poses: Array) -> Array:
        """Return the terms [E] that sum up to the cost."""
        out = np.empty(len(self.edges))
        kernel = chi2_2d if self.dimension == 2 else chi2_3d
        kernel(self.edges, np.ascontiguousarray(poses, dtype=np.float64), self.measurements, self.information, out)
        at = np.flatnonzero(self.is_position)
        if len(at):
            r, d = self._position_errors(poses, at), self.dimension
            out[at] = np.einsum("ea,eab,eb->e", r, self.information[at, -d:, -d:], r)
        return out

    def residuals(self, poses: Array) -> Array:
        """Return the errors r [E, k] of the edges (see the class)."""
        out = np.empty((len(self.edges), self.tangent))
        kernel = errors_2d if self.dimension == 2 else errors_3d
        kernel(self.edges, np.ascontiguousarray(poses, dtype=np.float64), self.measurements, out)
        at = np.flatnonzero(self.is_position)
        if len(at):
            out[at] = 0.0
            out[at, -self.dimension :] = self._position_errors(poses, at)
        return out

    def _position_errors(self, poses: Array, at: Ids) -> Array:
        """Return the errors [M, d] of edges that measure a position alone: the translation of Z^-1 T_i^-1 T_j."""
        d, (i, j) = self.dimension, self.edges[at].T
        seen = np.einsum("eba,eb->ea", poses[i, :d, :d], poses[j, :d, d] - poses[i, :d, d])
        return np.asarray(np.einsum("eba,eb->ea", self.measurements[at, :d, :d], seen - self.measurements[at, :d, d]))

    def components(self) -> Ids:
        """Return for each pose [N] the number of the connected part that it is in, counted in the order of the ids."""
        n, m = len(self.ids), len(self.edges)
        joined = coo_array((np.ones(m, dtype=np.int8), (self.edges[:, 0], self.edges[:, 1])), shape=(n, n))
        _, labels = connected_components(joined, directed=False)
        _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
        rank = np.empty(len(first), dtype=np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        return rank[inverse]

    def anchors(self) -> Ids:
        """Return the poses (indices) that hold the graph: the fixed ones, and the first of each part that has none."""
        return self.anchors_of(self.components())

    def anchors_of(self, labels: Ids) -> Ids:
        """Return the anchors, given the parts [N] as `components` numbers them."""
        held = np.unique(labels[self.fixed])
        # a landmark would leave its part free to turn, so poses come first
        order = np.lexsort((np.arange(len(labels)), self.is_point, labels))
        first = order[np.unique(labels[order], return_index=True)[1]]
        return np.sort(np.concatenate([np.flatnonzero(self.fixed), np.delete(first, held)]))

    def with_poses(self, poses: Array) -> PoseGraphProblem:
        """Return the problem with other poses to start from."""
        return replace(self, poses=np.ascontiguousarray(poses, dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Measurements in space between poses 0, 1, 2, ..., tangents as in `PoseGraphProblem`."""

    ends: Ids  # [E, 2]
    T_from_to: Array  # [E, 4, 4]
    information: Array  # [E, 6, 6]

    @staticmethod
    def of(ends: Sequence[tuple[int, int]], measured: Sequence[tuple[Array, Array]]) -> RelativePoses:
        """Return measurements [4, 4] with their information [6, 6] between these ends."""
        return RelativePoses(
            np.array(ends, dtype=np.int64).reshape(-1, 2),
            np.array([T for T, _ in measured], dtype=np.float64).reshape(-1, 4, 4),
            np.array([information for _, information in measured], dtype=np.float64).reshape(-1, 6, 6),
        )

    @staticmethod
    def joined(parts: Sequence[RelativePoses]) -> RelativePoses:
        """Return measurements one after another."""
        return RelativePoses(
            np.concatenate([part.ends for part in parts]),
            np.concatenate([part.T_from_to for part in parts]),
            np.concatenate([part.information for part in parts]),
        )

    def problem(self, poses: Array) -> PoseGraphProblem:
        """Return the pose graph of the measurements, with poses [N, 4, 4] to start from."""
        count = len(poses)
        return PoseGraphProblem(
            3, np.arange(count), np.ascontiguousarray(poses), np.zeros(count, np.bool_),
            np.ascontiguousarray(self.ends), np.ascontiguousarray(self.T_from_to),
            np.ascontiguousarray(self.information),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Which edges to believe, and why."""

    poses: Array | None  # [N, d + 1, d + 1] near their optimum; None: not known
    weights: Array  # [E] 1 kept, 0 rejected
    reason: str  # the method that was taken and what speaks for it
    undecided: NDArray[np.int64] = field(default_factory=lambda: np.array([], dtype=np.int64))  # edges left out so
    warning: str = ""  # empty where everything was decided
