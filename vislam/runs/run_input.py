"""What a run is fed with: a recording with the readings of further sensors, or what of it is left to process."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from vislam.core.errors import DataError
from vislam.core.memory import FrontMemory
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.readings import Reading
from vislam.core.recording import Problems, Recording
from vislam.core.streams import Happening, StreamJudge, together
from vislam.pipeline.dark import dark
from vislam.pipeline.front_report import FrontReport
from vislam.runs.further_sensors import FurtherReadings
from vislam.sensors import Suite

_AT_ONCE_NS = 500_000_000  # steps so near each other are one, of all clocks
_APART = "inertial sample after a step of its clock or of the camera's alone"
_INERTIAL_BEFORE_NS = 1_000_000_000  # given again before the keyframe at which a run is resumed


class RunInput:
    """The values of a recording and of the sensors beside it, by their stamps."""

    def __init__(self, recording: Recording, further: FurtherReadings | None, out: Path) -> None:
        """Take a recording and readings beside it, for the run in the folder `out`."""
        self._recording, self._further, self._out = recording, further, out
        self._apart = 0  # samples that were left out, see `_are_clocks_apart`

    @property
    def suite(self) -> Suite | None:
        """The further sensors; None without any."""
        return None if self._further is None else self._further.suite

    @property
    def problems(self) -> dict[str, int]:
        """What could not be read so far, with how often."""
        further = {} if self._further is None else self._further.problems
        return {**self._recording.problems, **further, **({_APART: self._apart} if self._apart else {})}

    def among(self, report: FrontReport) -> FrontReport:
        """Return a report whose events are all there are: also of clipped axes, and of stamps as they are recorded."""
        events = report.events + (() if report.condition is None else report.condition.events)
        return replace(report, events=tuple(together(events, self._judges)))

    @property
    def _judges(self) -> list[StreamJudge]:
        problems = self._recording.problems
        return list(problems.judges.values()) if isinstance(problems, Problems) else []

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
        if self._recording.rig.is_blind:
            return Frame(begin_ns, 0, ())
        if self._further is None:
            return None
        frames = (value for value in self._recording.events(begin_ns) if isinstance(value, Frame))
        first = next((frame for frame in frames if frame.t_ns >= begin_ns), None)
        return None if first is None or first.t_ns == begin_ns else dark(first, begin_ns)

    def _events(self, from_ns: int | None) -> Iterator[ImuSample | MagSample | Frame | Reading]:
        events = self._recording.events() if from_ns is None else self._recording.events(from_ns)
        fitting = (value for value in events if not (isinstance(value, ImuSample) and self._are_clocks_apart(value)))
        return fitting if self._further is None else self._further.among(fitting)

    def _are_clocks_apart(self, sample: ImuSample) -> bool:
        """Whether the IMU's clock or the camera's had stepped alone: which of their times are the same is not known."""
        steps_ns: dict[str, list[int]] = {"imu0": [], "cam0": []}
        for judge in self._judges:
            if judge.refused[Happening.LATE] and judge.stream in steps_ns:
                steps_ns[judge.stream] += judge.steps_ns
        for one, other in (("imu0", "cam0"), ("cam0", "imu0")):
            for at_ns in steps_ns[one]:
                is_alone = all(abs(at_ns - t_ns) > _AT_ONCE_NS for t_ns in steps_ns[other])
                if is_alone and sample.t_ns > at_ns + _AT_ONCE_NS * (one == "cam0"):
                    self._apart += 1
                    return True
        return False
