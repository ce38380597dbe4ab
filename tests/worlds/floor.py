"""A cart in a hall, drawn with exact truth: a textured floor and four walls, one camera that looks down a little."""

from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.camera import Camera, Rig
from vislam.core.geometry import transform
from vislam.core.messages import Array, Frame, ImuSpan
from worlds.parts import R_BODY_CAM, mixed_noise

HEIGHT_M = 0.6
TILT_DEG = 18.0
RATE_HZ = 20.0
FRAME_NS = 50_000_000
_HALF_M = 6.0  # of the hall
_TEXTURE_PX, _TEXELS_PER_M = 2048, 150.0
_GYRO_STEPS = 10  # per frame


def camera() -> Camera:
    """A small camera with the lens of a webcam."""
    return Camera(320, 240, 230.0, 229.0, 160.5, 119.5, distortion="radtan", coefficients=(-0.08, 0.03, 5e-4, -3e-4))


def rig(tilt_deg: float = TILT_DEG, roll_deg: float = 0.0) -> Rig:
    """One camera on the cart's body, whose z is up from the floor."""
    R = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix() @ R_BODY_CAM
    R = R @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    return Rig((camera(),), (transform(R, np.array([0.1, 0.02, 0.2])),))


@dataclass
class Drive:
    """Poses of the body while the cart drives: speed and rate of turn over time, and how its springs shake it."""

    seconds: float = 4.0
    speed_m_s: float = 0.6
    turn_rad_s: float = 0.25
    shake_deg: float = 0.0
    rest_s: float = 0.0  # at the end
    start: tuple[float, float, float] = (-2.0, -2.0, 0.3)
    times_s: Array = field(init=False)

    def __post_init__(self) -> None:
        self.times_s = np.arange(round(self.seconds * RATE_HZ)) / RATE_HZ

    def at(self, t_s: Array) -> Array:
        """Return the poses [N, 4, 4] at times [N]; the body is 0.4 m above the floor, 0.2 m under the camera."""
        fine = np.linspace(0.0, self.seconds, round(self.seconds * 1000) + 1)
        ramp = np.clip(fine / 0.5, 0.0, 1.0)
        if self.rest_s > 0.0:
            ramp = np.minimum(ramp, np.clip((self.seconds - self.rest_s - fine) / 0.5, 0.0, 1.0))
        yaw = self.start[2] + self.turn_rad_s * np.sin(0.9 * fine) / 0.9
        x = self.start[0] + np.cumsum(self.speed_m_s * ramp * np.cos(yaw)) * 1e-3
        y = self.start[1] + np.cumsum(self.speed_m_s * ramp * np.sin(yaw)) * 1e-3
        roll = np.deg2rad(self.shake_deg) * np.sin(11.0 * t_s)
        pitch = np.deg2rad(self.shake_deg) * np.sin(8.0 * t_s + 1.0)
        heading = np.interp(t_s, fine, yaw)
        R = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).as_matrix()
        poses = np.tile(np.eye(4), (len(t_s), 1, 1))
        poses[:, :3, :3] = R
        # the springs turn it about the camera's foot, so that the camera keeps its height
        foot = np.column_stack([np.interp(t_s, fine, x), np.interp(t_s, fine, y), np.full(len(t_s), HEIGHT_M)])
        poses[:, :3, 3] = foot - R @ np.array([0.1, 0.02, 0.2])
        return poses

    @property
    def poses(self) -> Array:
        """The poses at the frames."""
        return self.at(self.times_s)

    def gyro(self, index: int, bias_rad_s: Array | None = None) -> ImuSpan | None:
        """Return the rates between the frame before and frame `index`; None for the first."""
        if index == 0:
            return None
        t_s = np.linspace(self.times_s[index - 1], self.times_s[index], _GYRO_STEPS + 1)
        h = 1e-4
        before, after = self.at(np.maximum(t_s - h, 0.0)), self.at(t_s + h)
        steps = np.einsum("nji,njk->nik", before[:, :3, :3], after[:, :3, :3])
        rates = Rotation.from_matrix(steps).as_rotvec() / (t_s + h - np.maximum(t_s - h, 0.0))[:, None]
        rates = rates if bias_rad_s is None else rates + bias_rad_s
        return ImuSpan(stamp_ns(t_s), rates, np.tile([0.0, 0.0, 9.81], (len(t_s), 1)))


def stamp_ns(t_s: Array) -> np.ndarray:
    """Return stamps [N] of times [N]."""
    return np.round(np.asarray(t_s) * 1e9).astype(np.int64) + 1_000_000_000


@cache
def _noise() -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """Return the noise of floor and walls, and the generator after it; made once, as it takes a second."""
    rng = np.random.default_rng(5)
    return mixed_noise(rng, _TEXTURE_PX), mixed_noise(rng, _TEXTURE_PX), rng


@cache
def _painted(noise_at: int, contrast: float) -> np.ndarray:
    """Return the grey texture of the floor (0) or the walls (1)."""
    return np.clip(120 + contrast * _noise()[noise_at], 0, 255).astype(np.float32)


class FloorWorld:
    """Draws frames of the hall."""

    def __init__(self, rig_: Rig, contrast: float = 45.0) -> None:
        self.rig = rig_
        self._floor, self._wall = _painted(0, contrast), _painted(1, 50.0)
        self._rng = deepcopy(_noise()[2])
        u, v = np.meshgrid(np.arange(320, dtype=float), np.arange(240, dtype=float))
        self._rays = rig_.cameras[0].unproject(np.column_stack([u.ravel(), v.ravel()]))

    def draw(self, T_world_body: Array) -> np.ndarray:
        """Return the grey image at a pose."""
        T = T_world_body @ self.rig.T_body_cams[0]
        d, o = self._rays @ T[:3, :3].T, T[:3, 3]
        grey, nearest = np.full(len(d), 90.0, np.float32), np.full(len(d), np.inf)
        planes = [(2, 0.0, self._floor)] + [(axis, side * _HALF_M, self._wall) for axis in (0, 1) for side in (-1, 1)]
        for axis, at, painted in planes:
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (at - o[axis]) / d[:, axis]
            hit = np.flatnonzero((t > 0.01) & (t < nearest))
            if not len(hit):
                continue
            across = [other for other in range(3) if other != axis]
            uv = np.zeros((len(d), 2), np.float32)
            uv[hit] = (o + d[hit] * t[hit, None])[:, across] * _TEXELS_PER_M + _TEXTURE_PX / 2
            sampled = cv2.remap(painted, uv.reshape(240, 320, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            grey[hit], nearest[hit] = sampled.ravel()[hit], t[hit]
        grey += self._rng.normal(0.0, 2.0, len(grey)).astype(np.float32)
        image = np.clip(np.round(grey), 0, 255).astype(np.uint8).reshape(240, 320)
        return cv2.GaussianBlur(image, (0, 0), 0.7)  # a lens; without it far texture flickers

    def frames(self, drive: Drive) -> list[Frame]:
        """Draw the frames of a drive."""
        stamps = stamp_ns(drive.times_s)
        return [Frame(int(t), i, (self.draw(T),)) for i, (t, T) in enumerate(zip(stamps, drive.poses, strict=True))]
