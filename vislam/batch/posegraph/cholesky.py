"""Sparse Cholesky factorisation of a pose graph's normal equations: multifrontal, over BLAS where fronts are large.

Each front is assembled from the blocks of its poses and edges and from what its children leave, in columns; its pivots
are eliminated and the update goes to the parent. Small fronts are done in compiled loops, for a BLAS call costs more
than they do. Liu, "The Multifrontal Method for Sparse Matrix Solution", SIAM Review 1992.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vislam.batch.posegraph.native_calls import call_void, scipy_addresses
from vislam.batch.posegraph.ordering import Ints
from vislam.batch.posegraph.symbolic import Symbolic
from vislam.core.jit import njit
from vislam.core.messages import Array

_ROUTINES = ("cython_blas.dtrsm", "cython_blas.dsyrk", "cython_lapack.dpotrf")
_TRSM, _SYRK, _POTRF = range(3)
_TOGETHER = 8  # edges that are solved for at once
_SMALL = 24  # pivots' columns up to which loops beat BLAS
_SMALL_WORK = 40_000  # multiplications up to which they do


class _Fronts(NamedTuple):
    """The elimination as compiled code takes it; see `Symbolic`."""

    first: Ints
    row_begin: Ints
    rows: Ints
    target: Ints
    parent: Ints
    panel_begin: Ints


class _Edges(NamedTuple):
    """Which edges enter which front, and where; see `Symbolic`."""

    begin: Ints
    of: Ints
    row: Ints
    column: Ints


class _Blocks(NamedTuple):
    """A matrix to factorise; see `Factor`."""

    node: Ints  # [n] the pose at each place
    diagonal: Array
    off: Array


class Factor:
    """The Cholesky factor of one matrix after another of one structure, with blocks of size d.

    The matrix is given in blocks: `diagonal` [n, d, d] of the free poses in their order (the lower triangles count) and
    `off` [E, d, d] of the edges between them: off[e, b, a] is the entry of the a-th component of the edge's later pose
    and the b-th of the earlier one. Edges between the same poses add up.
    """

    def __init__(self, symbolic: Symbolic, d: int) -> None:
        """Allocate the factor; nothing is allocated later but what a solution returns."""
        self.symbolic, self.d = symbolic, d
        self.later_is_to = symbolic.later_is_to
        self._panels = np.empty(symbolic.blocks * d * d)
        self._stack = np.empty(symbolic.stack_size * d * d)
        self.node = np.empty(symbolic.count, dtype=np.int64)  # the pose at each place
        self.node[symbolic.place] = np.arange(symbolic.count)
        s = symbolic
        self._fronts = _Fronts(s.first, s.row_begin, s.rows, s.target, s.parent, s.panel_begin)
        self._edges = _Edges(s.edge_begin, s.edge_of, s.edge_row, s.edge_column)
        self._blas = scipy_addresses(*_ROUTINES)

    def factorise(self, diagonal: Array, off: Array) -> bool:
        """Replace the factor by that of another matrix; False where that is not positive definite."""
        blocks = _Blocks(self.node, diagonal, off)
        good: bool = _factorise(self.d, self._fronts, self._edges, blocks, self._panels, self._stack, self._blas)
        return good

    def panel(self, front: int) -> tuple[Array, Array]:
        """Return the triangle [w, w] of a front's pivots in the factor, and the rows [b, w] beneath it."""
        s, d = self.symbolic, self.d
        width = int(s.first[front + 1] - s.first[front]) * d
        columns = self._panels[s.panel_begin[front] * d * d : s.panel_begin[front + 1] * d * d].reshape(width, -1)
        return np.tril(columns[:, :width].T), columns[:, width:].T

    def solve(self, rhs: Array) -> Array:
        """Return x [n, d] with A @ x = rhs [n, d]."""
        s = self.symbolic
        y = rhs[self.node].ravel()
        _solve(self.d, s.first, s.row_begin, s.rows, s.panel_begin, self._panels, y)
        out = np.empty_like(rhs)
        out[self.node] = y.reshape(rhs.shape)
        return out

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of what was factorised last."""
        s, d = self.symbolic, self.d
        width, below = np.diff(s.first) * d, np.diff(s.row_begin) * d
        column = np.arange(s.first[-1] * d) - np.repeat(s.first[:-1] * d, width)
        at = np.repeat(s.panel_begin[:-1] * d * d, width) + column * np.repeat(width + below + 1, width)
        return 2.0 * float(np.log(self._panels[at]).sum())

    def edge_covariances(self, ends: Ints, jacobians: Array) -> Array:
        """Return J @ A^-1 @ J^T [M, d, d] of pairs of free poses: J is jacobians [M, 2, d, d], by the ends' columns.

        `ends` [M, 2] are indices of free poses, -1 for one that is known. Only the fronts between the two poses and
        the root are visited: of neighbours, which are taken together, nearly the same.
        """
        s = self.symbolic
        front_of = np.repeat(np.arange(len(s.first) - 1), np.diff(s.first))
        places = np.append(s.place, -1)[ends]
        order = np.argsort(places.max(axis=1), kind="stable")
        found, out = np.zeros((len(ends), self.d, self.d)), np.empty((len(ends), self.d, self.d))
        transposed = np.ascontiguousarray(jacobians[order].transpose(0, 1, 3, 2))
        _edge_covariances(self.d, self._fronts, front_of, self._panels, places[order], transposed, found)
        out[order] = found
        return out


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _edge_covariances(
    d: int, fronts: _Fronts, front_of: Ints, panels: Array, places: Ints, transposed: Array, out: Array
) -> None:
    """Solve L @ y = J^T of some edges at a time along their paths to the root, and sum y^T @ y up.

    Of y there are the rows of the fronts on these paths alone, one front after the other.
    """
    first, parent = fronts.first, fronts.parent
    y, visited = np.zeros((0, _TOGETHER * d)), np.zeros(len(parent), dtype=np.bool_)
    row = np.zeros(first[-1], dtype=np.int64)  # of each place in y, in blocks
    for begin in range(0, len(places), _TOGETHER):
        count, lowest, rows = min(_TOGETHER, len(places) - begin), len(parent), 0
        for place in places[begin : begin + count].flat:
            f = front_of[place]
            while place >= 0 and f != -1 and not visited[f]:
                visited[f] = True
                lowest = min(lowest, f)
                f = parent[f]
        for f in range(lowest, len(parent)):
            for at in range(first[f], first[f + 1] if visited[f] else first[f]):
                row[at] = rows
                rows += 1
        if rows * d > len(y):
            y = np.zeros((rows * d, _TOGETHER * d))
        for m in range(count):
            for end in range(2):
                place = places[begin + m, end]
                if place >= 0:
                    y[row[place] * d : (row[place] + 1) * d, m * d : (m + 1) * d] += transposed[begin + m, end]
        for f in range(lowest, len(parent)):
            if visited[f]:
                visited[f] = False
                _pass_front(d, fronts, f, panels, row, y[:, : count * d], out[begin : begin + count])


@njit(cache=True, nogil=True, inline="always")
def _pass_front(d: int, fronts: _Fronts, f: int, panels: Array, row: Ints, y: Array, out: Array) -> None:
    """Solve for a front's pivots, take them from the rows beneath, and add what they give to `out`."""
    first, row_begin = fronts.first, fronts.row_begin
    width = (first[f + 1] - first[f]) * d
    height = width + (row_begin[f + 1] - row_begin[f]) * d
    panel = panels[fronts.panel_begin[f] * d * d : fronts.panel_begin[f + 1] * d * d]
    own = y[row[first[f]] * d : row[first[f]] * d + width]
    for j in range(width):
        column, known = panel[j * height : (j + 1) * height], own[j]
        for c in range(len(known)):
            known[c] /= column[j]
        for i in range(j + 1, width):
            goal, value = own[i], column[i]
            for c in range(len(known)):
                goal[c] -= value * known[c]
        for m in range(len(out)):
            for a in range(d):
                for c in range(d):
                    out[m, a, c] += known[m * d + a] * known[m * d + c]
    for j in range(0, width, 3):  # blocks are of 3 or 6
        p, q, s = own[j], own[j + 1], own[j + 2]
        for r in range(row_begin[f], row_begin[f + 1]):
            for i in range(d):
                goal, at = y[row[fronts.rows[r]] * d + i], j * height + width + (r - row_begin[f]) * d + i
                u, v, w = panel[at], panel[at + height], panel[at + 2 * height]
                for c in range(len(p)):
                    goal[c] -= u * p[c] + v * q[c] + w * s[c]
    own[:] = 0.0


