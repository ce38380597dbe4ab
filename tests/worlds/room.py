"""Random landmarks around an exact motion, seen by a pinhole rig: keyframe packets without images, for tests."""

from dataclasses import dataclass

import numpy as np

from vislam.core import Array, FurtherTracks, KeyframePacket, NavState, Observations, Tracking, VoMeasurement
from vislam.core.camera import EXACT, Camera, Rig
from vislam.core.geometry import invert, skew, so3_exp, transform
from vislam.core.readings import Motion as Told
from vislam.imu import ImuNoise
from vislam.imu.series import ImuSeries
from worlds.motion import EUROC_NOISE, NS, T0_NS, Motion
from worlds.parts import R_BODY_CAM, bare_keyframe, on_walls

PINHOLE = Camera(640, 480, 460.0, 460.0, 320.0, 240.0, sigmas=EXACT)
T_BODY_CAM0 = transform(R_BODY_CAM, np.array([0.05, 0.05, 0.02]))
T_BODY_CAM1 = transform(R_BODY_CAM, np.array([0.05, -0.06, 0.02]))
MONO = Rig((PINHOLE,), (T_BODY_CAM0,))
STEREO = Rig((PINHOLE, PINHOLE), (T_BODY_CAM0, T_BODY_CAM1))
RGBD = Rig((PINHOLE,), (T_BODY_CAM0,), has_depth=True)


def ring(*others_deg: float, pair: bool = False) -> Rig:
    """Return the first camera, the pair if asked for, and others turned about the vertical, 12 cm from the middle."""
    further = []
    for angle in np.deg2rad(others_deg):
        turn = so3_exp(np.array([0.0, 0.0, angle]))
        further.append(transform(turn @ R_BODY_CAM, turn @ np.array([0.12, 0.01, 0.03])))
    first = STEREO.T_body_cams[: 2 if pair else 1]
    return Rig((PINHOLE,) * (len(first) + len(further)), (*first, *further))


GYRO_BIAS, ACCEL_BIAS = np.array([0.006, -0.004, 0.008]), np.array([0.08, -0.05, 0.06])


@dataclass(frozen=True)
class World:
    """A motion, landmarks on the walls of a room around it, and how they are seen."""

    motion: Motion
    rig: Rig = MONO
    seed: int = 0
    duration_s: float = 20.0
    keyframe_hz: float = 5.0
    tracks: int = 80
    sigma_px: float = 1.0
    outliers: float = 0.0
    noise: ImuNoise = EUROC_NOISE
    time_offset_s: float = 0.0  # the camera's stamps are early by this much: true time = stamp + offset
    readout_s: float = 0.0
    R_cam_correction: Array | None = None  # truth: R_body_cam0 = rig's @ exp(this)
    depth_sigma_rho: float = 2e-3
    room_m: tuple[float, float, float] = (7.0, 7.0, 4.0)
    rest_until_s: float = 0.0  # packets say "at rest" up to here; the motion must agree

    def landmarks(self, rng: np.random.Generator, count: int = 1500) -> Array:
        return on_walls(rng, count, np.array(self.room_m))

    def truth(self, t_ns: int) -> tuple[Array, Array]:
        T, v, _, _ = self.motion.at((t_ns - T0_NS) / NS)
        return T, v

    def packets(self) -> tuple[list[KeyframePacket], list[tuple[Array, Array, Array]]]:
        """Return keyframe packets and, for each, the true pose, velocity and biases [6]."""
        rng = np.random.default_rng(self.seed)
        samples, biases = self.motion.samples(
            self.duration_s + 0.5, self.noise.rate_hz, self.noise, rng, GYRO_BIAS, ACCEL_BIAS
        )
        series = ImuSeries()
        for sample in samples:
            series.append(sample)
        world = self.landmarks(rng)
        ids = np.full(len(world), -1)
        live: set[int] = set()
        next_id, packets, truths, t_before = 0, [], [], None
        correction = np.eye(3) if self.R_cam_correction is None else so3_exp(self.R_cam_correction)
        T_cams = [T_BODY_CAM0 @ transform(correction, np.zeros(3))]
        T_cams += [T_cams[0] @ T for T in self.rig.T_cam0_cams[1:]]
        further = {k: Followed(self.tracks, self.sigma_px, self.seed + k, k << 40) for k in self.rig.further}
        for k in range(int(self.duration_s * self.keyframe_hz)):
            t_s = 0.1 + k / self.keyframe_hz
            t_ns = T0_NS + round(t_s * NS)
            views = [self._seen(t_s + self.time_offset_s, T, world) for T in T_cams]
            pixels, depth = views[0]
            visible = np.flatnonzero(np.isfinite(pixels[:, 0]))
            live &= set(visible.tolist())
            if len(live) < self.tracks:
                fresh = [int(i) for i in rng.permutation(visible) if i not in live][: self.tracks - len(live)]
                for i in fresh:
                    ids[i], next_id = next_id, next_id + 1
                live |= set(fresh)
            chosen = np.array(sorted(live), dtype=np.int64)
            noisy = pixels[chosen] + rng.normal(size=(len(chosen), 2)) * self.sigma_px
            wrong = rng.random(len(chosen)) < self.outliers
            noisy[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2))
            right, depth_m = None, None
            if self.rig.is_stereo:
                right = views[1][0][chosen] + rng.normal(size=(len(chosen), 2)) * self.sigma_px
            if self.rig.has_depth:
                depth_m = 1.0 / (1.0 / depth[chosen] + rng.normal(size=len(chosen)) * self.depth_sigma_rho)
            T, v, _, _ = self.motion.at(t_s)
            imu = None if t_before is None else series.cut(t_before, t_ns)
            others = tuple(FurtherTracks(c, *followed.see(views[c][0])) for c, followed in further.items())
            seen = Observations(ids[chosen].copy(), noisy, right, depth_m, further=others)
            packets.append(packet(k, t_ns, seen, imu, at_rest=k > 0 and t_s <= self.rest_until_s))
            truths.append((T, v, biases[min(round(t_s * self.noise.rate_hz), len(biases) - 1)]))
            t_before = t_ns
        return packets, truths

    def _seen(self, t_s: float, T_body_cam: Array, world: Array) -> tuple[Array, Array]:
        T = invert(self.motion.pose(t_s) @ T_body_cam)
        p = world @ T[:3, :3].T + T[:3, 3]
        pixels = PINHOLE.project(p)
        pixels[~PINHOLE.contains(pixels) | (p[:, 2] < 0.3)] = np.nan
        if self.readout_s:  # of those in view, each where its own row sees it
            for i in np.flatnonzero(np.isfinite(pixels[:, 1])):
                for _ in range(2):
                    row = pixels[i, 1] / PINHOLE.height - 0.5
                    T = invert(self.motion.pose(t_s + row * self.readout_s) @ T_body_cam)
                    p[i] = T[:3, :3] @ world[i] + T[:3, 3]
                    pixels[i] = PINHOLE.project(p[i : i + 1])[0]
            pixels[~PINHOLE.contains(pixels)] = np.nan
        return pixels, p[:, 2]


