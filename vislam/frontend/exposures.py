"""When the rows and the depth of a frame were taken: the shutter's readout and the lag of depth, both learnt."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.memory import Learned
from vislam.core.messages import Array, Frame
from vislam.frontend.attempt import Attempt
from vislam.frontend.depth import DepthSensor
from vislam.frontend.depth_lag import DepthLag
from vislam.frontend.keyframes import Exposed
from vislam.vision.landmarks import Landmarks, move
from vislam.vision.refine import extra_parameter
from vislam.vision.shutter import Shutter


class Exposures:
    """Readout and lag of one camera, and how fast it moved at the keyframe, whose landmarks they shaped.

    Attributes:
        shutter: how the rows are spread in time.
        lag: how much later depth is taken.
        key_twist_per_s: velocity [6] of the camera at the keyframe, in its own frame, rotation first.
    """

    def __init__(self, camera: Camera, config: FrontEndConfig) -> None:
        """Begin with what the configuration tells, or with nothing."""
        self.shutter = Shutter(camera, config.readout_s)
        self.lag = DepthLag(camera, self.shutter, config.depth_delay_s, config.depth_readout_s)
        self.key_twist_per_s: Array = np.zeros(6)
        self._cauchy = config.cauchy

    def start_at(self, learned: Learned) -> None:
        """Take what an earlier run had learned, to be learned further."""
        if learned.readout_s is not None:
            self.shutter.start_at(learned.readout_s)
        self.lag.start_at(learned.depth_delay_s, learned.depth_rows_s)

    def learned(self, next_track_id: int, knows_lag: bool) -> Learned:
        """Return what was learned, as `start_at` takes it; `knows_lag` is whether every frame measures depth."""
        readout_s = self.shutter.readout_s if self.shutter.learns else None
        delay_s, rows_s = (self.lag.delay_estimate_s, self.lag.rows_estimate_s) if knows_lag else (None, None)
        return Learned(next_track_id, readout_s=readout_s, depth_delay_s=delay_s, depth_rows_s=rows_s)

    def look_through(self, camera: Camera, back: Array) -> None:
        """Go on with another camera of the rig; `back` [6, 6] brings velocities to its axes."""
        self.key_twist_per_s = back @ self.key_twist_per_s
        self.shutter.look_through(camera)

    def learn(
        self, frame: Frame, attempt: Attempt, landmarks: Landmarks, key_pixels: Array, sigma_xy: float, dt_s: float
    ) -> None:
        """Let what a placed frame leaves over correct readout and lag.

        Args:
            frame: that was placed.
            attempt: that placed the frame.
            landmarks: of the keyframe, [N].
            key_pixels: [N, 2] where the keyframe sees them.
            sigma_xy: standard deviation of a direction on z = 1.
            dt_s: over which its velocity was measured.
        """
        if self.shutter.learns and self.key_twist_per_s.any():
            xy = np.where(attempt.agreeing[:, None], attempt.xy, np.nan)
            shear = self.shear(attempt, landmarks, key_pixels, xy)
            T = attempt.estimate.T_key_cam
            change = extra_parameter(T, landmarks.mean, landmarks.covariance, xy, sigma_xy, self._cauchy, shear)
            self.shutter.learn(*change)
        if attempt.depth_now is not None and frame.depth_m is not None:
            rho = move(landmarks.mean, landmarks.covariance, attempt.estimate.T_key_cam)[0][:, 2]
            now, key = attempt.depth_now.slope, landmarks.by_delay
            by_rows = now * self.shutter.row(attempt.pixels) - key * self.shutter.row(key_pixels)
            slope = np.column_stack([now - key, by_rows])
            good = attempt.agreeing & landmarks.known
            self.lag.learn(attempt.depth_now.rho - rho, slope, attempt.depth_now.sigma_rho, good, dt_s)

    def of_keyframe(
        self, sensor: DepthSensor, frame: Frame, twist_per_s: Array, expected_rho: Callable[[Array], Array]
    ) -> Exposed:
        """Return when a keyframe's rows and depth were taken, at a velocity [6] of the camera; see DepthLag.reader."""
        return Exposed(
            self.lag.reader(sensor, frame, twist_per_s, expected_rho),
            partial(self.shutter.moved_to_instant, twist_per_s=twist_per_s),
            self.lag.motion(frame, twist_per_s),
            self.lag.sweep(frame, twist_per_s),
            self.shutter.sweep(twist_per_s),
        )

    def shear(self, attempt: Attempt, landmarks: Landmarks, key_pixels: Array, xy: Array) -> Array:
        """Return the derivative [N, 2] of predicted minus measured directions `xy` [N, 2] by the readout time."""
        mean = landmarks.mean
        of_key = self.shutter.slope(key_pixels, mean[:, :2], mean[:, 2], self.key_twist_per_s)
        of_now = self.shutter.slope(attempt.pixels, xy, attempt.expected_rho, attempt.twist_per_s)
        # a landmark's own shear is carried by the rotation between the two, nearly one over such short times
        return of_key - of_now