@njit(cache=True, nogil=True)
def _factorise(  # noqa: PLR0912
    d: int, fronts: _Fronts, edges: _Edges, blocks: _Blocks, panels: Array, stack: Array, blas: Ints
) -> bool:
    """Write the factor's columns into `panels`, front by front; False where a pivot is not positive."""
    first, row_begin, _, target, parent, panel_begin = fronts
    edge_begin, edge_of, edge_row, edge_column = edges
    node, diagonal, off = blocks
    count = len(parent)
    update_begin = np.empty(count, dtype=np.int64)  # of waiting updates, in the stack
    child, sibling = np.full(count, -1, dtype=np.int64), np.full(count, -1, dtype=np.int64)
    top = 0
    integers = np.empty(4, dtype=np.int32)
    for f in range(count):
        width, below = (first[f + 1] - first[f]) * d, (row_begin[f + 1] - row_begin[f]) * d
        height = width + below
        panel = panels[panel_begin[f] * d * d : panel_begin[f + 1] * d * d]
        panel[:] = 0.0
        update = stack[top : top + below * below]
        update[:] = 0.0
        for k in range(first[f + 1] - first[f]):
            block = diagonal[node[first[f] + k]]
            for b in range(d):
                at = (k * d + b) * height + k * d
                for a in range(d):
                    panel[at + a] += block[a, b]
        for q in range(edge_begin[f], edge_begin[f + 1]):
            e = edge_of[q]
            for b in range(d):
                at = (edge_column[e] * d + b) * height + edge_row[e] * d
                for a in range(d):
                    panel[at + a] += off[e, b, a]
        base = top
        c = child[f]
        while c != -1:
            base = min(base, update_begin[c])
            given, goal = stack[update_begin[c] :], target[row_begin[c] : row_begin[c + 1]]
            _extend_add(d, width, height, panel, update, given, goal)
            c = sibling[c]
        if width <= _SMALL and width * below * below <= _SMALL_WORK:
            good = _eliminate(width, height, panel, update)
        else:
            good = _eliminate_by_blas(width, height, panel, update, blas, integers)
        if not good:
            return False
        if base < top:  # the children's updates are used up
            for i in range(below * below):
                stack[base + i] = update[i]
        update_begin[f] = base
        top = base + below * below
        if parent[f] != -1:
            sibling[f] = child[parent[f]]
            child[parent[f]] = f
    return True