class Followed:
    """Tracks of a further camera: landmarks that it goes on seeing, and new ones for those that it lost."""

    def __init__(self, count: int, sigma_px: float, seed: int, first_id: int) -> None:
        self._count, self._sigma_px, self._next_id = count, sigma_px, first_id
        self._rng = np.random.default_rng(seed)
        self._id_of: dict[int, int] = {}  # by landmark

    def see(self, pixels: Array) -> tuple[Array, Array]:
        """Return ids [N] and noisy pixels [N, 2] of tracks, of all landmarks' pixels, NaN where out of sight."""
        visible = np.flatnonzero(np.isfinite(pixels[:, 0]))
        self._id_of = {i: self._id_of[i] for i in visible.tolist() if i in self._id_of}
        for i in self._rng.permutation(visible).tolist():
            if len(self._id_of) < self._count and i not in self._id_of:
                self._id_of[i], self._next_id = self._next_id, self._next_id + 1
        landmarks = np.array(list(self._id_of), dtype=np.int64)
        noise = self._rng.normal(size=(len(landmarks), 2)) * self._sigma_px
        return np.array(list(self._id_of.values()), dtype=np.int64), pixels[landmarks] + noise


def packet(k: int, t_ns: int, seen: Observations, imu, at_rest: bool = False) -> KeyframePacket:
    vo = VoMeasurement(t_ns, max(k - 1, 0), None, np.eye(6), False, Tracking.LOST, 0)
    return KeyframePacket(bare_keyframe(k, t_ns), vo, seen, imu, at_rest=at_rest)


START_SIGMAS = np.repeat([0.01, 1e-3, 0.05, 0.005, 0.05], 3)


def start_state(truth: tuple[Array, Array, Array], t_ns: int, rng: np.random.Generator) -> NavState:
    """Return the true state disturbed by START_SIGMAS (yaw and position not: they are the gauge)."""
    T, v, bias = truth
    e = rng.normal(size=15) * START_SIGMAS
    up = T[2, :3]
    e[:3] -= up * (up @ e[:3])
    T = T.copy()
    T[:3, :3] = T[:3, :3] @ so3_exp(-e[:3])
    return NavState(t_ns, T, v - e[6:9], bias[:3] - e[9:12], bias[3:] - e[12:15], np.diag(START_SIGMAS**2))


def told_way(
    T_a: Array, T_b: Array, sigma_m: float, scale: float, scale_sigma: float, rng: np.random.Generator
) -> Told:
    """Return what wheels would say of the way between two true poses [4, 4]: in body axes, `scale` times too long."""
    said = scale * (T_a[:3, :3].T @ (T_b[:3, 3] - T_a[:3, 3])) + sigma_m * rng.normal(size=3)

    def weighted(A: Array, B: Array) -> tuple[Array, Array, Array, Array]:
        way = A[:3, :3].T @ (B[:3, 3] - A[:3, 3])
        by_a = np.hstack([-skew(way), np.eye(3)]) / sigma_m
        by_b = np.hstack([np.zeros((3, 3)), -A[:3, :3].T @ B[:3, :3]]) / sigma_m
        return (said - way) / sigma_m, by_a, by_b, -(way * scale_sigma / sigma_m)[:, None]

    return weighted
