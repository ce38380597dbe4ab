"""Speed and steering angle of a car."""

import math
from dataclasses import dataclass

import numpy as np

from vislam.config.ranges import Finite, NonNegative, Positive
from vislam.config.sensors import Vector3
from vislam.core.messages import Array
from vislam.sensors.body import BodyState
from vislam.sensors.kinds.driven import NO_TURN, Compared, Driven
from vislam.sensors.mounting import Mount
from vislam.sensors.sensor import Variable, noisy

_LEAST_TURN = 1e-3  # rad/s; at rest no angle shows a turn, and a variance has to be positive
_MOST_STEERING_RAD = 1.4  # beyond it no wheel rolls


@dataclass(frozen=True, slots=True)
class AckermannSettings:
    """Settings of `ackermann`."""

    wheelbase_m: Positive = 2.5
    scale_sigma: Positive = 0.03
    steering_offset_rad: Finite = 0.0
    steering_offset_sigma_rad: Positive = 0.02
    axle_m: Vector3 = (0.0, 0.0, 0.0)  # middle of the axle that does not steer, in the body
    mount_rpy_rad: Vector3 = NO_TURN  # roll, pitch, yaw of the base in the body
    mount_sigma_rad: NonNegative = 0.0  # above 0 its yaw and pitch are estimated
    sigma_m_s: Positive = 0.05
    slip: NonNegative = 0.02  # share of the speed
    sigma_steering_rad: Positive = 0.01  # of the angle of a wheel in the middle; tyres slip sideways by as much
    sideways_m_s: Positive = 0.1
    upward_m_s: Positive = 0.1
    gyro_rad_s: NonNegative = 0.01


class Ackermann(Driven):
    """Speed of the rear axle and angle of the front wheels: `turn = speed * tan(steering + offset) / wheelbase`."""

    Settings = AckermannSettings
    columns = ("speed_m_s", "steering_rad")
    slips = ("speed_m_s",)

    def __init__(self, settings: AckermannSettings | None = None) -> None:
        """Take settings; the defaults without any."""
        self.settings = s = settings or AckermannSettings()
        super().__init__(
            Mount(s.axle_m, s.mount_rpy_rad, s.mount_sigma_rad),
            (
                Variable("scale", s.scale_sigma, 1.0),
                Variable("steering_offset_rad", s.steering_offset_sigma_rad, s.steering_offset_rad),
            ),
        )

    def compared(self, values: Array, motion: Array, own: Array) -> Compared:
        """Return speed, sideways and upward velocity and turn against a motion.

        The turn is that which the angle gives at the body's own speed; the angle that a turn gives is none at rest.
        """
        base_m, tangent = self.settings.wheelbase_m, math.tan(values[1] + own[1])
        expected = motion[0] / own[0]
        by_motion = np.diag([1.0 / own[0], 1.0, 1.0, 1.0])
        by_motion[3, 0] = -tangent / base_m
        by_own = np.zeros((4, 2))
        by_own[0, 0] = -expected / own[0]
        by_own[3, 1] = -motion[0] * (1.0 + tangent**2) / base_m
        turn = motion[0] * tangent / base_m
        return Compared(np.array([values[0] - expected, -motion[1], -motion[2], turn - motion[3]]), by_motion, by_own)

    def noise(self, values: Array) -> Array:
        """Return the covariance [4, 4]; that of the angle counts by the given speed."""
        s = self.settings
        speed, steering = np.diag(self._noise_at(values))
        by_angle = values[0] * (1.0 + math.tan(values[1] + s.steering_offset_rad) ** 2) / s.wheelbase_m
        turn = by_angle**2 * steering + s.gyro_rad_s**2 + _LEAST_TURN**2
        return np.diag([speed, s.sideways_m_s**2, s.upward_m_s**2, turn])

    def check(self, values: Array) -> str:
        """Return why an angle is none."""
        if abs(values[1]) <= _MOST_STEERING_RAD:
            return ""
        return f"wheels steered by {values[1]:g} rad; {_MOST_STEERING_RAD:g} at most; degrees?"

    def draw(self, body: BodyState, own: Array, rng: np.random.Generator) -> Array:
        """Return speed and angle of a true body; of one that stands, the wheels are straight."""
        motion = self.base_motion(body, own)
        moves = abs(motion[0]) > 1e-6
        steering = math.atan(motion[3] * self.settings.wheelbase_m / motion[0]) if moves else 0.0
        exact = np.array([motion[0] / own[0], steering - own[1]])
        return noisy(exact, self._noise_at(exact), rng)

    def _noise_at(self, values: Array) -> Array:
        s = self.settings
        return np.diag([s.sigma_m_s**2 + (s.slip * values[0]) ** 2, s.sigma_steering_rad**2])
