"""Attitude without vision: the baseline that vision has to beat. What an estimator integrates is not filtered here."""

from __future__ import annotations

from math import isfinite

import numpy as np

from vislam.config import AttitudeConfig
from vislam.core.geometry import so3_exp
from vislam.core.jit import njit
from vislam.core.messages import Array, ImuSample, ImuSpan, MagSample
from vislam.imu.heading import Heading, begin_heading, hold_heading, magnetic
from vislam.imu.levelling import Level, Levelling, begin_level, level, levelling

_NS = 1e-9
_MAX_STEP_S = 0.1  # longer holes are bridged by as much
_TILT_FLOOR_DEG = 0.4  # vqf publishes it, and what motion does on top: 0.05 m/s^2 of bias is 0.3 deg
_LEVEL_CUTOFF_HZ = 5.0  # low-pass on the force that levels, so that vibration does not close the gate
_MAG_GAIN = 0.05  # 1/s, of the yaw by the magnetometer
_TILT_SIGMA_DEG = 1.0  # that is published; twice the error on synthetic carts, whose springs are ideal
_NO_FIELD = np.full(3, np.nan)


class Complementary:
    """Mahony, Hamel and Pflimlin, IEEE TAC 2008, equation 48, with the force that levels low-passed and gated.

    Without the gate a cart that speeds up would tilt the horizon. Owns attitude, bias and filtered force; its error is
    constant.
    """

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


class Vqf:
    """VQF of Laidig and Seel: levelling where gravity stands still, and a heading on top. Owns tilt, bias, heading."""

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


class AttitudeFilter:
    """Owns attitude and gyro bias; starts from what power-up found. `config.method`: `Vqf` or `Complementary`.

    Causal and without a clock: the answer depends on the samples alone. Samples that are not finite, or not newer than
    the last, are left out.
    """

    def __init__(
        self, config: AttitudeConfig, gravity_m_s2: float, R_world_body: Array, gyro_bias_rad_s: Array
    ) -> None:
        """Begin with an attitude [3, 3] and a bias [3], as `PowerUp.R_level_body` and its bias."""
        self._method: Vqf | Complementary
        if config.method == "vqf":
            self._method = Vqf(config, gravity_m_s2, R_world_body, gyro_bias_rad_s)
        else:
            self._method = Complementary(config, gravity_m_s2, R_world_body, gyro_bias_rad_s)
        self._t_ns: int | None = None
        self._field_t_ns: int | None = None

    @property
    def R_world_body(self) -> Array:
        """The attitude [3, 3] at the newest sample; the world's z is up, its yaw is zero where the filter began."""
        return self._method.R_world_body

    @property
    def gyro_bias_rad_s(self) -> Array:
        """The bias [3]."""
        return self._method.gyro_bias_rad_s

    @property
    def tilt_sigma_rad(self) -> float:
        """The standard deviation of roll, and of pitch."""
        return self._method.tilt_sigma_rad

    def add(self, sample: ImuSample, mag: MagSample | None = None) -> None:
        """Take a sample, and the magnetometer's if one came with it.

        The fields that come first are the reference: yaw is held where it was then.
        """
        if self._t_ns is not None and sample.t_ns <= self._t_ns:
            return
        gyro, accel = sample.gyro_rad_s, sample.accel_m_s2
        if not isfinite(float(gyro @ gyro + accel @ accel)):
            return
        dt_s = 0.0 if self._t_ns is None else min((sample.t_ns - self._t_ns) * _NS, _MAX_STEP_S)
        self._t_ns = sample.t_ns
        field, field_dt_s = None, 0.0
        if mag is not None and isfinite(float(mag.field_ut @ mag.field_ut)):
            field = mag.field_ut
            if self._field_t_ns is not None:
                field_dt_s = min(max(mag.t_ns - self._field_t_ns, 0) * _NS, _MAX_STEP_S)
            self._field_t_ns = mag.t_ns
        self._method.add(gyro, accel, dt_s, field, field_dt_s)

    def add_span(self, span: ImuSpan) -> Array:
        """Take many samples at once, without a magnetometer; return the attitude at each, R_world_body [N, 3, 3].

        The first sample is the state's own time: nothing is integrated up to it.
        """
        gyro, accel = span.gyro_rad_s, span.accel_m_s2
        is_good = np.isfinite(np.sum(gyro * gyro, axis=1) + np.sum(accel * accel, axis=1))
        dt_s = np.zeros(len(is_good))
        good = np.flatnonzero(is_good | (np.arange(len(is_good)) == 0))
        dt_s[good[1:]] = np.minimum(np.diff(span.t_ns[good]) * _NS, _MAX_STEP_S)
        self._t_ns = int(span.t_ns[good[-1]])
        return self._method.add_many(gyro, accel, dt_s)
