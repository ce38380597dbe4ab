"""The complementary filter of Karpov's cart: Mahony's, with a gate and a low-pass on the force that levels.

The accelerometer's part is gated, for a cart that speeds up would tilt the horizon. Mahony, Hamel and Pflimlin,
"Nonlinear complementary filters on the special orthogonal group", IEEE TAC 2008, equation 48.
"""

from __future__ import annotations

import numpy as np

from vislam.config import AttitudeConfig
from vislam.core.geometry import so3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array

_LEVEL_CUTOFF_HZ = 5.0  # low-pass on the force that levels, so that vibration does not close the gate
_MAG_GAIN = 0.05  # 1/s, of the yaw by the magnetometer
_TILT_SIGMA_DEG = 1.0  # that is published; twice the error on synthetic carts, whose springs are ideal
_NO_FIELD = np.full(3, np.nan)


class Complementary:
    """Owns attitude, bias and filtered force; its error is constant."""

    def __init__(self, config: AttitudeConfig, gravity_m_s2: float, R_world_body: Array, bias: Array) -> None:
        """Begin with an attitude [3, 3] and a bias [3]."""
        R = np.array(R_world_body, dtype=np.float64)
        self._state = (R, np.array(bias, dtype=np.float64), gravity_m_s2 * R[2].copy())
        self._parameters = np.array(
            [
                config.proportional_gain, config.integral_gain, gravity_m_s2, config.gate_m_s2, _LEVEL_CUTOFF_HZ,
                _MAG_GAIN, config.mag_gate,
            ]
        )  # fmt: skip
        self._field_world: Array | None = None
        self.tilt_sigma_rad = float(np.deg2rad(_TILT_SIGMA_DEG))

    @property
    def R_world_body(self) -> Array:
        """The attitude [3, 3]."""
        return self._state[0].copy()

    @property
    def gyro_bias_rad_s(self) -> Array:
        """The bias [3]."""
        return self._state[1].copy()

    def add(self, gyro: Array, accel: Array, dt_s: float, field: Array | None, field_dt_s: float) -> None:
        """Take rate and force `dt_s` after the last, and a field `field_dt_s` after the last one, if there is one."""
        if field is not None and self._field_world is None:
            self._field_world = self._state[0] @ field
        field_world = _NO_FIELD if self._field_world is None else self._field_world
        _advance(
            self._state, gyro, accel, dt_s, _NO_FIELD if field is None else field, field_world, field_dt_s,
            self._parameters,
        )  # fmt: skip

    def add_many(self, gyro: Array, accel: Array, dt_s: Array) -> Array:
        """Take rates and forces [N, 3]; those without a step are left out. Return the attitude at each [N, 3, 3]."""
        return np.asarray(_advance_many(self._state, dt_s, gyro, accel, self._parameters))


@njit(cache=True, nogil=True)
def _advance(
    state: tuple[Array, Array, Array],
    gyro: Array,
    accel: Array,
    dt: float,
    field: Array,
    field_world: Array,
    field_dt: float,
    p: Array,
) -> None:
    """Move R_world_body [3, 3], gyro bias [3] and filtered force [3] on by one sample; NaN field: none.

    p: proportional gain, integral gain, gravity, gate, cutoff (Hz), magnetic gain, magnetic gate.
    """
    R, bias, force = state
    share = 1.0 - np.exp(-2.0 * np.pi * p[4] * dt)
    up = R[2]  # the world's z in the body
    rate = gyro - bias
    for i in range(3):
        force[i] += share * (accel[i] - force[i])
    norm = np.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    turn = rate * dt
    if abs(norm - p[2]) < p[3]:
        error = np.cross(force / norm, up)
        turn += (p[0] * dt) * error
        bias -= (p[1] * dt) * error
    if not np.isnan(field[0]):
        strength = np.sqrt(np.sum(field_world * field_world))
        seen = R @ field
        off = max(abs(np.sqrt(np.sum(seen * seen)) - strength), abs(seen[2] - field_world[2]))
        if off < p[6] * strength:
            ahead = np.arctan2(seen[1], seen[0]) - np.arctan2(field_world[1], field_world[0])
            ahead = np.arctan2(np.sin(ahead), np.cos(ahead))
            turn -= (p[5] * field_dt * ahead) * up
            bias += (p[1] * field_dt * ahead) * up
    R[:] = R @ so3_exp(turn)
    # keep the columns orthonormal: one Gram-Schmidt step
    R[0] /= np.sqrt(np.sum(R[0] * R[0]))
    R[1] -= np.sum(R[1] * R[0]) * R[0]
    R[1] /= np.sqrt(np.sum(R[1] * R[1]))
    R[2] = np.cross(R[0], R[1])


@njit(cache=True, nogil=True)
def _advance_many(state: tuple[Array, Array, Array], dt_s: Array, gyro: Array, accel: Array, p: Array) -> Array:
    out = np.empty((len(dt_s), 3, 3))
    none = np.full(3, np.nan)
    for k in range(len(dt_s)):
        if dt_s[k] > 0.0:
            _advance(state, gyro[k], accel[k], dt_s[k], none, none, 0.0, p)
        out[k] = state[0]
    return out
