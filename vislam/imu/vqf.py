"""VQF, the filter of Laidig and Seel: levelling where gravity stands still, and a heading on top of it."""

from __future__ import annotations

import numpy as np

from vislam.config import AttitudeConfig
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.imu.heading import Heading, begin_heading, hold_heading, magnetic
from vislam.imu.levelling import Level, Levelling, begin_level, level, levelling

_TILT_FLOOR_DEG = 0.4  # vqf publishes it, and what motion does on top: 0.05 m/s^2 of bias is 0.3 deg


class Vqf:
    """Owns tilt, bias and heading, each with what it remembers."""

    def __init__(self, config: AttitudeConfig, gravity_m_s2: float, R_world_body: Array, bias: Array) -> None:
        """Begin with an attitude [3, 3] and a bias [3], known to `_BIAS_SIGMA_DEG_S` of the levelling only."""
        self._levelling, self._magnetic = levelling(gravity_m_s2), magnetic(config)
        self._level: Level = begin_level(R_world_body, bias, self._levelling)
        self._heading: Heading = begin_heading()
        self._floor_rad = float(np.deg2rad(_TILT_FLOOR_DEG))

    @property
    def R_world_body(self) -> Array:
        """The attitude [3, 3]."""
        return np.asarray(_attitude(self._level, self._heading.yaw_rad[0]))

    @property
    def gyro_bias_rad_s(self) -> Array:
        """The bias [3]."""
        return self._level.bias.copy()

    @property
    def tilt_sigma_rad(self) -> float:
        """The error of the tilt per axis: what the accelerometer's bias leaves, and what motion does now."""
        return float(np.sqrt(self._floor_rad**2 + self._level.wander_rad2[0]))

    def add(self, gyro: Array, accel: Array, dt_s: float, field: Array | None, field_dt_s: float) -> None:
        """Take rate and force `dt_s` after the last, and a field `field_dt_s` after the last one, if there is one."""
        if dt_s > 0.0:
            level(self._level, gyro, accel, dt_s, self._levelling)
        if field is not None:
            rate_rad_s = float(np.linalg.norm(self._level.calm[0, :3] - self._level.bias))
            hold_heading(self._heading, _attitude(self._level, 0.0) @ field, rate_rad_s, field_dt_s, self._magnetic)

    def add_many(self, gyro: Array, accel: Array, dt_s: Array) -> Array:
        """Take rates and forces [N, 3]; those without a step are left out. Return the attitude at each [N, 3, 3]."""
        return np.asarray(_level_many(self._level, gyro, accel, dt_s, self._heading.yaw_rad[0], self._levelling))


@njit(cache=True, nogil=True)
def _attitude(state: Level, yaw_rad: float) -> Array:
    R = state.R_world_start @ state.R_start_body
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack((c * R[0] - s * R[1], s * R[0] + c * R[1], R[2]))


@njit(cache=True, nogil=True)
def _level_many(state: Level, gyro: Array, accel: Array, dt_s: Array, yaw_rad: float, p: Levelling) -> Array:
    out = np.empty((len(dt_s), 3, 3))
    for k in range(len(dt_s)):
        if dt_s[k] > 0.0:
            level(state, gyro[k], accel[k], dt_s[k], p)
        out[k] = _attitude(state, yaw_rad)
    return out
