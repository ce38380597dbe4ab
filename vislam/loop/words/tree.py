"""Hierarchical k-medians over 256-bit descriptors: growing the tree and walking down it.

Nister and Stewenius, "Scalable recognition with a vocabulary tree", CVPR 2006, with the majority bit as the median of
a cluster (Galvez-Lopez and Tardos, T-RO 2012) and k-means++ seeds. Nodes are stored breadth first: the children of a
node are consecutive and come after it, so the tree is four flat arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.vision.hamming import distance, popcount, prefetch

Packed = NDArray[np.uint64]
Ints = NDArray[np.int64]

_COUNT_BITS = 16
MAX_CHILDREN = 2**_COUNT_BITS - 1  # of a node
_CHILD_BITS = 48  # what the first child needs of the 64 beside the count
_ALL_CHILDREN = 2**_CHILD_BITS - 1
_FARTHEST = 2**63  # beyond any distance
_TOGETHER = 16  # descriptors that go down the tree side by side; more of their nodes leave the first cache
_SEED_SAMPLE = 4096  # members of a cluster that k-means++ looks at; more changes the seeds little
_ROUNDS = 11  # Lloyd rounds; nearly all clusters settle before
_SETTLED_PERCENT = 1  # a round that moves fewer members than this is the last


@njit(cache=True, nogil=True)
def _random(state: NDArray[np.uint64]) -> float:
    """Return a uniform number in [0, 1) and advance the state [1] (splitmix64): the same on every platform."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True, nogil=True)
def _spread_table() -> NDArray[np.uint64]:
    """Return for each byte a number whose byte j is its bit j, so that one addition counts eight bits."""
    table = np.zeros(256, np.uint64)
    for byte in range(256):
        for j in range(8):
            table[byte] |= np.uint64((byte >> j) & 1) << np.uint64(8 * j)
    return table


