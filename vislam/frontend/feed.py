"""What the camera delivers, before anything is made of it: frames that are missing, and frames that are repeated."""

from __future__ import annotations

import numpy as np

from vislam.core.messages import Frame, ImageU8

_EVERY_PX = 8  # the image is compared with the one before at one pixel in so many, each way
_MEDIAN_OF = 31  # intervals, that tell the usual one


class CameraFeed:
    """Owns a small copy of the last image and the last intervals.

    Attributes:
        frames: so far.
        missing: frames that an even rate would have brought.
        repeated: images equal to the one before to the last bit while the body moved, which noise makes impossible.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.frames = self.missing = self.repeated = 0
        self._last: ImageU8 | None = None
        self._last_t_ns: int | None = None
        self._intervals_ns: list[int] = []
        self._is_same = False

    def add(self, frame: Frame) -> None:
        """Take a frame as the camera gave it; `moved` has to follow."""
        self.frames += 1
        if self._last_t_ns is not None:
            step_ns = frame.t_ns - self._last_t_ns
            self._intervals_ns = [*self._intervals_ns[1 - _MEDIAN_OF :], step_ns]
            usual_ns = float(np.median(self._intervals_ns))
            self.missing += max(round(step_ns / usual_ns) - 1, 0) if usual_ns > 0.0 else 0
        self._last_t_ns = frame.t_ns
        small = frame.images[0][::_EVERY_PX, ::_EVERY_PX].copy() if frame.images else None
        self._is_same = small is not None and self._last is not None and np.array_equal(small, self._last)
        self._last = small

    def moved(self, at_rest: bool) -> None:
        """Say whether the body rested over the newest frame."""
        self.repeated += self._is_same and not at_rest
