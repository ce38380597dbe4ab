"""Cameras beyond the first, or the first pair: each follows corners of its own, which filter and window tie together.

No overlap is needed. A front end places the body by its own camera or pair; from the motion that it measures, else that
of the filter, follow where tracks of the other cameras are searched for and which of them move by themselves.
"""

from dataclasses import replace

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.geometry import invert
from vislam.core.memory import Learned
from vislam.core.messages import NO_IMAGE, Array, Bools, Frame, FurtherTracks, ImuSpan, Observations
from vislam.frontend.attempt import MotionPredictor
from vislam.frontend.keyframes import PATIENCE_S
from vislam.frontend.result import FrontEnd, TrackResult
from vislam.frontend.tracker import Tracker
from vislam.vision.two_view import direction_given_rotation, epipolar_distances, from_epipolar_segment

_SHARE = 0.5  # of the usual tracks, for each further camera
_ID_BITS = 40  # of a track's id, below the camera's number
_WORN = 0.5  # of the tracks are still followed at least, or new ones are looked for


class FurtherCamera:
    """Owns the tracks of one camera."""

    _begun: int  # tracks at the last beginning
    _last_px: Array  # [N, 2] of every track in the last frame, guessed where it was not found
    _T_begun_now: Array  # [4, 4] of the body since the beginning, or its rotation alone
    _is_known: bool  # whether it is all of the motion

    def __init__(self, number: int, config: FrontEndConfig, rig: Rig) -> None:
        """Start without tracks; `number` is the camera's in the rig."""
        self.number, self._camera, self._T_body_cam = number, rig.cameras[number], rig.T_body_cams[number]
        self._config = replace(config, max_tracks=max(round(_SHARE * config.max_tracks), 1))
        self._tracker, self._first_id = Tracker(self._config), number << _ID_BITS
        self.begin_at(0)

    @property
    def next_track_id(self) -> int:
        """The number of the next new track, of this camera's."""
        return self._tracker.next_id - self._first_id

    def begin_at(self, next_track_id: int) -> None:
        """Drop all tracks; number new ones from `next_track_id` on."""
        self._tracker.forget()
        self._tracker.next_id = self._first_id + next_track_id
        self._begun, self._last_px, self._T_begun_now, self._is_known = 0, np.empty((0, 2)), np.eye(4), True

    def follow(self, frame: Frame, T_last_now: Array, is_known: bool, is_keyframe: bool) -> FurtherTracks | None:
        """Return what the camera sees of its tracks; None where the frame has no image of it, nor tracks.

        Args:
            frame: all cameras'.
            T_last_now: the body's motion [4, 4] since the last frame, or its rotation alone.
            is_known: whether it is all of the motion, in metres.
            is_keyframe: whether the frame became a keyframe.
        """
        self._T_begun_now, self._is_known = self._T_begun_now @ T_last_now, self._is_known and is_known
        alone = self._alone(frame)
        if alone is None:
            return None
        T_cam = invert(self._T_body_cam) @ T_last_now @ self._T_body_cam
        guess = self._camera.project(self._camera.unproject(self._last_px) @ T_cam[:3, :3])
        pixels = self._tracker.follow(alone, guess)
        good = np.isfinite(pixels[:, 0]) & ~self._astray(pixels)
        self._last_px = np.where(good[:, None], pixels, guess)
        ids, seen = self._tracker.ids[good], pixels[good]
        if is_keyframe or good.sum() < _WORN * self._begun or not self._begun:
            fresh = self._tracker.begin(alone, good, pixels)
            self._begun, self._T_begun_now, self._is_known = len(self._tracker), np.eye(4), True
            self._last_px = self._tracker.pixels.copy()
            ids = np.concatenate([ids, self._tracker.ids[len(self._tracker) - fresh :]])
            seen = np.vstack([seen, self._tracker.pixels[len(self._tracker) - fresh :]])
        else:
            self._last_px = self._last_px[self._tracker.judge(good)]
        return FurtherTracks(self.number, ids.copy(), seen)

    def _alone(self, frame: Frame) -> Frame | None:
        """Return the frame as if this camera were the only one; None where it gave nothing."""
        if frame.tracks is not None:
            for seen in frame.tracks.further:
                if seen.camera == self.number:
                    good = self._camera.contains(seen.pixels_px)
                    return replace(frame, tracks=Observations(seen.track_ids[good], seen.pixels_px[good]))
            return None
        image = frame.images[self.number] if self.number < len(frame.images) else NO_IMAGE
        return replace(frame, images=(image,), masks=(frame.mask(self.number),)) if image.size else None

    def _astray(self, pixels: Array) -> Bools:
        """Return which tracks [N] no depth explains by the body's motion; where only its turn is known, most decide."""
        T = invert(self._T_body_cam) @ self._T_begun_now @ self._T_body_cam
        key_xy, xy = self._camera.normalise(self._tracker.pixels), self._camera.normalise(pixels)
        if self._is_known:
            off = from_epipolar_segment(T, key_xy, xy, 1.0 / self._config.min_depth_m)
        else:
            direction = direction_given_rotation(T[:3, :3], key_xy, xy)
            T[:3, 3] = 0.0 if direction is None else direction
            off = np.abs(epipolar_distances(T, key_xy, xy))
        with np.errstate(invalid="ignore"):
            return np.asarray(self._camera.fx * off > self._config.astray_px)


