"""What all that drives shares: a base that goes forward, not sideways and not up, and turns as the gyroscope has it."""

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from vislam.config.sensors import Vector3
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.mounting import Mount
from vislam.sensors.sensor import Configured, Variable


class Compared(NamedTuple):
    """A reading against the motion of the base: forward, left, up velocity and rate about up."""

    residual: Array  # [4]
    by_motion: Array  # [4, 4] minus its derivative by the motion
    by_own: Array  # [4, V without the mounting] the same by own variables


class Driven(Configured):
    """Residual [4] of a base that goes where it looks: what the device measures, and no motion sideways or up.

    The device's value is compared with the one expected by the body's motion, and never scaled itself: its noise would
    else make scales and widths too small. The body's rate is the gyroscope's, so wheels that turn otherwise fail the
    gate as a whole; what slips by less is in the noise, which grows with speed and turn.
    """

    touches = ("rotation", "velocity", "gyro_bias")
    sees_motion_only = True

    def __init__(self, mount: Mount, variables: tuple[Variable, ...]) -> None:
        """Take the mounting and the own variables besides."""
        self._mount = mount
        self._others = len(variables)
        self.variables = variables + mount.variables

    @abstractmethod
    def compared(self, values: Array, motion: Array, own: Array) -> Compared:
        """Return a reading against a motion [4] at own variables [V without the mounting]."""

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted [4]."""
        return self.compared(values, self.base_motion(body, own), own[: self._others]).residual

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [4, 15] and H_own [4, V]."""
        driven = self._mount.driven(body, own[self._others :])
        compared = self.compared(values, driven.motion, own[: self._others])
        by_mount = compared.by_motion @ driven.by_mount
        return compared.by_motion @ driven.H, np.hstack([compared.by_own, by_mount])

    def base_motion(self, body: BodyState, own: Array) -> Array:
        """Return forward, left, up velocity and rate about up [4] of a body."""
        return self._mount.motion(body, own[self._others :])


NO_TURN: Vector3 = (0.0, 0.0, 0.0)
