"""Calibration step by step: what a person sees while the sensor is moved, before anything is computed."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from vislam.calibration.options import BoardOptions
from vislam.calibration.outcome import Outcome
from vislam.core.messages import Frame, ImuSample, MagSample

Value = ImuSample | MagSample | Frame


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a step is.

    Attributes:
        share: of what is wanted, 0 to 1.
        can_finish: whether it is worth trying to calibrate with what there is.
        advice: what to do next, one sentence.
        facts: numbers to show, by name.
        cells: how much of each cell of the image was covered, row by row, 0 to 1.
        ways: directions x, y, z on the sphere that are wanted, and whether each was seen.
        jpeg: the newest picture with what was found in it; empty: there is none.
    """

    share: float
    can_finish: bool
    advice: str
    facts: dict[str, str] = field(default_factory=dict)
    cells: list[list[float]] = field(default_factory=list)
    ways: list[tuple[float, float, float, bool]] = field(default_factory=list)
    jpeg: bytes = b""


class Watch(Protocol):
    """One step: it takes what sensors give, reports its progress, and calibrates in the end."""

    has_images: bool  # whether it takes frames, or else samples

    def __init__(self, folder: Path, board: BoardOptions) -> None:
        """Begin; what it keeps of the sensors and what it finds goes into a folder."""
        ...

    def take(self, value: Value) -> None:
        """Take what a sensor gives; what does not concern the step is left."""
        ...

    def progress(self) -> Progress:
        """Return how far it is; may take a tenth of a second."""
        ...

    def calibrate(self) -> Outcome:
        """Write what was kept and calibrate as `vislam calibrate` does; raises DataError saying what lacks."""
        ...
