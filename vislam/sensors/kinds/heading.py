"""Headings about up: a compass that was calibrated elsewhere, two antennas, a sun sensor."""

import math
from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import Finite, NonNegative, Positive
from vislam.core.angles import wrapped
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.sensor import Configured, Variable, noisy

_UPRIGHT = 0.1  # cosine of the x axis's slope (84 deg) below which the body has no heading


@dataclass(frozen=True, slots=True)
class HeadingSettings:
    """Settings of `heading`."""

    sigma_rad: Positive = 0.05
    clockwise: bool = False  # as compasses count; False: from x to y, as everything here
    offset_rad: Finite = 0.0  # heading that is measured when the body's x axis is the world's
    offset_sigma_rad: Positive = math.pi  # the world's heading is arbitrary
    offset_walk_rad_per_sqrt_s: NonNegative = 0.0


class Heading(Configured):
    """The heading of the body's x axis against a direction that is estimated.

    A body whose x axis points nearly up or down has none: the reading then has no effect.
    """

    Settings = HeadingSettings
    columns = ("heading_rad",)
    sigma_columns = ("sigma_heading_rad",)
    touches = ("rotation",)

    def __init__(self, settings: HeadingSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or HeadingSettings()
        walk = s.offset_walk_rad_per_sqrt_s
        self.variables = (Variable("offset_rad", s.offset_sigma_rad, s.offset_rad, walk, of_machine=False),)
        self._sense = -1.0 if s.clockwise else 1.0

    def residual(self, values: Array, body: BodyState, own: Array) -> Array:
        """Return measured minus predicted heading [1], between -pi and pi."""
        if _level_part(body) < _UPRIGHT:
            return np.zeros(1)
        return np.array([wrapped(float(values[0]) - self._predicted(body, own))])

    def jacobians(self, values: Array, body: BodyState, own: Array) -> tuple[Array, Array]:
        """Return H [1, 15] and H_own [1, 1]."""
        H, R = np.zeros((1, 15)), body.R_world_body
        level = _level_part(body)
        if level < _UPRIGHT:
            return H, np.zeros((1, 1))
        # a turn about the body's y moves its x axis along -z, a turn about its z along y
        H[0, 1] = self._sense * (R[1, 0] * R[0, 2] - R[0, 0] * R[1, 2]) / level**2
        H[0, 2] = self._sense * (R[0, 0] * R[1, 1] - R[1, 0] * R[0, 1]) / level**2
        return H, np.ones((1, 1))

    def noise(self, values: Array) -> Array:
        """Return the variance [1, 1]."""
        return np.array([[self.settings.sigma_rad**2]])

    def check(self, values: Array) -> str:
        """Return why a heading is none: more than two turns are degrees."""
        return "" if abs(values[0]) <= 4.0 * math.pi else f"a heading of {values[0]:g} rad; degrees?"

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return a heading of a true body."""
        exact = np.array([self._predicted(body, own)])
        return np.array([wrapped(float(noisy(exact, self.noise(exact), rng)[0]))])

    def _predicted(self, body: BodyState, own: Array) -> float:
        yaw = math.atan2(body.R_world_body[1, 0], body.R_world_body[0, 0])
        return self._sense * yaw + float(own[0])


def _level_part(body: BodyState) -> float:
    """Return the length of the body's x axis in the level plane."""
    return math.hypot(body.R_world_body[0, 0], body.R_world_body[1, 0])