class WithFurtherCameras:
    """A front end, and what the cameras see that it does not look through. Implements `FrontEnd`."""

    def __init__(self, front: FrontEnd, config: FrontEndConfig, rig: Rig) -> None:
        """Take what places the body."""
        self._front = front
        self.mode, self.knows_scale = front.mode, front.knows_scale
        self._rig = rig
        self._cameras = tuple(FurtherCamera(number, config, rig) for number in rig.further)
        self._predictor = MotionPredictor(np.eye(4), PATIENCE_S)
        self._T_key_last: Array | None = None  # [4, 4] of the body at the last frame since keyframe `_key_id`
        self._key_id, self._t_ns = -1, 0

    @property
    def keyframe_spacing(self) -> float:
        """See FrontEnd."""
        return self._front.keyframe_spacing

    @keyframe_spacing.setter
    def keyframe_spacing(self, factor: float) -> None:
        self._front.keyframe_spacing = factor

    def track(
        self, frame: Frame, imu: ImuSpan | None, gyro_sigma_rad_s: float = np.inf, T_last_now: Array | None = None
    ) -> TrackResult:
        """See FrontEnd.track; what further cameras see is in the observations."""
        for given in () if frame.tracks is None else frame.tracks.further:
            self._check(given, frame.index)
        result = self._front.track(frame, imu, gyro_sigma_rad_s, T_last_now)
        motion, is_known = self._motion(result, imu, (frame.t_ns - self._t_ns) * 1e-9, T_last_now)
        followed = [c.follow(frame, motion, is_known, result.keyframe is not None) for c in self._cameras]
        seen = tuple(tracks for tracks in followed if tracks is not None)
        self._t_ns = frame.t_ns
        return replace(result, observations=replace(result.observations, further=seen))

    def _motion(
        self, result: TrackResult, imu: ImuSpan | None, dt_s: float, T_last_now: Array | None
    ) -> tuple[Array, bool]:
        """Return the body's motion [4, 4] since the last frame, and whether that is all of it, in metres."""
        vo, T_before = result.vo, self._T_key_last if result.vo.keyframe_id == self._key_id else None
        T_now = vo.T_keyframe_body
        if result.keyframe is not None:
            self._key_id, self._T_key_last = result.keyframe.id, np.eye(4)
        else:
            self._key_id, self._T_key_last = vo.keyframe_id, T_now
        if T_now is not None and T_before is not None:
            T = invert(T_before) @ T_now
            if vo.has_scale:
                self._predictor.observe(T, dt_s)
                return T, True
            T[:3, 3] = 0.0 if T_last_now is None else T_last_now[:3, 3]
            return T, T_last_now is not None
        if T_last_now is not None:
            return T_last_now, True
        return self._predictor.predict(dt_s, imu), False

    def _check(self, given: FurtherTracks, index: int) -> None:
        """Raise DataError unless given tracks are those of a further camera, with one pixel each."""
        ids = given.track_ids
        if given.camera not in self._rig.further:
            raise DataError(
                f"frame {index}: tracks of cam{given.camera} came by themselves, the rig's further cameras are "
                f"{', '.join(f'cam{k}' for k in self._rig.further)}"
            )
        if given.pixels_px.shape != (len(ids), 2) or len(np.unique(ids)) != len(ids):
            raise DataError(f"frame {index}: tracks of cam{given.camera} need one pixel each and ids that are unique")

    def begin_at(self, keyframe_id: int, learned: Learned, seeks_place: bool = False) -> None:
        """See FrontEnd.begin_at."""
        self._front.begin_at(keyframe_id, learned, seeks_place)
        self._T_key_last, self._key_id = None, -1
        for camera in self._cameras:
            camera.begin_at(learned.next_track_id)

    @property
    def learned(self) -> Learned:
        """See FrontEnd.learned."""
        learned = self._front.learned
        ids = [camera.next_track_id for camera in self._cameras]
        return replace(learned, next_track_id=max(learned.next_track_id, *ids))

    @property
    def calibration(self) -> dict[str, float]:
        """See FrontEnd.calibration."""
        return self._front.calibration
