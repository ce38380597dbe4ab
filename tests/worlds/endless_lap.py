"""An endless run around the same lap, made keyframe by keyframe so that an hour needs no more memory than a minute."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.geometry import invert, se3_exp, transform, transform_points
from vislam.core.messages import (
    ImuSpan,
    KeyframePacket,
    LoopEdge,
    NavState,
    Observations,
    Tracking,
    VoMeasurement,
)
from vislam.imu import ImuNoise
from worlds.fake_window import FakeWindow
from worlds.lap import EUROC_NOISE, LAP_S, T_BODY_CAM0, position, rotation
from worlds.parts import EUROC_CAMERA, along_x, bare_keyframe, derivative, ideal_imu, on_walls, rig_of

Array = NDArray[np.float64]

_IMU_HZ = 200
STEREO = rig_of("stereo", EUROC_CAMERA, T_BODY_CAM0, along_x(0.11))
_ROOM_M = np.array([8.0, 7.0, 3.0])  # half extents of the walls that carry the landmarks


@dataclass(frozen=True, slots=True, eq=False)
class LapStep:
    """One keyframe, the loops that end with it, and the truth."""

    packet: KeyframePacket
    edges: list[LoopEdge]
    truth: Array  # [4, 4]


class LapWorld:
    """The motion of `lap.World`, forever: stereo tracks, odometry, IMU with walking biases, loops to old laps."""

    def __init__(
        self,
        keyframe_hz: float = 2.0,
        seed: int = 1,
        tracks: int = 80,
        loop_every: int = 10,
        noise: ImuNoise = EUROC_NOISE,
        motion: tuple[Callable[[Array], Array], Callable[[Array], Rotation], float] = (position, rotation, LAP_S),
    ) -> None:
        """Prepare one lap; a lap must hold a whole number of keyframes. `tracks` 0: no observations.

        `motion` is position and rotation by the time in seconds, both periodic, and their period.
        """
        print(f"lap world seed {seed}")
        self.rng = np.random.default_rng(seed)
        self.keyframe_hz, self.tracks, self.loop_every, self.noise = keyframe_hz, tracks, loop_every, noise
        self.imu_hz = _IMU_HZ
        self.position, self.rotation, self.lap_s = motion
        self.per_lap = round(self.lap_s * keyframe_hz)
        times = np.arange(self.per_lap) / keyframe_hz
        R, p = self.rotation(times).as_matrix(), self.position(times)
        self.truth = np.stack([transform(R[k], p[k]) for k in range(self.per_lap)])
        self.velocity = derivative(self.position, times, 1e-3)
        self._make_imu()
        self.vo_sigmas = np.repeat([np.deg2rad(0.15), 0.004], 3)
        self.landmarks = on_walls(self.rng, 3000, _ROOM_M)
        self.views = [[_seen(T @ T_cam, self.landmarks) for T_cam in STEREO.T_body_cams] for T in self.truth]

    def _make_imu(self) -> None:
        t = np.arange(round(self.lap_s * _IMU_HZ) + 1) / _IMU_HZ
        self.gyro, self.accel = ideal_imu(self.position, self.rotation, t)

    def initial_state(self) -> NavState:
        """The true state of keyframe 0 with biases unknown."""
        sigmas = np.repeat([np.deg2rad(0.5), 1e-3, 0.05, 0.02, 0.15], 3)
        return NavState(0, self.truth[0], self.velocity[0], np.zeros(3), np.zeros(3), np.diag(sigmas**2))

    def steps(self, count: int) -> Iterator[LapStep]:
        """Yield keyframes."""
        bias = np.array([0.01, -0.015, 0.008, 0.08, -0.05, 0.06])
        self._live: dict[int, int] = {}  # landmark to track
        self._next_track = 0
        for k in range(count):
            t_ns = self.t_ns(k)
            imu = None
            if k:
                imu, bias = self._span(k, bias)
            packet = KeyframePacket(bare_keyframe(k, t_ns), self._vo(k), self._observe(k % self.per_lap), imu)
            yield LapStep(packet, self._loops(k), self.truth[k % self.per_lap])

    def t_ns(self, k: int) -> int:
        """Stamp of keyframe k."""
        return round(k / self.keyframe_hz * 1e9)

    def _span(self, k: int, bias: Array) -> tuple[ImuSpan, Array]:
        per = round(_IMU_HZ / self.keyframe_hz)
        n = np.arange((k - 1) * per, k * per + 1)
        at, noise, rng = n % (round(self.lap_s * _IMU_HZ)), self.noise, self.rng
        walk = np.repeat([noise.gyroscope_random_walk, noise.accelerometer_random_walk], 3) / np.sqrt(_IMU_HZ)
        white = np.repeat([noise.gyroscope_noise_density, noise.accelerometer_noise_density], 3) * np.sqrt(_IMU_HZ)
        biases = bias + np.cumsum(rng.normal(size=(len(n), 6)) * walk, axis=0)
        values = np.hstack([self.gyro[at], self.accel[at]]) + biases + rng.normal(size=(len(n), 6)) * white
        t_ns = np.round(n * (1e9 / _IMU_HZ)).astype(np.int64)
        return ImuSpan(t_ns, values[:, :3].copy(), values[:, 3:].copy()), biases[-1]

    def _vo(self, k: int) -> VoMeasurement:
        covariance = np.diag(self.vo_sigmas**2)
        if k == 0:
            return VoMeasurement(0, 0, np.eye(4), covariance, True, Tracking.OK, 100)
        T = invert(self.truth[(k - 1) % self.per_lap]) @ self.truth[k % self.per_lap]
        T = T @ se3_exp(self.rng.normal(size=6) * self.vo_sigmas)
        return VoMeasurement(self.t_ns(k), k - 1, T, covariance, True, Tracking.OK, 100)

    def _loops(self, k: int) -> list[LoopEdge]:
        """A loop to the same place of any earlier lap."""
        laps = k // self.per_lap
        if not self.loop_every or k % self.loop_every or laps < 1:
            return []
        old = k - self.per_lap * int(self.rng.integers(1, laps + 1))
        sigmas = np.repeat([0.005, 0.02], 3)
        T = se3_exp(self.rng.normal(size=6) * sigmas)
        return [LoopEdge(k, old, k, T, np.diag(sigmas**2), True, 60, 0.5)]

    def _observe(self, place: int) -> Observations:
        left, right = self.views[place]
        visible = np.flatnonzero(np.isfinite(left[:, 0]) & np.isfinite(right[:, 0]))
        live = {i: self._live[i] for i in visible.tolist() if i in self._live}
        for i in self.rng.permutation(visible).tolist():
            if len(live) >= self.tracks:
                break
            if i not in live:
                live[i] = self._next_track
                self._next_track += 1
        self._live = live
        chosen = np.array(sorted(live), dtype=np.int64)
        ids = np.array([live[i] for i in chosen.tolist()], dtype=np.int64)
        noise = self.rng.normal(size=(2, len(chosen), 2)) * 1.0
        return Observations(ids, left[chosen] + noise[0], right[chosen] + noise[1] * np.array([0.5, 1.0]))


def window_of_truth(world: LapWorld, count: int) -> FakeWindow:
    """Return a window that costs nothing, so that what is measured is the graph."""
    laps = -(-count // world.per_lap)
    zeros = np.zeros((round(count * world.imu_hz / world.keyframe_hz) + 1, 3))
    motion = SimpleNamespace(
        truth=np.tile(world.truth, (laps, 1, 1)),
        velocity=np.tile(world.velocity, (laps, 1)),
        true_gyro_bias=zeros,
        true_accel_bias=zeros,
        vo_sigma_rad=world.vo_sigmas[0],
        vo_sigma_m=world.vo_sigmas[3],
        imu_hz=world.imu_hz,
        keyframe_hz=world.keyframe_hz,
        t_ns=world.t_ns,
        seed=1,
    )
    return FakeWindow(motion, keyframes=15)


def _seen(T_world_cam: Array, points: Array) -> Array:
    """Pixels [N, 2] of points, NaN where they are not seen."""
    in_camera = transform_points(invert(T_world_cam), points)
    pixels = EUROC_CAMERA.project(in_camera)
    pixels[~EUROC_CAMERA.contains(pixels) | (in_camera[:, 2] < 0.3)] = np.nan
    return pixels
