"""What all that drives shares: a base that goes forward, not sideways and not up, and turns as the gyroscope says."""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from vislam.config.sensors import Vector3
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.configured import Configured
from vislam.sensors.mounting import Mount
from vislam.sensors.sensor import Variable


class Told(NamedTuple):
    """What a reading says of the base: forward, left, up velocity and rate about up, and how it hangs on own ones."""

    motion: Array  # [4]
    by_own: Array  # [4, V without the mounting]


class Driven(Configured):
    """Residual [4]: forward, left and up velocity of the axle in m/s, rate about the base's up in rad/s.

    The body's rate is the gyroscope's, so wheels that turn otherwise than the gyroscope fail the gate as a whole; what
    slips by less is in the noise, which grows with speed and turn.
    """

    touches = ("rotation", "velocity", "gyro_bias")

    def __init__(self, mount: Mount, variables: tuple[Variable, ...]) -> None:
        """Take the mounting and the own variables besides."""
        self._mount = mount
        self._told = len(variables)
        self.variables = variables + mount.variables

    @abstractmethod
    def told(self, values: Array, own: Array) -> Told:
        """Return what a reading says at own variables [V without the mounting]."""

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted motion [4] of the base."""
        return self.told(values, own[: self._told]).motion - self._mount.motion(body, own[self._told :])

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [4, 15] and H_own [4, V]."""
        told = self.told(values, own[: self._told])
        driven = self._mount.driven(body, own[self._told :])
        return driven.H, np.hstack([-told.by_own, driven.by_mount])

    def base_motion(self, body: BodyState, own: Array) -> Array:
        """Return forward, left, up velocity and rate about up [4] of a body."""
        return self._mount.motion(body, own[self._told :])


def floor_covariance(left_m_s: float, up_m_s: float, gyro_rad_s: float) -> Array:
    """Return the covariance [4, 4] of what no wheel tells: sideways and upward motion, and the gyroscope's noise."""
    return np.diag([0.0, left_m_s**2, up_m_s**2, gyro_rad_s**2])


NO_TURN: Vector3 = (0.0, 0.0, 0.0)
