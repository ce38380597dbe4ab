"""What happened in the streams of a recording, for `vislam doctor`: the judge that a run has, over all of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from filecmp import cmp

import numpy as np

from vislam.core.findings import Finding
from vislam.core.messages import ImageU8, ImuSample
from vislam.core.streams import Happening, StreamJudge, is_dark
from vislam.datasets.images import ImageList
from vislam.datasets.tables import Row
from vislam.imu import ConditionWatch
from vislam.imu.series import MOST

_FEW = 3  # images or rows that are worth no warning
_STEP = "look at the sensor's cable, driver and power; the run goes on by the other sensors"


class StreamChecks:
    """Owns a judge of each stream that was looked at; `findings` has what they found."""

    def __init__(self) -> None:
        """Begin before the first stream."""
        self._judges: dict[str, StreamJudge] = {}
        self._condition = ConditionWatch()

    def watched(self, rows: Iterable[Row[list[float]]]) -> Iterator[Row[list[float]]]:
        """Yield inertial rows (rates, forces), all of them, after the judge has seen them."""
        judge = self._judges["imu0"] = StreamJudge("imu0", MOST)
        for t_ns, values in rows:
            if judge.takes(t_ns, values):
                six = np.array(values)
                self._condition.add(ImuSample(t_ns, six[:3], six[3:]))
            yield t_ns, values

    def compare_files(self, images: ImageList) -> None:
        """Look for files that equal the one before to the byte, which noise makes impossible."""
        judge = self._judge(images.name)
        for i, t_ns in enumerate(images.t_ns.tolist()[1:]):
            before, path = images.path(i), images.path(i + 1)
            with suppress(OSError):  # what is missing is reported elsewhere
                if path != before and path.stat().st_size > 0 and cmp(before, path, shallow=False):
                    judge.note(Happening.REPEATED, t_ns, t_ns)

    def look_at(self, name: str, image: ImageU8, from_ns: int, to_ns: int) -> None:
        """Look whether an image [H, W], which stands for those of a stretch of time, shows nothing."""
        if is_dark(image):
            self._judge(name).note(Happening.DARK, from_ns, to_ns)

    def findings(self, begin_ns: int) -> list[Finding]:
        """Return what happened, with times in seconds since `begin_ns`; holes and stamps are reported elsewhere."""
        found = []
        for judge in self._judges.values():
            for event in judge.events:
                if event.happening in (Happening.STUCK, Happening.REPEATED, Happening.DARK) and event.rows > _FEW:
                    found.append(Finding("warning", event.words(begin_ns), event.stream, _STEP))
        if clipped := self._condition.condition().saturated_axes:
            what = f"imu0: the range ends where the motion does not: {', '.join(clipped)}"
            found.append(Finding("warning", what, "imu0", "set a wider range in the sensor, or move more gently"))
        return found

    def _judge(self, name: str) -> StreamJudge:
        return self._judges.setdefault(name, StreamJudge(name))
