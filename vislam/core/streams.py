"""What happens in the stream of a sensor, judged once, before anything is estimated from it: facts with time and kind.

Thresholds come from the stream itself: its usual interval, and how often two neighbours of it are equal by chance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise, takewhile
from typing import Any, Self

import numpy as np

from vislam.core.messages import ImageF32, ImageU8
from vislam.core.stream_axes import Axis, AxisWatch, Run

_NS = 1_000_000_000
_MEDIAN_OF = 31  # intervals, whose median is the usual one
_AT_FIRST = (3, 7, 15)  # of the first ones, too
_HOLE = 2.5  # usual intervals
_NEARLY_TOGETHER = 0.25  # of the usual interval
_FEWEST = 3  # that make a burst, a pattern in a window of intervals, or a motion in images
_ALIKE = 0.05  # of the usual interval: intervals of one length
_UNEVEN = 0.25  # of the usual interval: differences of stamps that are worth a word
_OFF = 0.1  # of a stated rate
_UNRELATED_NS = 60 * _NS  # a clock that is set again is seldom off by more; another log is
_EVERY_PX = 8  # of which two rows and columns are looked at, for how sharp an image is
_BLURRED = 0.5  # of the usual sharpness, for a second: longer than a turn blurs images
_SHARP_OF = 101  # images, whose median sharpness is the usual one
_MOST_EVENTS = 50  # of one kind; what comes later is counted with the last
_TOGETHER_NS = _NS // 2  # what happens again so soon is the same event
_DARK = 3.0  # mean grey, and as much of its scatter, below which an image shows nothing
# correlation of neighbours that noise has, at most, and in sigmas of it; a lens makes it 0.75
_NOISY, _BY_NOISE = 0.05, 5.0
_STEP_ROWS = 5  # in order among each other, behind what came before: the clock stepped; fewer are rows that came late


class Happening(StrEnum):
    """What may happen in a stream: its name, in words, and what is done about it."""

    words: str
    done: str

    STUCK = "stuck", "stuck at one value", "taken for missing"
    REPEATED = "repeated", "images that equal the one before", "used once or twice, then taken for dark"
    DUPLICATE = "duplicate", "rows of a time that was there already", "left out"
    LATE = "late", "rows behind newer ones", "left out"
    STEP_BACK = (
        "step back", "the clock stepped back", "left out until it has caught up, and not tied to what was before",
    )  # fmt: skip
    STEP_FORTH = "step forth", "the clock stepped forth", "bridged like a hole, and late from then on"  # of one stream
    HOLE = "hole", "rows are missing", "bridged by the other sensors"
    BURST = "burst", "rows that came together have stamps of their arrival", "left out where vision has metres"
    SAWTOOTH = "sawtooth", "stamps are rounded, or set right in steps", "used with these stamps"
    WRONG_RATE = "wrong rate", "another rate than the stated one", "the stamps count"
    LOOPED = "looped", "played again from its first row, back", "left out"
    APPENDED = "appended", "another log follows, off", "what is behind is left out, and nothing is tied across"
    UNUSABLE = "unusable", "rows that are no measurement", "left out"
    SPIKE = "spike", "single rows far off those around them", "left out"
    CONTRADICTING = "contradicting", "another motion than the camera sees", "left out until both agree again"
    CLIPPED = "clipped", "the range ends where the motion does not", "used as they are"
    DARK = "dark", "dark or blank images", "nothing is seen in them"
    BLURRED = "blurred", "images blurred all over", "used as they are"
    MOVING = "moving", "something moves by itself before the camera", "what moves as the room did before is followed"

    def __new__(cls, name: str, words: str = "", done: str = "") -> Self:
        """Make the member of a name."""
        made = str.__new__(cls, name)
        made._value_, made.words, made.done = name, words, done
        return made


_ALONE = {
    "imu0": "no sample is used from then on: which of their times are the camera's is not known",
    "cam0": "left out until it has caught up; inertial samples are used no more, for their times are not the camera's",
}
_TEARING = (Happening.STEP_BACK, Happening.LOOPED, Happening.APPENDED)
_OF_STAMPS = (Happening.BURST, Happening.SAWTOOTH, Happening.WRONG_RATE, Happening.APPENDED)


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
    done: str = ""  # about it, if not the usual

    @property
    def tears(self) -> bool:
        """Whether it parts what came before from what came after by an unknown time."""
        return self.happening in _TEARING

    def entry(self, begin_ns: int) -> dict[str, Any]:
        """Return it for a JSON file, in seconds since `begin_ns`."""
        return {
            "stream": self.stream, "happening": self.happening, "from_s": (self.from_ns - begin_ns) / _NS,
            "to_s": (self.to_ns - begin_ns) / _NS, "rows": self.rows, "done": self.done or self.happening.done,
        }  # fmt: skip

    def words(self, begin_ns: int) -> str:
        """Return it as a sentence without the full stop, see `entry`."""
        begin_s, end_s = (self.from_ns - begin_ns) / _NS, (self.to_ns - begin_ns) / _NS
        when = f"from {begin_s:.2f} to {end_s:.2f} s"
        if self.tears or self.happening is Happening.STEP_FORTH:
            when = f"by {abs(begin_s - end_s):.2f} s at {begin_s:.2f} s"
        return f"{self.stream}: {self.happening.words} {when} ({self.rows}); {self.done or self.happening.done}"


def is_dark(image: ImageU8) -> bool:
    """Return whether an image [H, W] shows nothing: it is black, or even but for the noise of its pixels.

    A lens makes neighbours alike, which noise does not; how brightness changes over the image is taken out.
    """
    if image.mean() < _DARK and image.std() < _DARK:
        return True
    rows = image[::_EVERY_PX].astype(np.float32)
    fine = rows[:, _EVERY_PX:] - rows[:, :-_EVERY_PX]
    fine -= fine.mean() if fine.size else 0.0
    alike = float(np.sum(fine[:, 1:] * fine[:, :-1]))
    return alike <= max(_NOISY, _BY_NOISE / max(fine.size, 1) ** 0.5) * float(np.sum(fine * fine))


class Repeats:
    """Finds images, of colour or depth, that are the one before again, to the last bit: one pixel in 8, each way.

    Attributes:
        row: how many in a row, up to now, equal the one before.
        changed: share of the pixels that differ, in the newest that did not.
    """

    def __init__(self) -> None:
        """Begin before the first image."""
        self.row, self.changed = 0, 0.0
        self._last: ImageU8 | ImageF32 | None = None

    def take(self, image: ImageU8 | ImageF32) -> bool:
        """Take the next image [H, W]; return whether it is the one before again."""
        small, last = image[::_EVERY_PX, ::_EVERY_PX].copy(), self._last
        self._last = small
        if last is None or last.shape != small.shape:
            return False
        changed = float(np.mean((small != last) & ~(np.isnan(small) & np.isnan(last))))
        self.row, self.changed = (0, changed) if changed else (self.row + 1, self.changed)
        return not changed


def _is_alone(step: StreamEvent, events: Iterable[StreamEvent]) -> bool:
    """Whether the clock of IMU or camera stepped, and the other's did not."""
    others = {"imu0", "cam0"} - {step.stream}
    near = (e for e in events if e.tears and e.stream in others)
    return len(others) == 1 and not any(abs(e.from_ns - step.from_ns) <= _TOGETHER_NS for e in near)


