"""When the rows and the depth of a frame were taken: the shutter's readout and the lag of depth, both learnt.

Structured light and colour have shutters of their own. On fr1_desk depth is stamped 19 ms before to 19 ms after its
image, and at 100 deg/s that is 2 degrees, 16 px. Stamps have that; what they lack, a driver's delay, is the same for
all images and learnt from how depth misfits the landmarks, along the gradient of the depth image. So is by
how much longer its rows take than the image's: the first and last rows of Kinect's depth are 30 ms apart (Ringaby and
Forssen, "Scan rectification for structured light range sensors with rolling shutters", ICCV 2011), others take all at
once.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import se3_exp
from vislam.core.memory import Learned
from vislam.core.messages import Array, Bools, Frame
from vislam.frontend.attempt import Attempt
from vislam.frontend.keyframes import Exposed
from vislam.frontend.view import DepthReading, DepthSensor
from vislam.vision.landmarks import Landmarks, move
from vislam.vision.refine import extra_parameter
from vislam.vision.shutter import Shutter, later

_SIGMA_S = 0.01  # of the delay, and of by how much longer rows take, before anything is known
_MAX_S = 0.05
_TRUST = 0.1  # of a frame's information: successive frames share landmarks and their errors
_FRAME_SIGMA_S = 0.01  # no single frame may claim to know it better
_MEMORY_FRAMES = 60  # over which is averaged: a delay that is half undone shows as a smaller one
_LEAST = 0.003  # s: a shorter delay moves nothing by a pixel ...
_LEAST_SHARE = 0.1  # ... nor is one known that is a small part of the time over which velocity was measured
# for the derivative by the delay: some pixels, for depth has noise from one to the next, and to both sides, for that
# noise must not be the same as that of what is measured
_STEP_S = 0.01
_MOST_ALIKE = 1e6  # condition number of the information on delay and rows; rows are counted from -0.5 to 0.5
_LEAST_TRACKS = 10  # with information on delay and rows in one frame
_LEAST_READOUT = 0.005  # s: a shorter one counts as none, for it is the sum of two that were learnt ...
_KNOWN_S = 0.002  # ... and depth is moved by it only once it is known so well
_ONE_FRAME = (1.0 / _FRAME_SIGMA_S**2,) * 2  # what an earlier run's delay and rows count for at least
_GATE = 3.0  # standard deviations of a depth that the delay is learnt from


class DepthLag:
    """How much later than its image depth is taken, beyond what stamps say, and how its rows are spread in time."""

    def __init__(self, camera: Camera, shutter: Shutter, delay_s: float | None, readout_s: float | None) -> None:
        """Take the shutter of the image, and delay and readout of depth in seconds, None to estimate them."""
        self._camera, self._shutter = camera, shutter
        self._delay, self._given_readout_s = _Learnt(delay_s), readout_s
        self._rows = _Learnt(None if readout_s is None else 0.0)  # by how much longer rows take than the image's
        self._interval_s = 0.0

    @property
    def delay_s(self) -> float:
        """The delay that is applied, in seconds."""
        return self._delay.estimate_s if self._delay.is_given else self._applied(self._delay.estimate_s, _LEAST)

    @property
    def readout_s(self) -> float:
        """From the first to the last row of depth, as it is applied, in seconds."""
        if self._given_readout_s is not None:
            return self._given_readout_s
        both_s = self._shutter.readout_s + self._rows.estimate_s
        return max(self._applied(both_s, _LEAST_READOUT), 0.0) if self._rows.sigma_s < _KNOWN_S else 0.0

    @property
    def delay_estimate_s(self) -> float | None:
        """The delay that was learnt; None: it was given."""
        return None if self._delay.is_given else self._delay.estimate_s

    @property
    def rows_estimate_s(self) -> float | None:
        """By how much longer rows of depth take than the image's, as far as learnt; None: the readout was given."""
        return None if self._rows.is_given else self._rows.estimate_s

    def start_at(self, delay_s: float | None, rows_s: float | None, information: Sequence[float] = _ONE_FRAME) -> None:
        """Take what an earlier run had learned, with its `information` [2] in 1/s^2, to be learned further."""
        self._delay.start_at(delay_s, information[0])
        self._rows.start_at(rows_s, information[1])

    @property
    def information(self) -> list[float]:
        """The information [2] on delay and rows, in 1/s^2."""
        return [self._delay.information, self._rows.information]

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
        late_s = self._lag_s(frame) + self._rows_s * self._shutter.row(pixels)
        if frame.depth_m is None or not twist_per_s.any():
            return sensor.measure(frame, pixels, xy, rho, ids)
        seen = np.column_stack([xy, np.nan_to_num(rho)])
        if late_s.any():
            reading = self._read(sensor, frame, seen, twist_per_s, ids, late_s)
        else:
            reading = sensor.measure(frame, pixels, xy, rho, ids)
        if (self._delay.is_given and self._rows.is_given) or not to_learn:
            return reading
        before, after = (self._read(sensor, frame, seen, twist_per_s, ids, late_s + s) for s in (-_STEP_S, _STEP_S))
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

    def sweep(self, frame: Frame, twist_per_s: Array) -> Array | None:
        """Return the camera's twist [6] from the first to the last row of depth; None where they are of one time."""
        twist = self.readout_s * twist_per_s
        return twist if frame.depth_m is not None and twist.any() else None

    def learn(self, misfit: Array, slope: Array, sigma_rho: Array, good: Bools, dt_s: float) -> None:
        """Let the misfit of depth in one frame correct delay and readout.

        Args:
            misfit: inverse depths [N] in 1/m, measured minus expected by landmarks; NaN: unknown.
            slope: derivatives [N, 2] of that by the delay, and by how much longer rows of depth take. A landmark is
                made of depth that lagged as well: where a camera turns evenly, both err alike and nothing is learnt.
            sigma_rho: of the measured ones [N].
            good: which tracks [N] agree on the motion.
            dt_s: over which the velocity was measured.
        """
        self._interval_s = dt_s
        with np.errstate(invalid="ignore"):
            use = good & np.isfinite(slope).all(axis=1) & (np.abs(misfit) < _GATE * sigma_rho)
        if int(use.sum()) < _LEAST_TRACKS:
            return
        A, r = slope[use] / sigma_rho[use, None], misfit[use] / sigma_rho[use]
        information = A.T @ A
        if not np.linalg.cond(information) < _MOST_ALIKE:
            return
        covariance = np.linalg.inv(information)
        delay_s, rows_s = np.array([self.delay_s, self._rows_s]) - covariance @ A.T @ r
        self._delay.take(delay_s, 1.0 / covariance[0, 0])
        self._rows.take(rows_s, 1.0 / covariance[1, 1])

    @property
    def _rows_s(self) -> float:
        """By how much longer the rows of depth take than the image's, as it is applied."""
        if self._given_readout_s is not None:
            return self._given_readout_s - self._shutter.readout_s
        return self._applied(self._rows.estimate_s, _LEAST)

    def _applied(self, seconds: float, least_s: float) -> float:
        return seconds if abs(seconds) > max(least_s, _LEAST_SHARE * self._interval_s) else 0.0

    def _lag_s(self, frame: Frame) -> float:
        return 0.0 if frame.depth_m is None else frame.depth_lag_s + self.delay_s

    def _read(
        self,
        sensor: DepthSensor,
        frame: Frame,
        seen: Array,
        twist_per_s: Array,
        ids: NDArray[np.int64] | None,
        late_s: Array,
    ) -> DepthReading:
        """Return the depth of inverse-depth points [N, 3] in an image that sees them `late_s` [N] later."""
        there = later(seen, late_s, twist_per_s)
        pixels = self._camera.project(np.column_stack([there[:, :2], np.ones(len(there))]))
        reading = sensor.measure(frame, pixels, there[:, :2], there[:, 2], ids)
        back = later(np.column_stack([there[:, :2], reading.rho]), -late_s, twist_per_s)
        return DepthReading(back[:, 2], reading.sigma_rho, reading.right_px)


