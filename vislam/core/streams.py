"""What happens in the stream of a sensor, judged once, before anything is estimated from it: facts with time and kind.

Thresholds come from the stream itself: its usual interval, and how often two neighbours of it are equal by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from vislam.core.messages import ImageU8

_NS = 1_000_000_000
_MEDIAN_OF = 31  # intervals, whose median is the usual one
_AT_FIRST = (3, 7, 15)  # of the first ones, too
_HOLE = 2.5  # usual intervals
_MOST_EVENTS = 50  # of one kind; what comes later is counted with the last
_TOGETHER_NS = _NS // 2  # what happens again so soon is the same event
_CHANGES = 100  # pairs of neighbours that differ, after which equal ones are a surprise
_BY_CHANCE = 1e-6  # runs of equal rows as long that a whole stream has by chance
_DARK = 3.0  # mean grey, and as much of its scatter, below which an image shows nothing
_STEP_ROWS = 5  # in order among each other, behind what came before: the clock stepped; fewer are rows that came late


class Happening(StrEnum):
    """What may happen in a stream."""

    STUCK = "stuck"  # one row again and again
    REPEATED = "repeated"  # an image equal to the one before to the byte
    DUPLICATE = "duplicate"  # another row of the same time
    LATE = "late"  # a row behind newer ones
    STEP_BACK = "step back"  # of the clock
    HOLE = "hole"
    UNUSABLE = "unusable"  # no numbers, or such as no sensor gives
    DARK = "dark"


@dataclass(frozen=True, slots=True)
class StreamEvent:
    """What happened in a stream: from the first row concerned to the last one, and what was done about it.

    Of a hole the ends are the rows around it, and `rows` are those that an even rate would have brought. Of a step of
    the clock `from_ns` is the newest time before it and `to_ns` that of the first row after it.
    """

    stream: str
    happening: Happening
    from_ns: int
    to_ns: int
    rows: int

    @property
    def done(self) -> str:
        """What was done about it."""
        return _DONE[self.happening]

    def entry(self, begin_ns: int) -> dict[str, Any]:
        """Return it for a JSON file, in seconds since `begin_ns`."""
        return {
            "stream": self.stream, "happening": self.happening, "from_s": (self.from_ns - begin_ns) / _NS,
            "to_s": (self.to_ns - begin_ns) / _NS, "rows": self.rows, "done": self.done,
        }  # fmt: skip

    def words(self, begin_ns: int) -> str:
        """Return it as a sentence without the full stop, in seconds since `begin_ns`."""
        begin_s, end_s = (self.from_ns - begin_ns) / _NS, (self.to_ns - begin_ns) / _NS
        when = f"from {begin_s:.2f} to {end_s:.2f} s"
        if self.happening is Happening.STEP_BACK:
            when = f"by {begin_s - end_s:.2f} s at {begin_s:.2f} s"
        return f"{self.stream}: {_WORDS[self.happening]} {when} ({self.rows}); {self.done}"


_DONE = {
    Happening.STUCK: "taken for missing",
    Happening.REPEATED: "used as they are",
    Happening.DUPLICATE: "left out",
    Happening.LATE: "left out",
    Happening.STEP_BACK: "left out until it has caught up, and not tied to what was before",
    Happening.HOLE: "bridged by the other sensors",
    Happening.UNUSABLE: "left out",
    Happening.DARK: "nothing is seen in them",
}
_WORDS = {
    Happening.STUCK: "stuck at one value",
    Happening.REPEATED: "images that equal the one before",
    Happening.DUPLICATE: "rows of a time that was there already",
    Happening.LATE: "rows behind newer ones",
    Happening.STEP_BACK: "the clock stepped back",
    Happening.HOLE: "rows are missing",
    Happening.UNUSABLE: "rows that are no measurement",
    Happening.DARK: "dark images",
}


def is_dark(image: ImageU8) -> bool:
    """Return whether an image [H, W] shows nothing."""
    return bool(image.mean() < _DARK and image.std() < _DARK)


class StreamJudge:
    """Judges the rows of one stream as they come.

    Attributes:
        refused: rows that are no measurement of a time of their own, by what happened.
        usual_ns: between two rows; 0 before there are enough.
    """

    def __init__(self, stream: str, most: Sequence[float] = (), hole_s: float = 0.0) -> None:
        """Begin with no row; `most` are limits of the numbers of a row, and shorter holes than `hole_s` are none."""
        kinds = (Happening.UNUSABLE, Happening.DUPLICATE, Happening.LATE, Happening.STUCK)
        self.refused: dict[str, int] = dict.fromkeys(map(str, kinds), 0)
        self._stream, self._most, self._hole_ns = stream, most, round(hole_s * _NS)
        self.usual_ns, self._is_new = 0, True
        self._newest_ns: int | None = None
        self._is_refused = False  # what came since then, so that a hole behind it has a name already
        self._intervals_ns: list[int] = []  # since `usual_ns` was taken
        self._behind: list[int] = []  # times of rows behind the newest, as far as they rise
        self._last: Sequence[float] = ()
        self._run, self._run_ns, self._is_stuck = 0, 0, False  # rows equal to the one before them, and since when
        self._pairs, self._equal = 0, 0  # of neighbours, those that were stuck left out
        self._events: dict[Happening, list[StreamEvent]] = {}

    @property
    def events(self) -> list[StreamEvent]:
        """What happened so far, in the order of time."""
        return sorted((e for some in self._events.values() for e in some), key=lambda e: (e.from_ns, e.happening))

    def takes(self, t_ns: int, row: Sequence[float] = ()) -> bool:
        """Take a row as it comes; return whether it is a measurement of a time of its own."""
        newest = self._newest_ns
        if any(not abs(value) <= most for value, most in zip(row, self._most, strict=False)):  # also what is no number
            return self._refuse(Happening.UNUSABLE, t_ns)
        if newest is not None and t_ns <= newest:
            return self._refuse(Happening.DUPLICATE, t_ns) if t_ns == newest else self._is_behind(t_ns, newest)
        if self._behind:
            self._let_late()
        if row and self._repeats(t_ns, row):
            return self._refuse(Happening.STUCK, t_ns, self._run_ns)
        self._newest_ns, is_after_refused, self._is_refused = t_ns, self._is_refused, False
        if newest is not None and not is_after_refused:
            self._look_for_hole(newest, t_ns)
        return True

    def correct(self, t_ns: int) -> None:
        """Take the stamp of the newest row for a wrong one, which had leapt ahead: a row at `t_ns` is in its place."""
        self._newest_ns = t_ns

    def note(self, happening: Happening, from_ns: int, to_ns: int, rows: int = 1) -> None:
        """Take note of what happened; the same again soon after is one event with it."""
        known = self._events.setdefault(happening, [])
        if known and (from_ns - known[-1].to_ns <= _TOGETHER_NS or len(known) == _MOST_EVENTS):
            last = known[-1]
            known[-1] = replace(last, to_ns=max(to_ns, last.to_ns), rows=last.rows + rows)
        else:
            known.append(StreamEvent(self._stream, happening, from_ns, to_ns, rows))

    def _refuse(self, happening: Happening, t_ns: int, from_ns: int | None = None) -> bool:
        self.refused[happening] += 1
        self._is_refused = self._is_refused or happening in (Happening.STUCK, Happening.UNUSABLE)
        self.note(happening, t_ns if from_ns is None else from_ns, t_ns)
        return False

    def _is_behind(self, t_ns: int, newest_ns: int) -> bool:
        """Refuse a row behind the newest; several that go on among each other say that the clock stepped back."""
        self.refused[Happening.LATE] += 1
        if self._behind and t_ns <= self._behind[-1]:
            self._let_late()
        self._behind.append(t_ns)
        if len(self._behind) == _STEP_ROWS:
            steps = self._events.setdefault(Happening.STEP_BACK, [])
            steps.append(StreamEvent(self._stream, Happening.STEP_BACK, newest_ns, self._behind[0], _STEP_ROWS))
        elif len(self._behind) > _STEP_ROWS:
            steps = self._events[Happening.STEP_BACK]
            steps[-1] = replace(steps[-1], rows=steps[-1].rows + 1)
            del self._behind[0]  # bounds it; the first one stands in the event
        return False

    def _let_late(self) -> None:
        """Take rows behind the newest for late ones, unless the clock stepped: they did not go on."""
        if len(self._behind) < _STEP_ROWS:
            for t_ns in self._behind:
                self.note(Happening.LATE, t_ns, t_ns)
        self._behind.clear()

    def _repeats(self, t_ns: int, row: Sequence[float]) -> bool:
        """Whether a row equals more before it than chance explains, by how often neighbours were equal up to now."""
        if row != self._last:
            usual = 0 if self._is_stuck else self._run
            self._pairs, self._equal = self._pairs + usual + 1, self._equal + usual
            self._last, self._run, self._run_ns, self._is_stuck = row, 0, t_ns, False
            return False
        self._run += 1
        by_chance = self._pairs * ((self._equal + 1.0) / (self._pairs + 1.0)) ** self._run
        self._is_stuck = self._pairs - self._equal >= _CHANGES and by_chance < _BY_CHANCE
        return self._is_stuck

    def _look_for_hole(self, before_ns: int, t_ns: int) -> None:
        step_ns = t_ns - before_ns
        if self.usual_ns and step_ns > max(self._hole_ns, _HOLE * self.usual_ns):
            self.note(Happening.HOLE, before_ns, t_ns, round(step_ns / self.usual_ns) - 1)
        self._intervals_ns.append(step_ns)
        if len(self._intervals_ns) == _MEDIAN_OF or (len(self._intervals_ns) in _AT_FIRST and self._is_new):
            self.usual_ns = int(np.median(self._intervals_ns))
        if len(self._intervals_ns) == _MEDIAN_OF:
            self._intervals_ns.clear()
            self._is_new = False
