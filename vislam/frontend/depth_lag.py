"""Depth that was taken at another moment than the image: read where the camera saw the same points then.

Structured light and colour have shutters of their own. On fr1_desk depth is stamped 19 ms before to 19 ms after its
image, and at 100 deg/s that is 2 degrees, 16 px. Stamps tell what they tell; what they leave, a driver's delay, is the
same for all images and learnt from how depth misfits the landmarks, along the gradient of the depth image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.geometry import se3_exp
from vislam.core.messages import Array, Bools, Frame
from vislam.frontend.depth import DepthReading, DepthSensor
from vislam.vision.shutter import later

_SIGMA_S = 0.01  # of the delay before anything is known
_MAX_S = 0.05
_TRUST = 0.1  # of a frame's information: successive frames share landmarks and their errors
_FRAME_SIGMA_S = 0.01  # no single frame may claim to know it better
_MEMORY_FRAMES = 60  # over which is averaged: a delay that is half undone shows as a smaller one
_LEAST = 0.003  # s: a shorter delay moves nothing by a pixel ...
_LEAST_SHARE = 0.1  # ... nor is one known that is a small part of the time over which velocity was measured
# for the derivative by the delay: some pixels, for depth has noise from one to the next, and to both sides, for that
# noise must not be the same as that of what is measured
_STEP_S = 0.01
_GATE = 3.0  # standard deviations of a depth that tells of the delay


class DepthLag:
    """How much later than its image depth is taken, beyond what stamps say."""

    def __init__(self, camera: Camera, delay_s: float | None) -> None:
        """Take the delay in seconds, None to estimate it.

        Attributes:
            estimate_s: what was learnt of it; see `delay_s` for what is applied.
        """
        self._camera = camera
        self._known = delay_s is not None
        self.estimate_s = delay_s or 0.0
        self._information = 1.0 / _SIGMA_S**2
        self._interval_s = 0.0

    @property
    def delay_s(self) -> float:
        """The delay that is applied, in seconds."""
        least = max(_LEAST, _LEAST_SHARE * self._interval_s)
        return self.estimate_s if self._known or abs(self.estimate_s) > least else 0.0

    @property
    def learns(self) -> bool:
        """Whether the delay is estimated."""
        return not self._known

    def start_at(self, delay_s: float) -> None:
        """Take the delay that an earlier run had learned, to be learned further."""
        if not self._known:
            self.estimate_s = min(max(delay_s, -_MAX_S), _MAX_S)
            self._information = 1.0 / _FRAME_SIGMA_S**2

    def measure(
        self, sensor: DepthSensor, frame: Frame, pixels: Array, xy: Array, rho: Array, twist_per_s: Array,
        ids: NDArray[np.int64] | None, to_learn: bool = True,
    ) -> DepthReading:  # fmt: skip
        """Return the depth of raw pixels [N, 2] at the time of the image.

        Args:
            sensor: reads the depth image.
            frame: with depth.
            pixels: raw pixels [N, 2] in the image.
            xy: their directions [N, 2] on z = 1.
            rho: inverse depths [N] in 1/m that are expected; NaN: unknown.
            twist_per_s: velocity [6] of the camera in its own frame, rotation first.
            ids: tracks [N] that they belong to; None: of none.
            to_learn: say how it would change with the delay, too.
        """
        lag_s = self._lag_s(frame)
        if frame.depth_m is None or not twist_per_s.any():
            return sensor.measure(frame, pixels, xy, rho, ids)
        seen = np.column_stack([xy, np.nan_to_num(rho)])
        if lag_s == 0.0:
            reading = sensor.measure(frame, pixels, xy, rho, ids)
        else:
            reading = self._read(sensor, frame, seen, twist_per_s, ids, lag_s)
        if self._known or not to_learn:
            return reading
        before, after = (self._read(sensor, frame, seen, twist_per_s, ids, lag_s + s) for s in (-_STEP_S, _STEP_S))
        return replace(reading, by_delay=(after.rho - before.rho) / (2.0 * _STEP_S))

    def reader(
        self, sensor: DepthSensor, frame: Frame, twist_per_s: Array, expected_rho: Callable[[Array], Array]
    ) -> Callable[[Array, NDArray[np.int64] | None], Array]:
        """Return what gives raw pixels [N, 2] of tracks [N] their z-depth [N], at a velocity [6] of the camera.

        `expected_rho` returns the inverse depths [N] that are likely in directions [N, 2] on z = 1.
        """

        def depth_m(pixels: Array, ids: NDArray[np.int64] | None) -> Array:
            xy = self._camera.normalise(pixels)
            rho = expected_rho(xy)
            return self.measure(sensor, frame, pixels, xy, rho, twist_per_s, ids, to_learn=False).depth_m

        return depth_m

    def motion(self, frame: Frame, twist_per_s: Array) -> Array | None:
        """Return T_image_depth [4, 4] of a frame at a velocity [6] of the camera; None where it did not move."""
        twist = self._lag_s(frame) * twist_per_s
        return np.asarray(se3_exp(twist)) if twist.any() else None

    def learn(self, misfit: Array, slope: Array, sigma_rho: Array, good: Bools, dt_s: float) -> None:
        """Let the misfit of depth in one frame correct the delay.

        Args:
            misfit: inverse depths [N] in 1/m, measured minus expected by landmarks; NaN: unknown.
            slope: derivative [N] of that by the delay. A landmark is made of depth that lagged as well: where a camera
                turns evenly, both err alike and nothing is learnt.
            sigma_rho: of the measured ones [N].
            good: which tracks [N] agree on the motion.
            dt_s: over which the velocity was measured.
        """
        self._interval_s = dt_s
        if self._known:
            return
        with np.errstate(invalid="ignore"):
            use = good & np.isfinite(slope) & (np.abs(misfit) < _GATE * sigma_rho)
        weight = 1.0 / sigma_rho[use] ** 2
        information = float(np.sum(weight * slope[use] ** 2))
        if not information > 0.0:
            return
        change_s = -float(np.sum(weight * slope[use] * misfit[use])) / information
        trusted = min(_TRUST * information, 1.0 / _FRAME_SIGMA_S**2)
        self._information = min(self._information, _MEMORY_FRAMES / _FRAME_SIGMA_S**2) + trusted
        self.estimate_s += trusted / self._information * (self.delay_s + change_s - self.estimate_s)
        self.estimate_s = min(max(self.estimate_s, -_MAX_S), _MAX_S)

    def _lag_s(self, frame: Frame) -> float:
        return 0.0 if frame.depth_m is None else frame.depth_lag_s + self.delay_s

    def _read(
        self,
        sensor: DepthSensor,
        frame: Frame,
        seen: Array,
        twist_per_s: Array,
        ids: NDArray[np.int64] | None,
        lag_s: float,
    ) -> DepthReading:
        """Return the depth of inverse-depth points [N, 3] in an image that is taken `lag_s` later."""
        there = later(seen, lag_s, twist_per_s)
        pixels = self._camera.project(np.column_stack([there[:, :2], np.ones(len(there))]))
        reading = sensor.measure(frame, pixels, there[:, :2], there[:, 2], ids)
        back = later(np.column_stack([there[:, :2], reading.rho]), -lag_s, twist_per_s)
        return DepthReading(back[:, 2], reading.sigma_rho, reading.right_px)
