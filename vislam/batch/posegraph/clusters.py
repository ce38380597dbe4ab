"""Conjugate gradients on the normal equations of pose graphs whose Cholesky factor would be too large or too slow.

Two levels precondition them. Poses that are near each other in the graph form clusters. The inner one factorises the
equations of each cluster for itself. The outer one lets clusters move as wholes: the equations projected on motions of
rigid clusters are those of a pose graph again, a small one, and are factorised as such. Together they are an additive
Schwarz preconditioner (Smith, Bjorstad, Gropp, "Domain Decomposition", 1996) with Nicolaides' coarse space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.batch.posegraph.cholesky import Factor
from vislam.batch.posegraph.ordering import Ints, adjacency
from vislam.batch.posegraph.symbolic import analyse
from vislam.core.jit import njit
from vislam.core.messages import Array

_NONE = -1
_CLUSTER = 64  # poses: more make fewer steps, each dearer
_STEPS_MAX = 1000


class Clusters:
    """Poses in clusters, and the eliminations of the two levels; the same for all sizes of blocks."""

    def __init__(self, count: int, ends: Ints, size: int = _CLUSTER) -> None:
        """Cluster `count` free poses that edges with these ends [E, 2] join; -1 stands for a pose that is not free.

        `size` is that of a cluster; those of fewer than a quarter are joined to a neighbour.
        """
        both = np.flatnonzero((ends >= 0).all(axis=1))
        a, b = np.ascontiguousarray(ends[both].T)
        self.of = grown(*adjacency(count, a, b), size)  # [n]
        _, self.first = np.unique(self.of, return_index=True)  # a pose of each cluster
        inside = self.of[a] == self.of[b]
        local = np.full(ends.shape, _NONE, dtype=np.int64)
        local[both[inside]] = ends[both[inside]]
        self.local = analyse(count, *np.ascontiguousarray(local.T))
        to = self.local.later_is_to[both]
        self.later, self.earlier, self.edges = np.where(to, b, a), np.where(to, a, b), both
        c, d = self.of[a[~inside]], self.of[b[~inside]]
        pairs, which = np.unique(np.minimum(c, d) * len(self.first) + np.maximum(c, d), return_inverse=True)
        low, high = np.divmod(pairs, max(len(self.first), 1))
        self.coarse = analyse(len(self.first), low, high)
        self.pair = np.full(len(both), _NONE, dtype=np.int64)  # of clusters that an edge joins
        self.pair[~inside] = which
        self.pair_later = np.where(self.coarse.later_is_to, high, low)


class _Joins(NamedTuple):
    """What edges join, as compiled code takes it; see `Clusters`."""

    of: Ints
    later: Ints
    earlier: Ints
    edges: Ints
    pair: Ints
    pair_later: Ints


class RigidMotions:
    """Solves one system after another for the best motion of each cluster as a whole, with blocks of size d."""

    def __init__(self, clusters: Clusters, d: int) -> None:
        """Allocate what all systems share."""
        self.clusters, self._factor = clusters, Factor(clusters.coarse, d)
        self.later_is_to = clusters.local.later_is_to

    def factorise(self, diagonal: Array, off: Array, motions: Array) -> bool:
        """Prepare for a matrix in blocks as `Factor` has them; False where it is not positive definite.

        `motions` [n, d, d]: what a motion of a pose's cluster as a whole is as a motion of the pose.
        """
        c, self._motions = self.clusters, motions
        coarse = np.zeros((len(c.first), *diagonal.shape[1:]))
        coarse_off = np.zeros((len(c.pair_later), *diagonal.shape[1:]))
        joins = _Joins(c.of, c.later, c.earlier, c.edges, c.pair, c.pair_later)
        _project(joins, motions, diagonal, off, coarse, coarse_off)
        return self._factor.factorise(coarse, coarse_off)

    def solve(self, rhs: Array) -> Array:
        """Return x [n, d] among the motions of whole clusters for which what is left of A @ x = rhs moves none."""
        of = self.clusters.of
        gathered = np.zeros((len(self.clusters.first), rhs.shape[1]))
        np.add.at(gathered, of, np.einsum("nba,nb->na", self._motions, rhs))
        return np.asarray(np.einsum("nab,nb->na", self._motions, self._factor.solve(gathered)[of]))


class ClusteredSolver:
    """Solves one system after another of the structure of its clusters, with blocks of size d, as `Factor` does."""

    def __init__(self, clusters: Clusters, d: int, tolerance: float) -> None:
        """Allocate both levels. Steps end when the preconditioned residual is this share of what it was."""
        self.clusters, self._tolerance = clusters, tolerance
        self.later_is_to = clusters.local.later_is_to
        self._local, self._rigid = Factor(clusters.local, d), RigidMotions(clusters, d)
        self.steps = 0  # of the last solution

    def factorise(self, diagonal: Array, off: Array, motions: Array) -> bool:
        """Prepare for a matrix in blocks; see `RigidMotions`."""
        self._diagonal, self._off = diagonal, off
        return self._local.factorise(diagonal, off) and self._rigid.factorise(diagonal, off, motions)

    def solve(self, rhs: Array) -> Array:
        """Return x [n, d] with A @ x = rhs [n, d] nearly."""
        c = self.clusters
        x, r, Ap = np.zeros_like(rhs), rhs.copy(), np.empty_like(rhs)
        z = self._preconditioned(r)
        p, rz = z.copy(), float(np.vdot(r, z))
        end = self._tolerance**2 * rz
        for self.steps in range(1, _STEPS_MAX + 1):
            multiply(self._diagonal, self._off, c.later, c.earlier, c.edges, p, Ap)
            curvature = float(np.vdot(p, Ap))
            if not curvature > 0.0:
                break
            x += (rz / curvature) * p
            r -= (rz / curvature) * Ap
            z = self._preconditioned(r)
            before, rz = rz, float(np.vdot(r, z))
            if not rz > end:
                break
            p *= rz / before
            p += z
        return x

    def _preconditioned(self, r: Array) -> Array:
        return self._local.solve(r) + self._rigid.solve(r)


@njit(cache=True, nogil=True)
def grown(begins: Ints, neighbours: Ints, size: int) -> Ints:
    """Return the cluster [n] of each node: grown by breadth to `size` nodes, each beside those before it."""
    n = len(begins) - 1
    cluster = np.full(n, _NONE, dtype=np.int64)
    waiting, head, tail, following = np.empty(n + len(neighbours), dtype=np.int64), 0, 0, 0
    members, counts = np.empty(size, dtype=np.int64), np.zeros(n, dtype=np.int64)
    made = 0
    while True:
        seed = _NONE
        while head < tail and seed == _NONE:  # beside what is clustered already, so that few are left over
            if cluster[waiting[head]] == _NONE:
                seed = waiting[head]
            head += 1
        while following < n and seed == _NONE:
            if cluster[following] == _NONE:
                seed = following
            following += 1
        if seed == _NONE:
            break
        members[0], count, at = seed, 1, 0
        cluster[seed] = made
        while at < count:
            for p in range(begins[members[at]], begins[members[at] + 1]):
                j = neighbours[p]
                if cluster[j] != _NONE:
                    continue
                if count < size:
                    cluster[j] = made
                    members[count] = j
                    count += 1
                else:
                    waiting[tail] = j
                    tail += 1
            at += 1
        counts[made] = count
        made += 1
    return _joined(begins, neighbours, cluster, counts[:made], size // 4)


@njit(cache=True, nogil=True)
def _joined(begins: Ints, neighbours: Ints, cluster: Ints, counts: Ints, least: int) -> Ints:
    """Return clusters with those of fewer than `least` nodes joined to a neighbour, numbered without gaps."""
    made = len(counts)
    becomes = np.arange(made)
    for i in range(len(cluster)):
        own = cluster[i]
        while becomes[own] != own:
            own = becomes[own]
        if counts[own] >= least:
            continue
        for p in range(begins[i], begins[i + 1]):
            other = cluster[neighbours[p]]
            while becomes[other] != other:
                other = becomes[other]
            if other != own:
                becomes[own] = other
                counts[other] += counts[own]
                break
    number, used = np.full(made, _NONE, dtype=np.int64), 0
    out = np.empty_like(cluster)
    for i in range(len(cluster)):
        own = cluster[i]
        while becomes[own] != own:
            own = becomes[own]
        if number[own] == _NONE:
            number[own] = used
            used += 1
        out[i] = number[own]
    return out


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def multiply(diagonal: Array, off: Array, later: Ints, earlier: Ints, edges: Ints, x: Array, out: Array) -> None:
    """Write A @ x into out [n, d]."""
    d = x.shape[1]
    for i in range(len(x)):
        for a in range(d):
            s = 0.0
            for b in range(d):
                s += diagonal[i, a, b] * x[i, b]
            out[i, a] = s
    for q in range(len(edges)):
        block, i, j = off[edges[q]], later[q], earlier[q]
        for b in range(d):
            s, value = 0.0, x[j, b]
            for a in range(d):
                s += block[b, a] * x[i, a]
                out[i, a] += block[b, a] * value
            out[j, b] += s


@njit(cache=True, nogil=True)
def _project(joins: _Joins, motions: Array, diagonal: Array, off: Array, coarse: Array, coarse_off: Array) -> None:
    """Add the blocks of P^T A P to those of the clusters, P being the motions."""
    cluster, later, earlier, edges, pair, pair_later = joins
    d = diagonal.shape[1]
    half, K = np.empty((d, d)), np.empty((d, d))
    for i in range(len(diagonal)):
        _sandwiched(motions[i], diagonal[i], motions[i], half, K)
        coarse[cluster[i]] += K
    for q in range(len(edges)):
        i, j = later[q], earlier[q]
        _sandwiched(motions[j], off[edges[q]], motions[i], half, K)  # rows of the earlier, columns of the later one
        if pair[q] == _NONE:
            coarse[cluster[i]] += K + K.T
        elif pair_later[pair[q]] == cluster[i]:
            coarse_off[pair[q]] += K
        else:
            coarse_off[pair[q]] += K.T


@njit(cache=True, nogil=True, inline="always")
def _sandwiched(L: Array, A: Array, R: Array, half: Array, out: Array) -> None:
    """Write L^T @ A @ R into out."""
    d = len(A)
    for a in range(d):
        for b in range(d):
            s = 0.0
            for k in range(d):
                s += A[a, k] * R[k, b]
            half[a, b] = s
    for a in range(d):
        for b in range(d):
            s = 0.0
            for k in range(d):
                s += L[k, a] * half[k, b]
            out[a, b] = s