def together(events: Iterable[StreamEvent], recorded: Collection[StreamJudge]) -> list[StreamEvent]:
    """Return events of streams of one clock, of their stamps as they are recorded where they are, in the order of time.

    A hole in a stream that ends later than another one by as much is a step of its clock: until then they look alike.
    """
    kept = (Happening.HOLE, Happening.STUCK)  # as a run meets them
    known = [event for judge in recorded for event in judge.events if event.happening not in kept]
    begun = {(event.stream, event.from_ns) for event in known}
    streams = [judge.stream for judge in recorded]
    for event in events:
        is_known = event.happening is Happening.HOLE and (event.stream, event.from_ns) in begun
        if not is_known and not (event.stream in streams and event.happening in _OF_STAMPS):
            known.append(event)
    spans = {judge.stream: judge.span for judge in recorded if judge.span is not None}
    for k, hole in enumerate(known):
        if hole.happening is Happening.HOLE and hole.stream in spans:
            late_ns = spans[hole.stream][1] - (hole.to_ns - hole.from_ns)
            ends_ns = [
                end for name, (begin, end) in spans.items() if name != hole.stream and begin < hole.from_ns < end
            ]
            if any(abs(late_ns - end) <= _OFF * (hole.to_ns - hole.from_ns) for end in ends_ns):
                known[k] = replace(hole, happening=Happening.STEP_FORTH)
        elif hole.happening is Happening.STEP_BACK and {"imu0", "cam0"} <= spans.keys() and _is_alone(hole, known):
            known[k] = replace(hole, done=_ALONE[hole.stream])
    return sorted(dict.fromkeys(known), key=lambda event: event.from_ns)


