"""Attitude from the IMU alone: a complementary filter, the baseline that vision has to beat.

The accelerometer's part is gated, for a cart that speeds up would tilt the horizon. Filtering for display only: nothing
that an estimator integrates is filtered here. Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on the
special orthogonal group", IEEE TAC 2008, equation 48, with a gate and a low-pass on what levels.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vislam.config import AttitudeConfig
from vislam.geometry import so3_exp
from vislam.messages import Array, ImuSample, ImuSpan, MagSample

_NO_FIELD = np.full(3, np.nan)
_MAX_STEP_S = 0.1  # longer holes are bridged by as much


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
def _advance_many(
    state: tuple[Array, Array, Array], t_ns: NDArray[np.int64], gyro: Array, accel: Array, p: Array
) -> Array:
    out = np.empty((len(t_ns), 3, 3))
    none = np.full(3, np.nan)
    out[0] = state[0]
    for k in range(1, len(t_ns)):
        dt = min((t_ns[k] - t_ns[k - 1]) * 1e-9, 0.1)
        _advance(state, gyro[k], accel[k], dt, none, none, 0.0, p)
        out[k] = state[0]
    return out


class AttitudeFilter:
    """Owns attitude and gyro bias; starts from what power-up found.

    Attributes:
        R_world_body: [3, 3], a copy is handed out; the world's z is up, its yaw is zero where the filter began.
    """

    def __init__(
        self, config: AttitudeConfig, gravity_m_s2: float, R_world_body: Array, gyro_bias_rad_s: Array
    ) -> None:
        """Begin with an attitude [3, 3] and a bias [3], as `PowerUp.R_level_body` and its bias."""
        R = np.array(R_world_body, dtype=np.float64)
        self._state = (R, np.array(gyro_bias_rad_s, dtype=np.float64), gravity_m_s2 * R[2].copy())
        self._parameters = np.array(
            [
                config.proportional_gain, config.integral_gain, gravity_m_s2, config.gate_m_s2, config.level_cutoff_hz,
                config.mag_gain, config.mag_gate,
            ]
        )  # fmt: skip
        self._field_world: Array = _NO_FIELD
        self._t_ns: int | None = None
        self._field_t_ns: int | None = None

    @property
    def R_world_body(self) -> Array:
        """The attitude [3, 3] at the newest sample."""
        return self._state[0].copy()

    @property
    def gyro_bias_rad_s(self) -> Array:
        """The bias [3]."""
        return self._state[1].copy()

    def add(self, sample: ImuSample, mag: MagSample | None = None) -> None:
        """Take a sample, and the magnetometer's if one came with it; older samples than the last are left out.

        The first field that comes is the reference: yaw is held where it was then.
        """
        if self._t_ns is not None and sample.t_ns <= self._t_ns:
            return
        dt = 0.0 if self._t_ns is None else min((sample.t_ns - self._t_ns) * 1e-9, _MAX_STEP_S)
        self._t_ns = sample.t_ns
        field, field_dt = _NO_FIELD, 0.0
        if mag is not None:
            field = mag.field_ut
            if self._field_t_ns is None:
                self._field_world = self._state[0] @ field
            else:
                field_dt = min(max(mag.t_ns - self._field_t_ns, 0) * 1e-9, _MAX_STEP_S)
            self._field_t_ns = mag.t_ns
        _advance(
            self._state, sample.gyro_rad_s, sample.accel_m_s2, dt, field, self._field_world, field_dt, self._parameters
        )

    def add_span(self, span: ImuSpan) -> Array:
        """Take many samples at once, without a magnetometer; return the attitude at each, R_world_body [N, 3, 3].

        The first sample is the state's own time: nothing is integrated up to it.
        """
        self._t_ns = int(span.t_ns[-1])
        return np.asarray(_advance_many(self._state, span.t_ns, span.gyro_rad_s, span.accel_m_s2, self._parameters))
