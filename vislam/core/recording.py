"""What every source of measurements offers: dataset readers, the simulated world, live sensors."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Protocol, runtime_checkable

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.imu_noise import ImuNoise
from vislam.core.messages import Frame, ImageU8, ImuSample, MagSample
from vislam.core.streams import StreamJudge
from vislam.core.trajectory import Trajectory


class Recording(Protocol):
    """A recording as a stream of values in time order.

    Problems that can be lived with (an unreadable image, a backward stamp, an unpaired stereo frame) are skipped and
    counted in `problems`; what makes the whole recording unusable raises DataError.
    """

    name: str
    rig: Rig
    imu_noise: ImuNoise | None  # None: no IMU
    frame_count: int  # frames that `events` will yield if nothing is damaged
    problems: dict[str, int]  # what was skipped so far, by kind, for the report

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield samples and frames in time order; can be called again for a second pass.

        Frames before `from_ns` may be left out, where reading them takes time.
        """
        ...

    def truth(self) -> Trajectory | None:
        """Return the true body trajectory in a world frame, or None."""
        ...


@runtime_checkable
class Wrapping(Protocol):
    """What plays or changes another recording, and has the same cameras."""

    def wrapped(self) -> Recording:
        """Return the recording within this one."""
        ...


def with_camera(recording: Recording) -> Recording:
    """Return a recording; raises DataError where it has no camera."""
    if recording.rig.is_blind:
        raise DataError(f"{recording.name} holds no camera images, which this works on; give a recording with some")
    return recording


class WrappedRecording:
    """A recording that has what another one has; who wraps one yields its values otherwise."""

    def __init__(self, recording: Recording) -> None:
        """Take over everything but the values."""
        self._recording = recording
        self.name = recording.name
        self.rig = recording.rig
        self.imu_noise: ImuNoise | None = recording.imu_noise
        self.frame_count = recording.frame_count
        self.problems: dict[str, int] = recording.problems

    def wrapped(self) -> Recording:
        """Return the recording within this one."""
        return self._recording

    def truth(self) -> Trajectory | None:
        """Return the recording's truth."""
        return self._recording.truth()


Masker = Callable[[Frame], Sequence[ImageU8 | None]]
"""Gives the masks [H, W] of a frame's images, as a network does; see `Frame.masks`."""


class MaskedRecording(WrappedRecording):
    """A recording whose frames have the masks that a function gives each."""

    def __init__(self, recording: Recording, masker: Masker) -> None:
        """Wrap a recording."""
        super().__init__(recording)
        self._masker = masker

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield the recording's values."""
        for value in self._recording.events(from_ns):
            yield replace(value, masks=tuple(self._masker(value))) if isinstance(value, Frame) else value


@contextmanager
def noted(errors: list[DataError]) -> Iterator[None]:
    """Add to a list what makes a part of a recording unusable, and go on behind the block."""
    try:
        yield
    except DataError as error:
        errors.append(error)


class Problems(dict[str, int]):
    """Counts of what was skipped, by kind; the text of a kind names the place of its first case.

    Attributes:
        judges: of the stamps of streams, by name: what happened in them, and when.
    """

    def __init__(self) -> None:
        super().__init__()
        self._keys: dict[str, str] = {}
        self.judges: dict[str, StreamJudge] = {}

    def count(self, kind: str, where: str = "", times: int = 1) -> None:
        """Add `times` cases of `kind`; `where` is kept for the first case only."""
        if times:
            key = self._keys.setdefault(kind, f"{kind} (first: {where})" if where else kind)
            self[key] = self.get(key, 0) + times

    def restart(self, known: dict[str, int]) -> None:
        """Forget what was counted and start from `known`, the counts that every pass shares."""
        self.clear()
        self._keys.clear()
        self.update(known)