class StreamJudge:
    """Judges the rows of one stream as they come.

    Attributes:
        stream: its name.
        refused: rows that are no measurement of a time of their own, by what happened.
    """

    def __init__(
        self, stream: str, axes: Sequence[Axis] = (), hole_s: float = 0.0, rate_hz: float = 0.0, recorded: bool = False
    ) -> None:
        """Begin with no row; a stream that is `recorded` may be several logs in one.

        `axes` are the numbers of a row, `rate_hz` is the stated rate, holes below `hole_s` are none.
        """
        kinds = (Happening.UNUSABLE, Happening.DUPLICATE, Happening.LATE, Happening.STUCK, Happening.SPIKE)
        self.refused: dict[str, int] = dict.fromkeys(map(str, kinds), 0)
        self.stream = stream
        self._newest_ns: int | None = None
        self._first: list[tuple[int, Sequence[float]]] = []  # rows with their times, that begin a loop again
        self._is_refused = False  # what came since then, so that a hole behind it has a name already
        self._behind: list[tuple[int, Sequence[float]]] = []  # rows behind the newest, as far as they rise
        self._step = Happening.STEP_BACK  # what they are, when they are many
        self._rows, self._axes = Run(), AxisWatch(axes)
        self._of_axes: dict[str, list[StreamEvent]] = {}  # what happened to one alone, by its name
        self._taken: Sequence[float] = ()  # the newest row that was
        self._leapt: tuple[int, Sequence[float]] | None = None  # the one after it, until the next shows why
        self._events: dict[Happening, list[StreamEvent]] = {}
        self._pace = _Pace(self, round(hole_s * _NS), rate_hz, recorded)
        self._sharp: deque[float] = deque(maxlen=_SHARP_OF)  # of the newest images, blurred ones left out
        self._blur = 0, 0, 0  # since when images are, how many, and how many of them were noted

    @property
    def events(self) -> list[StreamEvent]:
        """What happened so far, in the order of time."""
        known = self._events
        if (pause := self._pace.pending) is not None:
            known = known | {pause[0]: _joined(known.get(pause[0], []), StreamEvent(self.stream, *pause))}
        all_known = (e for some in (*known.values(), *self._of_axes.values()) for e in some)
        shown = (e for e in all_known if e.happening is not Happening.MOVING or e.rows >= _FEWEST)
        return sorted(shown, key=lambda e: (e.from_ns, e.happening))

    @property
    def steps_ns(self) -> list[int]:
        """The newest times before events that tear; cheap where there are none."""
        pending = self._pace.pending
        last = [pending[1]] if pending is not None and pending[0] in _TEARING else []
        return [event.from_ns for kind in _TEARING for event in self._events.get(kind, ())] + last

    @property
    def usual_ns(self) -> int:
        """The usual time between two rows; 0 before there are enough."""
        return self._pace.usual_ns

    @property
    def span(self) -> tuple[int, int] | None:
        """The times of the first row and of the newest one; None before the first."""
        return None if self._newest_ns is None else (self._first[0][0], self._newest_ns)

    def takes(self, t_ns: int, row: Sequence[float] = ()) -> bool:
        """Take a row as it comes; return whether it is a measurement of a time of its own."""
        newest = self._newest_ns
        if not self._axes.are_possible(row):
            return self._refuse(Happening.UNUSABLE, t_ns)
        if newest is not None and t_ns <= newest:
            if t_ns < newest or self._behind:
                return self._is_behind(t_ns, row, newest)
            if row != self._rows.last:
                self._pace.shared += 1
                self._pace.hurried += self._pace.pause is not None
            return self._refuse(Happening.DUPLICATE, t_ns)
        if self._behind:
            self._let_late()
        if row and not self._is_alive(t_ns, row):
            return False
        if len(self._first) < _STEP_ROWS:
            self._first.append((t_ns, row))
        self._taken = row
        self._newest_ns, is_after_refused, self._is_refused = t_ns, self._is_refused, False
        if newest is not None and not is_after_refused:
            self._pace.see(newest, t_ns)
        return True

    def look(self, image: ImageU8, from_ns: int, to_ns: int) -> bool:
        """Look at an image [H, W], which stands for those of a stretch of time; return whether it shows nothing."""
        if is_dark(image):
            self.note(Happening.DARK, from_ns, to_ns)
            return True
        sharp = _sharpness(image)
        if len(self._sharp) < _STEP_ROWS or sharp > _BLURRED * float(np.median(self._sharp)):
            self._sharp.append(sharp)
            self._blur = 0, 0, 0
            return False
        since_ns, images, noted = self._blur if self._blur[1] else (from_ns, 0, 0)
        if images + 1 >= _STEP_ROWS and to_ns - since_ns >= _NS:
            self.note(Happening.BLURRED, since_ns, to_ns, images + 1 - noted)
            noted = images + 1
        self._blur = since_ns, images + 1, noted
        return False

    def correct(self, t_ns: int) -> None:
        """Take the stamp of the newest row for a wrong one, which had leapt ahead: a row at `t_ns` is in its place."""
        self._newest_ns = t_ns
        self._pace.pause, self._pace.hurried = None, 0

    def note(self, happening: Happening, from_ns: int, to_ns: int, rows: int = 1) -> None:
        """Take note of what happened; the same again soon is one event with it, but for another step of a clock."""
        if happening is Happening.BURST and (holes := self._events.get(Happening.HOLE)):
            self._events[Happening.HOLE] = [hole for hole in holes if hole.from_ns < from_ns]  # it explains the others
        event = StreamEvent(self.stream, happening, from_ns, to_ns, rows)
        self._events[happening] = _joined(self._events.get(happening, []), event)

    def _refuse(self, happening: Happening, t_ns: int, from_ns: int | None = None) -> bool:
        self.refused[happening] += 1
        self._is_refused = self._is_refused or happening in (Happening.STUCK, Happening.UNUSABLE)
        self.note(happening, t_ns if from_ns is None else from_ns, t_ns)
        return False

    def _is_alive(self, t_ns: int, row: Sequence[float]) -> bool:
        """Refuse a row that repeats others, as a whole or in one axis, or that leaps where the next does not follow."""
        stuck_axes = self._axes.stuck(t_ns, row)
        if self._rows.take(t_ns, row):
            return self._refuse(Happening.STUCK, t_ns, self._rows.since_ns)
        for name, since_ns in stuck_axes:
            event = StreamEvent(f"{self.stream} {name}", Happening.STUCK, since_ns, t_ns, 1)
            self._of_axes[name] = _joined(self._of_axes.get(name, []), event)
        leapt, is_soon = self._leapt, t_ns - (self._newest_ns or 0) <= _HOLE * self.usual_ns
        leaps = is_soon and self._axes.leaps(row, self._taken)
        is_far = leaps and (leapt is None or self._axes.leaps(row, leapt[1]))  # two that agree are a motion
        if leapt is not None and leaps == is_far:
            self.note(Happening.SPIKE, leapt[0], leapt[0])
        self._leapt = (t_ns, row) if is_far else None
        if stuck_axes or is_far:
            self.refused[Happening.STUCK if stuck_axes else Happening.SPIKE] += 1
            self._is_refused = True
        return not (stuck_axes or is_far)

    def _is_behind(self, t_ns: int, row: Sequence[float], newest_ns: int) -> bool:
        """Refuse a row behind the newest; several that go on among each other say that the clock stepped back."""
        self.refused[Happening.LATE] += 1
        if self._behind and t_ns <= self._behind[-1][0]:
            self._let_late()
        self._behind.append((t_ns, row))
        if len(self._behind) == _STEP_ROWS:
            self._step = self._kind_of_step()
            self.note(self._step, newest_ns, self._behind[0][0], _STEP_ROWS)
        elif len(self._behind) > _STEP_ROWS:
            steps = self._events[self._step]
            steps[-1] = replace(steps[-1], rows=steps[-1].rows + 1)
            del self._behind[0]  # bounds it; the first one stands in the event
        return False

    def _kind_of_step(self) -> Happening:
        """Return whether rows behind the newest are a loop, another log, or a clock that was set back."""
        if self._behind == self._first:
            return Happening.LOOPED
        early_ns = self._first[0][0] - self._behind[0][0]
        return Happening.APPENDED if early_ns == 0 or early_ns > _UNRELATED_NS else Happening.STEP_BACK

    def _let_late(self) -> None:
        """Take rows behind the newest for late ones, unless the clock stepped: they did not go on."""
        if len(self._behind) < _STEP_ROWS:
            for t_ns, _ in self._behind:
                self.note(Happening.LATE, t_ns, t_ns)
        self._behind.clear()


