"""What a run is fed with: a recording with the readings of further sensors, or what of it is left to process."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from vislam.core.errors import DataError
from vislam.core.memory import FrontMemory
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.core.recording import Problems, Recording
from vislam.core.streams import together
from vislam.pipeline.dark import dark
from vislam.pipeline.front_report import FrontReport
from vislam.runs.further_sensors import FurtherReadings
from vislam.sensors import Suite

_INERTIAL_BEFORE_NS = 1_000_000_000  # given again before the keyframe at which a run is resumed


class RunInput:
    """The values of a recording and of the sensors beside it, by their stamps."""

    def __init__(self, recording: Recording, further: FurtherReadings | None, out: Path) -> None:
        """Take a recording and readings beside it, for the run in the folder `out`."""
        self._recording, self._further, self._out = recording, further, out

    @property
    def suite(self) -> Suite | None:
        """The further sensors; None without any."""
        return None if self._further is None else self._further.suite

    @property
    def problems(self) -> dict[str, int]:
        """What could not be read so far, with how often."""
        return {**self._recording.problems, **({} if self._further is None else self._further.problems)}

    def among(self, report: FrontReport) -> FrontReport:
        """Return a report whose events are all there are: also of clipped axes, and of stamps as they are recorded."""
        events = report.events + (() if report.condition is None else report.condition.events)
        problems = self._recording.problems
        judges = problems.judges.values() if isinstance(problems, Problems) else ()
        return replace(report, events=tuple(together(events, judges)))

    def values(self, front: FrontMemory | None) -> Iterator[ImuSample | MagSample | Frame | Reading]:
        """Yield all values, or those from the newest keyframe of an earlier process on, and some samples before it.

        Raises DataError when the recording has no frame there.
        """
        if front is None:
            yield from self._events(None)
            return
        begin_ns = front.camera_t_ns
        samples_ns = min(begin_ns, front.t_ns) - _INERTIAL_BEFORE_NS
        begun, stand_in = False, self._stand_in(begin_ns)
        for value in self._events(begin_ns):
            if value.t_ns < (begin_ns if isinstance(value, Frame) else samples_ns):
                continue
            if stand_in is not None and value.t_ns > begin_ns:
                yield stand_in
                begun, stand_in = True, None
            if isinstance(value, Frame) and not begun:
                if value.t_ns != begin_ns:
                    raise DataError(
                        f"{self._recording.name} has no frame at {begin_ns} ns, where the last keyframe of {self._out} "
                        "is; give the recording that the run began with"
                    )
                begun = True
            yield value

    def _stand_in(self, begin_ns: int) -> Frame | None:
        """Return the dark frame that the last keyframe was, where the camera was silent, see `SilentCamera`."""
        if self._further is None:
            return None
        frames = (value for value in self._recording.events(begin_ns) if isinstance(value, Frame))
        first = next((frame for frame in frames if frame.t_ns >= begin_ns), None)
        return None if first is None or first.t_ns == begin_ns else dark(first, begin_ns)

    def _events(self, from_ns: int | None) -> Iterator[ImuSample | MagSample | Frame | Reading]:
        events = self._recording.events() if from_ns is None else self._recording.events(from_ns)
        return events if self._further is None else self._further.among(events)
