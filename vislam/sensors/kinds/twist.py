"""Velocities of another odometry in the base's axes."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vislam.config.ranges import NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.kinds.driven import NO_TURN, Compared, Driven
from vislam.sensors.mounting import Mount
from vislam.sensors.sensor import Variable, noisy


@dataclass(frozen=True, slots=True)
class TwistSettings:
    """Settings of `twist` and `omni`."""

    scale_sigma: Positive = 0.03  # of the speed
    turn_scale_sigma: Positive = 0.03  # of the rate
    base_m: Vector3 = (0.0, 0.0, 0.0)  # in the body, the point whose velocity is measured
    mount_rpy_rad: Vector3 = NO_TURN  # roll, pitch, yaw of the base in the body
    mount_sigma_rad: NonNegative = 0.0  # above 0 its yaw and pitch are estimated
    sigma_m_s: Positive = 0.03
    slip: NonNegative = 0.02  # share of the speed
    sigma_rad_s: Positive = 0.02
    turn_slip: NonNegative = 0.05  # share of the rate
    sideways_m_s: Positive = 0.05  # of a base that cannot go sideways
    upward_m_s: Positive = 0.1
    gyro_rad_s: NonNegative = 0.01


class Omni(Driven):
    """Forward and left velocity and rate of a base that goes any way: `true = scale * measured`."""

    Settings = TwistSettings
    columns: ClassVar[tuple[str, ...]] = ("vx_m_s", "vy_m_s", "wz_rad_s")
    slips = ("vx_m_s",)

    def __init__(self, settings: TwistSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or TwistSettings()
        super().__init__(
            Mount(s.base_m, s.mount_rpy_rad, s.mount_sigma_rad),
            (Variable("scale", s.scale_sigma, 1.0), Variable("turn_scale", s.turn_scale_sigma, 1.0)),
        )

    def compared(self, values: Array, motion: Array, own: Array) -> Compared:
        """Return forward, left and upward velocity and rate against a motion."""
        vx, vy, wz = self._all(values)
        scales = np.array([own[0], own[0] if len(values) == 3 else 1.0, 1.0, own[1]])
        expected = motion / scales
        by_own = np.zeros((4, 2))
        by_own[0, 0], by_own[3, 1] = -expected[0] / own[0], -expected[3] / own[1]
        if len(values) == 3:
            by_own[1, 0] = -expected[1] / own[0]
        return Compared(np.array([vx, vy, 0.0, wz]) - expected, np.diag(1.0 / scales), by_own)

    def noise(self, values: Array) -> Array:
        """Return the covariance [4, 4]."""
        s = self.settings
        along, left, turn = np.diag(self._noise_at(values))
        sideways = left if len(values) == 3 else s.sideways_m_s**2
        return np.diag([along, sideways, s.upward_m_s**2, turn + s.gyro_rad_s**2])

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the velocities of a true body."""
        vx, vy, _, wz = self.base_motion(body, own) / own[[0, 0, 0, 1]]
        values = noisy(np.array([vx, vy, wz]), self._noise_at(np.array([vx, vy, wz])), rng)
        return values if len(self.columns) == 3 else values[[0, 2]]

    def _all(self, values: Array) -> tuple[float, float, float]:
        return float(values[0]), float(values[1]) if len(values) == 3 else 0.0, float(values[-1])

    def _noise_at(self, values: Array) -> Array:
        """Return the covariance [3, 3] of forward, left and rate."""
        s = self.settings
        vx, vy, wz = self._all(values)
        along = s.sigma_m_s**2 + s.slip**2 * (vx**2 + vy**2)
        return np.diag([along, along, s.sigma_rad_s**2 + (s.turn_slip * wz) ** 2])


class Twist(Omni):
    """Forward velocity and rate of a base that cannot go sideways."""

    columns = ("vx_m_s", "wz_rad_s")