@njit(cache=True, nogil=True)
def _seed_centres(data: Packed, centres: Packed, state: NDArray[np.uint64]) -> int:
    """Choose centres by k-means++ among descriptors [M, 4]; return how many different ones were found."""
    sample = data[:: (len(data) + _SEED_SAMPLE - 1) // _SEED_SAMPLE]
    nearest = np.empty(len(sample), np.float64)
    pick = int(_random(state) * len(sample))
    found = 0
    while True:
        centres[found] = sample[pick]
        total = 0.0
        for s in range(len(sample)):
            d = np.float64(distance(sample, s, centres, found))
            if found == 0 or d * d < nearest[s]:
                nearest[s] = d * d
            total += nearest[s]
        found += 1
        if found == len(centres) or total <= 0.0:
            return found
        target = _random(state) * total
        pick = 0
        reached = nearest[0]
        while reached <= target and pick < len(sample) - 1:
            pick += 1
            reached += nearest[pick]


@njit(cache=True, nogil=True)
def _assign(data: Packed, centres: Packed, count: int, labels: Ints) -> int:
    """Label descriptors [M, 4] with their nearest centre (the first of equals); return how many changed."""
    changed = 0
    for i in range(len(data)):
        best, label = 257, 0
        for c in range(count):
            d = distance(data, i, centres, c)
            if d < best:
                best, label = d, c
        if labels[i] != label:
            labels[i] = label
            changed += 1
    return changed


@njit(cache=True, nogil=True)
def _flush(sums: NDArray[np.uint64], counts: Ints) -> None:
    """Add counters of eight bits [32] to those they stand for [256], and clear them."""
    for b in range(256):
        counts[b] += np.int64((sums[b >> 3] >> np.uint64(8 * (b & 7))) & np.uint64(255))
    sums[:] = np.uint64(0)


@njit(cache=True, nogil=True)
def _majorities(data: Packed, labels: Ints, centres: Packed, count: int, spread: NDArray[np.uint64]) -> None:
    """Write the bitwise majority of the descriptors of each label to its centre; a tie gives 0, no member no change."""
    octets = data.view(np.uint8)
    sums = np.zeros((count, 32), np.uint64)  # eight counters each, which are full after 255 members
    counts = np.zeros((count, 256), np.int64)
    members, waiting = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for i in range(len(data)):
        label = labels[i]
        if waiting[label] == 255:
            _flush(sums[label], counts[label])
            waiting[label] = 0
        for b in range(32):
            sums[label, b] += spread[octets[i, b]]
        waiting[label] += 1
        members[label] += 1
    for label in range(count):
        _flush(sums[label], counts[label])
    for label in range(count):
        for w in range(4 if members[label] > 0 else 0):
            bits = np.uint64(0)
            for b in range(64):
                if 2 * counts[label, w * 64 + b] > members[label]:
                    bits |= np.uint64(1) << np.uint64(b)
            centres[label, w] = bits


@njit(cache=True, nogil=True)
def _gather(data: Packed, labels: Ints, count: int, spare: Packed) -> Ints:
    """Reorder descriptors [M, 4] (stable) so that clusters are contiguous; return their bounds [count + 1]."""
    bounds = np.zeros(count + 1, np.int64)
    for label in labels:
        bounds[label + 1] += 1
    for c in range(count):
        bounds[c + 1] += bounds[c]
    position = bounds.copy()
    for i in range(len(data)):
        spare[position[labels[i]]] = data[i]
        position[labels[i]] += 1
    data[:] = spare[: len(data)]
    return bounds


@njit(cache=True, nogil=True)
def _split(
    data: Packed, centres: Packed, labels: Ints, spare: Packed, spread: NDArray[np.uint64], state: NDArray[np.uint64]
) -> Ints:
    """Cluster descriptors [M, 4], which are reordered; return the bounds of the clusters, whose centres are written."""
    count = _seed_centres(data, centres, state)
    labels[:] = -1
    for turn in range(_ROUNDS):
        changed = _assign(data, centres, count, labels)
        if changed * 100 < _SETTLED_PERCENT * len(data) or turn == _ROUNDS - 1:
            break
        _majorities(data, labels, centres, count, spread)
    return _gather(data, labels, count, spare)


@njit(cache=True, nogil=True)
def grow(data: Packed, branching: int, depth: int, seed: int) -> tuple[Packed, NDArray[np.int32], NDArray[np.int32]]:
    """Grow a tree over packed descriptors [N, 4], N >= 1; breadth first, deterministic for a seed.

    Returns centres [nodes, 4] (the root's is unused), each node's first child and its number of children (0: a leaf).
    """
    total = len(data)
    capacity = 1 + total * depth  # every node below the root holds at least one descriptor of its level
    full, width = 1, 1
    for _ in range(depth):
        width = min(width * branching, total)
        full += width
    capacity = min(capacity, full)
    nodes = np.zeros((capacity, 4), np.uint64)
    first, children = np.zeros(capacity, np.int32), np.zeros(capacity, np.int32)
    low, high, level = np.zeros(capacity, np.int64), np.zeros(capacity, np.int64), np.zeros(capacity, np.int64)
    data, spare = data.copy(), np.empty_like(data)  # clusters are kept contiguous: chasing indices is 5 times slower
    labels, spread = np.empty(total, np.int64), _spread_table()
    centres = np.zeros((branching, 4), np.uint64)
    state = np.array([seed], np.uint64)
    high[0] = total
    used, node = 1, 0
    while node < used:
        if level[node] < depth and high[node] - low[node] > 1:
            begin, end = low[node], high[node]
            bounds = _split(data[begin:end], centres, labels[begin:end], spare, spread, state)
            if len(bounds) > 2:  # identical descriptors stay one leaf
                first[node] = used
                for c in range(len(bounds) - 1):
                    if bounds[c + 1] > bounds[c]:
                        nodes[used] = centres[c]
                        low[used], high[used], level[used] = begin + bounds[c], begin + bounds[c + 1], level[node] + 1
                        children[node] += 1
                        used += 1
        node += 1
    return nodes[:used].copy(), first[:used].copy(), children[:used].copy()


def walk_table(nodes: Packed, first: NDArray[np.int32], children: NDArray[np.int32]) -> Packed:
    """Return [nodes, 5] for `descend`: centre, then first child and number of children, or the word of a leaf."""
    leaf = children == 0
    begin = np.where(leaf, np.cumsum(leaf) - 1, first).astype(np.uint64)
    return np.column_stack([nodes, (begin << np.uint64(_COUNT_BITS)) | children.astype(np.uint64)])


@njit(cache=True, nogil=True)
def descend(data: Packed, table: Packed) -> NDArray[np.int32]:
    """Return the word [N] of each packed descriptor [N, 4]: the nearest child at each level, the first of equals.

    Some descriptors go down a level together before any goes on, so that the next children of each are under way from
    memory while the others are looked at: 3 times faster in a tree that is larger than the caches.
    """
    words = np.empty(len(data), np.int32)
    at = np.empty(_TOGETHER, np.uint64)
    for begin in range(0, len(data), _TOGETHER):
        size = min(_TOGETHER, len(data) - begin)
        at[:] = table[0, 4]
        active = True
        while active:
            active = False
            for i in range(size):
                count = at[i] & np.uint64(MAX_CHILDREN)
                if count == 0:
                    continue
                active = True
                row = begin + i
                a0, a1, a2, a3 = data[row, 0], data[row, 1], data[row, 2], data[row, 3]
                first = at[i] >> np.uint64(_COUNT_BITS)
                best = np.uint64(_FARTHEST)  # distance and child in one number, so that no branch has to be guessed
                for child in range(first, first + count):
                    low = popcount(a0 ^ table[child, 0]) + popcount(a1 ^ table[child, 1])
                    d = low + popcount(a2 ^ table[child, 2]) + popcount(a3 ^ table[child, 3])
                    best = min(best, (d << np.uint64(_CHILD_BITS)) | child)
                at[i] = table[best & np.uint64(_ALL_CHILDREN), 4]
                if at[i] & np.uint64(MAX_CHILDREN):
                    first = at[i] >> np.uint64(_COUNT_BITS)
                    for ahead in range(0, 12, 2):  # ten children of 40 bytes are seven lines at most
                        prefetch(table, np.int64(first) + ahead)
        for i in range(size):
            words[begin + i] = at[i] >> np.uint64(_COUNT_BITS)
    return words


@njit(cache=True, nogil=True)
def weigh(
    ordered: NDArray[np.int32], idf: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64], float]:
    """Return the words of an image, ascending and unique, how often each occurs, their tf-idf weights, and their total.

    `ordered` are those of its features, ascending. The weights are divided by the total, so they sum to 1.
    """
    unique = np.empty(len(ordered), np.int32)
    counts = np.zeros(len(ordered), np.int32)
    weights = np.zeros(len(ordered))
    count, total = 0, 0.0
    for word in ordered:
        if idf[word] <= 0.0:  # a word that every image has carries no information
            continue
        if count == 0 or unique[count - 1] != word:
            unique[count] = word
            count += 1
        counts[count - 1] += 1
        weights[count - 1] += idf[word]
        total += idf[word]
    for i in range(count):
        weights[i] /= total
    return unique[:count].copy(), counts[:count].copy(), weights[:count].copy(), total


@njit(cache=True, nogil=True)
def similarity(
    words_a: NDArray[np.int32], weights_a: NDArray[np.float64], words_b: NDArray[np.int32],
    weights_b: NDArray[np.float64],
) -> float:  # fmt: skip
    """Return 1 - |a - b|_1 / 2 of two weighted bags, 0..1, walking their common words (DBoW2's L1 score)."""
    i, j, total = 0, 0, 0.0
    while i < len(words_a) and j < len(words_b):
        if words_a[i] < words_b[j]:
            i += 1
        elif words_a[i] > words_b[j]:
            j += 1
        else:
            total += weights_a[i] + weights_b[j] - abs(weights_a[i] - weights_b[j])
            i += 1
            j += 1
    return 0.5 * total
