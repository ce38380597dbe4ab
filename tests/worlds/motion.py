"""Smooth exact motions with ideal and noisy inertial samples, and visual odometry made from truth, for tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vislam.core.geometry import (
    interpolate,
    invert,
    rotation_from_quaternion_xyzw,
    se3_exp,
    skew,
    so3_exp,
    so3_log,
    transform,
)
from vislam.core.messages import Array, ImuSample, ImuSpan, NavState, Tracking, VoMeasurement
from vislam.imu import ImuNoise
from worlds.parts import GRAVITY_M_S2

NS = 1_000_000_000
T0_NS = 1_403_715_273_000_000_000  # a real epoch: arithmetic on floats of seconds would show


@dataclass(frozen=True)
class Motion:
    """Position and roll-pitch-yaw as sums of two sines per axis: exact derivatives at any time."""

    position: Array  # [2, 3, 3]: per term and axis amplitude (m), angular frequency (rad/s), phase
    angles: Array  # [2, 3, 3]: the same in rad

    @staticmethod
    def random(seed: int, vigour: float = 1.0) -> Motion:
        rng = np.random.default_rng(seed)

        def terms(amplitude: float) -> Array:
            return np.stack(
                [rng.uniform(0.3, 1.0, (2, 3)) * amplitude, rng.uniform(0.4, 2.2, (2, 3)), rng.uniform(0, 6.3, (2, 3))],
                axis=-1,
            )

        return Motion(terms(0.6 * vigour), terms(0.35 * vigour))

    @staticmethod
    def _sum(terms: Array, t_s: float) -> tuple[Array, Array, Array]:
        a, w, phi = terms[..., 0], terms[..., 1], terms[..., 2]
        s, c = np.sin(w * t_s + phi), np.cos(w * t_s + phi)
        return (a * s).sum(0), (a * w * c).sum(0), (-a * w * w * s).sum(0)

    def at(self, t_s: float) -> tuple[Array, Array, Array, Array]:
        """Return T_world_body, velocity, body rate and specific force at a time in seconds."""
        p, v, a = self._sum(self.position, t_s)
        (roll, pitch, yaw), (droll, dpitch, dyaw), _ = self._sum(self.angles, t_s)
        R = so3_exp(np.array([0, 0, yaw])) @ so3_exp(np.array([0, pitch, 0])) @ so3_exp(np.array([roll, 0, 0]))
        sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
        rate = np.array(
            [droll - dyaw * sp, dpitch * cr + dyaw * sr * cp, -dpitch * sr + dyaw * cr * cp],
        )
        return transform(R, p), v, rate, R.T @ (a + np.array([0, 0, GRAVITY_M_S2]))

    def pose(self, t_s: float) -> Array:
        return self.at(t_s)[0]

    def samples(
        self,
        duration_s: float,
        rate_hz: float = 200.0,
        noise: ImuNoise | None = None,
        rng: np.random.Generator | None = None,
        gyro_bias: Array | None = None,
        accel_bias: Array | None = None,
    ) -> tuple[list[ImuSample], Array]:
        """Return samples from 0 to `duration_s` and the true biases [N, 6] at each of them."""
        count = round(duration_s * rate_hz) + 1
        times = np.arange(count) / rate_hz
        ideal = np.array([np.concatenate(self.at(t)[2:]) for t in times])
        bias = np.concatenate([np.zeros(3) if b is None else b for b in (gyro_bias, accel_bias)])
        biases = np.repeat(bias[None], count, axis=0)
        if noise is not None:
            assert rng is not None
            white = np.repeat([noise.gyroscope_noise_density, noise.accelerometer_noise_density], 3) * np.sqrt(rate_hz)
            walk = np.repeat([noise.gyroscope_random_walk, noise.accelerometer_random_walk], 3) / np.sqrt(rate_hz)
            biases = biases + np.cumsum(rng.normal(size=(count, 6)) * walk, axis=0)
            ideal = ideal + rng.normal(size=(count, 6)) * white
        values = ideal + biases
        stamps = T0_NS + np.round(times * NS).astype(np.int64)
        return [ImuSample(int(t), v[:3].copy(), v[3:].copy()) for t, v in zip(stamps, values, strict=True)], biases


@dataclass(frozen=True)
class SimulatedVision:
    """Visual odometry made from true poses: frames, keyframes, and errors of which a part is the keyframe's own."""

    rotation_sigma_rad: float = np.deg2rad(0.1)
    translation_sigma_m: float = 0.002
    shared: float = 0.5  # of the variance, the same for all motions from one keyframe
    keyframe_every: int = 8  # frames
    T_body_camera: Array | None = None  # given: directions only

    @property
    def covariance(self) -> Array:
        return np.diag(np.repeat([self.rotation_sigma_rad**2, self.translation_sigma_m**2], 3))

    def motions(self, poses: list[Array], stamps: list[int], rng: np.random.Generator) -> list[VoMeasurement]:
        """Return one motion per frame, in the manner of a front end: frame `k * keyframe_every` becomes keyframe k."""
        root = np.linalg.cholesky(self.covariance)
        exact = VoMeasurement(stamps[0], 0, np.eye(4), np.zeros((6, 6)), self.T_body_camera is None, Tracking.OK, 100)
        out = [exact]
        common = root @ rng.normal(size=6)
        for i in range(1, len(poses)):
            k = (i - 1) // self.keyframe_every
            if i > 1 and (i - 1) % self.keyframe_every == 0:
                common = root @ rng.normal(size=6)
            xi = np.sqrt(self.shared) * common + np.sqrt(1.0 - self.shared) * (root @ rng.normal(size=6))
            T = invert(poses[k * self.keyframe_every]) @ poses[i]
            out.append(relative_vo(stamps[i], k, T, self.covariance, xi, self.T_body_camera))
        return out


