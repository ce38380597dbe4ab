"""What happened in the streams of a recording, for `vislam doctor`: the judge that a run has, over all of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from vislam.core.findings import Finding
from vislam.core.messages import ImageU8, ImuSample
from vislam.core.streams import Happening, StreamJudge
from vislam.datasets.images import ImageList
from vislam.datasets.tables import Row
from vislam.imu import ConditionWatch
from vislam.imu.series import MOST

_DARK = 3.0  # mean grey, and as much of its scatter, below which an image shows nothing
_FEW = 3  # images or rows that are worth no warning
_STEP = "look at the sensor's cable, driver and power; the run goes on by the other sensors"


class StreamChecks:
    """Owns a judge of each stream that was looked at; `findings` has what they found."""

    def __init__(self) -> None:
        """Begin before the first stream."""
        self._judges: list[StreamJudge] = []
        self._condition = ConditionWatch()

    def watched(self, rows: Iterable[Row[list[float]]]) -> Iterator[Row[list[float]]]:
        """Yield inertial rows (rates, forces), all of them, after the judge has seen them."""
        judge = StreamJudge("imu0", MOST)
        self._judges.append(judge)
        for t_ns, values in rows:
            if judge.takes(t_ns, values):
                six = np.array(values)
                self._condition.add(ImuSample(t_ns, six[:3], six[3:]))
            yield t_ns, values

    def compare_files(self, images: ImageList) -> None:
        """Look for files that equal the one before to the byte, which noise makes impossible."""
        judge, last = StreamJudge(images.name), (-1, Path())
        self._judges.append(judge)
        for i, t_ns in enumerate(images.t_ns.tolist()):
            path, size = images.path(i), -1
            with suppress(OSError):  # what is missing is reported elsewhere
                size = path.stat().st_size
                if size == last[0] > 0 and path != last[1] and path.read_bytes() == last[1].read_bytes():
                    judge.note(Happening.REPEATED, t_ns, t_ns)
            last = size, path

    def look_for_dark(self, name: str, seen: Iterable[tuple[int, int, ImageU8]]) -> None:
        """Look for images [H, W] that show nothing; each stands for those from its time to another, in ns."""
        judge = StreamJudge(name)
        self._judges.append(judge)
        for from_ns, to_ns, image in seen:
            if image.mean() < _DARK and image.std() < _DARK:
                judge.note(Happening.DARK, from_ns, to_ns)

    def findings(self, begin_ns: int) -> list[Finding]:
        """Return what happened, with times in seconds since `begin_ns`; holes and stamps are reported elsewhere."""
        found = []
        for judge in self._judges:
            for event in judge.events:
                if event.happening in (Happening.STUCK, Happening.REPEATED, Happening.DARK) and event.rows > _FEW:
                    found.append(Finding("warning", event.words(begin_ns), event.stream, _STEP))
        if clipped := self._condition.condition().saturated_axes:
            what = f"imu0: the range ends where the motion does not: {', '.join(clipped)}"
            found.append(Finding("warning", what, "imu0", "set a wider range in the sensor, or move more gently"))
        return found
