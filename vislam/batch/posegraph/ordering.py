"""In which order to eliminate the poses of a graph so that the factor stays sparse: approximate minimum degree.

Amestoy, Davis, Duff, "An Approximate Minimum Degree Ordering Algorithm", SIAM J. Matrix Anal. Appl. 1996: quotient
graph, approximate external degrees, element absorption, mass elimination and indistinguishable nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit

Ints = NDArray[np.int64]

_NONE = -1
_DENSE = 10.0  # times the root of the count of nodes: neighbours from which on a node is eliminated last


class _Variables(NamedTuple):
    """Nodes of the quotient graph, [n] each; see `minimum_degree`."""

    start: Ints  # of a node's list
    length: Ints
    elements: Ints  # at the front of the list; -1: no variable any more
    size: Ints  # nodes that it stands for
    parent: Ints  # what absorbed it


class _Buckets(NamedTuple):
    """Variables of the new element by a hash of their neighbours, [n] each."""

    head: Ints
    following: Ints
    hashed: Ints


@njit(cache=True, nogil=True)
def adjacency(n: int, a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """Return begins [n + 1] and neighbours, each once, of the undirected graph whose edges join a[e] and b[e]."""
    begins = np.zeros(n + 2, dtype=np.int64)
    for e in range(len(a)):
        begins[a[e] + 2] += 1
        begins[b[e] + 2] += 1
    for i in range(2, n + 2):
        begins[i] += begins[i - 1]
    neighbours = np.empty(2 * len(a), dtype=np.int64)
    for e in range(len(a)):
        neighbours[begins[a[e] + 1]] = b[e]
        begins[a[e] + 1] += 1
        neighbours[begins[b[e] + 1]] = a[e]
        begins[b[e] + 1] += 1
    seen = np.full(n, _NONE, dtype=np.int64)
    kept, begin = 0, 0
    for i in range(n):
        end = begins[i + 1]
        seen[i] = i
        for p in range(begin, end):
            j = neighbours[p]
            if seen[j] != i:
                seen[j] = i
                neighbours[kept] = j
                kept += 1
        begin = end
        begins[i + 1] = kept
    begins[0] = 0
    return begins[: n + 1], neighbours[:kept].copy()


def minimum_degree(begins: Ints, neighbours: Ints) -> Ints:
    """Return the nodes [n] of a graph in the order of their elimination; `neighbours` without repetition."""
    return np.argsort(_steps(begins, neighbours), kind="stable")


@njit(cache=True, nogil=True)
def _steps(begins: Ints, neighbours: Ints) -> Ints:  # noqa: PLR0912, PLR0915
    """Return the step [n] in which each node, or what absorbed it, is eliminated."""
    n = len(begins) - 1
    # a node is a variable until it is a pivot, then an element; lists hold first elements, then variables
    space = np.empty(len(neighbours) + len(neighbours) // 2 + n + 16, dtype=np.int64)
    for p in range(len(neighbours)):
        space[p] = neighbours[p]
    free = len(neighbours)
    start, length, degree = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for i in range(n):
        start[i], length[i] = begins[i], begins[i + 1] - begins[i]
        degree[i] = length[i]
    elements = np.zeros(n, dtype=np.int64)  # at the front of a variable's list; -1: no variable any more
    size = np.ones(n, dtype=np.int64)  # nodes in a supervariable; 0: absorbed; negative while in the new element
    parent = np.full(n, _NONE, dtype=np.int64)  # what absorbed a node
    mark = np.ones(n, dtype=np.int64)  # of elements: 0 when dead
    stamp = 2
    head, following, preceding = _lists(n), np.full(n, _NONE, dtype=np.int64), np.full(n, _NONE, dtype=np.int64)
    bucket, bucket_next, hashed = _lists(n), np.full(n, _NONE, dtype=np.int64), np.zeros(n, dtype=np.int64)
    step_of = np.full(n, _NONE, dtype=np.int64)
    eliminated, step = 0, 0
    dense = max(16, int(_DENSE * math.sqrt(n)))
    for i in range(n):
        if degree[i] > dense:
            elements[i], size[i], step_of[i] = _NONE, 0, n
            eliminated += 1
        else:
            _link(i, degree[i], head, following, preceding)
    lowest = 0
    while eliminated < n:
        while head[lowest] == _NONE:
            lowest += 1
        pivot = head[lowest]
        _unlink(pivot, degree[pivot], head, following, preceding)
        pivot_size = size[pivot]
        eliminated += pivot_size
        size[pivot] = -pivot_size

        # the new element: the union of the pivot's elements and variables
        needed = length[pivot]
        for p in range(start[pivot], start[pivot] + elements[pivot]):
            needed += length[space[p]]
        if free + needed > len(space):
            larger = np.empty(2 * len(space) + needed, dtype=np.int64)
            for p in range(free):
                larger[p] = space[p]
            space = larger
        begin = free
        boundary = 0
        for k in range(elements[pivot] + 1):
            if k < elements[pivot]:
                element = space[start[pivot] + k]
                p, count = start[element], length[element]
            else:
                element, p, count = pivot, start[pivot] + elements[pivot], length[pivot] - elements[pivot]
            for q in range(p, p + count):
                i = space[q]
                if size[i] > 0:
                    boundary += size[i]
                    size[i] = -size[i]
                    space[free] = i
                    free += 1
                    _unlink(i, degree[i], head, following, preceding)
            if element != pivot:
                parent[element], mark[element] = pivot, 0
        start[pivot], length[pivot], elements[pivot] = begin, free - begin, _NONE
        step_of[pivot] = step
        step += 1

        # how much of each element lies outside the new one
        for p in range(begin, free):
            i = space[p]
            for q in range(start[i], start[i] + elements[i]):
                e = space[q]
                if mark[e] >= stamp:
                    mark[e] += size[i]
                elif mark[e] != 0:
                    mark[e] = degree[e] + stamp + size[i]

        # new approximate degrees; lists lose what the new element covers
        for p in range(begin, free):
            i = space[p]
            first = write = start[i]
            outside, key = 0, 0
            for q in range(first, first + elements[i]):
                e = space[q]
                if mark[e] == 0:
                    continue
                beyond = mark[e] - stamp
                if beyond > 0:
                    outside += beyond
                    key += e
                    space[write] = e
                    write += 1
                else:
                    parent[e], mark[e] = pivot, 0
            kept = write - first
            for q in range(first + elements[i], first + length[i]):
                j = space[q]
                if size[j] > 0:
                    outside += size[j]
                    key += j
                    space[write] = j
                    write += 1
            if outside == 0:  # all its neighbours are in the new element: eliminated with the pivot
                parent[i] = pivot
                pivot_size -= size[i]
                boundary += size[i]
                eliminated -= size[i]
                size[i], elements[i] = 0, _NONE
                continue
            degree[i] = min(degree[i], outside)
            # room for the new element at the front: the list has lost at least the pivot or one of its elements
            if write > first + kept:
                space[write] = space[first + kept]
            space[first + kept] = space[first]
            space[first] = pivot
            elements[i], length[i] = kept + 1, write - first + 1
            key %= n
            hashed[i] = key
            bucket_next[i] = bucket[key]
            bucket[key] = i
        degree[pivot] = boundary
        stamp += n + boundary + 1

        variables, buckets = _Variables(start, length, elements, size, parent), _Buckets(bucket, bucket_next, hashed)
        stamp = _merge_alike(space, begin, free, variables, buckets, mark, stamp)

        # back into the lists of degrees
        write = begin
        for p in range(begin, free):
            i = space[p]
            if size[i] == 0:
                continue
            size[i] = -size[i]
            d = max(0, min(degree[i] + boundary - size[i], n - eliminated - size[i]))
            degree[i] = d
            _link(i, d, head, following, preceding)
            lowest = min(lowest, d)
            space[write] = i
            write += 1
        length[pivot] = write - begin
        size[pivot] = pivot_size
        free = write
        if length[pivot] == 0:
            mark[pivot] = 0
    _count_absorbed(step_of, parent)
    return step_of


@njit(cache=True, nogil=True)
def _lists(n: int) -> Ints:
    return np.full(n + 1, _NONE, dtype=np.int64)


@njit(cache=True, nogil=True)
def _link(i: int, degree: int, head: Ints, following: Ints, preceding: Ints) -> None:
    first = head[degree]
    if first != _NONE:
        preceding[first] = i
    following[i], preceding[i], head[degree] = first, _NONE, i


@njit(cache=True, nogil=True)
def _unlink(i: int, degree: int, head: Ints, following: Ints, preceding: Ints) -> None:
    if following[i] != _NONE:
        preceding[following[i]] = preceding[i]
    if preceding[i] != _NONE:
        following[preceding[i]] = following[i]
    else:
        head[degree] = following[i]


@njit(cache=True, nogil=True)
def _merge_alike(
    space: Ints, begin: int, end: int, variables: _Variables, buckets: _Buckets, mark: Ints, stamp: int
) -> int:
    """Merge variables of the new element that have the same neighbours; return the next free stamp."""
    start, length, elements, size, parent = variables
    bucket, bucket_next, hashed = buckets
    for p in range(begin, end):
        i = space[p]
        if size[i] >= 0:
            continue
        key = hashed[i]
        i = bucket[key]
        bucket[key] = _NONE
        while i != _NONE and bucket_next[i] != _NONE:
            for q in range(start[i] + 1, start[i] + length[i]):
                mark[space[q]] = stamp
            last, j = i, bucket_next[i]
            while j != _NONE:
                same = length[j] == length[i] and elements[j] == elements[i]
                q = start[j] + 1
                while same and q < start[j] + length[j]:
                    same = mark[space[q]] == stamp
                    q += 1
                if same:
                    parent[j] = i
                    size[i] += size[j]
                    size[j], elements[j] = 0, _NONE
                    j = bucket_next[j]
                    bucket_next[last] = j
                else:
                    last, j = j, bucket_next[j]
            stamp += 1
            i = bucket_next[i]
    return stamp


@njit(cache=True, nogil=True)
def _count_absorbed(step_of: Ints, parent: Ints) -> None:
    """Give nodes that were absorbed the step of what absorbed them."""
    n = len(step_of)
    for i in range(n):
        root = i
        while step_of[root] == _NONE:
            root = parent[root]
        j = i
        while step_of[j] == _NONE:
            step_of[j] = step_of[root]
            j = parent[j]
