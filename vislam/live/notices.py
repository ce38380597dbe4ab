"""Messages between the processes, beside measurements. Plain values; nothing here loads a heavy package."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, NavState, NoiseScale, VoMeasurement
from vislam.ekf.correction import AppliedReading, Correction
from vislam.hw.health import Health


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Gravity is known: the first state, and the motion seen there."""

    state: NavState
    vo: VoMeasurement


@dataclass(frozen=True, slots=True)
class GaveUp:
    """Gravity was not found in time: vision goes on alone, and nothing corrects a filter any more."""


@dataclass(frozen=True, slots=True, eq=False)
class Rebase:
    """The state that a tight filter has after a frame; too much work for the fast process itself."""

    state: NavState
    is_tracking: bool
    at_rest: bool
    noise: NoiseScale  # of the IMU from now on


@dataclass(frozen=True, slots=True)
class CameraHealth:
    """Counters of the camera, when they change."""

    health: Health


@dataclass(frozen=True, slots=True)
class Doubted:
    """Whether the verdict on the run so far is anything but trusted, when it changes."""

    is_doubtful: bool

    @property
    def health(self) -> Health:
        """DOUBTFUL or nothing."""
        return Health.DOUBTFUL if self.is_doubtful else Health(0)


@dataclass(frozen=True, slots=True, eq=False)
class MapMoved:
    """Where `odom` is in `map` since a revision of the graph."""

    revision: int
    T_map_odom: Array  # [4, 4]
    is_in_map: bool = True  # its submap is joined with the map; else T_map_odom is a guess


@dataclass(frozen=True, slots=True, eq=False)
class MapCells:
    """The drive grid of the map as it is now, see `DriveGrid`; row 0 is at the lowest y."""

    states: NDArray[np.int8]  # [rows, columns] above 0: the cart cannot drive there; 0 free, -1 not seen
    resolution_m: float
    origin_m: tuple[float, float]  # x, y of the lower-left corner, in the map frame
    floor_m: float
    body_m: tuple[float, float]  # length and width of the cart


ToFast = Start | GaveUp | Correction | AppliedReading | Rebase | CameraHealth | Doubted | MapMoved
