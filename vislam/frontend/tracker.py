"""Tracks: corners of the keyframe that are followed into every later frame, with ids that outlive keyframes.

Every frame is matched against the keyframe's image, not against the previous frame: errors do not add up between
keyframes, and a track that one blurred frame loses is found again in the next. Where the exposure has changed since,
the keyframe's image is made as bright as the frame's.

A frame may bring points that were followed elsewhere (`Frame.tracks`). Then those take the place of corners and of
Lucas-Kanade, and keep their ids; once such a track has been dropped it is not taken up again under the same id.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.messages import Array, Bools, Frame, ImageU8, Observations
from vislam.vision.brightness import matched
from vislam.vision.features import FlowSettings, detect_corners, follow

CELL_PX = 48  # side of the grid cells that share the tracks
MIN_CORNER_RESPONSE = 1.0  # (grey levels / px)^2, smaller eigenvalue; sensor noise gives less
_FLOW_WINDOW_PX = 16  # Lucas-Kanade window: larger is robuster to blur, smaller to parallax, and cheaper
_FLOW_LEVELS = 3  # pyramid levels above the image: reach of about 80 px around the predicted place
MIN_START_CORNERS = 40  # an image with fewer cannot start a keyframe
# forward-backward disagreement of a good match; 0.7 drops blurred ones that still help
MAX_BACK_PX = 1.5


FindCorners = Callable[[ImageU8, Array, ImageU8 | None], Array]
"""Finds new corners: grey image [H, W], pixels [M, 2] of those that are followed, mask [H, W] -> pixels [N, 2]."""


class Tracker:
    """The corners of one keyframe image and how they fare in the frames after it."""

    def __init__(self, config: FrontEndConfig, find: FindCorners | None = None) -> None:
        """Start without tracks; `find` looks for corners instead of a grid over the whole image."""
        self._config = config
        self._find = find
        self._flow = FlowSettings(window_px=_FLOW_WINDOW_PX, levels=_FLOW_LEVELS, max_back_px=MAX_BACK_PX)
        self._image: ImageU8 | None = None
        self.next_id = 0
        self.ids: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self.pixels: Array = np.empty((0, 2))  # [N, 2] in the keyframe
        self.misses: NDArray[np.int64] = np.empty(0, dtype=np.int64)  # [N] frames in a row without a good match
        self.proven: Bools = np.zeros(0, dtype=np.bool_)  # [N] agreed in the keyframe: they go with the room
        self._given = False  # whether tracks are given
        self._dropped: set[int] = set()  # given tracks that may still be there but are not wanted any more

    def __len__(self) -> int:
        return len(self.ids)

    def forget(self) -> None:
        """Drop all tracks; given ones may then be taken up again."""
        self._keep(np.zeros(len(self.ids), dtype=np.bool_))
        self._dropped.clear()

    def follow(self, frame: Frame, guess: Array) -> Array:
        """Return the pixels [N, 2] of all tracks in `frame`, searched around `guess` [N, 2]; NaN where not found."""
        if frame.tracks is not None:
            return given_rows(frame.tracks, frame.tracks.pixels_px, self.ids)
        if self._image is None:
            return np.full((len(self), 2), np.nan)
        source = matched(self._image, frame.images[0], self.pixels, guess, self._flow.window_px)
        return follow(source, frame.images[0], self.pixels, guess, self._flow, frame.mask(0))[0]

    def follow_warped(self, frame: Frame, guess: Array, on_plane: Bools, H: Array) -> Array:
        """Return the same where tracks `on_plane` [N] lie on a plane whose homography is about H [3, 3].

        H takes pixels of the keyframe to those of the frame. Their patches are seen as it warps the keyframe: what is
        left to find is then a shift, and a way over the plane does not pull the answer to one side.
        """
        found = self.follow(frame, np.where(on_plane[:, None], np.nan, guess))
        if self._image is None or frame.tracks is not None or not on_plane.any():
            return found
        height, width = self._image.shape
        flags = cv2.INTER_LINEAR
        warped = np.asarray(cv2.warpPerspective(self._image, H, (width, height), flags=flags), dtype=np.uint8)
        at = np.column_stack([self.pixels[on_plane], np.ones(int(on_plane.sum()))]) @ H.T
        source = at[:, :2] / np.where(at[:, 2:] > 0.0, at[:, 2:], np.nan)
        warped = matched(warped, frame.images[0], source, guess[on_plane], self._flow.window_px)
        found[on_plane] = follow(warped, frame.images[0], source, guess[on_plane], self._flow, frame.mask(0))[0]
        return found

    def look_through(self, image: ImageU8, pixels: Array) -> None:
        """Follow the same tracks in another camera from now on: its keyframe `image`, and where it sees them [N, 2].

        A track that it does not see has NaN, is not found, and leaves after its misses.
        """
        self._image, self.pixels = image, pixels

    def judge(self, good: Bools) -> Bools:
        """Count misses of tracks that are not `good` [N] in this frame and drop those with too many.

        Returns:
            Which tracks [N, before the call] are still there.
        """
        self.misses = np.where(good, 0, self.misses + 1)
        alive = self.misses <= self._config.max_misses
        self._keep(alive)
        return alive

    def begin(self, frame: Frame, kept: Bools, pixels: Array) -> int:
        """Make `frame` the keyframe: tracks `kept` [N] go on at `pixels` [N, 2] in it, new corners fill the gaps.

        Returns:
            How many corners are new; they come after the kept ones.
        """
        self._keep(kept)
        self.pixels = pixels[kept].copy()
        self._given = frame.tracks is not None
        ids, fresh = self._detect(frame) if frame.tracks is None else self._take(frame.tracks)
        self.ids = np.concatenate([self.ids, ids])
        self.pixels = np.vstack([self.pixels, fresh])
        self.misses = np.zeros(len(self.ids), dtype=np.int64)
        self.proven = np.arange(len(self.ids)) < len(self.ids) - len(ids)
        self._image = frame.images[0] if frame.images else None
        return len(ids)

    def _detect(self, frame: Frame) -> tuple[NDArray[np.int64], Array]:
        """Return ids [M] and pixels [M, 2] of new corners."""
        config, image, mask = self._config, frame.images[0], frame.mask(0)
        if self._find is not None:
            fresh = self._find(image, self.pixels, mask)
        else:
            fresh = detect_corners(
                image, config.max_tracks - len(self.ids), CELL_PX, config.min_distance_px, self.pixels,
                MIN_CORNER_RESPONSE, mask,
            )  # fmt: skip
        ids = np.arange(self.next_id, self.next_id + len(fresh), dtype=np.int64)
        self.next_id += len(fresh)
        return ids, fresh

    def _take(self, given: Observations) -> tuple[NDArray[np.int64], Array]:
        """Return ids [M] and pixels [M, 2] of given tracks that are new."""
        self._dropped.intersection_update(given.track_ids.tolist())
        known = np.concatenate([self.ids, np.array(sorted(self._dropped), dtype=np.int64)])
        chosen = np.flatnonzero(~np.isin(given.track_ids, known))[: max(self._config.max_tracks - len(self.ids), 0)]
        return given.track_ids[chosen], given.pixels_px[chosen]

    def _keep(self, which: Bools) -> None:
        if self._given:
            self._dropped.update(self.ids[~which].tolist())
        self.ids, self.pixels, self.misses = self.ids[which], self.pixels[which], self.misses[which]
        self.proven = self.proven[which]


def given_rows(given: Observations, values: Array, ids: NDArray[np.int64]) -> Array:
    """Return the rows [N, ...] of `values` [M, ...] that belong to the tracks `ids` [N]; NaN for those not given."""
    out: Array = np.full((len(ids), *values.shape[1:]), np.nan)
    _, mine, theirs = np.intersect1d(ids, given.track_ids, assume_unique=True, return_indices=True)
    out[mine] = values[theirs]
    return out
