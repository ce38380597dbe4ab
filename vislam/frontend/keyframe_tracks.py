"""The tracks of the keyframe and the landmarks behind them, as the camera that is looked through sees them."""

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import invert, se3_adjoint, se3_log
from vislam.core.messages import Array, Bools, Frame, ImuSpan, Keyframe, Observations
from vislam.frontend.attempt import Attempt, MotionPredictor
from vislam.frontend.exposures import Exposures
from vislam.frontend.keyframes import PATIENCE_S, Exposed
from vislam.frontend.tracker import Tracker, given_rows
from vislam.frontend.view import EPIPOLAR_GATE_PX, DepthReading, View, spread
from vislam.vision.landmarks import Landmarks, move
from vislam.vision.shutter import Shutter

_CORNER_SIGMA = 0.1  # of the track noise: the patch in the keyframe is the landmark, by definition
_DEEP = 0.02  # of a keyframe's tracks have depth at least, or its sensor is covered: wrong matches alone are fewer


class KeyframeTracks:
    """Owns tracks, landmarks and the camera's motion since the keyframe: all that another camera would see otherwise.

    Attributes:
        view: the camera that is looked through.
        tracker: follows the tracks.
        landmarks: theirs, in the camera at the keyframe.
        exposures: when rows and depth are taken.
        predictor: of the camera's motion.
        T_key_cam: [4, 4] of the last frame, predicted while lost.
        lacks_depth: hardly a track of the keyframe had depth when it began.
    """

    def __init__(self, config: FrontEndConfig, views: tuple[View, ...]) -> None:
        """Begin without tracks, looking through the first of the cameras, the usual one."""
        self.view = self.usual = usual = views[0]
        self._other = views[-1]
        self.tracker = Tracker(config)
        self.landmarks = Landmarks()
        self.exposures = Exposures(usual.camera, config)
        self.predictor = MotionPredictor(usual.T_body_cam, PATIENCE_S)
        self.T_key_cam: Array = np.eye(4)
        self.lacks_depth = False
        self._config = config

    def __len__(self) -> int:
        return len(self.tracker)

    @property
    def camera(self) -> Camera:
        """The camera that is looked through."""
        return self.view.camera

    @property
    def sigma_xy(self) -> float:
        """Standard deviation of a track on z = 1."""
        return self._config.track_sigma_px / self.view.camera.fx

    # -- from frame to frame -----------------------------------------------------------------------------------------

    def predicted(self, dt_s: float, imu: ImuSpan | None) -> Array:
        """Return the T_key_cam [4, 4] expected after `dt_s`; its rotation is from `imu`, where that is given."""
        return self.T_key_cam @ self.predictor.predict(dt_s, imu)

    def follow(self, frame: Frame, T_guess: Array, dt_s: float) -> Array:
        """Return the pixels [N, 2] of all tracks in a frame, searched from a guess [4, 4] `dt_s` after the last."""
        twist = se3_log(invert(self.T_key_cam) @ T_guess) / dt_s
        predicted, _ = move(self.landmarks.mean, self.landmarks.covariance, T_guess)
        return self.tracker.follow(frame, self.exposures.shutter.project(predicted, twist))

    def measure(
        self, frame: Frame, pixels: Array, seen: Array, rho: Array, twist_per_s: Array, to_learn: bool
    ) -> DepthReading:
        """Return the depth of all tracks in a frame, see `DepthLag.measure`."""
        ids = self.tracker.ids
        return self.exposures.lag.measure(self.view.depth, frame, pixels, seen, rho, twist_per_s, ids, to_learn)

    def moved(self, T_key_cam: Array, dt_s: float, was_lost: bool) -> None:
        """Take where a frame was placed; the velocity follows from its motion unless the one before `was_lost`."""
        T_before, self.T_key_cam = self.T_key_cam, T_key_cam
        if not was_lost:
            self.predictor.observe(invert(T_before) @ T_key_cam, dt_s)

    def key_xy(self, keyframe: Keyframe) -> tuple[Array, float]:
        """Return the tracks' directions [N, 2] in the keyframe, and the variances of a distance in those of a pixel.

        Given tracks are taken as they were seen there, not as they were improved: their noise is then known.
        """
        given = keyframe.frame.tracks
        if given is None:
            return self.landmarks.mean[:, :2], 1.0
        return self.camera.normalise(given_rows(given, given.pixels_px, self.tracker.ids)), 2.0

    def observations(self, good: Bools, pixels: Array, xy: Array) -> Observations:
        """Return what a frame between keyframes sees of tracks `good` [N]: all at `pixels` and `xy` [N, 2]."""
        ids = self.tracker.ids[good].copy()
        if self.view.is_swapped:
            means, covariances = move(self.landmarks.mean[good], self.landmarks.covariance[good], self.T_key_cam)
            return self._as_usual_would(ids, xy[good], means, covariances)
        return Observations(ids, pixels[good], instant_px=self.exposures.shutter.instant_px(xy[good]))

    def judge(self, good: Bools) -> None:
        """Drop tracks that were not `good` [N] for too many frames."""
        self.landmarks.keep(self.tracker.judge(good))

    # -- keyframes ---------------------------------------------------------------------------------------------------

    def forget(self) -> None:
        """Drop all tracks."""
        self.tracker.forget()
        self.landmarks = Landmarks()

    def begin(self, frame: Frame, twist_per_s: Array) -> Observations:
        """Begin at a frame, at a velocity [6] of the camera, with new tracks only; return what it sees of them."""
        self.forget()
        count = self.tracker.begin(frame, np.zeros(0, dtype=np.bool_), np.empty((0, 2)))
        reading = self._add_landmarks(frame, count, twist_per_s)
        return self._all(self.tracker.pixels, reading, self.landmarks.mean[:, :2], twist_per_s)

    def carry_on(self, frame: Frame, attempt: Attempt) -> Observations:
        """Carry tracks that agree into a keyframe, improve their landmarks by what it measures, fill the gaps."""
        kept, twist = attempt.agreeing, attempt.twist_per_s
        reading = self.exposures.lag.measure(
            self.view.depth, frame, attempt.pixels[kept], attempt.seen[kept], attempt.expected_rho[kept], twist,
            self.tracker.ids[kept],
        )  # fmt: skip
        landmarks = self.landmarks.carried(
            kept, self.T_key_cam, attempt.xy[kept], self.sigma_xy, reading.rho, reading.sigma_rho, reading.slope
        )
        self.landmarks = landmarks
        # the patch that is followed from now on is the one where the landmark is believed to be
        pixels = attempt.pixels.copy()
        pixels[kept] = self.exposures.shutter.project(landmarks.mean, twist)
        count = self.tracker.begin(frame, kept, pixels)
        fresh = self._add_landmarks(frame, count, twist)
        seen_at = np.vstack([attempt.pixels[kept], self.tracker.pixels[len(self) - count :]])
        instant = np.vstack([attempt.xy[kept], landmarks.mean[len(landmarks.mean) - count :, :2]])
        measured = reading.joined(fresh)
        self.lacks_depth = len(measured.rho) > np.isfinite(measured.rho).sum() / _DEEP
        return self._all(seen_at, measured, instant, twist)

    def exposed(self, whole: Frame, twist_per_s: Array) -> Exposed:
        """Return when rows and depth of a new keyframe were taken, at a velocity [6] of the camera."""
        usual_twist = np.zeros(6) if self.view.is_swapped else twist_per_s
        return self.exposures.of_keyframe(self.usual.depth, whole, usual_twist, self.landmarks.expected_rho)

    def anchor(self, twist_per_s: Array) -> None:
        """Count motion from the frame that just became the keyframe, at a velocity [6] of the camera."""
        self.exposures.key_twist_per_s = twist_per_s
        self.T_key_cam = np.eye(4)

    def _add_landmarks(self, frame: Frame, count: int, twist_per_s: Array) -> DepthReading:
        """Give the tracker's last `count` corners landmarks; return their depth reading."""
        first = len(self) - count
        pixels = self.tracker.pixels[first:]
        seen = self.camera.normalise(pixels)
        expected_rho = self.landmarks.expected_rho(seen)
        reading = self.exposures.lag.measure(
            self.view.depth, frame, pixels, seen, expected_rho, twist_per_s, self.tracker.ids[first:]
        )
        xy = self.exposures.shutter.to_instant(pixels, seen, np.nan_to_num(reading.rho), twist_per_s)
        # a corner is its patch in the keyframe; a point that was followed elsewhere is as noisy here as anywhere
        sigma_xy = self.sigma_xy if frame.tracks is not None else _CORNER_SIGMA * self.sigma_xy
        self.landmarks.append(xy, reading.rho, sigma_xy, reading.sigma_rho, reading.slope)
        return reading

    def _all(self, pixels: Array, reading: DepthReading, xy: Array, twist_per_s: Array) -> Observations:
        """Return what a keyframe sees: raw pixels [N, 2] and directions [N, 2] of the middle row's time."""
        ids = self.tracker.ids.copy()
        if self.view.is_swapped:
            return self._as_usual_would(ids, xy, self.landmarks.mean, self.landmarks.covariance)
        return Observations(
            ids, pixels.copy(), reading.right_px, reading.depth_m, instant_px=self.exposures.shutter.instant_px(xy),
            right_instant_px=self._right_at_once(xy, reading, twist_per_s),
        )  # fmt: skip

    def _right_at_once(self, xy: Array, reading: DepthReading, twist_per_s: Array) -> Array | None:
        """Return where a second camera would have seen the same at the middle row's time; None as `Shutter.instant_px`.

        Both read their rows at the same times. Undone in one image alone, the shear would become disparity.
        """
        right_px, other = reading.right_px, self._other
        shutter = Shutter(other.camera, self.exposures.shutter.readout_s)
        if right_px is None or shutter.readout_s == 0.0:
            return None
        there, _ = self.view.carry(np.column_stack([xy, reading.rho]), np.zeros((len(xy), 3, 3)), other)
        twist_there = se3_adjoint(np.asarray(invert(other.T_body_cam) @ self.view.T_body_cam)) @ twist_per_s
        seen = other.camera.normalise(right_px)
        return shutter.instant_px(shutter.to_instant(right_px, seen, there[:, 2], twist_there))

    def _as_usual_would(self, ids: NDArray[np.int64], xy: Array, means: Array, covariances: Array) -> Observations:
        gate_px = EPIPOLAR_GATE_PX
        return self.view.as_other_would(self.usual, ids, xy, means, covariances, gate_px)

    # -- another camera of the rig -----------------------------------------------------------------------------------

    def look_through(self, view: View) -> None:
        """Let another camera of the rig be the one that is followed; what is known of the keyframe stays behind."""
        if view is self.view:
            return
        T_cam_other = invert(self.view.T_body_cam) @ view.T_body_cam
        back = se3_adjoint(np.asarray(invert(T_cam_other)))
        self.T_key_cam = invert(T_cam_other) @ self.T_key_cam @ T_cam_other
        self.exposures.look_through(view.camera, back)
        self.predictor.look_through(view.T_body_cam, np.asarray(T_cam_other))
        self.view = view

    def carry_keyframe(self, view: View, keyframe: Keyframe) -> None:
        """Look through another camera at the same keyframe; landmarks that it does not see to the pixel get NaN."""
        landmarks = Landmarks()
        landmarks.mean, landmarks.covariance = self.view.carry(self.landmarks.mean, self.landmarks.covariance, view)
        self.look_through(view)
        vague = view.camera.fx * spread(landmarks.covariance) > EPIPOLAR_GATE_PX
        landmarks.mean[vague] = np.nan
        # from here on the landmark is the patch at this place, and no longer the one that the other camera saw
        landmarks.pin(_CORNER_SIGMA * self.sigma_xy)
        landmarks.by_delay = self.landmarks.by_delay
        self.landmarks = landmarks
        pixels = self.exposures.shutter.project(landmarks.mean, self.exposures.key_twist_per_s)
        pixels[~view.camera.contains(pixels)] = np.nan
        self.tracker.look_through(view.of(keyframe.frame).images[0], pixels)
