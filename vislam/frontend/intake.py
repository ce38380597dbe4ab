"""The door of a front end: what a camera delivers, and what every frame is checked for before it is looked at."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.messages import Frame, ImageF32, ImageU8, Observations
from vislam.core.streams import Happening, StreamJudge

_DESCRIPTOR_BYTES = 32
_EVERY_PX = 8  # the image is compared with the one before at one pixel in so many, each way
_HOLE_S = 0.25  # without a frame, at least
_STUCK_ROWS = 2  # images equal to the one before, from which on they show nothing: one may be a hiccup
_ALIVE = 0.5  # of the pixels that change from frame to frame, by noise or motion: equal images then are no rest


class Intake:
    """Refuses frames that do not fit the rig or do not advance in time, and seeds OpenCV's random numbers per frame."""

    def __init__(self, rig: Rig, seed: int) -> None:
        """Take the rig that frames must fit.

        Attributes:
            refused_tracks: given points that were not numbers or not in the image.
        """
        self.refused_tracks = 0
        self._rig = rig
        self._seed = seed
        self._t_ns: int | None = None

    def accept(self, frame: Frame) -> tuple[Frame, float]:
        """Return the frame as it can be used and the seconds since the previous one, 0 for the first.

        Given points that are not numbers or not in the image are left out and counted. Raises DataError when time does
        not advance, an image is missing or has not the calibrated size, or given tracks do not fit together.
        """
        if not frame.images and frame.tracks is None:
            raise DataError(f"frame {frame.index} has no image and no tracks")
        if self._t_ns is not None and frame.t_ns <= self._t_ns:
            raise DataError(
                f"frame {frame.index} at {frame.t_ns} ns does not come after the one at {self._t_ns} ns; "
                "frames must be in time order"
            )
        for camera, image in zip(self._rig.cameras, frame.images, strict=False):
            camera.check_image(image)
        if frame.depth_m is not None:
            self._rig.cameras[0].check_image(frame.depth_m)
        if frame.tracks is not None:
            frame = replace(frame, tracks=self._usable(frame.index, frame.tracks))
        dt_s = 0.0 if self._t_ns is None else (frame.t_ns - self._t_ns) * 1e-9
        self._t_ns = frame.t_ns
        cv2.setRNGSeed((self._seed + frame.index) % 2**31)
        return frame, dt_s

    def _usable(self, index: int, given: Observations) -> Observations:
        """Return the given tracks without those that cannot be used."""
        count = len(given.track_ids)
        shapes = {
            "pixels_px": (given.pixels_px, (count, 2)),
            "right_px": (given.right_px, (count, 2)),
            "depth_m": (given.depth_m, (count,)),
            "descriptors": (given.descriptors, (count, _DESCRIPTOR_BYTES)),
        }
        for name, (values, shape) in shapes.items():
            if values is not None and values.shape != shape:
                raise DataError(f"frame {index}: {count} tracks came with {name} of shape {values.shape}")
        if len(np.unique(given.track_ids)) != count:
            raise DataError(f"frame {index}: a track id came twice; ids must be unique within a frame")
        good = self._rig.cameras[0].contains(given.pixels_px)
        if good.all():
            return given
        self.refused_tracks += int((~good).sum())
        return Observations(
            given.track_ids[good],
            given.pixels_px[good],
            None if given.right_px is None else given.right_px[good],
            None if given.depth_m is None else given.depth_m[good],
            descriptors=None if given.descriptors is None else given.descriptors[good],
        )


class CameraFeed:
    """Owns a small copy of the last image.

    Attributes:
        frames: so far.
        missing: frames that an even rate would have brought.
        repeated: images equal to the one before to the last bit while the body moved, which noise makes impossible.
        frozen: those of them that were several in a row.
        judge: of their times, and of what happened to images.
        first_t_ns: of the first one; None before it.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.frames = self.missing = self.repeated = self.frozen = 0
        self.judge = StreamJudge("cam0", hole_s=_HOLE_S)
        self.first_t_ns: int | None = None
        self._last: ImageU8 | None = None
        self._last_depth_m: ImageF32 | None = None
        self._has_new_depth = False  # other than that of the frame before
        self._last_t_ns: int | None = None
        self._same = 0  # images in a row that equal the one before
        self._changed = 0.0  # share of the pixels, in the newest that did not

    @property
    def is_frozen(self) -> bool:
        """Whether the newest frame is one of long ago again, and shows nothing of its own time."""
        return self._same >= _STUCK_ROWS and self._changed > _ALIVE and not self._has_new_depth

    def count(self, frame: Frame) -> None:
        """Take note of a frame that no camera gave."""
        self.frames += 1
        self.first_t_ns = frame.t_ns if self.first_t_ns is None else self.first_t_ns

    def add(self, frame: Frame) -> None:
        """Take a frame as the camera gave it; `moved` has to follow."""
        self.count(frame)
        usual_ns = self.judge.usual_ns
        self.judge.takes(frame.t_ns)
        if self._last_t_ns is not None and usual_ns:
            self.missing += max(round((frame.t_ns - self._last_t_ns) / usual_ns) - 1, 0)
        self._last_t_ns = frame.t_ns
        small = frame.images[0][::_EVERY_PX, ::_EVERY_PX].copy() if frame.images else None
        depth_m = None if frame.depth_m is None else frame.depth_m[::_EVERY_PX, ::_EVERY_PX].copy()
        if small is not None and self._last is not None and small.shape == self._last.shape:
            changed = float(np.mean(small != self._last))
            self._same, self._changed = (0, changed) if changed else (self._same + 1, self._changed)
        before = self._last_depth_m
        self._has_new_depth = (
            depth_m is not None and before is not None and not np.array_equal(depth_m, before, equal_nan=True)
        )
        if frame.images:
            self.judge.look(frame.images[0], frame.t_ns, frame.t_ns)
        self._last, self._last_depth_m = small, depth_m

    def moved(self, at_rest: bool, are_two: bool) -> None:
        """Say whether the body rested over the newest frame, and whether tracks show two motions in it."""
        if are_two and self._last_t_ns is not None:
            self.judge.note(Happening.MOVING, self._last_t_ns, self._last_t_ns)
        if self._same and not at_rest and self._last_t_ns is not None:
            self.repeated += 1
            self.frozen += self.is_frozen
            self.judge.note(Happening.REPEATED, self._last_t_ns, self._last_t_ns)
