"""Who steers the virtual cart: a controller that writes commands, or else a driver who knows the way."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.messages import Array
from vislam.live.wire.slot import SlotReader, SlotWriter

_COMMAND = struct.Struct("<2d")
_SPEED_M_S, _AHEAD_M = 0.6, 0.45  # of a driver who knows the way, and how far ahead he looks


class CommandWriter:
    """Owns the place where a controller's newest command is."""

    def __init__(self, name: str) -> None:
        """Make the shared memory."""
        self._slot = SlotWriter(name, _COMMAND.size)

    def command(self, speed_m_s: float, rate_rad_s: float) -> None:
        """Ask the wheels for a twist."""
        self._slot.write(_COMMAND.pack(speed_m_s, rate_rad_s))

    def close(self) -> None:
        """Remove the shared memory; the cart then stops."""
        self._slot.close()


class CommandReader:
    """Reads commands; one that does not change for too long means that it is not steered."""

    def __init__(self, name: str, timeout_s: float = 0.5) -> None:
        self._name, self._timeout_s = name, timeout_s
        self._slot: SlotReader | None = None
        self._sequence = 0
        self._since_s = 0.0

    def newest(self, now_s: float) -> tuple[float, float]:
        """Return speed and rate to drive with at a time; zero when it is not steered."""
        if self._slot is None:
            try:
                self._slot = SlotReader(self._name)
            except DataError:
                return 0.0, 0.0
        read = self._slot.read()
        if read is None:
            return 0.0, 0.0
        if read[0] != self._sequence:
            self._sequence, self._since_s = read[0], now_s
        if now_s - self._since_s > self._timeout_s:
            return 0.0, 0.0
        speed, rate = _COMMAND.unpack(read[1])
        return speed, rate


class PathFollower:
    """Pure pursuit of a polyline, with a speed that bends and the end allow (Coulter, CMU-RI-TR-92-01)."""

    def __init__(self, xy_m: Array) -> None:
        """Take a dense path [N, 2]."""
        self.xy_m = xy_m
        self._arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
        self._at = 0

    @property
    def length_m(self) -> float:
        """Of the path."""
        return float(self._arc[-1])

    def error_m(self, x_m: float, y_m: float) -> float:
        """Return the distance of a place from the path around where the follower is."""
        return float(np.linalg.norm(self._near(x_m, y_m)[1], axis=1).min())

    def command(self, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float, bool]:
        """Return speed, rate and whether the end is reached, at a pose."""
        window, offsets = self._near(x_m, y_m)
        self._at = int(window[int(np.argmin(np.linalg.norm(offsets, axis=1)))])
        left_m = self._arc[-1] - self._arc[self._at]
        if left_m < 0.05:
            return 0.0, 0.0, True
        goal = self._goal()
        dx, dy = goal[0] - x_m, goal[1] - y_m
        bearing = (np.arctan2(dy, dx) - yaw_rad + np.pi) % (2.0 * np.pi) - np.pi
        curvature = 2.0 * np.sin(bearing) / max(float(np.hypot(dx, dy)), 1e-3)
        speed = min(_SPEED_M_S, float(np.sqrt(2.0 * 0.4 * left_m)), 0.5 / max(abs(curvature), 1e-6))
        if abs(bearing) > 1.0:  # turn on the spot first
            return 0.0, float(np.clip(1.5 * bearing, -0.8, 0.8)), False
        return speed, speed * curvature, False

    def _near(self, x_m: float, y_m: float) -> tuple[NDArray[np.int64], Array]:
        window = np.clip(np.arange(self._at - 20, self._at + 80), 0, len(self.xy_m) - 1)
        return window, self.xy_m[window] - np.array([x_m, y_m])

    def _goal(self) -> Array:
        place = int(np.searchsorted(self._arc, self._arc[self._at] + _AHEAD_M))
        return np.asarray(self.xy_m[min(place, len(self.xy_m) - 1)])
