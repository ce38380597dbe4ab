"""The inverted index: which keyframes have a word, so that a query touches only what it shares.

Each word's postings lie together in one pool, keyframes ascending, and move to the end of the pool with twice the
room when they have no more: adding stays incremental and a query reads memory in order (postings chained in blocks
are ten times slower at 50,000 keyframes, from cache misses).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.loop.vocabulary import BagOfWords

_FIRST_ROOM = 4  # postings of a word when it first occurs; most words of a large vocabulary stay rare
Int32s = NDArray[np.int32]
Float32s = NDArray[np.float32]
Int64s = NDArray[np.int64]


@njit(cache=True, nogil=True)
def _room_needed(words: Int32s, fill: Int32s, room: Int32s) -> int:
    needed = 0
    for word in words:
        if fill[word] == room[word]:
            needed += max(_FIRST_ROOM, 2 * room[word])
    return needed


@njit(cache=True, nogil=True)
def _append(
    slot: int, words: Int32s, weights: NDArray[np.float64], start: Int64s, fill: Int32s, room: Int32s,
    slots: Int32s, values: Float32s, used: int,
) -> int:  # fmt: skip
    """Append a posting to each word; return how much of the pool is used afterwards."""
    for i in range(len(words)):
        word = words[i]
        if fill[word] == room[word]:
            new_room = max(_FIRST_ROOM, 2 * room[word])
            for p in range(fill[word]):
                slots[used + p] = slots[start[word] + p]
                values[used + p] = values[start[word] + p]
            start[word], room[word] = used, new_room
            used += new_room
        slots[start[word] + fill[word]] = slot
        values[start[word] + fill[word]] = weights[i]
        fill[word] += 1
    return used


@njit(cache=True, nogil=True)
def _accumulate(
    words: Int32s, weights: NDArray[np.float64], start: Int64s, fill: Int32s, slots: Int32s, values: Float32s,
    scores: Float32s,
) -> None:  # fmt: skip
    for i in range(len(words)):
        weight = np.float32(weights[i])
        begin = start[words[i]]
        for p in range(begin, begin + fill[words[i]]):
            # |a| + |b| - |a - b| of positive numbers is twice the smaller one
            scores[slots[p]] += min(weight, values[p])


@njit(cache=True, nogil=True)
def _best(scores: Float32s, k: int) -> Int64s:
    """Return the slots of the k largest positive scores, best first; of equals the older first."""
    chosen = np.empty(k, np.int64)
    count = 0
    for slot in range(len(scores)):
        score = scores[slot]
        if score <= 0.0 or (count == k and score <= scores[chosen[k - 1]]):
            continue
        place = count if count < k else k - 1
        while place > 0 and scores[chosen[place - 1]] < score:
            chosen[place] = chosen[place - 1]
            place -= 1
        chosen[place] = slot
        count = min(count + 1, k)
    return chosen[:count]


class InvertedIndex:
    """Bags of words of keyframes under one vocabulary; answers which are most like a query (L1 score, 0..1)."""

    def __init__(self, word_count: int) -> None:
        self._start = np.zeros(word_count, np.int64)
        self._fill = np.zeros(word_count, np.int32)
        self._room = np.zeros(word_count, np.int32)
        self._slots = np.empty(1024, np.int32)
        self._values = np.empty(1024, np.float32)
        self._used = 0
        self._ids = np.empty(64, np.int64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, keyframe_id: int, bag: BagOfWords) -> None:
        """Add a keyframe; ids must ascend. Raises ValueError when they do not: the caller's order is broken."""
        if self._count and keyframe_id <= self._ids[self._count - 1]:
            raise ValueError(f"keyframe {keyframe_id} added to the index after {self._ids[self._count - 1]}")
        if self._count == len(self._ids):
            self._ids = np.resize(self._ids, 2 * self._count)
        needed = self._used + _room_needed(bag.words, self._fill, self._room)
        if needed > len(self._slots):
            self._slots = np.resize(self._slots, 2 * needed)
            self._values = np.resize(self._values, 2 * needed)
        self._used = _append(
            self._count,
            bag.words,
            bag.weights,
            self._start,
            self._fill,
            self._room,
            self._slots,
            self._values,
            self._used,
        )
        self._ids[self._count] = keyframe_id
        self._count += 1

    def query(self, bag: BagOfWords, k: int, excluded: Int64s | None = None) -> tuple[Int64s, Float32s]:
        """Return ids and scores of the at most k keyframes most like the bag, best first, without the excluded ids."""
        scores = np.zeros(self._count, np.float32)
        _accumulate(bag.words, bag.weights, self._start, self._fill, self._slots, self._values, scores)
        if excluded is not None:
            scores[np.isin(self._ids[: self._count], excluded)] = 0.0
        best = _best(scores, k) if k > 0 else np.empty(0, np.int64)
        return self._ids[best], scores[best]