class _Learnt:
    """A time that is given, or estimated from a little information in each frame."""

    def __init__(self, given_s: float | None) -> None:
        self.is_given = given_s is not None
        self.estimate_s = given_s or 0.0
        self.information = 1.0 / _SIGMA_S**2

    @property
    def sigma_s(self) -> float:
        return float(self.information**-0.5)

    def start_at(self, seconds: float | None, information: float) -> None:
        if seconds is not None and not self.is_given:
            self.estimate_s, self.information = min(max(seconds, -_MAX_S), _MAX_S), information

    def take(self, seconds: float, information: float) -> None:
        if self.is_given:
            return
        trusted = min(_TRUST * information, 1.0 / _FRAME_SIGMA_S**2)
        self.information = min(self.information, _MEMORY_FRAMES / _FRAME_SIGMA_S**2) + trusted
        self.estimate_s += trusted / self.information * (seconds - self.estimate_s)
        self.estimate_s = min(max(self.estimate_s, -_MAX_S), _MAX_S)


class Exposures:
    """Readout and lag of one camera, and how fast it moved at the keyframe, whose landmarks they shaped.

    Attributes:
        shutter: how the rows are spread in time.
        lag: how much later depth is taken.
        key_twist_per_s: velocity [6] of the camera at the keyframe, in its own frame, rotation first.
    """

    def __init__(self, camera: Camera, config: FrontEndConfig) -> None:
        """Begin with the times that the configuration gives; the others are learnt from zero."""
        self.shutter = Shutter(camera, config.readout_s)
        self.lag = DepthLag(camera, self.shutter, config.depth_delay_s, config.depth_readout_s)
        self.key_twist_per_s: Array = np.zeros(6)
        self._cauchy = config.cauchy

    def start_at(self, learned: Learned) -> None:
        """Take what an earlier run had learned, to be learned further."""
        information = (1.0 / _FRAME_SIGMA_S**2,) * 3 if learned.habits is None else learned.habits[8:].tolist()
        if learned.readout_s is not None:
            self.shutter.start_at(learned.readout_s, information[0])
        self.lag.start_at(learned.depth_delay_s, learned.depth_rows_s, information[1:])

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
