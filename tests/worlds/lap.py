"""A small exact world for the graph's tests: analytic periodic motion, noisy IMU, visual odometry and loop edges."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.camera import Rig
from vislam.core.geometry import invert, se3_exp, transform
from vislam.core.messages import (
    Frame,
    ImuSpan,
    Keyframe,
    KeyframePacket,
    LoopEdge,
    NavState,
    Observations,
    Tracking,
    VoMeasurement,
)
from vislam.imu import ImuNoise
from worlds.motion import direction_only
from worlds.parts import EUROC_CAMERA, R_BODY_CAM, derivative, ideal_imu

Array = NDArray[np.float64]

EUROC_NOISE = ImuNoise(1.7e-4, 2.0e-3, 1.9393e-5, 3.0e-3, 200.0)
LAP_S = 20.0  # the motion repeats after this time, so loops are exact
T_BODY_CAM0 = transform(R_BODY_CAM, np.array([0.08, 0.03, -0.02]))

RIG = Rig((EUROC_CAMERA,), (T_BODY_CAM0,))


def position(t: Array, scale_m: float = 3.0) -> Array:
    w = 2.0 * np.pi / LAP_S
    return np.stack(
        [scale_m * np.sin(w * t), 0.6 * scale_m * np.sin(2 * w * t + 0.3), 0.1 * scale_m * np.sin(3 * w * t)], axis=-1
    )


def rotation(t: Array) -> Rotation:
    w = 2.0 * np.pi / LAP_S
    yaw, pitch, roll = 1.2 * np.sin(w * t), 0.2 * np.sin(4 * w * t), 0.15 * np.sin(5 * w * t + 0.5)
    return Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1))


@dataclass
class World:
    """One simulated run with keyframes at `keyframe_hz`; `packets()` and `loops()` are what the graph gets."""

    duration_s: float = 60.0
    keyframe_hz: float = 5.0
    imu_hz: float = 200.0
    seed: int = 1
    scale_m: float = 3.0
    noise: ImuNoise = EUROC_NOISE
    gyro_bias: Array = field(default_factory=lambda: np.array([0.01, -0.015, 0.008]))
    accel_bias: Array = field(default_factory=lambda: np.array([0.08, -0.05, 0.06]))
    vo_sigma_rad: float = np.deg2rad(0.15)
    vo_sigma_m: float = 0.004
    mono: bool = False
    walk: bool = True  # biases walk as `noise` says

    def __post_init__(self) -> None:
        print(f"world seed {self.seed}")
        self.rng = np.random.default_rng(self.seed)
        self.count = round(self.duration_s * self.keyframe_hz) + 1
        self.times_s = np.arange(self.count) / self.keyframe_hz
        R = rotation(self.times_s).as_matrix()
        p = position(self.times_s, self.scale_m)
        self.truth = np.stack([transform(R[k], p[k]) for k in range(self.count)])
        self.velocity = derivative(lambda t: position(t, self.scale_m), self.times_s, 1e-3)
        self._make_imu()
        self.vo_covariance = np.diag([self.vo_sigma_rad**2] * 3 + [self.vo_sigma_m**2] * 3)

    def _make_imu(self) -> None:
        dt = 1.0 / self.imu_hz
        t = np.arange(round(self.duration_s * self.imu_hz) + 1) * dt
        gyro, force = ideal_imu(lambda s: position(s, self.scale_m), rotation, t)
        n = self.noise
        walk = float(self.walk) * np.sqrt(dt)
        self.true_gyro_bias = self.gyro_bias + np.cumsum(
            self.rng.normal(size=(len(t), 3)) * n.gyroscope_random_walk * walk, 0
        )
        self.true_accel_bias = self.accel_bias + np.cumsum(
            self.rng.normal(size=(len(t), 3)) * n.accelerometer_random_walk * walk, 0
        )
        self.imu_t_ns = np.round(t * 1e9).astype(np.int64)
        white = 1.0 / np.sqrt(dt)
        self.gyro = gyro + self.true_gyro_bias + self.rng.normal(size=(len(t), 3)) * n.gyroscope_noise_density * white
        self.accel = (
            force + self.true_accel_bias + self.rng.normal(size=(len(t), 3)) * n.accelerometer_noise_density * white
        )

    def t_ns(self, k: int) -> int:
        return round(self.times_s[k] * 1e9)

    def span(self, k: int) -> ImuSpan:
        """Samples between keyframes k - 1 and k, both ends included."""
        per = self.imu_hz / self.keyframe_hz
        a, b = round((k - 1) * per), round(k * per) + 1
        return ImuSpan(self.imu_t_ns[a:b].copy(), self.gyro[a:b].copy(), self.accel[a:b].copy())

    def initial_state(self, sigma_bias_gyro: float = 0.02, sigma_bias_accel: float = 0.15) -> NavState:
        """The state at keyframe 0 as a good initialisation reports it: true pose, biases unknown."""
        sigmas = np.array(
            [np.deg2rad(0.5)] * 2 + [1e-3] + [1e-3] * 3 + [0.05] * 3 + [sigma_bias_gyro] * 3 + [sigma_bias_accel] * 3
        )
        return NavState(0, self.truth[0], self.velocity[0], np.zeros(3), np.zeros(3), np.diag(sigmas**2))

    def vo(self, k: int, lost: bool = False) -> VoMeasurement:
        if k == 0:
            return VoMeasurement(self.t_ns(0), 0, np.eye(4), self.vo_covariance, True, Tracking.OK, 0)
        xi = self.rng.normal(size=6) * np.sqrt(np.diag(self.vo_covariance))
        if lost:
            return VoMeasurement(self.t_ns(k), k - 1, None, np.eye(6), not self.mono, Tracking.LOST, 0)
        T = invert(self.truth[k - 1]) @ self.truth[k] @ se3_exp(xi)
        if not self.mono:
            return VoMeasurement(self.t_ns(k), k - 1, T, self.vo_covariance, True, Tracking.OK, 100)
        T, covariance = unscaled(T, self.vo_covariance)
        return VoMeasurement(self.t_ns(k), k - 1, T, covariance, False, Tracking.OK, 100)

    def packet(self, k: int, lost: bool = False, imu: bool = True, at_rest: bool = False) -> KeyframePacket:
        return packet_of(k, self.t_ns(k), self.vo(k, lost), self.span(k) if imu and k else None, at_rest)

    def loop(self, edge_id: int, i: int, j: int, sigma_rad: float = 0.005, sigma_m: float = 0.02) -> LoopEdge:
        covariance = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
        T = invert(self.truth[i]) @ self.truth[j] @ se3_exp(self.rng.normal(size=6) * np.sqrt(np.diag(covariance)))
        if self.mono:
            T, covariance = unscaled(T, covariance)
        return LoopEdge(edge_id, i, j, T, covariance, not self.mono, 60, 0.5)

    def false_loop(self, edge_id: int, i: int, j: int) -> LoopEdge:
        """A gross outlier: claims two different places are about the same one."""
        xi = np.concatenate([self.rng.normal(size=3) * 0.3, self.rng.normal(size=3) * 0.5])
        covariance = np.diag([0.005**2] * 3 + [0.02**2] * 3)
        return LoopEdge(edge_id, i, j, se3_exp(xi), covariance, True, 40, 0.4)

    def dead_reckoning(self, packets: list[KeyframePacket]) -> Array:
        T = [self.truth[0]]
        for packet in packets[1:]:
            assert packet.vo.T_keyframe_body is not None
            T.append(T[-1] @ packet.vo.T_keyframe_body)
        return np.stack(T)


def unscaled(T_a_b: Array, covariance: Array) -> tuple[Array, Array]:
    """Turn a metric body motion into a mono one: the unit direction of cam0's motion in the axes of body a."""
    return direction_only(T_a_b, covariance, T_BODY_CAM0)


def packet_of(
    k: int, t_ns: int, vo: VoMeasurement, imu: ImuSpan | None = None, at_rest: bool = False
) -> KeyframePacket:
    frame = Frame(t_ns, k, (np.zeros((2, 2), np.uint8),))
    keyframe = Keyframe(k, t_ns, frame, np.zeros((0, 2)), np.zeros((0, 32), np.uint8), None)
    observations = Observations(np.zeros(0, np.int64), np.zeros((0, 2)))
    return KeyframePacket(keyframe, vo, observations, imu, None, at_rest)


def rmse_m(estimate: Array, truth: Array) -> float:
    """Position error without alignment (the graph starts at the true pose)."""
    return float(np.sqrt(np.mean(np.sum((estimate[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))


def with_vo(packet: KeyframePacket, **changes: object) -> KeyframePacket:
    return replace(packet, vo=replace(packet.vo, **changes))
