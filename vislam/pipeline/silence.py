"""A camera that gives no images for long: keyframes have to go on without it, or readings have nothing to hang on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vislam.core.messages import Frame

_PATIENCE_NS = 5_000_000_000  # a shorter silence is crossed by tracking on from the last image
_EVERY_NS = 1_000_000_000  # as often as a covered camera makes keyframes


class SilentCamera:
    """Stands in for a camera that is silent: frames in which it is dark, so that all goes on as for a covered one.

    The graph hangs readings on the keyframes before and after, by inertial data of which only the last seconds are
    kept; so there must be keyframes. Dark ones are few, and bounded by time alone.
    """

    def __init__(self) -> None:
        """Start before the first frame."""
        self.frames = 0  # that were put in
        self._last: Frame | None = None  # of the camera
        self._newest_ns = 0  # dark ones included

    def see(self, frame: Frame) -> None:
        """Take a frame of the camera."""
        self._last, self._newest_ns = frame, frame.t_ns

    def stand_in(self, t_ns: int) -> Frame | None:
        """Return the dark frame that is due at a time, a nanosecond before it; None: there is none.

        The camera's own next frame has that time, or a later one.
        """
        last = self._last
        if last is None or t_ns - last.t_ns < _PATIENCE_NS or t_ns - self._newest_ns < _EVERY_NS:
            return None
        self._newest_ns = t_ns - 1
        self.frames += 1
        return dark(last, self._newest_ns)


def dark(frame: Frame, t_ns: int) -> Frame:
    """Return a frame like another in which nothing is seen."""
    tracks = frame.tracks
    if tracks is not None:
        tracks = replace(
            tracks, track_ids=tracks.track_ids[:0], pixels_px=tracks.pixels_px[:0],
            right_px=None if tracks.right_px is None else tracks.right_px[:0],
            depth_m=None if tracks.depth_m is None else tracks.depth_m[:0],
            descriptors=None if tracks.descriptors is None else tracks.descriptors[:0],
        )  # fmt: skip
    return Frame(
        t_ns, frame.index, tuple(np.zeros_like(image) for image in frame.images),
        None if frame.color is None else np.zeros_like(frame.color),
        None if frame.depth_m is None else np.zeros_like(frame.depth_m), tracks,
    )  # fmt: skip
