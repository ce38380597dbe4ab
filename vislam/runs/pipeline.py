"""What a run asks of the pipeline: `Slam` in this process, or processes that do the same."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.core.clock import StageClock
from vislam.core.memory import EdgeReport, Learned, SlamMemory, StartFacts
from vislam.core.messages import Array, GraphUpdate, NavState
from vislam.mapping.mapper import Mapper
from vislam.pipeline.front_report import FrontReport
from vislam.pipeline.steps import Finish


class Pipeline(Protocol):
    """What a run asks of the pipeline beside its steps: `Slam`, or processes that do the same."""

    @property
    def counters(self) -> dict[str, int]:
        """How often the place in the map was lost and found again."""
        ...

    @property
    def clock(self) -> StageClock:
        """Durations of the stages of this process."""
        ...

    @property
    def front(self) -> FrontHalf:
        """The half at the rate of the sensors."""
        ...

    @property
    def back(self) -> BackHalf | None:
        """The half at the rate of keyframes; None before the first."""
        ...

    def resume(self, memory: SlamMemory) -> GraphUpdate:
        """Go on where an earlier run was, before the first value; return all its poses."""
        ...

    def begin_in_map(self, memory: SlamMemory) -> GraphUpdate:
        """Begin in the map of earlier runs, before the first value; return its poses."""
        ...

    def finish(self) -> Finish:
        """Process what still waits and optimise a last time."""
        ...


class FrontHalf(Protocol):
    """What a run asks of the front half, in this process or another."""

    @property
    def start(self) -> StartFacts | None:
        """How gravity was found."""
        ...

    @property
    def learned(self) -> Learned:
        """What was learned so far."""
        ...

    def report(self) -> FrontReport:
        """Return what there is to say of the run."""
        ...


class BackHalf(Protocol):
    """What a run asks of the back end, in this process or another."""

    @property
    def graph(self) -> FinalGraph:
        """The graph."""
        ...

    @property
    def mapper(self) -> Mapper | None:
        """The map; None where it is off."""
        ...

    @property
    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of the rooms."""
        ...


class FinalGraph(Protocol):
    """What a run asks of the graph when it is finished."""

    @property
    def ids(self) -> NDArray[np.int64]:
        """Keyframes [M]."""
        ...

    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4]."""
        ...

    def states(self) -> list[NavState]:
        """Return the states of the keyframes; empty without an IMU."""
        ...

    def own(self, name: str) -> tuple[Array, Array] | None:
        """Return own variables [V] of a further sensor and their sigmas [V]; None where it has none in the graph."""
        ...

    def sensed(self, name: str) -> dict[str, int]:
        """Return what became of the readings of a further sensor, see `PoseGraph.sensed`."""
        ...

    def edge_reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop."""
        ...
