"""What a cart can be asked for: to stand somewhere, to drive as it is steered, to believe where it is."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Goal:
    """Where the base is to stand, in the map frame."""

    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Steer:
    """Speed and turn rate as of a `cmd_vel`."""

    speed_m_s: float
    rate_rad_s: float


@dataclass(frozen=True, slots=True)
class Place:
    """Where the base is in the map, by an `initialpose`: x, y, z in m, and its heading."""

    position_m: tuple[float, float, float]
    yaw_rad: float
