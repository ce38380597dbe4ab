"""Speeds of two wheels, or two tracks, that steer by their difference."""

from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.kinds.driven import NO_TURN, Compared, Driven
from vislam.sensors.mounting import Mount
from vislam.sensors.sensor import Variable, noisy

_MOST_M_S = 100.0


@dataclass(frozen=True, slots=True)
class WheelsSettings:
    """Settings of `wheels`."""

    track_width_m: Positive = 0.5  # between the wheels' points of contact
    track_sigma_m: Positive = 0.015
    scale_sigma: Positive = 0.03  # of each wheel: load and pressure change a radius by a few percent
    axle_m: Vector3 = (0.0, 0.0, 0.0)  # middle of the axle in the body
    mount_rpy_rad: Vector3 = NO_TURN  # roll, pitch, yaw of the base in the body
    mount_sigma_rad: NonNegative = 0.0  # above 0 its yaw and pitch are estimated
    sigma_m_s: Positive = 0.02  # of each wheel, at any speed
    slip: NonNegative = 0.02  # of each wheel, share of its speed
    turn_slip: NonNegative = 0.05  # of each wheel, share of the difference of speeds; tracks and skid steering: 0.3
    sideways_m_s: Positive = 0.05
    upward_m_s: Positive = 0.1  # also what a base that pitches and rolls on its springs does
    gyro_rad_s: NonNegative = 0.01  # of the rate that the turn is compared with


class Wheels(Driven):
    """Left and right speed at nominal radii: `true = scale * measured` of each wheel."""

    Settings = WheelsSettings
    columns = ("left_m_s", "right_m_s")
    slips = ("left_m_s", "right_m_s")

    def __init__(self, settings: WheelsSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or WheelsSettings()
        super().__init__(
            Mount(s.axle_m, s.mount_rpy_rad, s.mount_sigma_rad),
            (
                Variable("scale_left", s.scale_sigma, 1.0),
                Variable("scale_right", s.scale_sigma, 1.0),
                Variable("track_width_m", s.track_sigma_m, s.track_width_m),
            ),
        )

    def compared(self, values: Array, motion: Array, own: Array) -> Compared:
        """Return left and right speed, sideways and upward velocity against a motion."""
        scales, half = own[:2], 0.5 * own[2] * np.array([-1.0, 1.0])  # how far left a wheel is, to the right
        expected = (motion[0] + half * motion[3]) / scales
        by_motion, by_own = np.zeros((4, 4)), np.zeros((4, 3))
        by_motion[:2, 0], by_motion[:2, 3] = 1.0 / scales, half / scales
        by_motion[2, 1] = by_motion[3, 2] = 1.0
        by_own[[0, 1], [0, 1]] = -expected / scales
        by_own[:2, 2] = half / own[2] * motion[3] / scales
        return Compared(np.append(values - expected, -motion[1:3]), by_motion, by_own)

    def noise(self, values: Array) -> Array:
        """Return the covariance [4, 4]."""
        s = self.settings
        noise = np.diag([0.0, 0.0, s.sideways_m_s**2, s.upward_m_s**2])
        turned = 0.5 * s.track_width_m * s.gyro_rad_s * np.array([-1.0, 1.0])
        noise[:2, :2] = self._wheel_noise(values) + np.outer(turned, turned)
        return noise

    def check(self, values: Array) -> str:
        """Return why a speed is none."""
        return "" if np.abs(values).max() <= _MOST_M_S else f"wheels at {values.tolist()} m/s; mm/s or counts?"

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return the speeds of a true body's wheels."""
        motion = self.base_motion(body, own)
        half = 0.5 * own[2] * motion[3]
        exact = np.array([(motion[0] - half) / own[0], (motion[0] + half) / own[1]])
        return noisy(exact, self._wheel_noise(exact), rng)

    def _wheel_noise(self, values: Array) -> Array:
        """Return the covariance [2, 2] of left and right."""
        s = self.settings
        turning = s.turn_slip * abs(float(values[1] - values[0]))
        return np.diag(s.sigma_m_s**2 + (s.slip * values) ** 2 + turning**2)