def _joined(known: list[StreamEvent], event: StreamEvent) -> list[StreamEvent]:
    """Return events of one kind with the next one, which may be one with the last."""
    is_new = not known or event.tears or event.from_ns - known[-1].to_ns > _TOGETHER_NS
    if is_new and len(known) < _MOST_EVENTS:
        return [*known, event]
    to_ns = max(event.to_ns, known[-1].to_ns)
    return [*known[:-1], replace(known[-1], to_ns=to_ns, rows=known[-1].rows + event.rows)]


class _Pace:
    """Owns the newest intervals of a stream: which one is usual, and what the others say."""

    def __init__(self, judge: StreamJudge, hole_ns: int, rate_hz: float, recorded: bool) -> None:
        self.usual_ns = 0  # before there are enough
        self.pause: tuple[int, int, int] | None = None  # times around it and of the newest row, until it is named ...
        self.hurried = 0  # ... by the rows close behind it
        self.shared = 0  # rows since the last look that had the stamp of the one before, and other numbers
        self._judge, self._hole_ns, self._rate_hz, self._recorded = judge, hole_ns, rate_hz, recorded
        self._steps_ns: list[int] = []  # since the last look ...
        self._before_ns: list[int] = []  # ... and up to it
        self._looked_ns = 0
        self._since: dict[Happening, tuple[int, int]] = {}  # what the last windows showed, and in how many of them

    @property
    def pending(self) -> tuple[Happening, int, int, int] | None:
        """What the pause is by the rows so far: a burst, a hole or another log; None: nothing."""
        if self.pause is None or self._judge.span is None:
            return None
        from_ns, to_ns, newest_ns = self.pause
        missing = round((to_ns - from_ns) / self.usual_ns) - 1
        if self.hurried + 1 >= max(_FEWEST, missing / 2):
            return Happening.BURST, from_ns, newest_ns, self.hurried + 1
        is_log = self._recorded and to_ns - from_ns > max(_UNRELATED_NS, from_ns - self._judge.span[0])
        kind = Happening.APPENDED if is_log else Happening.HOLE
        return (kind, from_ns, to_ns, missing) if to_ns - from_ns > self._hole_ns else None

    def see(self, before_ns: int, t_ns: int) -> None:
        """Take the times of two neighbours."""
        step_ns = t_ns - before_ns
        if self.pause is not None:
            from_ns, to_ns, _ = self.pause
            if step_ns < _NEARLY_TOGETHER * self.usual_ns and (self.hurried + 1) * self.usual_ns < to_ns - from_ns:
                self.hurried += 1
                self.pause = from_ns, to_ns, t_ns
                return
            happened, self.pause, self.hurried = self.pending, None, 0
            if happened is not None:
                self._judge.note(*happened)
            if happened is None or happened[0] is not Happening.BURST:
                self._count(to_ns - from_ns, to_ns)
        if self.usual_ns and step_ns > _HOLE * self.usual_ns:
            self.pause = before_ns, t_ns, t_ns
        else:
            self._count(step_ns, t_ns)

    def _count(self, step_ns: int, t_ns: int) -> None:
        if not self._steps_ns and not self._before_ns:
            self._looked_ns = t_ns - step_ns
        self._steps_ns.append(step_ns)
        count = len(self._steps_ns)
        if count == _MEDIAN_OF or (count in _AT_FIRST and not self._before_ns):
            ordered = sorted(self._steps_ns)
            self.usual_ns = ordered[count // 2]
            if count == _MEDIAN_OF:
                self._look(ordered, t_ns)
                self._before_ns, self._steps_ns, self.shared, self._looked_ns = self._steps_ns, [], 0, t_ns

    def _look(self, ordered: list[int], t_ns: int) -> None:
        """Look at a window of intervals; what two of them in a row show is noted."""
        found, pace_ns, all_ns = [], float(self.usual_ns), sum(ordered)
        if _FEWEST * self.shared > _MEDIAN_OF or self._is_sawtooth(ordered[0], ordered[-1]):
            found, pace_ns = [Happening.SAWTOOTH], all_ns / (_MEDIAN_OF + self.shared)
        elif not self._before_ns and ordered[-_FEWEST] > _HOLE * pace_ns and all_ns > 2 * _MEDIAN_OF * pace_ns:
            self.usual_ns = all_ns // _MEDIAN_OF  # rows came together from the beginning
            self._judge.note(Happening.BURST, self._looked_ns, t_ns, _MEDIAN_OF)
        if self._rate_hz and abs(pace_ns * self._rate_hz / _NS - 1.0) > _OFF:
            found.append(Happening.WRONG_RATE)
        since, self._since = self._since, {}
        for kind in found:
            these_ns = (self.usual_ns,) if kind is Happening.WRONG_RATE else (ordered[0], ordered[-1])
            from_ns, windows = since.get(kind) or (self._looked_ns - self._alike_ns(these_ns), 0)
            self._since[kind] = from_ns, windows + 1
            if windows:
                self._judge.note(kind, from_ns, t_ns, _MEDIAN_OF * (1 + (windows == 1)))

    def _alike_ns(self, these_ns: Sequence[int]) -> int:
        """Return for how long the window before ended in such intervals."""
        most_ns = _ALIKE * self.usual_ns
        return sum(takewhile(lambda step: min(abs(step - t) for t in these_ns) <= most_ns, self._before_ns[::-1]))

    def _is_sawtooth(self, low_ns: int, high_ns: int) -> bool:
        """Whether intervals have two lengths, and the rarer one comes evenly; missing rows make some twice as long."""
        steps, alike_ns = self._steps_ns, _ALIKE * self.usual_ns
        if high_ns - low_ns < _UNEVEN * self.usual_ns or any(min(s - low_ns, high_ns - s) > alike_ns for s in steps):
            return False
        is_long = [2 * s > low_ns + high_ns for s in steps]
        are_rare = 2 * sum(is_long) < len(steps)
        gaps = [b - a for a, b in pairwise(k for k, long in enumerate(is_long) if long is are_rare)]
        may_miss = are_rare and high_ns + alike_ns > 2 * low_ns
        return len(gaps) >= _FEWEST - 1 and max(gaps) - min(gaps) <= 1 and not may_miss


def _sharpness(image: ImageU8) -> float:
    """Return how much the slope of an image [H, W] changes by two pixels, over the slope, in the sharper direction.

    Contrast does not change it, a Gaussian blur divides it by its width, motion blurs one direction only, and noise,
    which is no sharpness, is less in the mean of four pixels.
    """
    found = []
    for lines in (image, image.T):
        whole = lines[: len(lines) // _EVERY_PX * _EVERY_PX, : lines.shape[1] // 2 * 2]
        pairs = whole[::_EVERY_PX].astype(np.int16) + whole[1::_EVERY_PX]
        slopes = np.diff(pairs[:, ::2] + pairs[:, 1::2], axis=1)
        total = float(np.abs(slopes[:, 1:] + slopes[:, :-1]).sum())
        found.append(float(np.abs(np.diff(slopes, axis=1)).sum()) / max(total, 1.0))
    return max(found)
