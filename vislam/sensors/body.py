"""The body as a sensor sees it: pose, velocity, rate and biases at one time, by any estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vislam.core.geometry import (
    skew,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
    so3_right_jacobian,
    so3_right_jacobian_inverse,
)
from vislam.core.messages import Array
from vislam.core.readings import Station

ERRORS = 15
PARTS = {
    "rotation": slice(0, 3), "position": slice(3, 6), "velocity": slice(6, 9),
    "gyro_bias": slice(9, 12), "accel_bias": slice(12, 15),
}  # fmt: skip
NUDGE = 1e-6  # by which derivatives are found
_STEPS: Array = NUDGE * np.eye(3)
_ABOUT: Array = np.array([np.cross(axis, np.eye(3)).T for axis in _STEPS])  # [3, 3, 3] the skew matrix of each step
_TURNS: Array = np.eye(3) + _ABOUT + 0.5 * _ABOUT @ _ABOUT  # the rotation by each step, exact to double precision


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """The body at one time. Its error [15] is that of `NavState`: rotation on the body side, the rest in world axes.

    `world` is `odom` for a filter and `map` for a graph: gravity-aligned, z up, origin and heading arbitrary.
    """

    t_ns: int
    R_world_body: Array  # [3, 3]
    position_m: Array  # [3] of the body in world
    velocity_m_s: Array  # [3] in world axes
    gyro_bias_rad_s: Array  # [3]
    accel_bias_m_s2: Array  # [3]
    rate_rad_s: Array  # [3] of the body in its own axes, bias taken off

    def moved(self, error: Array) -> BodyState:
        """Return the state with an error [15] added; a larger gyro bias leaves a smaller rate."""
        return replace(
            self,
            R_world_body=self.R_world_body @ so3_exp(np.ascontiguousarray(error[0:3])),
            position_m=self.position_m + error[3:6],
            velocity_m_s=self.velocity_m_s + error[6:9],
            gyro_bias_rad_s=self.gyro_bias_rad_s + error[9:12],
            accel_bias_m_s2=self.accel_bias_m_s2 + error[12:15],
            rate_rad_s=self.rate_rad_s - error[9:12],
        )

    def nudged(self, part: str) -> list[BodyState]:
        """Return the three states that `moved` makes of an error `NUDGE` in each number of one part.

        Derivatives are found with some ten of them at each reading: all but what moves is shared.
        """
        t_ns, R, position, velocity = self.t_ns, self.R_world_body, self.position_m, self.velocity_m_s
        gyro, accel, rate = self.gyro_bias_rad_s, self.accel_bias_m_s2, self.rate_rad_s
        if part == "rotation":
            return [BodyState(t_ns, turned, position, velocity, gyro, accel, rate) for turned in R @ _TURNS]
        if part == "position":
            return [BodyState(t_ns, R, moved, velocity, gyro, accel, rate) for moved in position + _STEPS]
        if part == "velocity":
            return [BodyState(t_ns, R, position, moved, gyro, accel, rate) for moved in velocity + _STEPS]
        if part == "gyro_bias":
            return [BodyState(t_ns, R, position, velocity, gyro + step, accel, rate - step) for step in _STEPS]
        return [BodyState(t_ns, R, position, velocity, gyro, moved, rate) for moved in accel + _STEPS]

    def later(self, by_s: float) -> BodyState:
        """Return the state a moment later, at the same velocity and rate."""
        turned = self.R_world_body @ so3_exp(self.rate_rad_s * by_s)
        return replace(
            self,
            t_ns=self.t_ns + round(by_s * 1e9),
            R_world_body=turned,
            position_m=self.position_m + by_s * self.velocity_m_s,
        )


def between_keyframes(T_earlier: Array, T_later: Array, t_ns: int, station: Station) -> BodyState:
    """Return the body at a reading between two poses [4, 4]: inertial data give the path its shape, the poses its ends.

    What the inertial path misses of the later pose is spread evenly in time. So the graph needs no variable at the time
    of the reading, and none for velocity.
    """
    R, p, s, T_s = T_earlier[:3, :3], T_earlier[:3, 3], station.since_s, station.length_s
    missed = _missed(T_earlier, T_later, station)
    share = s / T_s
    g = np.array([0.0, 0.0, -station.gravity_m_s2])
    begun = (T_later[:3, 3] - p - 0.5 * T_s * T_s * g - R @ station.dp_all_m) / T_s
    return BodyState(
        t_ns,
        R @ station.dR @ so3_exp(share * missed),
        p + s * begun + 0.5 * s * s * g + R @ station.dp_m,
        begun + s * g + R @ station.dv_m_s,
        station.gyro_bias_rad_s,
        station.accel_bias_m_s2,
        station.rate_rad_s + missed / T_s,
    )


def by_keyframes(T_earlier: Array, T_later: Array, station: Station) -> tuple[Array, Array]:
    """Return how the error [9] of the body's rotation, position and velocity hangs on both poses: [9, 6] each.

    Poses err as everywhere (`core.messages`): rotation, then translation, on the body side.
    """
    R_a, R_b = T_earlier[:3, :3], T_later[:3, :3]
    s, T_s = station.since_s, station.length_s
    share, missed = s / T_s, _missed(T_earlier, T_later, station)
    spread = share * so3_right_jacobian(share * missed)
    earlier, later = np.zeros((9, 6)), np.zeros((9, 6))
    earlier[:3, :3] = so3_exp(-share * missed) @ station.dR.T
    earlier[:3, :3] -= spread @ so3_left_jacobian_inverse(missed) @ station.dR_all.T
    later[:3, :3] = spread @ so3_right_jacobian_inverse(missed)
    turned = R_a @ skew(station.dp_all_m)
    earlier[3:6, :3] = share * turned - R_a @ skew(station.dp_m)
    earlier[3:6, 3:], later[3:6, 3:] = (1.0 - share) * R_a, share * R_b
    earlier[6:9, :3] = turned / T_s - R_a @ skew(station.dv_m_s)
    earlier[6:9, 3:], later[6:9, 3:] = -R_a / T_s, R_b / T_s
    return earlier, later


def rate_by_keyframes(T_earlier: Array, T_later: Array, station: Station) -> tuple[Array, Array]:
    """Return how the rate [3] of `between_keyframes` hangs on both poses: [3, 6] each, as `by_keyframes`."""
    missed, T_s = _missed(T_earlier, T_later, station), station.length_s
    earlier, later = np.zeros((3, 6)), np.zeros((3, 6))
    earlier[:, :3] = -so3_left_jacobian_inverse(missed) @ station.dR_all.T / T_s
    later[:, :3] = so3_right_jacobian_inverse(missed) / T_s
    return earlier, later


def path_by_force(station: Station) -> tuple[float, float]:
    """Return by how much an error of the force of one sigma moves position (m) and velocity (m/s) along its axis.

    All readings between two keyframes share that error: where one shows the body too far ahead, so do its neighbours.
    """
    s, T_s, sigma = station.since_s, station.length_s, station.accel_sigma_m_s2
    return 0.5 * sigma * s * (s - T_s), sigma * (s - 0.5 * T_s)


def _missed(T_earlier: Array, T_later: Array, station: Station) -> Array:
    """Return what the gyroscope missed between two keyframes, a rotation vector [3] in the later body's axes."""
    turned = T_earlier[:3, :3] @ station.dR_all
    return so3_log(np.ascontiguousarray(turned.T @ T_later[:3, :3]))
