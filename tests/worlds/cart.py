"""A synthetic cart for attitude: bursts of acceleration, turns, slow tilt, and sensors like those of a GY-85."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from vislam.core.messages import Array, ImuSpan

FIELD_UT = np.array([20.0, 0.0, -42.0])


@dataclass(frozen=True, eq=False)
class Cart:
    """A drive of 120 s at 200 Hz unless asked otherwise."""

    span: ImuSpan
    R_world_body: Array  # [N, 3, 3]
    field_ut: Array  # [N, 3]
    is_disturbed: Array  # [N] bool: a magnet is near

    @staticmethod
    def drive(
        seed: int, duration_s: float = 120.0, rate_hz: float = 200.0, gyro_bias_deg_s: float = 0.05, shake: float = 0.0
    ) -> Cart:
        rng = np.random.default_rng(seed)
        count = round(duration_s * rate_hz)
        t = np.arange(count) / rate_hz
        ahead, turning = np.zeros(count), np.zeros(count)
        speed, k = 0.0, round(2.0 * rate_hz)
        while k < count:
            size = rng.uniform(0.5, 1.2)
            burst_s = rng.uniform(0.5, 1.0) if speed < 0.4 else speed / size
            size = size if speed < 0.4 else -size
            steps = round(burst_s * rate_hz)
            ahead[k : k + steps] = size
            speed = max(speed + size * burst_s, 0.0)
            k += steps + round(rng.uniform(2.0, 6.0) * rate_hz)
        k = round(5.0 * rate_hz)
        while k < count:
            steps = round(rng.uniform(1.0, 4.0) * rate_hz)
            turning[k : k + steps] = rng.uniform(-0.6, 0.6)
            k += steps + round(rng.uniform(1.0, 4.0) * rate_hz)
        ahead, turning = gaussian_filter1d(ahead, 10), gaussian_filter1d(turning, 20)
        velocity, yaw = np.cumsum(ahead) / rate_hz, np.cumsum(turning) / rate_hz
        pitch = np.deg2rad(1.0) * np.sin(2 * np.pi * t / 17 + rng.uniform(0, 6))
        pitch += np.deg2rad(0.3) * np.sin(2 * np.pi * t / 2.3)
        roll = np.deg2rad(1.0) * np.sin(2 * np.pi * t / 23 + 1.0)
        R = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()
        steps_R = np.einsum("nji,njk->nik", R[:-1], R[1:])
        rate = Rotation.from_matrix(steps_R).as_rotvec() * rate_hz
        rate = np.vstack([rate[:1], rate])
        c, s = np.cos(yaw), np.sin(yaw)
        centripetal = velocity * turning
        force_world = np.stack([ahead * c - centripetal * s, ahead * s + centripetal * c, np.full(count, 9.81)], axis=1)
        gyro_bias = np.deg2rad(gyro_bias_deg_s) * rng.standard_normal(3)
        walk = np.cumsum(2e-5 / np.sqrt(rate_hz) * rng.standard_normal((count, 3)), axis=0)
        gyro_noise = np.deg2rad(0.03) * np.sqrt(0.5 * rate_hz) * rng.standard_normal((count, 3))
        gyro = rate + gyro_bias + walk + gyro_noise
        accel = np.einsum("nji,nj->ni", R, force_world) + 0.05 * rng.standard_normal(3)
        accel += np.hypot(0.05, shake) * rng.standard_normal((count, 3))
        is_disturbed = (t > 60.0) & (t < 75.0)
        field = np.einsum("nji,j->ni", R, FIELD_UT) + 0.4 * rng.standard_normal((count, 3))
        field[is_disturbed] += [15.0, 25.0, 5.0]
        return Cart(ImuSpan(np.round(t * 1e9).astype(np.int64), gyro, accel), R, field, is_disturbed)

    def tilt_deg(self, R_world_body: Array) -> Array:
        """Return the angle [N] between the true vertical and that of an estimate [N, 3, 3]."""
        cosine = np.sum(R_world_body[:, 2] * self.R_world_body[:, 2], axis=1)
        return np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))

    def yaw_deg(self, R_world_body: Array) -> Array:
        """Return the error of yaw [N]."""
        off = np.einsum("nij,nkj->nik", R_world_body, self.R_world_body)
        return np.abs(np.rad2deg(np.arctan2(off[:, 1, 0], off[:, 0, 0])))
