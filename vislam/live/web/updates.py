"""Messages of a run's processes to the one that serves its page. Plain values; nothing here loads a heavy package."""

from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array


@dataclass(frozen=True, slots=True)
class WebEnds:
    """The ends of the page's wires that go to the processes of a run."""

    frames: Connection
    map: Connection  # both ways: the page asks the map process to save
    back: Connection  # the page's user takes out loops


@dataclass(frozen=True, slots=True)
class Status:
    """How the run is, as JSON has it."""

    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """A frame as vision saw it."""

    t_ns: int
    jpeg: bytes  # empty: there was no picture
    tracking: str
    inliers: int
    reason: str


@dataclass(frozen=True, slots=True)
class StepPicture:
    """What a calibration step sees."""

    jpeg: bytes


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeCloud:
    """Points of one keyframe in its body frame, in an order of which every beginning is an even sample."""

    step_m: float
    xyz: NDArray[np.int16]  # [N, 3] in steps
    rgb: NDArray[np.uint16]  # [N] red 5 bits, green 6, blue 5


@dataclass(frozen=True, slots=True)
class LoopUpdate:
    """A loop candidate, with the newest decision about it: that of the graph, if it was offered to it."""

    from_id: int
    to_id: int
    source: str
    decision: str  # a LoopDecision, or "undone"
    reason: str
    id: int = -1  # of the graph's edge; -1: it was not offered


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """What is new in the map since the last of these."""

    revision: int = 0
    T_map_body: dict[int, Array] = field(default_factory=dict)  # of keyframes that are new or moved
    t_ns: dict[int, int] = field(default_factory=dict)  # of keyframes that are new
    clouds: dict[int, KeyframeCloud] = field(default_factory=dict)
    loops: list[LoopUpdate] = field(default_factory=list)  # those that are new or decided otherwise
    decided: dict[str, int] = field(default_factory=dict)  # how many candidates of the whole run, by decision
    left_out: int = 0  # clouds that the page was too slow for, so far


@dataclass(frozen=True, slots=True)
class Save:
    """The page asks for what there is of the map, as files in the run folder."""


@dataclass(frozen=True, slots=True)
class Undo:
    """The page's user takes a loop out of the graph."""

    loop_id: int


@dataclass(frozen=True, slots=True)
class Saved:
    """What became of that."""

    text: str
    is_well: bool = True


@dataclass(frozen=True, slots=True)
class Asked:
    """A command of the page for the process that owns the run; values are short text."""

    do: str
    values: dict[str, str] = field(default_factory=dict)
