"""Where the factor of a pose graph's normal equations has entries: found once per graph, on poses instead of numbers.

The analysis knows poses, not their dimension: one serves blocks of 6 (poses in space), 3 (rotations, poses in the
plane), 2 and 1 (the relaxations). Liu, "The Multifrontal Method for Sparse Matrix Solution", SIAM Review 1992.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.ordering import Ints, adjacency, minimum_degree
from vislam.core.jit import njit

_NONE = -1
_SLOWER = 0.1  # than a factorisation are solves for a few columns, product by product
FACTOR_MAX_BYTES = 1_500_000_000  # beyond, graphs of 100,000 poses would not be solved within 4 GB


@dataclass(frozen=True, slots=True, eq=False)
class Symbolic:
    """The elimination of the free poses of a graph in fronts: dense blocks of poses eliminated together."""

    count: int  # free poses, n
    place: Ints  # [n] when each is eliminated
    first: Ints  # [F + 1] the first place of each front; a front's pivots are places first[f] to first[f + 1] - 1
    row_begin: Ints  # [F + 1] into rows
    rows: Ints  # places beneath the pivots of each front, ascending
    target: Ints  # [len(rows)] the row's position in the parent's front, its pivots counted first
    parent: Ints  # [F] -1 for a root; children come before their parents
    panel_begin: Ints  # [F + 1] of the front's columns of the factor, in blocks
    stack_size: int  # blocks that updates to parents take at most
    edge_begin: Ints  # [F + 1] into edge_of: which edges enter which front
    edge_of: Ints  # [M] edges between free poses
    edge_row: Ints  # [E] position of the edge's later pose in the front; -1: the edge has a pose that is not free
    edge_column: Ints  # [E] of its earlier pose
    later_is_to: NDArray[np.bool_]  # [E] whether the pose `to` is the later one

    @property
    def blocks(self) -> int:
        """Blocks that the factor has, those beneath and above the diagonal of pivots counted alike."""
        return int(self.panel_begin[-1])

    @property
    def work(self) -> float:
        """Products of blocks that a factorisation takes, about."""
        width, below = np.diff(self.first).astype(np.float64), np.diff(self.row_begin)
        return float(np.dot(width, (width + below) ** 2))

    def affordable(self) -> int:
        """Return how many pairs of poses can have their covariance in the time of a factorisation or two, about."""
        blocks = np.diff(self.panel_begin).astype(np.float64)  # from each front to its root, once added up
        for f in range(len(blocks) - 1, -1, -1):
            blocks[f] += blocks[self.parent[f]] if self.parent[f] != _NONE else 0.0
        return int(_SLOWER * self.work * self.count / max(np.dot(blocks, np.diff(self.first)), 1.0))

    def bytes(self, d: int) -> int:
        """Return the memory that a factor with blocks of size d takes."""
        return 8 * d * d * (self.blocks + self.stack_size)


def analyse(count: int, a: Ints, b: Ints) -> Symbolic:
    """Return the elimination of `count` poses whose edges join a[e] and b[e]; -1 stands for a pose that is not free."""
    free = np.flatnonzero((a >= 0) & (b >= 0))
    begins, neighbours = adjacency(count, a[free], b[free])
    order = minimum_degree(begins, neighbours)
    place, parent = _postordered(begins, neighbours, order)
    first, row_begin, rows = _fronts(begins, neighbours, place, parent)
    rows = rows[np.lexsort((rows, np.repeat(np.arange(len(first) - 1), np.diff(row_begin))))]
    front_of = np.repeat(np.arange(len(first) - 1), np.diff(first))
    height = np.diff(row_begin)
    has_rows = height > 0
    front_parent = np.full(len(first) - 1, _NONE, dtype=np.int64)
    front_parent[has_rows] = front_of[rows[row_begin[:-1][has_rows]]]
    target, stack_size = _targets(first, row_begin, rows, front_parent)
    width = np.diff(first)
    place_a, place_b = place[a[free]], place[b[free]]
    column, row = np.minimum(place_a, place_b), np.maximum(place_a, place_b)
    fronts = front_of[column]
    edge_row, edge_column = np.full(len(a), _NONE, dtype=np.int64), np.zeros(len(a), dtype=np.int64)
    order_of_edges = np.argsort(fronts, kind="stable")
    edge_of = free[order_of_edges]
    edge_begin = np.searchsorted(fronts[order_of_edges], np.arange(len(first)))
    _positions(edge_begin, edge_of, row[order_of_edges], first, row_begin, rows, edge_row)
    edge_column[free] = column - first[fronts]
    later = np.zeros(len(a), dtype=np.bool_)
    later[free] = place_b > place_a
    panel_begin = np.concatenate(([0], np.cumsum(width * (width + height))))
    return Symbolic(
        count, place, first, row_begin, rows, target, front_parent, panel_begin, stack_size,
        edge_begin, edge_of, edge_row, edge_column, later,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _postordered(begins: Ints, neighbours: Ints, order: Ints) -> tuple[Ints, Ints]:  # noqa: PLR0912
    """Return the place [n] of each node in a postorder of the elimination tree, and the parent [n] of each place."""
    n = len(order)
    step = np.empty(n, dtype=np.int64)
    for k in range(n):
        step[order[k]] = k
    parent, ancestor = np.full(n, _NONE, dtype=np.int64), np.full(n, _NONE, dtype=np.int64)
    for k in range(n):
        for p in range(begins[order[k]], begins[order[k] + 1]):
            i = step[neighbours[p]]
            while i != _NONE and i < k:
                following = ancestor[i]
                ancestor[i] = k
                if following == _NONE:
                    parent[i] = k
                i = following
    child, sibling = np.full(n, _NONE, dtype=np.int64), np.full(n, _NONE, dtype=np.int64)
    size = np.ones(n, dtype=np.int64)
    for k in range(n):
        if parent[k] != _NONE:
            size[parent[k]] += size[k]
    for k in np.argsort(size, kind="mergesort"):
        if parent[k] != _NONE:
            sibling[k] = child[parent[k]]
            child[parent[k]] = k
    post = np.empty(n, dtype=np.int64)
    stack = np.empty(n, dtype=np.int64)
    done = 0
    for root in range(n):
        if parent[root] != _NONE:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            k = stack[top]
            if child[k] != _NONE:
                top += 1
                stack[top] = child[k]
                child[k] = sibling[child[k]]
            else:
                post[k] = done
                done += 1
                top -= 1
    place, new_parent = np.empty(n, dtype=np.int64), np.full(n, _NONE, dtype=np.int64)
    for k in range(n):
        place[order[k]] = post[k]
        if parent[k] != _NONE:
            new_parent[post[k]] = post[parent[k]]
    return place, new_parent


@njit(cache=True, nogil=True)
def _fronts(  # noqa: PLR0912, PLR0915
    begins: Ints, neighbours: Ints, place: Ints, parent: Ints
) -> tuple[Ints, Ints, Ints]:
    """Return the first places [F + 1] of fronts, where their rows begin [F + 1], and the rows, unsorted."""
    n = len(place)
    node = np.empty(n, dtype=np.int64)
    for i in range(n):
        node[place[i]] = i
    child, sibling = np.full(n, _NONE, dtype=np.int64), np.full(n, _NONE, dtype=np.int64)
    seen = np.full(n, _NONE, dtype=np.int64)
    begin, count = np.empty(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    space = np.empty(4 * n + len(neighbours), dtype=np.int64)
    free = 0
    first, top = np.empty(n + 1, dtype=np.int64), 0  # the fronts so far; their last columns give the rows
    zeros = np.zeros(n + 1, dtype=np.int64)
    for k in range(n):
        seen[k] = k
        needed = begins[node[k] + 1] - begins[node[k]]
        c = child[k]
        while c != _NONE:
            needed += count[c]
            c = sibling[c]
        if free + needed > len(space):
            larger = np.empty(2 * len(space) + needed, dtype=np.int64)
            for p in range(free):
                larger[p] = space[p]
            space = larger
        begin[k] = free
        for p in range(begins[node[k]], begins[node[k] + 1]):
            j = place[neighbours[p]]
            if j > k and seen[j] != k:
                seen[j] = k
                space[free] = j
                free += 1
        c = child[k]
        while c != _NONE:
            for p in range(begin[c], begin[c] + count[c]):
                j = space[p]
                if seen[j] != k:
                    seen[j] = k
                    space[free] = j
                    free += 1
            c = sibling[c]
        count[k] = free - begin[k]
        if parent[k] != _NONE:
            sibling[k] = child[parent[k]]
            child[parent[k]] = k
        first[top], zeros[top] = k, 0
        top += 1
        while top > 1 and parent[first[top - 1] - 1] >= first[top - 1] and parent[first[top - 1] - 1] <= k:
            width, below = first[top - 1] - first[top - 2], count[first[top - 1] - 1]
            upper = k + 1 - first[top - 1]
            filled = zeros[top - 2] + zeros[top - 1] + width * (upper + count[k] - below)
            total = (width + upper) * (width + upper + 1) // 2 + (width + upper) * count[k]
            if not _worth_merging(width + upper, filled, total):
                break
            top -= 1
            zeros[top - 1] = filled
    first[top] = n
    row_begin = np.zeros(top + 1, dtype=np.int64)
    for f in range(top):
        row_begin[f + 1] = row_begin[f] + count[first[f + 1] - 1]
    rows = np.empty(row_begin[top], dtype=np.int64)
    for f in range(top):
        last = first[f + 1] - 1
        for p in range(count[last]):
            rows[row_begin[f] + p] = space[begin[last] + p]
    return first[: top + 1].copy(), row_begin, rows


@njit(cache=True, nogil=True)
def _worth_merging(width: int, zeros: int, total: int) -> bool:
    """Return whether a wider front is worth the zeros that it stores (thresholds as CHOLMOD has them, of its paper)."""
    if zeros == 0:
        return True
    share = zeros / total
    return share < 0.8 if width <= 4 else share < 0.25 if width <= 12 else share < 0.08


@njit(cache=True, nogil=True)
def _targets(first: Ints, row_begin: Ints, rows: Ints, parent: Ints) -> tuple[Ints, int]:
    """Return the position of each row in the parent's front, and the blocks that waiting updates take at most."""
    target = np.full(len(rows), _NONE, dtype=np.int64)
    waiting = np.zeros(len(parent), dtype=np.int64)  # blocks of the children's updates
    level, peak = 0, 0
    for f in range(len(parent)):
        own = (row_begin[f + 1] - row_begin[f]) ** 2
        peak = max(peak, level + own)
        level += own - waiting[f]
        if parent[f] == _NONE:
            continue
        waiting[parent[f]] += own
        p, end = row_begin[parent[f]], first[parent[f] + 1]
        width = end - first[parent[f]]
        for q in range(row_begin[f], row_begin[f + 1]):
            if rows[q] < end:
                target[q] = rows[q] - first[parent[f]]
            else:
                while rows[p] != rows[q]:
                    p += 1
                target[q] = width + p - row_begin[parent[f]]
    return target, peak


@njit(cache=True, nogil=True)
def _positions(
    edge_begin: Ints, edge_of: Ints, row: Ints, first: Ints, row_begin: Ints, rows: Ints, edge_row: Ints
) -> None:
    """Fill the position of each edge's later pose in its front."""
    for f in range(len(first) - 1):
        width = first[f + 1] - first[f]
        for q in range(edge_begin[f], edge_begin[f + 1]):
            if row[q] < first[f + 1]:
                edge_row[edge_of[q]] = row[q] - first[f]
            else:
                beneath = rows[row_begin[f] : row_begin[f + 1]]
                edge_row[edge_of[q]] = width + np.searchsorted(beneath, row[q])
