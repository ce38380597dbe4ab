"""When old keyframes leave the solver: segments of them, the oldest first, once many loops tie them."""

from __future__ import annotations

from vislam.config import GraphConfig
from vislam.graph.belief.held import HeldLoops
from vislam.graph.estimator import Estimator
from vislam.graph.segments import Segment, segments


class Freezer:
    """Looks now and then for a segment that can be summed up."""

    def __init__(self, config: GraphConfig, estimator: Estimator, held: HeldLoops) -> None:
        """Look at the keyframes and loops of an estimator."""
        self._config = config
        self._estimator = estimator
        self._held = held
        self._next = 0  # keyframe with which to look again

    def step(self) -> str:
        """Sum up the oldest segment of keyframes that many loops tie, now and then; return what went wrong."""
        newest = len(self._estimator.poses) - 1
        if newest < self._next:
            return ""
        segment = self._segment()
        if segment is None:
            self._next = newest + self._config.freeze_keyframes // 4
            return ""
        return self._estimator.freeze(segment)

    def all(self) -> str:
        """Sum up all old segments at once, as after a restart; return what went wrong."""
        notes: list[str] = []
        while not any(notes) and (segment := self._segment()) is not None:
            notes.append(self._estimator.freeze(segment))
        return "; ".join(note for note in notes if note)

    def _segment(self) -> Segment | None:
        """Return the oldest segment that can be summed up."""
        config, estimator = self._config, self._estimator
        if not self._held.are_many:
            return None
        last, summed_up = len(estimator.poses) - 1 - config.freeze_after, estimator.summed_up
        found = segments(
            estimator.solved_loops(), config.freeze_keyframes, last, frozen=summed_up.firsts, pinned=summed_up.pinned
        )
        return next((segment for segment in found if estimator.can_freeze(segment)), None)
