"""Trials of BROAD (Laidig et al. 2021): a board in the hand, with optical attitude."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from vislam.config import AttitudeConfig, PowerUpConfig
from vislam.core.messages import Array, ImuSample, ImuSpan, MagSample
from vislam.imu import AttitudeFilter, PowerUp, power_up
from worlds.parts import GRAVITY_M_S2

_START = 600  # samples at rest, 2.1 s


def rms(values: Array) -> Array:
    return np.sqrt(np.mean(values**2, axis=-1))


@dataclass(frozen=True, eq=False)
class Trial:
    """One recording of about 200 s at 286 Hz; its world is east, north, up."""

    span: ImuSpan
    field_ut: Array  # [N, 3]
    R_world_body: Array  # [N, 3, 3] where `is_used`
    is_used: Array  # [N] bool: it moves, and the cameras saw it
    rate_hz: float

    @staticmethod
    def read(path: Path) -> Trial:
        data = loadmat(path, squeeze_me=True)
        gyro, accel, field, wxyz = (
            np.ascontiguousarray(data[k]) for k in ("imu_gyr", "imu_acc", "imu_mag", "opt_quat")
        )
        rate_hz = float(data["sampling_rate"])
        is_used = data["movement"].astype(bool) & np.isfinite(wxyz).all(axis=1)
        R = np.full((len(gyro), 3, 3), np.nan)
        R[is_used] = Rotation.from_quat(wxyz[is_used][:, [1, 2, 3, 0]]).as_matrix()
        t_ns = np.round(np.arange(len(gyro)) * 1e9 / rate_hz).astype(np.int64)
        return Trial(ImuSpan(t_ns, gyro, accel), field, R, is_used, rate_hz)

    def estimate(self, attitude: AttitudeFilter) -> tuple[Array, Array]:
        """Return what the filter has, R_world_body [N, 3, 3], and what it says of its tilt, sigma [N] in rad."""
        R, sigma_rad = np.empty((len(self.field_ut), 3, 3)), np.empty(len(self.field_ut))
        for k, t_ns in enumerate(self.span.t_ns.tolist()):
            sample = ImuSample(t_ns, self.span.gyro_rad_s[k], self.span.accel_m_s2[k])
            attitude.add(sample, MagSample(t_ns, self.field_ut[k]))
            R[k], sigma_rad[k] = attitude.R_world_body, attitude.tilt_sigma_rad
        return R, sigma_rad


def started(trial: Trial, config: AttitudeConfig) -> AttitudeFilter:
    """Return a filter that begins with the first two seconds: their force is up, their field lies to the north."""
    span, field = trial.span, trial.field_ut[:_START].mean(axis=0)
    first = ImuSpan(span.t_ns[:_START], span.gyro_rad_s[:_START], span.accel_m_s2[:_START])
    zero = power_up(first, PowerUpConfig(), GRAVITY_M_S2)
    up = first.accel_m_s2.mean(axis=0)
    east = np.cross(field, up)
    R = np.stack([east, np.cross(up, east), up])
    R /= np.linalg.norm(R, axis=1, keepdims=True)
    bias = zero.gyro_bias_rad_s if isinstance(zero, PowerUp) else np.zeros(3)
    return AttitudeFilter(config, GRAVITY_M_S2, R, bias)


def errors_deg(trial: Trial, R_world_body: Array) -> Array:
    """Return the whole error, that of the heading and the inclination [3, N]; they are those of BROAD's own script."""
    R = R_world_body[trial.is_used] @ trial.R_world_body[trial.is_used].transpose(0, 2, 1)
    _, _, z, w = np.abs(Rotation.from_matrix(R).as_quat()).T
    halves = np.stack([np.arccos(np.clip(w, 0.0, 1.0)), np.arctan2(z, w), np.arccos(np.clip(np.hypot(w, z), 0.0, 1.0))])
    return np.rad2deg(2.0 * halves)
