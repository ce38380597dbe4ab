"""What the processes tell each other, beside measurements. Plain values; nothing here loads a heavy package."""

from __future__ import annotations

from dataclasses import dataclass

from vislam.ekf.correction import Correction
from vislam.hw.health import Health
from vislam.imu import ImuNoise
from vislam.messages import Array, NavState, VoMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Gravity is known: the first state, the motion seen there, and the noise model that fits the samples."""

    state: NavState
    vo: VoMeasurement
    noise: ImuNoise


@dataclass(frozen=True, slots=True, eq=False)
class Rebase:
    """The state that a tight filter has after a frame; too much work for the fast process itself."""

    state: NavState
    is_tracking: bool
    at_rest: bool


@dataclass(frozen=True, slots=True)
class CameraHealth:
    """What the camera says of itself, when it changes."""

    health: Health


@dataclass(frozen=True, slots=True, eq=False)
class MapMoved:
    """Where `odom` is in `map` since a revision of the graph."""

    revision: int
    T_map_odom: Array  # [4, 4]


ToFast = Start | Correction | Rebase | CameraHealth | MapMoved
