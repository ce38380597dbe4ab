"""Random starts of one camera with an IMU among points: exact truth, pixel noise, wrong tracks, visual rotations."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vislam.config import ImuConfig, InitConfig, MachineConfig
from vislam.core.geometry import invert, so3_exp, transform, transform_points
from vislam.core.messages import Array, ImuSample, NavState, Observations, Tracking, VoMeasurement
from vislam.frontend.start import Initialisation, Initialiser
from vislam.imu import ImuBuffer, ImuNoise
from worlds.motion import NS, T0_NS, Motion
from worlds.parts import EUROC_CAMERA, GRAVITY_M_S2, R_BODY_CAM

NOISE = ImuNoise(1.7e-4, 2.0e-3, 2e-5, 3e-3, 200.0)  # EuRoC's ADIS16448
CAMERA = EUROC_CAMERA
T_BODY_CAM = transform(
    R_BODY_CAM @ so3_exp(np.array([0.05, -0.03, 0.02])),
    np.array([0.07, -0.02, 0.03]),
)
KINDS = ("static", "moving", "gentle", "rotation", "uniform", "accelerating")

State = tuple[Array, Array, Array, Array]  # T_world_body, velocity, body rate, specific force


@dataclass
class Start:
    """One random start: what the sensors and the front end give, frame by frame, and the truth."""

    kind: str
    seed: int
    duration_s: float = 6.0
    frame_ns: int = 50_000_000
    pixel_sigma: float = 0.7
    outliers: float = 0.05
    rotation_sigma_rad: float = 5e-4
    offset_s: float = 0.0  # what has to be added to the camera's stamps
    tracks: int = 120
    noise: ImuNoise = NOISE
    told_sigma: float | None = None  # of pixels; None: the true one
    shaken: tuple[float, float] | None = None  # until these seconds the IMU feels motion by this factor
    gyro_bias: Array = field(init=False)
    accel_bias: Array = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, KINDS.index(self.kind)])
        self.gyro_bias, self.accel_bias = rng.normal(0.0, 0.04, 3), rng.normal(0.0, 0.08, 3)
        self.at = self._motion(rng)
        self.buffer = ImuBuffer(ImuConfig(), MachineConfig())
        self.samples = self._samples(rng)
        for sample in self.samples:
            self.buffer.add(sample)
        self.stamps = [
            T0_NS + 100_000_000 + self.frame_ns * k for k in range(round((self.duration_s - 0.3) * NS / self.frame_ns))
        ]
        self._see(rng)

    def _motion(self, rng: np.random.Generator) -> Callable[[float], State]:
        """Return the motion; all but rest hold what a hand, a cart or a drone may do."""
        if self.kind in ("moving", "gentle"):
            return Motion.random(
                int(rng.integers(1 << 31)), rng.uniform(0.8, 1.5) if self.kind == "moving" else 0.35
            ).at
        turning = Motion.random(int(rng.integers(1 << 31)), 1.0)
        R0 = so3_exp(rng.normal(0.0, 0.2, 3))
        velocity, acceleration = rng.normal(0.0, 0.7, 3), rng.normal(0.0, 0.5, 3)

        def at(t: float) -> State:
            up = np.array([0.0, 0.0, GRAVITY_M_S2])
            if self.kind == "static":
                return transform(R0, np.zeros(3)), np.zeros(3), np.zeros(3), R0.T @ up
            if self.kind == "rotation":
                T, _, rate, _ = turning.at(t)
                R = np.ascontiguousarray(T[:3, :3])
                return transform(R, np.zeros(3)), np.zeros(3), rate, R.T @ up
            if self.kind == "uniform":
                return transform(R0, velocity * t), velocity, np.zeros(3), R0.T @ up
            p, v = velocity * t + 0.5 * acceleration * t * t, velocity + acceleration * t
            return transform(R0, p), v, np.zeros(3), R0.T @ (up + acceleration)

        return at

    def _samples(self, rng: np.random.Generator) -> list[ImuSample]:
        count, rate = round(self.duration_s * 200) + 1, 200.0
        white = np.repeat([self.noise.gyroscope_noise_density, self.noise.accelerometer_noise_density], 3) * np.sqrt(
            rate
        )
        values = np.array([np.concatenate(self.at(k / rate)[2:]) for k in range(count)])
        if self.shaken is not None:
            until_s, factor = self.shaken
            for k in range(round(until_s * rate)):
                up = self.at(k / rate)[0][2, :3] * GRAVITY_M_S2
                values[k, 3:] = up + factor * (values[k, 3:] - up)
        values += np.concatenate([self.gyro_bias, self.accel_bias]) + rng.normal(size=(count, 6)) * white
        return [ImuSample(T0_NS + 5_000_000 * k, v[:3].copy(), v[3:].copy()) for k, v in enumerate(values)]

    def pose(self, stamp_ns: int) -> Array:
        """Return the true pose when the camera says `stamp_ns`."""
        return self.at((stamp_ns - T0_NS) / NS + self.offset_s)[0]

    def _see(self, rng: np.random.Generator) -> None:
        """Project points into every frame; odometry's rotations come with noise that motions of a keyframe share."""
        middle = self.pose(self.stamps[0]) @ T_BODY_CAM
        count = 900
        ray = np.column_stack([rng.uniform(-2.5, 2.5, count), rng.uniform(-1.8, 1.8, count), np.ones(count)])
        points = transform_points(middle, ray * rng.uniform(1.5, 8.0, count)[:, None])
        poses = [self.pose(t) for t in self.stamps]
        self.frames: list[tuple[VoMeasurement, Observations, bool]] = []
        ids, wrong = np.full(count, -1), np.zeros((count, 2))
        next_id, before = 0, np.full((count, 2), np.nan)
        shared = rng.normal(0.0, self.rotation_sigma_rad, 3)
        for k, T in enumerate(poses):
            exact = CAMERA.project(transform_points(invert(T @ T_BODY_CAM), points))
            inside = CAMERA.contains(exact, 4.0)
            ids[~inside] = -1
            keyframe = max(k - 1, 0) // 8 * 8
            if k == keyframe + 1:
                shared = rng.normal(0.0, self.rotation_sigma_rad, 3)
            if k % 8 == 0:  # keyframes take new corners in
                free = np.flatnonzero(inside & (ids < 0))
                fresh = free[: max(self.tracks - int((ids >= 0).sum()), 0)]
                ids[fresh] = next_id + np.arange(len(fresh))
                next_id += len(fresh)
                wrong[fresh] = 0.0
            followed = np.flatnonzero(ids >= 0)
            slips = followed[rng.uniform(size=len(followed)) < self.outliers / 10.0]
            wrong[slips] += rng.normal(0.0, 6.0, (len(slips), 2))  # a slipped track stays wrong
            seen = exact[followed] + wrong[followed] + rng.normal(0.0, self.pixel_sigma, (len(followed), 2))
            kf_T = poses[keyframe]
            R = (invert(kf_T) @ T)[:3, :3] @ so3_exp(rng.normal(0.0, self.rotation_sigma_rad, 3) + shared)
            R = np.eye(3) if k == 0 else R
            sigma2 = 2.0 * self.rotation_sigma_rad**2
            vo = VoMeasurement(
                self.stamps[k], keyframe // 8, transform(np.ascontiguousarray(R), np.zeros(3)), np.eye(6) * sigma2,
                False, Tracking.OK, len(followed),
            )  # fmt: skip
            flow = np.linalg.norm(exact - before, axis=1)[followed]
            still = k > 0 and bool(np.isfinite(flow).any()) and float(np.nanmedian(flow)) < 0.3
            before = exact
            self.frames.append((vo, Observations(ids[followed].astype(np.int64), seen), still))

    def run(self, initialiser: Initialiser) -> tuple[Initialisation, list[Initialisation]]:
        """Feed until a start is settled; return the newest start, or the last answer where there is none, and all."""
        answers: list[Initialisation] = []
        for i, (vo, observations, still) in enumerate(self.frames):
            span = None if i == 0 else self.buffer.span(self.stamps[i - 1], self.stamps[i])
            answers.append(initialiser.add(span, vo, still, observations))
            if answers[-1].first is not None and answers[-1].is_settled:
                break
        starts = [answer for answer in answers if answer.first is not None]
        return (starts or answers)[-1], answers

    def tilt_error_rad(self, state: NavState) -> float:
        """Return the angle between the true and the estimated vertical, in the body."""
        return float(np.arccos(np.clip(state.T_world_body[2, :3] @ self.pose(state.t_ns)[2, :3], -1.0, 1.0)))

    def scale_error(self, found: Initialisation) -> float:
        """Return estimated over true length of the displacements from the first node, minus one."""
        assert found.T_odom_body is not None
        T_true = [self.pose(t) for t in found.t_ns]
        true = np.array([T[:3, 3] - T_true[0][:3, 3] for T in T_true])
        R_odom = found.T_odom_body[0, :3, :3] @ T_true[0][:3, :3].T
        estimated = found.T_odom_body[:, :3, 3] - found.T_odom_body[0, :3, 3]
        aligned = true @ R_odom.T
        return float(np.sum(aligned * estimated) / np.sum(aligned**2) - 1.0)


def initialiser(start: Start, config: InitConfig | None = None) -> Initialiser:
    return Initialiser(
        config or InitConfig(), start.noise, GRAVITY_M_S2, T_BODY_CAM, CAMERA, start.told_sigma or start.pixel_sigma
    )
