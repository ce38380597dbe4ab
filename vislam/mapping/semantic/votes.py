"""Votes for labels in bounded memory: of each voxel or surfel the counts of the few labels that were seen most.

A keyframe has one vote per place, for the label that most of its pixels there have: pixels of one image err together.
Of each place four counters are kept. When a fifth label comes, all of them lose one (Misra and Gries, "Finding repeated
elements", Science of Computer Programming 1982): whatever more than a fifth of the votes are for is never lost, and a
count is too low by at most a fifth of them, never too high.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.mapping.octree import find_slot, keys_at

KEPT = 4  # labels of one place
KEY_ORIGIN = 32768  # OctoMap's: the key of the voxel whose lower corner is the map's origin
_KEY_BITS = 16
_ID_BITS = 16
_I64 = NDArray[np.int64]


class Votes(NamedTuple):
    """What was seen of places, a row each."""

    ids: NDArray[np.uint16]  # [N, 4] labels, 0: the counter is free
    counts: NDArray[np.int32]  # [N, 4]
    total: NDArray[np.int32]  # [N] votes in all

    @classmethod
    def none(cls, rows: int) -> Votes:
        """Return places without votes."""
        return cls(np.zeros((rows, KEPT), np.uint16), np.zeros((rows, KEPT), np.int32), np.zeros(rows, np.int32))

    def grown(self, rows: int) -> Votes:
        """Return as many rows as asked for, these first."""
        more = Votes.none(rows - len(self.total))
        return Votes(
            np.concatenate([self.ids, more.ids]),
            np.concatenate([self.counts, more.counts]),
            np.concatenate([self.total, more.total]),
        )

    def select(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Votes:
        """Return those of some places."""
        return Votes(self.ids[rows], self.counts[rows], self.total[rows])

    def winners(self) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
        """Return the label [N] with most votes, of equal ones the lower id, and its count [N]; 0 without votes."""
        most = self.counts.max(axis=1, initial=0)
        leads = (self.counts == most[:, None]) & (self.ids > 0)
        ids = np.where(leads, self.ids, np.uint16(65535)).min(axis=1, initial=65535)
        return np.where(most > 0, ids, 0).astype(np.uint16), most


@njit(cache=True, nogil=True)
def vote(votes: Votes, row: int, label: int) -> None:
    """Count a vote for a label at a place."""
    ids, counts, total = votes
    total[row] += 1
    free = -1
    for k in range(KEPT):
        if counts[row, k] > 0 and ids[row, k] == label:
            counts[row, k] += 1
            return
        if counts[row, k] == 0 and free < 0:
            free = k
    if free >= 0:
        ids[row, free], counts[row, free] = label, 1
        return
    for k in range(KEPT):
        counts[row, k] -= 1


@njit(cache=True, nogil=True)
def _vote_all(keys: _I64, labels: _I64, table: _I64, rows: NDArray[np.int32], known: _I64, votes: Votes,
              bounds: tuple[int, int]) -> tuple[int, int]:  # fmt: skip
    """Count votes [M] at voxels; return how many voxels there are and how many votes found no room."""
    count, most = bounds
    refused = 0
    for i in range(len(keys)):
        slot = find_slot(table, keys[i])
        if table[slot] < 0:
            if count >= most:
                refused += 1
                continue
            table[slot], rows[slot], known[count] = keys[i], count, keys[i]
            count += 1
        vote(votes, rows[slot], labels[i])
    return count, refused


@njit(cache=True, nogil=True)
def _link(keys: _I64, count: int, table: _I64, rows: NDArray[np.int32]) -> None:
    for row in range(count):
        slot = find_slot(table, keys[row])
        table[slot], rows[slot] = keys[row], row


class VoxelVotes:
    """Votes at the voxels of an octree, over any number of keyframes, for a bounded number of voxels."""

    def __init__(self, resolution_m: float, max_voxels: int) -> None:
        self.resolution_m = resolution_m
        self.refused = 0  # votes at voxels for which there was no room
        self._most = max_voxels
        self._count = 0
        self._keys = np.empty(1 << 10, np.int64)
        self._votes = Votes.none(1 << 10)
        self._table = np.full(1 << 12, -1, np.int64)
        self._rows = np.zeros(1 << 12, np.int32)

    def add(self, points_m: NDArray[np.float32], labels: NDArray[np.uint16]) -> None:
        """Count one keyframe's labels of its points [N, 3]; label 0 does not count."""
        keys = voxel_keys(points_m, self.resolution_m)
        used = (labels > 0) & (keys >= 0)
        keys, chosen = majority(keys[used], labels[used])
        self._reserve(len(keys))
        self._count, refused = _vote_all(
            keys, chosen, self._table, self._rows, self._keys, self._votes, (self._count, self._most)
        )
        self.refused += refused

    def voxels(self) -> tuple[_I64, Votes]:
        """Return the keys [N] of the voxels with votes, ascending, and the votes."""
        order = np.argsort(self._keys[: self._count])
        return self._keys[order], self._votes.select(order)

    def _reserve(self, extra: int) -> None:
        need = min(self._count + extra, self._most)
        if need > len(self._keys):
            rows = max(need, 2 * len(self._keys))
            self._keys = np.resize(self._keys, rows)
            self._votes = self._votes.grown(rows)
        if 2 * need >= len(self._table):
            size = 1 << int(np.ceil(np.log2(4 * need)))
            self._table, self._rows = np.full(size, -1, np.int64), np.zeros(size, np.int32)
            _link(self._keys, self._count, self._table, self._rows)


def majority(places: _I64, labels: NDArray[np.uint16]) -> tuple[_I64, _I64]:
    """Return places [M] that occur in [N], each once and ascending, and the label most had; of equal ones the lower."""
    if len(places) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # a key of 48 bits and a label of 16 in one number
    pairs, counts = np.unique(places.astype(np.uint64) << np.uint64(_ID_BITS) | labels, return_counts=True)
    keys, found = (pairs >> np.uint64(_ID_BITS)).astype(np.int64), (pairs & np.uint64(0xFFFF)).astype(np.int64)
    order = np.lexsort((found, -counts, keys))
    first = np.r_[True, np.diff(keys[order]) > 0]
    return keys[order][first], found[order][first]


def voxel_keys(points_m: NDArray[np.floating], resolution_m: float) -> _I64:
    """Return OctoMap's keys [N] of the voxels of points [N, 3], packed; -1 where no octree reaches."""
    keys, inside = keys_at(points_m, resolution_m)
    a, b, c = keys.T
    return np.where(inside, (c << (2 * _KEY_BITS)) | (b << _KEY_BITS) | a, -1)


def voxel_centres(keys: _I64, resolution_m: float) -> Array:
    """Return the centres [N, 3] of voxels in metres."""
    mask = (1 << _KEY_BITS) - 1
    cells = np.stack([keys & mask, (keys >> _KEY_BITS) & mask, keys >> (2 * _KEY_BITS)], axis=1)
    return (cells - KEY_ORIGIN + 0.5) * resolution_m
