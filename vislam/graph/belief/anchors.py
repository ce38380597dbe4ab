"""Anchors: the keyframe that stands for a place, so that a run's loops tie to few keyframes however long it goes on."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from vislam.core.memory import Tied

_ANCHOR_REACH = 10  # keyframes from one that is tied to an older one: a loop to it ties to that one, the anchor


class Anchors:
    """Remembers to which anchor accepted loops tie keyframes.

    Loops from each visit of a place to any earlier one fill the factorised system with every visit; loops to the same
    old keyframe with one. The idea is that of the reduced pose graph (Johannsson et al., "Temporally scalable visual
    SLAM using a reduced pose graph", ICRA 2013), whose size follows the space explored and not the time.
    """

    def __init__(self) -> None:
        """Start without any."""
        self._tied: dict[int, Tied] = {}
        self._ids: list[int] = []  # keys of the above, ascending
        self._fresh: list[Tied] = []  # since `take_record`

    def near(self, k: int) -> Tied | None:
        """Return the tied keyframe nearest to k along the run; None when there is none in reach."""
        n = bisect_left(self._ids, k)
        around = [c for c in self._ids[max(n - 1, 0) : n + 1] if abs(c - k) <= _ANCHOR_REACH]
        return self._tied[min(around, key=lambda c: abs(c - k))] if around else None

    def tie(self, tied: Tied) -> None:
        """Take note of a keyframe; what is known of one stays."""
        if tied.id not in self._tied:
            self._tied[tied.id] = tied
            self._ids.insert(bisect_left(self._ids, tied.id), tied.id)
            self._fresh.append(tied)

    def forget(self) -> None:
        """Let every keyframe stand for itself again: a loop was wrong, and nobody knows how far that went."""
        self._tied = {k: Tied(k, k, np.zeros((6, 6))) for k in self._ids}
        self._fresh = list(self._tied.values())

    def take_record(self) -> tuple[Tied, ...]:
        """Return what was tied since the last call."""
        fresh, self._fresh = tuple(self._fresh), []
        return fresh
