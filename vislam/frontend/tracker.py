"""Tracks: corners of the keyframe that are followed into every later frame, with ids that outlive keyframes.

Every frame is matched against the keyframe's image, not against the previous frame: errors do not add up between
keyframes, and a track that one blurred frame loses is found again in the next.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.features import FlowSettings, detect_corners, follow
from vislam.messages import Array, ImageU8

Bools = NDArray[np.bool_]


class Tracker:
    """The corners of one keyframe image and how they fare in the frames after it."""

    def __init__(self, config: FrontEndConfig) -> None:
        """Start without tracks."""
        self._config = config
        self._flow = FlowSettings(
            window_px=config.flow_window_px, levels=config.flow_levels, max_back_px=config.max_back_px
        )
        self._image: ImageU8 | None = None
        self._next_id = 0
        self.ids: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self.pixels: Array = np.empty((0, 2))  # [N, 2] in the keyframe
        self.misses: NDArray[np.int64] = np.empty(0, dtype=np.int64)  # [N] frames in a row without a good match

    def __len__(self) -> int:
        return len(self.ids)

    def forget(self) -> None:
        """Drop all tracks."""
        self._keep(np.zeros(len(self.ids), dtype=np.bool_))

    def follow(self, image: ImageU8, guess: Array) -> Array:
        """Return the pixels [N, 2] of all tracks in `image`, searched around `guess` [N, 2]; NaN where not found."""
        if self._image is None:
            return np.full((len(self), 2), np.nan)
        return follow(self._image, image, self.pixels, guess, self._flow)[0]

    def judge(self, good: Bools) -> Bools:
        """Count misses of tracks that are not `good` [N] in this frame and drop those with too many.

        Returns:
            Which tracks [N, before the call] are still there.
        """
        self.misses = np.where(good, 0, self.misses + 1)
        alive = self.misses <= self._config.max_misses
        self._keep(alive)
        return alive

    def begin(self, image: ImageU8, kept: Bools, pixels: Array) -> int:
        """Make `image` the keyframe: tracks `kept` [N] go on at `pixels` [N, 2] in it, new corners fill the gaps.

        Returns:
            How many corners are new; they come after the kept ones.
        """
        self._keep(kept)
        self.pixels = pixels[kept].copy()
        config = self._config
        fresh = detect_corners(
            image, config.max_tracks - len(self.ids), config.cell_px, config.min_distance_px, self.pixels,
            config.min_corner_response,
        )  # fmt: skip
        count = len(fresh)
        self.ids = np.concatenate([self.ids, np.arange(self._next_id, self._next_id + count, dtype=np.int64)])
        self._next_id += count
        self.pixels = np.vstack([self.pixels, fresh])
        self.misses = np.zeros(len(self.ids), dtype=np.int64)
        self._image = image
        return count

    def _keep(self, which: Bools) -> None:
        self.ids, self.pixels, self.misses = self.ids[which], self.pixels[which], self.misses[which]
