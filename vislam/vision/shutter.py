"""Rolling shutter: bring what each image row saw to the instant of the middle row, and back.

A rolling shutter reads the rows one after the other: at 100 deg/s a Kinect's image is sheared by 20 px between top and
bottom. With the camera's velocity known from the last frame, that is undone (constant velocity during the readout;
Forssen and Ringaby, CVPR 2010). Recordings rarely say how long the readout takes, so it is estimated while running: on
fr1_desk it settles at 20 ms within a second and halves the error, on MH_01's global shutter it stays at 0.
"""

from __future__ import annotations

import numpy as np

from vislam.core.camera import Camera
from vislam.core.jit import njit
from vislam.core.messages import Array

_SIGMA_S = 0.02  # before anything is known: cameras take 0 to 33 ms
_MAX_S = 0.05
_GLOBAL_S = 0.003  # a shorter readout than this counts as a global shutter: half a pixel at 60 deg/s
_TRUST = 0.1  # of a frame's information: successive frames share landmarks and their errors
_FRAME_SIGMA_S = 0.01  # no single frame may claim to know it better: its velocity may be wrong
_MIN_Z = 0.05  # relative to its old z-depth: a point nearer than this is beside or behind the camera
_STEP_S = 1e-3  # for the derivative by the readout


class Shutter:
    """How the rows of a camera are spread in time."""

    def __init__(self, camera: Camera, readout_s: float | None, least_sigmas: float = 0.0) -> None:
        """Take the time from the first to the last row in seconds, 0 for a global shutter, None to estimate it.

        An estimate of less than `least_sigmas` of its standard deviation counts as a global shutter.
        """
        self._camera, self._least_sigmas = camera, least_sigmas
        self._known = readout_s is not None
        self._estimate_s = readout_s if readout_s is not None else 0.0
        self.information = 1.0 / _SIGMA_S**2

    @property
    def readout_s(self) -> float:
        """The readout that is applied, in seconds."""
        least_s = max(_GLOBAL_S, self._least_sigmas * float(self.information**-0.5))
        return self._estimate_s if self._known or self._estimate_s > least_s else 0.0

    @property
    def sigma_s(self) -> float:
        """How well the readout is known, in seconds: given ones and global shutters are.

        Velocities that an estimate rests on are wrong in the same way in frame after frame, so that frames do not make
        it better than one of them: on fr1_desk it stays 10 ms below what its truth shows.
        """
        return 0.0 if self._known or self.readout_s == 0.0 else _FRAME_SIGMA_S

    @property
    def learns(self) -> bool:
        """Whether the readout is estimated."""
        return not self._known

    def instant_px(self, xy: Array) -> Array | None:
        """Return raw pixels [N, 2] of directions [N, 2] of the middle row's time; None: all rows are of one time."""
        if self.readout_s == 0.0:
            return None
        return self._camera.project(np.column_stack([xy, np.ones(len(xy))]))

    def look_through(self, camera: Camera) -> None:
        """Go on with another camera of the same make."""
        self._camera = camera

    def start_at(self, readout_s: float, information: float = 1.0 / _FRAME_SIGMA_S**2) -> None:
        """Take the readout that an earlier run had learned, with `information` in 1/s^2, to be learned further."""
        if not self._known:
            self._estimate_s, self.information = min(max(readout_s, 0.0), _MAX_S), information

    def learn(self, change_s: float, information: float) -> None:
        """Take in one frame's estimate: the applied readout plus `change_s`, with `information` in 1/s^2."""
        weight = min(_TRUST * information, 1.0 / _FRAME_SIGMA_S**2)
        measured = self.readout_s + change_s
        self.information += weight
        self._estimate_s += weight / self.information * (measured - self._estimate_s)
        self._estimate_s = min(max(self._estimate_s, -_GLOBAL_S), _MAX_S)

    def to_instant(self, pixels: Array, xy: Array, rho: Array, twist_per_s: Array) -> Array:
        """Return directions [N, 2] as the camera would have seen them at the middle row's time.

        Args:
            pixels: raw pixels [N, 2], for their rows.
            xy: directions [N, 2] on z = 1 as seen.
            rho: inverse depths [N] in 1/m, roughly.
            twist_per_s: velocity [6] of the camera in its own frame, rotation first.
        """
        return self._undone(pixels, xy, rho, twist_per_s, self.readout_s)

    def moved_to_instant(self, pixels: Array, depth_m: Array, twist_per_s: Array) -> Array:
        """Return raw pixels [N, 2] where the camera would have seen the same at the middle row's time.

        Args:
            pixels: raw pixels [N, 2] as seen.
            depth_m: z-depths [N]; NaN: unknown, and taken for infinitely far.
            twist_per_s: velocity [6] of the camera in its own frame, rotation first.
        """
        if self.readout_s == 0.0 or not twist_per_s.any():
            return pixels
        xy = self.to_instant(pixels, self._camera.normalise(pixels), np.nan_to_num(1.0 / depth_m), twist_per_s)
        moved = self.instant_px(xy)
        assert moved is not None
        return np.where(np.isfinite(moved), moved, pixels)

    def slope(self, pixels: Array, xy: Array, rho: Array, twist_per_s: Array) -> Array:
        """Return the derivative [N, 2] of `to_instant` by the readout, in 1/s; zero where `xy` is NaN."""
        return np.nan_to_num((self._undone(pixels, xy, rho, twist_per_s, _STEP_S) - xy) / _STEP_S)

    def project(self, points: Array, twist_per_s: Array) -> Array:
        """Return raw pixels [N, 2] at which inverse-depth points [N, 3] of the middle row's instant are seen."""
        pixels = self._camera.project(np.column_stack([points[:, :2], np.ones(len(points))]))
        if self.readout_s == 0.0:
            return pixels
        for _ in range(2):  # the row decides the time, the time moves the row
            seen = _shift(points, self._delay_s(pixels, self.readout_s), twist_per_s)
            pixels = self._camera.project(np.column_stack([seen[:, :2], np.ones(len(seen))]))
        return pixels

    def sweep(self, twist_per_s: Array) -> Array | None:
        """Return the camera's twist [6] from the first to the last row; None where they are of one time."""
        twist = self.readout_s * twist_per_s
        return twist if twist.any() else None

    def _undone(self, pixels: Array, xy: Array, rho: Array, twist_per_s: Array, readout_s: float) -> Array:
        if readout_s == 0.0:
            return xy
        points = np.column_stack([xy, rho])
        return np.asarray(_shift(points, -self._delay_s(pixels, readout_s), twist_per_s)[:, :2])

    def row(self, pixels: Array) -> Array:
        """Return where the rows of raw pixels [N, 2] are: -0.5 the first, 0.5 the last."""
        rows = np.clip(pixels[:, 1], 0.0, self._camera.height - 1.0)
        return np.asarray(rows / (self._camera.height - 1.0) - 0.5)

    def _delay_s(self, pixels: Array, readout_s: float) -> Array:
        return self.row(pixels) * readout_s


