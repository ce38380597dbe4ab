"""How a vehicle's base sits in the body: its axle, and which way it drives."""

from typing import NamedTuple

import numpy as np

from vislam.config.sensors import Vector3
from vislam.core.geometry import skew
from vislam.core.messages import Array
from vislam.sensors.body import PARTS, BodyState
from vislam.sensors.measuring_frame import about_up, cross
from vislam.sensors.sensor import Variable


class Driven(NamedTuple):
    """Forward, left, up velocity of the axle and rate about the base's up, and what they hang on."""

    motion: Array  # [4] m/s and rad/s
    H: Array  # [4, 15]
    by_mount: Array  # [4, 2] by yaw and pitch, of a known mounting [4, 0]


class Mount:
    """A base whose x axis is forward: `R_body_base = R(roll, pitch, yaw) @ Rz(own yaw) @ Ry(own pitch)`."""

    def __init__(self, axle_m: Vector3, roll_pitch_yaw_rad: Vector3, sigma_rad: float) -> None:
        """Take the middle of the axle in the body, and the base's attitude; a sigma above 0 asks to estimate it."""
        self.axle_m: Array = np.array(axle_m, dtype=np.float64)
        roll, pitch, yaw = roll_pitch_yaw_rad
        self._R_body_base = about_up(yaw) @ _about_left(pitch) @ _about_forward(roll)
        names = ("mount_yaw_rad", "mount_pitch_rad") if sigma_rad else ()
        self.variables = tuple(Variable(name, sigma_rad) for name in names)

    def motion(self, body: BodyState, mount: Array) -> Array:
        """Return the axle's velocity in base axes and the rate about its up [4], at own yaw and pitch [2], or [0]."""
        R = self._rotation(mount)
        velocity = R.T @ (body.R_world_body.T @ body.velocity_m_s + cross(body.rate_rad_s, self.axle_m))
        return np.append(velocity, R[:, 2] @ body.rate_rad_s)

    def driven(self, body: BodyState, mount: Array) -> Driven:
        """Return the same with its derivatives."""
        R = self._rotation(mount)
        velocity = body.R_world_body.T @ body.velocity_m_s  # of the body, in its own axes
        H = np.zeros((4, 15))
        H[:3, PARTS["rotation"]] = R.T @ skew(velocity)
        H[:3, PARTS["velocity"]] = R.T @ body.R_world_body.T
        H[:3, PARTS["gyro_bias"]] = R.T @ skew(self.axle_m)  # a larger bias leaves a smaller rate
        H[3, PARTS["gyro_bias"]] = -R[:, 2]
        motion = self.motion(body, mount)
        rate = R.T @ body.rate_rad_s
        by_mount = np.zeros((4, len(mount)))
        if len(mount):
            turned = _about_left(float(mount[1]))
            for k, axis in enumerate((turned[2], np.array([0.0, 1.0, 0.0]))):  # own axes, in base axes
                by_mount[:3, k] = -cross(axis, motion[:3])
                by_mount[3, k] = -cross(axis, rate)[2]
        return Driven(motion, H, by_mount)

    def _rotation(self, mount: Array) -> Array:
        if not len(mount):
            return self._R_body_base
        return self._R_body_base @ about_up(float(mount[0])) @ _about_left(float(mount[1]))


def _about_left(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _about_forward(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