def to_span(samples: list[ImuSample]) -> ImuSpan:
    return ImuSpan(
        np.array([s.t_ns for s in samples], dtype=np.int64),
        np.array([s.gyro_rad_s for s in samples]),
        np.array([s.accel_m_s2 for s in samples]),
    )


def relative_vo(
    t_ns: int,
    keyframe_id: int,
    T_keyframe_body: Array,
    covariance: Array,
    xi: Array,
    T_body_camera: Array | None = None,
) -> VoMeasurement:
    """Return a motion perturbed by `xi` [6]; with a camera, only its direction of displacement is kept."""
    T = T_keyframe_body @ se3_exp(xi)
    if T_body_camera is None:
        return VoMeasurement(t_ns, keyframe_id, T, covariance, True, Tracking.OK, 100)
    T, covariance = direction_only(T, covariance, T_body_camera)
    return VoMeasurement(t_ns, keyframe_id, T, covariance, False, Tracking.OK, 100)


def direction_only(T: Array, covariance: Array, T_body_camera: Array) -> tuple[Array, Array]:
    """Return a motion of the body as one camera sees it: of the camera's displacement only the direction, unit long."""
    lever = T_body_camera[:3, 3]
    displacement = T[:3, 3] + T[:3, :3] @ lever - lever
    distance = np.linalg.norm(displacement)
    direction = displacement / distance
    across = np.eye(3) - np.outer(direction, direction)
    D = np.eye(6)
    D[3:, 3:] = T[:3, :3].T @ across @ T[:3, :3] / distance
    return transform(T[:3, :3], direction), D @ covariance @ D.T


def state_error(truth: tuple[Array, Array, Array], state: NavState) -> Array:
    """Return the 15-dim error truth minus estimate: rotation (body side), position, velocity, biases."""
    T, v, bias = truth
    R = state.T_world_body[:3, :3]
    return np.concatenate(
        [
            so3_log(R.T @ T[:3, :3]),
            T[:3, 3] - state.T_world_body[:3, 3],
            v - state.velocity_world_m_s,
            bias[:3] - state.gyro_bias_rad_s,
            bias[3:] - state.accel_bias_m_s2,
        ]
    )


