"""Points around a path, a camera that follows them, and a run of the tight filter over what it sees, for tests."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import EkfConfig
from vislam.core import Array, FurtherTracks, ImuSample, NavState, Observations, Tracking, VoMeasurement
from vislam.core.camera import Rig
from vislam.core.geometry import invert, so3_exp, transform
from vislam.ekf import MsckfEkf
from vislam.imu import ImuNoise
from worlds.motion import NS, T0_NS, Motion, state_error
from worlds.parts import EUROC_CAMERA, MACHINE, R_BODY_CAM, along_x, on_walls, rig_of
from worlds.room import Followed

CHEAP = ImuNoise(1e-3, 1e-2, 1e-4, 1e-3, 200.0)
SIGMAS = np.repeat([0.02, 0.001, 0.05, 0.02, 0.1], 3)
CAMERA = replace(EUROC_CAMERA, distortion="radtan", coefficients=(-0.28, 0.07, 2e-4, 2e-5))
# z of the camera looks along x of the body, a little turned
R_BODY_TURNED = R_BODY_CAM @ so3_exp(np.array([0.05, -0.1, 0.02]))
T_BODY_CAM = transform(R_BODY_TURNED, np.array([0.07, 0.03, -0.02]))
REAR_TURN = transform(so3_exp(np.array([0.0, 0.0, np.pi])), np.array([-0.1, 0.02, 0.03]))
MONO, STEREO, RGBD = (rig_of(kind, CAMERA, T_BODY_CAM, along_x(0.11)) for kind in ("mono", "stereo", "rgbd"))
REAR = Rig(MONO.cameras * 2, (T_BODY_CAM, REAR_TURN @ T_BODY_CAM))  # and a camera that looks back


@dataclass
class Landmarks:
    """Points on the walls of a room, followed while they are in the image; ids change when they come back."""

    rig: Rig
    rng: np.random.Generator
    count: int = 1500
    half_m: Array = field(default_factory=lambda: np.array([6.0, 6.0, 3.0]))
    tracks: int = 200
    sigma_px: float = 1.0
    outliers: float = 0.0  # of the observations
    readout_s: float = 0.0
    depth_sigma_rho: float = 3e-3
    centre: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        self.points = on_walls(self.rng, self.count, self.half_m) + self.centre
        self._ids: NDArray[np.int64] = np.full(self.count, -1, dtype=np.int64)
        self._next = 0
        self._further = {k: Followed(self.tracks, self.sigma_px, k, k << 40) for k in self.rig.further}

    def _project(self, T_world_body: Array, cam: int) -> Array:
        T = invert(T_world_body @ self.rig.T_body_cams[cam])
        return self.rig.cameras[cam].project(self.points @ T[:3, :3].T + T[:3, 3])

    def see(self, pose_at, t_s: float, keyframe: bool) -> Observations:  # type: ignore[no-untyped-def]
        """Return what is seen at a time; `pose_at` is called again for the rows of a rolling shutter."""
        camera = self.rig.cameras[0]
        pixels = self._project(pose_at(t_s), 0)
        visible = camera.contains(np.nan_to_num(pixels, nan=-1.0), 5.0)
        self._ids[~visible] = -1
        free = self.tracks - int((self._ids >= 0).sum())
        new = np.flatnonzero(visible & (self._ids < 0))
        new = self.rng.permutation(new)[: max(free, 0)]
        self._ids[new] = self._next + np.arange(len(new))
        self._next += len(new)
        seen = np.flatnonzero(self._ids >= 0)
        if self.readout_s:
            for k in seen:
                for _ in range(3):
                    row = pixels[k, 1] / (camera.height - 1.0) - 0.5
                    T = invert(pose_at(t_s + row * self.readout_s) @ self.rig.T_body_cams[0])
                    pixels[k] = camera.project((T[:3, :3] @ self.points[k] + T[:3, 3])[None])[0]
        noisy = pixels[seen] + self.rng.normal(size=(len(seen), 2)) * self.sigma_px
        bad = self.rng.random(len(seen)) < self.outliers
        noisy[bad] += self.rng.uniform(-40.0, 40.0, (int(bad.sum()), 2))
        right = depth = None
        if keyframe and self.rig.is_stereo:
            disparity = self._project(pose_at(t_s), 1)[seen] - pixels[seen]
            right = noisy + disparity + self.rng.normal(size=noisy.shape) * 0.5
        if keyframe and self.rig.has_depth:
            T = invert(pose_at(t_s) @ self.rig.T_body_cams[0])
            z = (self.points[seen] @ T[:3, :3].T + T[:3, 3])[:, 2]
            rho = 1.0 / z + self.rng.normal(size=len(seen)) * self.depth_sigma_rho
            depth = np.where(z < 6.0, 1.0 / np.maximum(rho, 1e-2), np.nan)
        others = []
        for k, followed in self._further.items():
            theirs = self._project(pose_at(t_s), k)
            theirs[~self.rig.cameras[k].contains(np.nan_to_num(theirs, nan=-1.0), 5.0)] = np.nan
            others.append(FurtherTracks(k, *followed.see(theirs)))
        return Observations(self._ids[seen].copy(), noisy, right, depth, further=tuple(others))


def motion_of(t_ns: int, lost: bool = False) -> VoMeasurement:
    tracking = Tracking.LOST if lost else Tracking.OK
    return VoMeasurement(t_ns, 0, None if lost else np.eye(4), np.eye(6), False, tracking, 100)


@dataclass
class Flight:
    """One simulated run: samples, true biases, frames."""

    motion: Motion
    samples: list[ImuSample]
    biases: Array
    start: NavState
    frames: list[tuple[int, Observations]]
    rig: Rig

    @staticmethod
    def make(
        seed: int,
        duration_s: float,
        rig: Rig = MONO,
        noise: ImuNoise = CHEAP,
        sigmas: Array = SIGMAS,
        offset_s: float = 0.0,
        motion: Motion | None = None,
        **world: object,
    ) -> Flight:
        """Make a run; frames are stamped `offset_s` before the time by the IMU at which they were seen."""
        rng = np.random.default_rng(4000 + seed)
        motion = Motion.random(seed) if motion is None else motion
        drawn = rng.normal(size=15) * sigmas
        samples, biases = motion.samples(duration_s, 200.0, noise, rng, -drawn[9:12], -drawn[12:15])
        T, v, *_ = motion.at(0.0)
        T = transform(T[:3, :3] @ so3_exp(drawn[:3]), T[:3, 3] + drawn[3:6])
        start = NavState(T0_NS, T, v + drawn[6:9], np.zeros(3), np.zeros(3), np.diag(sigmas**2))
        landmarks = Landmarks(rig, rng, **world)  # type: ignore[arg-type]
        frames = []
        for k in range(1, round((duration_s - 0.15) * 20.0)):
            t_s = 0.05 * k + 0.0012
            seen = landmarks.see(motion.pose, t_s, k % 6 == 1)
            frames.append((T0_NS + round((t_s - offset_s) * NS), seen))
        return Flight(motion, samples, biases, start, frames, rig)

    def truth(self, k: int) -> tuple[Array, Array, Array]:
        """Return pose, velocity and biases at sample k."""
        T, v, *_ = self.motion.at(k / 200.0)
        return T, v, self.biases[k]

    def filter(self, noise: ImuNoise = CHEAP, rig: Rig | None = None, **settings: object) -> MsckfEkf:
        """Return a filter started at the flight's first state."""
        config = EkfConfig(**{"tight_point_inflation": 1.0, **settings})  # type: ignore[arg-type]
        ekf = MsckfEkf(config, noise, MACHINE, self.rig if rig is None else rig)
        ekf.initialise(self.start)
        return ekf

    def fly(self, ekf: MsckfEkf, delay_s: float = 0.0, every: int = 20, order: NDArray[np.int64] | None = None):  # type: ignore[no-untyped-def]
        """Feed everything, each frame `delay_s` late; yield (k, error [15], state) at every n-th sample."""
        frames = self.frames if order is None else [self.frames[i] for i in order]
        arrivals = sorted(t for t, _ in frames)
        i = 0
        for k, sample in enumerate(self.samples):
            ekf.predict(sample)
            while i < len(frames) and sample.t_ns >= arrivals[i] + round(delay_s * NS):
                ekf.update_vision(motion_of(frames[i][0]), frames[i][1])
                i += 1
            if k % every == 0 and k > 0:
                state = ekf.state()
                yield k, state_error(self.truth(k), state), state