@njit(cache=True, nogil=True)
def _extend_add(d: int, width: int, height: int, panel: Array, update: Array, given: Array, target: Ints) -> None:
    """Add a child's update (columns, lower triangle) to the front."""
    count = len(target)
    side, below = count * d, height - width
    for c in range(count):
        column = target[c] * d
        for b in range(d):
            source = (c * d + b) * side
            if column < width:
                at = (column + b) * height
                for r in range(c, count):
                    to, come = at + target[r] * d, source + r * d
                    for a in range(d):
                        panel[to + a] += given[come + a]
            else:
                at = (column - width + b) * below - width
                for r in range(c, count):
                    to, come = at + target[r] * d, source + r * d
                    for a in range(d):
                        update[to + a] += given[come + a]


@njit(cache=True, nogil=True)
def _eliminate(width: int, height: int, panel: Array, update: Array) -> bool:
    """Eliminate the pivots of a small front."""
    below = height - width
    for j in range(width):
        column = panel[j * height : (j + 1) * height]
        pivot = column[j]
        if not (pivot > 0.0 and pivot < 1e300):
            return False
        scale = 1.0 / math.sqrt(pivot)
        for i in range(j, height):
            column[i] *= scale
        for k in range(j + 1, width):
            other, factor = panel[k * height : (k + 1) * height], column[k]
            if factor != 0.0:
                for i in range(k, height):
                    other[i] -= factor * column[i]
    for k in range(below):
        goal = update[k * below : (k + 1) * below]
        j = 0
        while j + 2 < width:
            p, q, r = panel[j * height + width :], panel[(j + 1) * height + width :], panel[(j + 2) * height + width :]
            x, y, z = p[k], q[k], r[k]
            for i in range(k, below):
                goal[i] -= x * p[i] + y * q[i] + z * r[i]
            j += 3
        while j < width:
            p = panel[j * height + width :]
            x = p[k]
            for i in range(k, below):
                goal[i] -= x * p[i]
            j += 1
    return True


