"""What happened in the streams of a recording, for `vislam doctor`: the judge that a run has, over all of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from filecmp import cmp
from itertools import pairwise

import numpy as np

from vislam.core.findings import Finding
from vislam.core.messages import ImageU8, ImuSample
from vislam.core.recording import Problems
from vislam.core.streams import Happening, StreamJudge, together
from vislam.datasets.images import ImageList
from vislam.datasets.tables import Row
from vislam.imu import ConditionWatch
from vislam.imu.series import AXES

_FEW = 3  # images or rows that are worth no warning
_NAMED = 3  # events of a kind in a stream, the longest
_COUNTED = (Happening.DUPLICATE, Happening.LATE, Happening.HOLE)  # with the problems of the tables
_STEP = "look at the sensor's cable, driver and power; the run goes on by the other sensors"
_STEPS = {
    Happening.CLIPPED: "set a wider range in the sensor, or move more gently",
    Happening.WRONG_RATE: "correct rate_hz of its sensor file",
    Happening.BLURRED: "look at the lens and its focus",
}


class StreamChecks:
    """Owns a judge of each stream that was looked at; `findings` has what they found."""

    def __init__(self, problems: Problems) -> None:
        """Take the judges of the stamps of streams."""
        self._problems = problems
        self._judges = dict(problems.judges)
        self._condition = ConditionWatch()

    def watched(self, rows: Iterable[Row[list[float]]]) -> Iterator[Row[list[float]]]:
        """Yield inertial rows (rates, forces), all of them, after the judge has seen them."""
        judge = self._judges["imu0"] = StreamJudge("imu0", AXES)
        for t_ns, values in rows:
            if judge.takes(t_ns, values):
                six = np.array(values)
                self._condition.add(ImuSample(t_ns, six[:3], six[3:]))
            yield t_ns, values

    def compare(self, images: ImageList, repeats: Iterable[bool]) -> None:
        """Take for each image but the first whether it equals the one before, which noise makes impossible."""
        judge = self._judge(images.name)
        for t_ns, is_same in zip(images.t_ns.tolist()[1:], repeats, strict=False):
            if is_same:
                judge.note(Happening.REPEATED, t_ns, t_ns)

    def look_at(self, name: str, image: ImageU8, from_ns: int, to_ns: int) -> None:
        """Look at an image [H, W], which stands for those of a stretch of time."""
        self._judge(name).look(image, from_ns, to_ns)

    def findings(self, begin_ns: int) -> list[Finding]:
        """Return what happened, with times in seconds since `begin_ns`; holes and stamps are reported elsewhere."""
        found, named = [], dict[tuple[str, str], int]()
        events = [event for judge in self._judges.values() for event in judge.events]
        events += self._condition.condition().events
        for event in sorted(together(events, self._problems.judges.values()), key=lambda event: -event.rows):
            kind = event.stream, event.happening
            named[kind] = named.get(kind, 0) + 1
            if event.happening not in _COUNTED and event.rows > _FEW and named[kind] <= _NAMED:
                found.append(
                    Finding("warning", event.words(begin_ns), event.stream, _STEPS.get(event.happening, _STEP))
                )
        return found

    def _judge(self, name: str) -> StreamJudge:
        return self._judges.setdefault(name, StreamJudge(name))


def repeats(images: ImageList) -> Iterator[bool]:
    """Yield for each file of a list but the first whether it equals the one before to the byte."""
    for before, path in pairwise(map(images.path, range(len(images.files)))):
        try:
            yield path != before and path.stat().st_size > 0 and cmp(before, path, shallow=False)
        except OSError:  # what is missing is reported elsewhere
            yield False
