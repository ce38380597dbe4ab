"""Hierarchical k-medians over 256-bit descriptors: growing the tree and walking down it.

Nister and Stewenius, "Scalable recognition with a vocabulary tree", CVPR 2006, with the majority bit as the median of
a cluster (Galvez-Lopez and Tardos, T-RO 2012) and k-means++ seeds. Nodes are stored breadth first: the children of a
node are consecutive and come after it, so the tree is four flat arrays.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.loop.hamming import distance

Packed = NDArray[np.uint64]
Ints = NDArray[np.int64]

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
def _majority(data: Packed, members: Ints, low: int, high: int, out: Packed, row: int) -> None:
    """Write the bitwise majority of `data[members[low:high]]` to `out[row]`; a tie gives 0."""
    counts = np.zeros(256, np.int64)
    for i in range(low, high):
        for w in range(4):
            bits = data[members[i], w]
            for b in range(64):
                counts[w * 64 + b] += np.int64((bits >> np.uint64(b)) & np.uint64(1))
    for w in range(4):
        bits = np.uint64(0)
        for b in range(64):
            if 2 * counts[w * 64 + b] > high - low:
                bits |= np.uint64(1) << np.uint64(b)
        out[row, w] = bits


@njit(cache=True, nogil=True)
def _seed_centres(data: Packed, members: Ints, low: int, high: int, centres: Packed, state: NDArray[np.uint64]) -> int:
    """Choose centres by k-means++ among `members[low:high]`; return how many different ones were found."""
    stride = (high - low + _SEED_SAMPLE - 1) // _SEED_SAMPLE
    sample = members[low:high:stride]
    nearest = np.empty(len(sample), np.float64)
    pick = int(_random(state) * len(sample))
    found = 0
    while True:
        centres[found] = data[sample[pick]]
        total = 0.0
        for s in range(len(sample)):
            d = np.float64(distance(data, sample[s], centres, found))
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
def _assign(data: Packed, members: Ints, low: int, high: int, centres: Packed, count: int, labels: Ints) -> int:
    """Label members with their nearest centre (the first of equals); return how many changed."""
    changed = 0
    for i in range(low, high):
        best, label = 257, 0
        for c in range(count):
            d = distance(data, members[i], centres, c)
            if d < best:
                best, label = d, c
        if labels[i] != label:
            labels[i] = label
            changed += 1
    return changed


@njit(cache=True, nogil=True)
def _sort_by_label(members: Ints, labels: Ints, low: int, high: int, count: int, spare: Ints) -> Ints:
    """Reorder `members[low:high]` (stable) so that clusters are contiguous; return their bounds [count + 1]."""
    bounds = np.zeros(count + 1, np.int64)
    for i in range(low, high):
        bounds[labels[i] + 1] += 1
    bounds[0] = low
    for c in range(count):
        bounds[c + 1] += bounds[c]
    position = bounds.copy()
    for i in range(low, high):
        spare[position[labels[i]]] = members[i]
        position[labels[i]] += 1
    for c in range(count):
        for i in range(bounds[c], bounds[c + 1]):
            members[i] = spare[i]
            labels[i] = c
    return bounds


@njit(cache=True, nogil=True)
def _split(
    data: Packed, members: Ints, low: int, high: int, centres: Packed, labels: Ints, spare: Ints,
    state: NDArray[np.uint64],
) -> Ints:  # fmt: skip
    """Cluster `members[low:high]`; return the bounds of the clusters, whose centres are written."""
    count = _seed_centres(data, members, low, high, centres, state)
    labels[low:high] = -1
    bounds = np.zeros(count + 1, np.int64)
    for turn in range(_ROUNDS):
        changed = _assign(data, members, low, high, centres, count, labels)
        bounds = _sort_by_label(members, labels, low, high, count, spare)
        if changed * 100 < _SETTLED_PERCENT * (high - low) or turn == _ROUNDS - 1:
            break
        for c in range(count):
            if bounds[c + 1] > bounds[c]:
                _majority(data, members, bounds[c], bounds[c + 1], centres, c)
    return bounds


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
    members, labels, spare = np.arange(total), np.full(total, -1, np.int64), np.empty(total, np.int64)
    centres = np.zeros((branching, 4), np.uint64)
    state = np.array([seed], np.uint64)
    high[0] = total
    used, node = 1, 0
    while node < used:
        if level[node] < depth and high[node] - low[node] > 1:
            bounds = _split(data, members, low[node], high[node], centres, labels, spare, state)
            if len(bounds) > 2:  # identical descriptors stay one leaf
                first[node] = used
                for c in range(len(bounds) - 1):
                    if bounds[c + 1] > bounds[c]:
                        nodes[used] = centres[c]
                        low[used], high[used], level[used] = bounds[c], bounds[c + 1], level[node] + 1
                        children[node] += 1
                        used += 1
        node += 1
    return nodes[:used].copy(), first[:used].copy(), children[:used].copy()


@njit(cache=True, nogil=True)
def descend(
    data: Packed, nodes: Packed, first: NDArray[np.int32], children: NDArray[np.int32], word_of: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the word [N] of each packed descriptor [N, 4]: the nearest child at each level, the first of equals."""
    words = np.empty(len(data), np.int32)
    for i in range(len(data)):
        node = 0
        while children[node] > 0:
            best, chosen = 257, first[node]
            for child in range(first[node], first[node] + children[node]):
                d = distance(data, i, nodes, child)
                if d < best:
                    best, chosen = d, child
            node = chosen
        words[i] = word_of[node]
    return words


@njit(cache=True, nogil=True)
def weigh(words: NDArray[np.int32], idf: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the words of an image, ascending and unique, and their tf-idf weights, which sum to 1."""
    ordered = np.sort(words)
    unique = np.empty(len(words), np.int32)
    weights = np.zeros(len(words))
    count, total = 0, 0.0
    for word in ordered:
        if idf[word] <= 0.0:  # a word that every image has tells nothing
            continue
        if count == 0 or unique[count - 1] != word:
            unique[count] = word
            count += 1
        weights[count - 1] += idf[word]
        total += idf[word]
    for i in range(count):
        weights[i] /= total
    return unique[:count].copy(), weights[:count].copy()


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
