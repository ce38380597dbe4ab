"""The inverted index: which keyframes have a word, so that a query touches only what it shares.

A query over 50,000 keyframes walks through a million postings, and memory decides how fast. So a posting is two bytes
where it can be: of a word that a keyframe has once, only the distance to the keyframe before is stored. Its share of
the L1 score, idf * min(1 / T_query, 1 / T_keyframe) (T: the total that a bag's weights are divided by), is known
without it: idf is added up, and divided at the end by the larger T. Words that a keyframe has several times have
postings of their own with the count. Nothing is rounded but to single precision.

The postings of a word lie together in one pool and move into an area of twice the room when they have no more; the
area that they leave is used again. So adding stays incremental and a query reads memory in order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.loop.words.vocabulary import BagOfWords
from vislam.vision.hamming import prefetch

Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]

_START, _FILL, _ROOM, _LAST = 0, 1, 2, 3  # of a list: place and room in cells, entries, newest slot
_SKIP = 0xFFFF  # an entry that only has the distance to the next one
_COUNT_BITS = 12  # of an entry with a count
_MAX_COUNT = 2**_COUNT_BITS - 1  # what one image has more often of one word counts as so often
_MAX_SLOTS = 2 ** (32 - _COUNT_BITS)  # a million keyframes: the largest distance that fits beside a count
_MAX_CELLS = 2**32 - 1  # 16 GiB; the last number means "none" in the chain of free areas
_FAR, _NEAR = 8, 3  # words ahead of the one in work whose lists' heads and postings are asked for from memory
_SIZES = 40  # areas have 1, 2, 4, ... cells


@njit(cache=True, nogil=True)
def _cells_needed(slot: int, words: Int32s, counts: Int32s, lists: Int64s) -> int:
    """Return how many cells adding a bag takes from the end of the pool, at most."""
    needed = 0
    for i in range(len(words)):
        if i + _FAR < len(words):
            prefetch(lists, 2 * np.int64(words[i + _FAR]))
        single = counts[i] == 1
        row = 2 * words[i] + (0 if single else 1)
        entries = lists[row, _FILL] + 1 + ((slot - lists[row, _LAST]) // _SKIP if single else 0)
        cells = (entries + 1) // 2 if single else entries
        if cells > lists[row, _ROOM]:
            room = max(1, lists[row, _ROOM])
            while room < cells:
                room *= 2
            needed += room
    return needed


@njit(cache=True, nogil=True)
def _make_room(row: int, cells: int, lists: Int64s, pool: NDArray[np.uint32], free: Int64s, used: int) -> int:
    """Move a list into an area of at least `cells` cells; return how much of the pool is used afterwards."""
    old, room = lists[row, _ROOM], max(1, lists[row, _ROOM])
    while room < cells:
        room *= 2
    size = 0
    while (1 << size) < room:
        size += 1
    start = free[size]
    if start >= 0:
        following = pool[start]
        free[size] = -1 if following == np.uint32(_MAX_CELLS) else np.int64(following)
    else:
        start = used
        used += room
    begin = lists[row, _START]
    for cell in range(old):
        pool[start + cell] = pool[begin + cell]
    if old > 0:  # the area that was left heads the chain of its size
        size = 0
        while (1 << size) < old:
            size += 1
        pool[begin] = np.uint32(_MAX_CELLS) if free[size] < 0 else np.uint32(free[size])
        free[size] = begin
    lists[row, _START], lists[row, _ROOM] = start, room
    return used


@njit(cache=True, nogil=True)
def _append(
    slot: int, words: Int32s, counts: Int32s, lists: Int64s, pool: NDArray[np.uint32], halves: NDArray[np.uint16],
    free: Int64s, used: int,
) -> int:  # fmt: skip
    """Append a posting to each word's list; return how much of the pool is used afterwards."""
    for i in range(len(words)):
        if i + _NEAR < len(words):
            ahead = 2 * np.int64(words[i + _NEAR]) + (0 if counts[i + _NEAR] == 1 else 1)
            prefetch(pool, lists[ahead, _START] + lists[ahead, _FILL] // 2)
        single = counts[i] == 1
        row = 2 * words[i] + (0 if single else 1)
        gap = slot - lists[row, _LAST]
        entries = lists[row, _FILL] + 1 + (gap // _SKIP if single else 0)
        cells = (entries + 1) // 2 if single else entries
        if cells > lists[row, _ROOM]:
            used = _make_room(row, cells, lists, pool, free, used)
        place = lists[row, _START]
        if single:
            place = 2 * place + lists[row, _FILL]
            while gap >= _SKIP:
                halves[place] = _SKIP
                place += 1
                gap -= _SKIP
            halves[place] = gap
        else:
            pool[place + lists[row, _FILL]] = (gap << _COUNT_BITS) | min(counts[i], _MAX_COUNT)
        lists[row, _FILL] = entries
        lists[row, _LAST] = slot
    return used


@njit(cache=True, nogil=True)
def _add_singles(
    place: int, stop: int, weight: np.float32, own: np.float32, once: bool, halves: NDArray[np.uint16],
    common: Float32s, others: Float32s,
) -> None:  # fmt: skip
    """Add up the postings of a word that keyframes have once; `own` is its count in the query over that one's total."""
    slot = np.uint64(0)
    for i in range(np.uint64(place), np.uint64(stop)):  # unsigned: no check for negative indices
        gap = halves[i]
        slot += np.uint64(gap)
        if gap == _SKIP:
            continue
        if once:
            common[slot] += weight
        else:
            others[slot, 0] += weight * min(own, others[slot, 1])


@njit(cache=True, nogil=True)
def _add_counted(
    place: int, stop: int, weight: np.float32, own: np.float32, pool: NDArray[np.uint32], others: Float32s
) -> None:
    """Add up the postings of a word that keyframes have several times."""
    slot = np.uint64(0)
    for i in range(np.uint64(place), np.uint64(stop)):
        entry = pool[i]
        slot += np.uint64(entry >> np.uint32(_COUNT_BITS))
        count = np.float32(np.int32(entry & np.uint32(_MAX_COUNT)))
        others[slot, 0] += weight * min(own, count * others[slot, 1])


class _Postings(NamedTuple):
    """The lists of all words and what they hold."""

    lists: Int64s
    pool: NDArray[np.uint32]
    halves: NDArray[np.uint16]  # the pool again, entries of two bytes


@njit(cache=True, nogil=True)
def _accumulate(
    words: Int32s, counts: Int32s, per_total: np.float32, idf: Float32s, postings: _Postings, common: Float32s,
    others: Float32s,
) -> None:  # fmt: skip
    """Add up what each keyframe shares with a query.

    The query has `words` [M] with `counts` [M] and `per_total`, 1 over its total. To `common` [slots] the idf of words
    is added that both have once; to column 0 of `others` [slots, 2] all other shares of the score (column 1 is 1 over
    the keyframe's total).
    """
    lists, pool, halves = postings
    for i in range(len(words)):
        if i + _FAR < len(words):
            prefetch(lists, 2 * np.int64(words[i + _FAR]))
        if i + _NEAR < len(words):
            row = 2 * np.int64(words[i + _NEAR])
            prefetch(pool, lists[row, _START])
            prefetch(pool, lists[row + 1, _START])
        row, weight = 2 * np.int64(words[i]), idf[words[i]]
        own = np.float32(counts[i]) * per_total
        place = 2 * lists[row, _START]
        _add_singles(place, place + lists[row, _FILL], weight, own, counts[i] == 1, halves, common, others)
        place = lists[row + 1, _START]
        _add_counted(place, place + lists[row + 1, _FILL], weight, own, pool, others)


@njit(cache=True, nogil=True)
def _best(per_total: np.float32, common: Float32s, others: Float32s, count: int, k: int) -> tuple[Int64s, Float32s]:
    """Return slots and scores of the k largest positive scores, best first, and clear the sums; of equals the older."""
    chosen, best = np.empty(k, np.int64), np.zeros(k, np.float32)
    found, least = 0, np.float32(0.0)
    for slot in range(count):
        score = common[slot] * min(per_total, others[slot, 1]) + others[slot, 0]
        common[slot] = 0.0
        others[slot, 0] = 0.0
        if score > least:
            place = found if found < k else k - 1
            while place > 0 and best[place - 1] < score:
                best[place] = best[place - 1]
                chosen[place] = chosen[place - 1]
                place -= 1
            best[place] = score
            chosen[place] = slot
            found = min(found + 1, k)
            if found == k:
                least = best[k - 1]
    return chosen[:found], best[:found]


class InvertedIndex:
    """Bags of words of keyframes under one vocabulary; answers which are most like a query (L1 score, 0..1)."""

    def __init__(self, idf: Float64s) -> None:
        """Start empty, for words of these inverse document frequencies [words]."""
        self._idf = idf.astype(np.float32)
        self._lists = np.zeros((2 * len(idf), 4), np.int64)  # of a word: where it occurs once, where more often
        self._pool = np.zeros(1024, np.uint32)
        self._free = np.full(_SIZES, -1, np.int64)  # first of the areas of each size that were left
        self._used = 0
        self._ids = np.zeros(64, np.int64)
        self._common = np.zeros(64, np.float32)  # sums of a query, zero between queries
        self._others = np.zeros((64, 2), np.float32)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def bytes_used(self) -> int:
        """The memory that postings and lists take."""
        return self._lists.nbytes + self._pool.nbytes

    def add(self, keyframe_id: int, bag: BagOfWords) -> None:
        """Add a keyframe; ids must ascend. Raises ValueError when they do not: the caller's order is broken."""
        if self._count and keyframe_id <= self._ids[self._count - 1]:
            raise ValueError(f"keyframe {keyframe_id} added to the index after {self._ids[self._count - 1]}")
        self._grow(self._used + _cells_needed(self._count, bag.words, bag.counts, self._lists))
        self._used = _append(
            self._count, bag.words, bag.counts, self._lists, self._pool, self._pool.view(np.uint16), self._free,
            self._used,
        )  # fmt: skip
        self._ids[self._count] = keyframe_id
        self._others[self._count, 1] = 1.0 / bag.total if bag.total > 0.0 else 0.0
        self._count += 1

    def _grow(self, cells: int) -> None:
        """Have room for one more keyframe and `cells` cells. Growing in place, a large pool is remapped, not copied."""
        if cells > len(self._pool):
            if cells > _MAX_CELLS or self._count >= _MAX_SLOTS:
                raise ValueError(f"an index of {self._count} keyframes and {cells} cells is full")
            self._pool.resize(min(_MAX_CELLS, cells + cells // 4), refcheck=False)
        if self._count == len(self._ids):
            room = 2 * self._count
            self._ids.resize(room, refcheck=False)
            self._common.resize(room, refcheck=False)
            self._others.resize((room, 2), refcheck=False)

    def query(self, bag: BagOfWords, k: int, excluded: Int64s | None = None) -> tuple[Int64s, Float32s]:
        """Return ids and scores of the at most k keyframes most like the bag, best first, without the excluded ids."""
        if k <= 0 or bag.total <= 0.0 or self._count == 0:
            return np.empty(0, np.int64), np.empty(0, np.float32)
        per_total = np.float32(1.0 / bag.total)
        _accumulate(
            bag.words, bag.counts, per_total, self._idf,
            _Postings(self._lists, self._pool, self._pool.view(np.uint16)), self._common, self._others,
        )  # fmt: skip
        if excluded is not None and len(excluded):
            ids = self._ids[: self._count]
            slots = np.minimum(np.searchsorted(ids, excluded), self._count - 1)
            left_out = slots[ids[slots] == excluded]
            self._common[left_out] = 0.0
            self._others[left_out, 0] = 0.0
        slots, scores = _best(per_total, self._common, self._others, self._count, k)
        return self._ids[slots], scores