def later(points: Array, delay_s: Array, twist_per_s: Array) -> Array:
    """Return inverse-depth points [N, 3] as the camera sees them `delay_s` [N] later; NaN behind it.

    `twist_per_s` [6] is the velocity of the camera in its own frame, rotation first.
    """
    return np.asarray(_shift(points, delay_s, twist_per_s))


@njit(cache=True, nogil=True)
def _shift(points: Array, delay_s: Array, twist_per_s: Array) -> Array:
    """Return inverse-depth points [N, 3] as seen from where the camera is `delay_s` [N] later; NaN behind it.

    Rotation is exact (Rodrigues); the path is taken as straight, which over a readout it is to a few micrometres.
    """
    out = np.full_like(points, np.nan)
    w, v = twist_per_s[:3], twist_per_s[3:]
    rate = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    axis = w / rate if rate > 0.0 else np.zeros(3)
    for i in range(len(points)):
        rho, delay = points[i, 2], delay_s[i]
        if not (np.isfinite(points[i, 0]) and np.isfinite(rho) and np.isfinite(delay)):
            continue
        # rho times the point seen from the displaced camera, still unturned
        x = points[i, 0] - rho * v[0] * delay
        y = points[i, 1] - rho * v[1] * delay
        z = 1.0 - rho * v[2] * delay
        sine, rest = np.sin(-rate * delay), 1.0 - np.cos(rate * delay)
        cx, cy, cz = axis[1] * z - axis[2] * y, axis[2] * x - axis[0] * z, axis[0] * y - axis[1] * x
        turned_x = x + sine * cx + rest * (axis[1] * cz - axis[2] * cy)
        turned_y = y + sine * cy + rest * (axis[2] * cx - axis[0] * cz)
        turned_z = z + sine * cz + rest * (axis[0] * cy - axis[1] * cx)
        if turned_z > _MIN_Z:
            out[i, 0], out[i, 1], out[i, 2] = turned_x / turned_z, turned_y / turned_z, rho / turned_z
    return out
