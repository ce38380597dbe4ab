"""What goes from the front and the back process to the map process, and from the front to the back."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vislam.core.memory import EdgeReport, GraphRecord, Learned, StartFacts
from vislam.core.messages import Array, GraphUpdate, NavState
from vislam.imu import ImuNoise
from vislam.pipeline.front_report import FrontReport
from vislam.pipeline.steps import FrontStep
from vislam.trajectory.odometry_keyframe import OdometryKeyframe

Timings = dict[str, dict[str, float]]


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeOut:
    """A keyframe for the back end; the first one brings the noise of the IMU and the first state."""

    odometry: OdometryKeyframe
    noise: ImuNoise | None
    first_state: NavState | None


@dataclass(frozen=True, slots=True, eq=False)
class BackBegun:
    """The back process has taken over an earlier session and reads it no more; the first message after that."""

    update: GraphUpdate  # all poses


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One frame after the front half, with what was published then and what was known."""

    step: FrontStep
    T_map_odom: Array | None  # [4, 4]; None: not in the map
    start: StartFacts | None
    learned: Learned


@dataclass(frozen=True, slots=True, eq=False)
class FrontEnded:
    """The last word of the front process."""

    report: FrontReport
    start: StartFacts | None
    learned: Learned
    timings: Timings


@dataclass(frozen=True, slots=True, eq=False)
class EndedGraph:
    """The graph after it was finished, as plain values; see `vislam.runs.FinalGraph`."""

    ids: NDArray[np.int64]
    T_map_body: Array  # [M, 4, 4]
    nav_states: list[NavState]
    reports: list[EdgeReport]
    own_variables: dict[str, tuple[Array, Array]] = field(default_factory=dict)  # of further sensors, with sigmas
    readings: dict[str, dict[str, int]] = field(default_factory=dict)  # of further sensors: what became of them

    def own(self, name: str) -> tuple[Array, Array] | None:
        """Return own variables of a further sensor and their sigmas; None where it has none in the graph."""
        return self.own_variables.get(name)

    def sensed(self, name: str) -> dict[str, int]:
        """Return what became of the readings of a further sensor; empty where that is unknown."""
        return self.readings.get(name, {})

    def poses(self) -> Array:
        """Return T_map_body [M, 4, 4]."""
        return self.T_map_body

    def states(self) -> list[NavState]:
        """Return the states of the keyframes."""
        return self.nav_states

    def edge_reports(self) -> list[EdgeReport]:
        """Return what became of every offered loop."""
        return self.reports


@dataclass(frozen=True, slots=True, eq=False)
class BackEnded:
    """The last word of the back process."""

    graph: EndedGraph | None  # None: not one keyframe came
    update: GraphUpdate | None
    record: GraphRecord | None
    counters: dict[str, dict[str, int]]
    timings: Timings
