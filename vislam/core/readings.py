"""Readings of sensors other than IMU and camera, and where between two keyframes they were taken."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from vislam.core.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What a sensor said at one time; what its numbers mean is defined by the sensor (`vislam.sensors.Sensor`)."""

    sensor: str  # its name in the configuration
    t_ns: int  # by the IMU's clock
    values: Array  # [C] as `Sensor.columns` has them
    covariance: Array | None = None  # [m, m] of the residual as the device stated it; None: what the sensor knows


class OwnStart(NamedTuple):
    """First values of a sensor's own variables, found by comparing its first readings with the path."""

    sensor: str
    values: Array  # [V]
    sigmas: Array  # [V]


class OwnNow(NamedTuple):
    """A sensor's own variables as a filter has them at a keyframe."""

    values: Array  # [V]
    sigmas: Array  # [V]


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """Where between two keyframes a reading was taken, as inertial data alone give it: free of both poses.

    Motions are given in the axes of the body at the earlier keyframe, without gravity, as `imu.Preintegrated` has them.
    Without an IMU they are those of a body that keeps its speed: no turn, and nothing gained.
    """

    since_s: float  # from the earlier keyframe to the reading
    length_s: float  # from the earlier keyframe to the later
    dR: Array  # [3, 3] to the reading
    dv_m_s: Array  # [3]
    dp_m: Array  # [3]
    dR_all: Array  # [3, 3] to the later keyframe
    dp_all_m: Array  # [3]
    gravity_m_s2: float  # 0 without an IMU
    rate_rad_s: Array  # [3] of the body at the reading, bias taken off
    gyro_bias_rad_s: Array  # [3] that was taken off
    accel_bias_m_s2: Array  # [3]
    accel_sigma_m_s2: float  # of a constant error of the force between the keyframes


@dataclass(frozen=True, slots=True, eq=False)
class PlacedReading:
    """A reading on its way to the graph."""

    reading: Reading
    station: Station


# What a further sensor said between two keyframes, by both poses [4, 4]: residual [M], whitened and weighted, and its
# Jacobians [M, 6] and [M, 6] by both (rotation, translation, body side) and [M, V] by own variables over their sigmas
Motion = Callable[[Array, Array], tuple[Array, Array, Array, Array]]


@dataclass(frozen=True, slots=True, eq=False)
class MotionReadings:
    """What one sensor said of the motion between two keyframes that vision does not tie together."""

    sensor: str
    placed: tuple[PlacedReading, ...]
    own: OwnNow
