"""The second camera of a stereo rig: it is looked through while the first is covered."""

from __future__ import annotations

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.geometry import invert
from vislam.core.messages import Array, Frame, Keyframe
from vislam.frontend.attempt import Attempt
from vislam.frontend.keyframe_tracks import KeyframeTracks
from vislam.frontend.placing import Placer
from vislam.frontend.view import View, sees


class SecondCamera:
    """Decides which camera of a rig is looked through; with one, it is always that."""

    def __init__(self, config: FrontEndConfig, views: tuple[View, ...], tracks: KeyframeTracks, placer: Placer) -> None:
        """Take the cameras, the usual one first, and what follows tracks through one of them."""
        self._config, self._views, self._tracks, self._placer = config, views, tracks, placer
        self._key_sees = True  # whether the usual camera sees anything in the keyframe
        self._now_sees = True  # and in this frame; only asked while the other camera is looked through

    def take_keyframe(self) -> None:
        """Take note that the frame became the keyframe."""
        self._now_sees = self._now_sees or not self._tracks.view.is_swapped
        self._key_sees = self._now_sees

    def look_back(self, whole: Frame, keyframe: Keyframe) -> None:
        """Go back to the usual camera as soon as it sees again, if the keyframe has anything in its image."""
        if not self._tracks.view.is_swapped:
            return
        self._now_sees = sees(whole, 0, self._config)
        if self._now_sees and self._key_sees:
            self._tracks.carry_keyframe(self._views[0], keyframe)

    def placed(self, failed: Attempt, whole: Frame, keyframe: Keyframe, T_guess: Array, dt_s: float) -> Attempt:
        """Place a frame by the other camera and go on looking through it; where that fails, nothing has changed.

        Which camera is covered is not asked of its image: what counts is which one can be followed.
        """
        tracks, before = self._tracks, self._tracks.view
        if min(len(self._views), len(whole.images), len(keyframe.frame.images)) < 2:
            return failed
        if before.is_swapped and not self._key_sees:
            return failed
        other = self._views[not before.is_swapped]
        T_key_cam, landmarks, pixels = tracks.T_key_cam, tracks.landmarks, tracks.tracker.pixels
        T_cam_other = invert(before.T_body_cam) @ other.T_body_cam
        tracks.carry_keyframe(other, keyframe)
        self._now_sees = not other.is_swapped
        T_guess = np.asarray(invert(T_cam_other) @ T_guess @ T_cam_other)
        attempt = self._placer.attempt(other.of(whole), T_guess, dt_s)
        if not attempt.failure:
            return attempt
        tracks.look_through(before)
        self._now_sees = not before.is_swapped
        tracks.T_key_cam, tracks.landmarks = T_key_cam, landmarks
        tracks.tracker.look_through(before.of(keyframe.frame).images[0], pixels)
        return failed

    def sees_again(self, frame: Frame) -> str:
        """Return which camera was covered in the keyframe and sees again, or an empty string: a reason for another."""
        if self._tracks.view.is_swapped:
            return "cam0 sees again" if self._now_sees else ""
        lost_depth = self._tracks.lacks_depth and min(len(self._views), len(frame.images)) > 1
        return "cam1 sees again" if lost_depth and sees(frame, 1, self._config) else ""
