"""Which readings of further sensors get into equations, of the graph or of the sliding window."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from vislam.core.readings import Motion, MotionReadings, PlacedReading
from vislam.factors.reading_counts import ReadingCounts
from vislam.factors.reading_factor import as_motion
from vislam.sensors import USER_ERRORS, Suite


class Admission:
    """Says which readings are used, and counts those that are not."""

    def __init__(self, suite: Suite, counts: ReadingCounts) -> None:
        """Set up for the sensors of a machine; `counts` is told."""
        self._suite = suite
        self._counts = counts

    def is_usable(self, placed: PlacedReading) -> bool:
        """Return whether a sensor that is there takes a reading of its own."""
        if placed.reading.sensor not in self._suite.names:
            self._counts.add(placed.reading.sensor, "unknown")
            return False
        try:
            why = self._suite.why_unusable(placed.reading)
        except USER_ERRORS as error:
            why = str(error) or type(error).__name__
        if why:
            self._counts.add(placed.reading.sensor, "unusable")
        return not why

    def for_window(self, motions: Sequence[MotionReadings], k: int) -> list[Motion]:
        """Return what a window takes of each sensor between keyframe k and the one before, where vision was lost."""
        out = []
        for motion in motions:
            name = motion.sensor
            placed = [one for one in motion.placed if self.is_usable(one)]
            if placed:
                self._counts.add(name, "in_window", len(placed))
                out.append(as_motion(self._suite[name], placed, motion.own, partial(self._counts.fail, name, -k)))
        return out