@njit(cache=True, nogil=True)
def _eliminate_by_blas(width, height, panel, update, blas, integers):  # type: ignore[no-untyped-def]
    """Eliminate the pivots of a large front: dpotrf, dtrsm, dsyrk."""
    letters, numbers = np.array([76, 82, 84, 78], dtype=np.uint8), np.array([1.0, -1.0])  # L R T N
    text, one, minus = letters.ctypes.data, numbers.ctypes.data, numbers.ctypes.data + 8
    below = height - width
    integers[0], integers[1], integers[2], integers[3] = width, below, height, 0
    at = integers.ctypes.data
    address = panel.ctypes.data
    call_void(blas[_POTRF], (text, at, address, at + 8, at + 12))
    for j in range(width):
        if not panel[j * height + j] > 0.0:  # dpotrf lets NaN pass
            return False
    if integers[3] != 0:
        return False
    if below > 0:
        beneath = address + 8 * width
        call_void(blas[_TRSM], (text + 1, text, text + 2, text + 3, at + 4, at, one, address, at + 8, beneath, at + 8))
        call_void(blas[_SYRK], (text, text + 3, at + 4, at, minus, beneath, at + 8, one, update.ctypes.data, at + 4))
    return True


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _solve(  # noqa: PLR0912
    d: int, first: Ints, row_begin: Ints, rows: Ints, panel_begin: Ints, panels: Array, y: Array
) -> None:
    """Solve in place, forwards and backwards."""
    fronts = len(first) - 1
    widest = 0
    for f in range(fronts):
        widest = max(widest, row_begin[f + 1] - row_begin[f])
    beneath = np.empty(widest * d)
    for f in range(fronts):
        width, below = (first[f + 1] - first[f]) * d, (row_begin[f + 1] - row_begin[f]) * d
        height = width + below
        own, panel = y[first[f] * d : first[f + 1] * d], panels[panel_begin[f] * d * d : panel_begin[f + 1] * d * d]
        beneath[:below] = 0.0
        for j in range(width):
            column = panel[j * height : (j + 1) * height]
            value = own[j] / column[j]
            own[j] = value
            for i in range(j + 1, width):
                own[i] -= value * column[i]
            lower = column[width:]
            for i in range(below):
                beneath[i] += value * lower[i]
        for r in range(row_begin[f], row_begin[f + 1]):
            for a in range(d):
                y[rows[r] * d + a] -= beneath[(r - row_begin[f]) * d + a]
    for f in range(fronts - 1, -1, -1):
        width, below = (first[f + 1] - first[f]) * d, (row_begin[f + 1] - row_begin[f]) * d
        height = width + below
        own, panel = y[first[f] * d : first[f + 1] * d], panels[panel_begin[f] * d * d : panel_begin[f + 1] * d * d]
        for r in range(row_begin[f], row_begin[f + 1]):
            for a in range(d):
                beneath[(r - row_begin[f]) * d + a] = y[rows[r] * d + a]
        for j in range(width - 1, -1, -1):
            column = panel[j * height : (j + 1) * height]
            lower = column[width:]
            value = own[j]
            for i in range(below):
                value -= lower[i] * beneath[i]
            for i in range(j + 1, width):
                value -= column[i] * own[i]
            own[j] = value / column[j]
