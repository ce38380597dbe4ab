"""Rolling shutter of one camera beside a gyroscope: rows are undone as far as it turns, and their readout is learnt.

What the way between two rows does to an image needs depth, which one camera has not: filter and window, which know
velocity and depth, undo that with the readout learnt here. It moves points along their epipolar lines as long as the
camera goes on in the same direction, and so hardly shows in how far they are from these, which is all that teaches.
"""

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.messages import Array, ImuSpan
from vislam.vision.shutter import Shutter
from vislam.vision.two_view import RotationPrior, TwoViewEstimate, extra_of_two_views

_STEP_S = 1e-3  # for the derivative by the readout
_LEAST_SIGMAS = 2.0  # of an estimate that is used: the first frames of a global shutter showed up to 1.5, 6 ms


class TurningRows:
    """How fast the camera turns now and turned at the keyframe, and how its rows are spread in time.

    Attributes:
        key_xy: directions [N, 2] on z = 1 of the tracks in the keyframe, at its middle row's time.
    """

    def __init__(self, camera: Camera, R_body_cam: Array, config: FrontEndConfig) -> None:
        """Take a camera and its rotation [3, 3] on the body."""
        self._camera, self._R_body_cam, self._cauchy = camera, R_body_cam, config.cauchy
        self._shutter = Shutter(camera, config.readout_s, _LEAST_SIGMAS)
        self._now: Array = np.zeros(6)  # velocity of the camera, rotation first, of which only that is known
        self._key: Array = np.zeros(6)
        self._key_px: Array = np.empty((0, 2))
        self.key_xy: Array = np.empty((0, 2))

    @property
    def learned_s(self) -> float | None:
        """The readout for estimators that have no stated one; None: there is one, or the shutter counts as global."""
        return self._shutter.readout_s or None if self._shutter.learns else None

    def start_at(self, readout_s: float | None) -> None:
        """Take what an earlier run had learned, if anything."""
        if readout_s is not None:
            self._shutter.start_at(readout_s, (2.0 * _LEAST_SIGMAS / readout_s) ** 2)

    def take(self, imu: ImuSpan | None) -> None:
        """Take how fast the body turns at the end of a span, that of a new frame; None: not known."""
        self._now = np.zeros(6)
        if imu is not None and len(imu.t_ns) > 0 and bool(np.isfinite(imu.gyro_rad_s[-1]).all()):
            self._now[:3] = self._R_body_cam.T @ imu.gyro_rad_s[-1]

    def begin(self) -> None:
        """Make the newest frame the keyframe."""
        self._key = self._now

    def look(self, key_px: Array) -> None:
        """Take where the tracks are in the keyframe, raw pixels [N, 2]."""
        self._key_px, self.key_xy = key_px, self._at_once(key_px, self._key)

    def now_xy(self, pixels: Array) -> Array:
        """Return directions [N, 2] on z = 1 of raw pixels [N, 2] in the newest frame, at its middle row's time."""
        return self._at_once(pixels, self._now)

    def learn(self, view: TwoViewEstimate, pixels: Array, sigma_xy: float, prior: RotationPrior | None) -> None:
        """Let what a view of the newest frame, with raw pixels [N, 2], leaves over correct the readout."""
        if not (self._shutter.learns and view.direction_key.any() and self._now.any() and self._key.any()):
            return
        xy, ahead = list[Array](), list[Array]()
        for px, twist in ((self._key_px, self._key), (pixels, self._now)):
            xy.append(self._at_once(px, twist))
            ahead.append(xy[-1] + _STEP_S * self._shutter.slope(px, xy[-1], np.zeros(len(px)), twist))
        change, information = extra_of_two_views(view, xy, ahead, sigma_xy, self._cauchy, prior)
        self._shutter.learn(_STEP_S * change, information / _STEP_S**2)

    def _at_once(self, pixels: Array, twist_per_s: Array) -> Array:
        return self._shutter.to_instant(pixels, self._camera.normalise(pixels), np.zeros(len(pixels)), twist_per_s)
