"""Speed and turn rate along a path, and onto a place and heading: pure pursuit, with what the cart may do at most."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.angles import wrapped
from vislam.core.messages import Array

_AHEAD_M = 0.45  # of the cart is the point that it steers for
_BEND_RAD_S = 0.5  # of turn in a bend: it slows down for more
_TURN_RAD, _TURNED_RAD = 1.0, 0.15  # off its way by more, it turns on the spot, until it is off by less
_TURN_GAIN_HZ = 1.8
_SPACING_M = 0.04  # of the places that a route is followed by
_WINDOW = 20, 80  # places back and ahead in which the nearest is looked for
_NEAR_M = 0.012  # of the goal counts as there while it is driven to ...
_BACK_M = 0.25  # ... and so near one that lies behind is reached backwards
_APPROACH_HZ = 0.9
_MIN_M = 1e-3


@dataclass(frozen=True, slots=True)
class Limits:
    """What a follower asks of the wheels at most."""

    speed_m_s: float = 0.6
    rate_rad_s: float = 0.8
    accel_m_s2: float = 0.4  # by which it brakes
    angular_accel_rad_s2: float = 0.8  # by which a turn on the spot ends


class PathFollower:
    """Pure pursuit of a polyline, with a speed that bends and the end allow (Coulter, CMU-RI-TR-92-01)."""

    def __init__(self, xy_m: Array, limits: Limits | None = None) -> None:
        """Take a dense path [N, 2]."""
        self.xy_m = xy_m
        self._limits = Limits() if limits is None else limits
        self._arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
        self._at = 0
        self._turns = False

    @classmethod
    def of_corners(cls, corners_m: Array, limits: Limits) -> PathFollower:
        """Return one that follows straight lines between corners [N, 2]."""
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners_m, axis=0), axis=1))])
        places = np.linspace(0.0, arc[-1], max(2, math.ceil(arc[-1] / _SPACING_M) + 1))
        return cls(np.column_stack([np.interp(places, arc, column) for column in corners_m.T]), limits)

    @property
    def length_m(self) -> float:
        """Of the path."""
        return float(self._arc[-1])

    @property
    def left(self) -> Array:
        """The path [N, 2] from the place that was nearest to the newest pose on."""
        return self.xy_m[self._at :]

    def error_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a place from the path around where the follower is."""
        return float(np.linalg.norm(self._near(x_m, y_m)[1], axis=1).min())

    def command(self, x_m: float, y_m: float, yaw_rad: float, free_m: float = math.inf) -> tuple[float, float, bool]:
        """Return speed, rate and whether the end is reached, at a pose; it has to stop `free_m` along the path."""
        window, offsets = self._near(x_m, y_m)
        self._at = int(window[int(np.argmin(np.linalg.norm(offsets, axis=1)))])
        left_m = float(self._arc[-1] - self._arc[self._at])
        if left_m < 0.05:
            return 0.0, 0.0, True
        goal = self._goal()
        dx, dy = goal[0] - x_m, goal[1] - y_m
        bearing = wrapped(math.atan2(dy, dx) - yaw_rad)
        self._turns = abs(bearing) > (_TURNED_RAD if self._turns else _TURN_RAD)
        if self._turns:
            return 0.0, turn(bearing, self._limits), False
        curvature = 2.0 * math.sin(bearing) / max(math.hypot(dx, dy), _MIN_M)
        braking = math.sqrt(2.0 * self._limits.accel_m_s2 * max(min(left_m, free_m), 0.0))
        speed = min(self._limits.speed_m_s, braking, _BEND_RAD_S / max(abs(curvature), 1e-6))
        return speed, speed * curvature, False

    def _near(self, x_m: float, y_m: float) -> tuple[NDArray[np.int64], Array]:
        window = np.clip(np.arange(self._at - _WINDOW[0], self._at + _WINDOW[1]), 0, len(self.xy_m) - 1)
        return window, self.xy_m[window] - np.array([x_m, y_m])

    def _goal(self) -> Array:
        place = int(np.searchsorted(self._arc, self._arc[self._at] + _AHEAD_M))
        return np.asarray(self.xy_m[min(place, len(self.xy_m) - 1)])


class Docking:
    """The last of the way: onto the goal, then to its heading, on the spot."""

    def __init__(self, x_m: float, y_m: float, yaw_rad: float, limits: Limits) -> None:
        """Take the goal."""
        self._goal = x_m, y_m, yaw_rad
        self._limits = limits
        self._is_there = False

    def again(self) -> None:
        """Drive onto the goal once more: the pose was corrected since."""
        self._is_there = False

    def command(self, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """Return speed and rate at a pose within a metre of the goal."""
        dx, dy = self._goal[0] - x_m, self._goal[1] - y_m
        away_m, bearing = math.hypot(dx, dy), wrapped(math.atan2(dy, dx) - yaw_rad)
        is_behind = away_m < _BACK_M and abs(bearing) > 0.5 * math.pi
        off = wrapped(bearing + math.pi) if is_behind else bearing
        # beside it by less than it is good to, driving on helps no more
        self._is_there |= away_m < _NEAR_M or (away_m < 2.0 * _NEAR_M and abs(off) > 1.0)
        if self._is_there:
            return 0.0, turn(wrapped(self._goal[2] - yaw_rad), self._limits)
        if abs(off) > 0.35:
            return 0.0, turn(off, self._limits)
        speed = min(self._limits.speed_m_s, math.sqrt(self._limits.accel_m_s2 * away_m), _APPROACH_HZ * away_m)
        curvature = 2.0 * math.sin(off) / max(away_m, 0.1)
        return (-speed if is_behind else speed), speed * curvature


def turn(off_rad: float, limits: Limits) -> float:
    """Return the rate by which to turn on the spot by an angle."""
    braking = math.sqrt(2.0 * limits.angular_accel_rad_s2 * abs(off_rad))
    return math.copysign(min(_TURN_GAIN_HZ * abs(off_rad), braking, limits.rate_rad_s), off_rad)