def still(roll_rad: float, pitch_rad: float) -> Motion:
    """Return a body that never moves."""
    angles = np.zeros((2, 3, 3))
    angles[0] = [[roll_rad, 0.0, 0.5 * np.pi], [pitch_rad, 0.0, 0.5 * np.pi], [0.4, 0.0, 0.5 * np.pi]]
    return Motion(np.zeros((2, 3, 3)), angles)


def levelled(
    rng: np.random.Generator, T: Array, gyro_bias: Array, accel_bias: Array, bias_sigma_m_s2: float = 0.1
) -> NavState:
    """Return the state that a second of rest gives: the sum of tilt and bias is known, each alone is not."""
    sigmas = np.repeat([1e-4, 1e-4, 1e-3, 5e-4, 5e-3], 3)
    drawn = rng.normal(size=15) * sigmas
    share = rng.normal(size=3) * bias_sigma_m_s2
    up = T[:3, :3].T @ [0.0, 0.0, 1.0]
    R = T[:3, :3] @ so3_exp(-np.cross(up, share) / GRAVITY_M_S2 - drawn[:3])
    up, old_up = R.T @ [0.0, 0.0, 1.0], up
    bias = accel_bias - GRAVITY_M_S2 * (up - old_up) - drawn[12:15]  # the same force at rest
    J = np.zeros((15, 3))  # of tilt and bias by what of the bias is taken for tilt
    J[:3] = skew(up) / GRAVITY_M_S2
    J[12:15] = -GRAVITY_M_S2 * skew(up) @ J[:3]
    P = J @ J.T * bias_sigma_m_s2**2 + np.diag(sigmas**2)
    return NavState(T0_NS, transform(R, T[:3, 3]), -drawn[6:9], gyro_bias - drawn[9:12], bias, P)


@dataclass(frozen=True)
class RealMotion:
    """A real inertial recording with its true poses, both as arrays."""

    samples: list[ImuSample]
    truth_t_ns: Array
    truth_T_world_body: Array

    @staticmethod
    def euroc(folder: Path) -> RealMotion:
        imu = np.genfromtxt(folder / "mav0/imu0/data.csv", delimiter=",", skip_header=1, dtype=np.float64)
        stamps = np.genfromtxt(folder / "mav0/imu0/data.csv", delimiter=",", skip_header=1, usecols=0, dtype=np.int64)
        truth = np.genfromtxt(folder / "mav0/mocap0/data.csv", delimiter=",", skip_header=1)
        truth_t = np.genfromtxt(
            folder / "mav0/mocap0/data.csv", delimiter=",", skip_header=1, usecols=0, dtype=np.int64
        )
        T = np.tile(np.eye(4), (len(truth), 1, 1))
        T[:, :3, :3] = rotation_from_quaternion_xyzw(truth[:, [5, 6, 7, 4]])
        T[:, :3, 3] = truth[:, 1:4]
        samples = [ImuSample(int(t), row[1:4].copy(), row[4:7].copy()) for t, row in zip(stamps, imu, strict=True)]
        return RealMotion(samples, truth_t, T)

    def pose(self, t_ns: int) -> Array:
        k = int(np.clip(np.searchsorted(self.truth_t_ns, t_ns), 1, len(self.truth_t_ns) - 1))
        t0, t1 = int(self.truth_t_ns[k - 1]), int(self.truth_t_ns[k])
        return interpolate(self.truth_T_world_body[k - 1], self.truth_T_world_body[k], (t_ns - t0) / (t1 - t0))

    def velocity(self, t_ns: int, half_ns: int = 50_000_000) -> Array:
        ahead, behind = self.pose(t_ns + half_ns), self.pose(t_ns - half_ns)
        return (ahead[:3, 3] - behind[:3, 3]) / (2e-9 * half_ns)


EUROC_NOISE = ImuNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3, 200.0)
