"""The door of a front end: what a camera delivers, and what every frame is checked for before it is looked at."""

from dataclasses import replace

import cv2
import numpy as np

from vislam.core.camera import Rig
from vislam.core.errors import DataError
from vislam.core.messages import Frame, ImageU8, Observations, chosen
from vislam.core.streams import Happening, Repeats, StreamEvent, StreamJudge

_DESCRIPTOR_BYTES = 32
_EVERY_PX = 8  # depth is looked for in every eighth row and column
_OLD_NS = 500_000_000  # that a depth image stays the same, at most: such sensors give five a second at least
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
        for number, (camera, image) in enumerate(zip(self._rig.cameras, frame.images, strict=False)):
            if image.size or number not in self._rig.further:
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
        return chosen(given, good)


class CameraFeed:
    """Judges what the cameras of a frame deliver, by the streams `cam0`, `cam1`, ... and `depth0`.

    Attributes:
        frames: so far.
        missing: frames that an even rate would have brought.
        repeated: images of cam0 equal to the one before while the body moved, which noise makes impossible.
        frozen: those of them that were several in a row.
        first_t_ns: of the first one; None before it.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.frames = self.missing = self.repeated = self.frozen = 0
        self.first_t_ns: int | None = None
        self._judges = {"cam0": StreamJudge("cam0", hole_s=_HOLE_S)}
        self._repeats: dict[str, Repeats] = {}
        self._before_ns: int | None = None
        self._last_t_ns: int | None = None
        self._depth_ns = 0  # of the newest depth image that was another one than before

    @property
    def events(self) -> list[StreamEvent]:
        """What happened to the streams so far."""
        return [event for judge in self._judges.values() for event in judge.events]

    @property
    def is_frozen(self) -> bool:
        """Whether the newest frame is one of long ago again, and shows nothing of its own time."""
        return self._is_stuck("cam0") and (self._depth_ns != self._last_t_ns or "depth0" not in self._repeats)

    def count(self, frame: Frame) -> None:
        """Take note of a frame that no camera gave."""
        self.frames += 1
        self.first_t_ns = frame.t_ns if self.first_t_ns is None else self.first_t_ns

    def add(self, frame: Frame) -> Frame:
        """Take a frame as the camera gave it; return it with black for what shows nothing. `moved` has to follow."""
        self.count(frame)
        usual_ns = self._judges["cam0"].usual_ns
        if self._last_t_ns is not None and usual_ns:
            self.missing += max(round((frame.t_ns - self._last_t_ns) / usual_ns) - 1, 0)
        self._before_ns, self._last_t_ns = self._last_t_ns, frame.t_ns
        images = tuple(self._seen(f"cam{k}", image) if image.size else image for k, image in enumerate(frame.images))
        if not images:
            self._judges["cam0"].takes(frame.t_ns)
        depth_m = frame.depth_m
        if depth_m is not None:
            is_same = self._repeats.setdefault("depth0", Repeats()).take(depth_m)
            self._depth_ns = self._depth_ns if is_same else frame.t_ns
            judge = self._judge("depth0", frame.t_ns)
            if not (depth_m[::_EVERY_PX, ::_EVERY_PX] > 0.0).any():
                judge.note(Happening.DARK, frame.t_ns, frame.t_ns)
            depth_m = np.zeros_like(depth_m) if self._is_depth_old else depth_m
        return replace(frame, images=images, depth_m=depth_m)

    def moved(self, at_rest: bool, are_two: bool) -> None:
        """Say whether the body rested over the newest frame, and whether tracks show two motions in it."""
        t_ns = self._last_t_ns
        if t_ns is None:
            return
        if are_two:
            self._judges["cam0"].note(Happening.MOVING, t_ns, t_ns)
        if at_rest:
            return
        for name, repeats in self._repeats.items():
            if repeats.row and name != "depth0":
                self._judges[name].note(Happening.REPEATED, self._before_ns or t_ns, t_ns)
        if self._is_depth_old:
            self._judges["depth0"].note(Happening.REPEATED, self._depth_ns, t_ns)
        if "cam0" in self._repeats and self._repeats["cam0"].row:
            self.repeated += 1
            self.frozen += self.is_frozen

    def _judge(self, name: str, t_ns: int) -> StreamJudge:
        judge = self._judges.setdefault(name, StreamJudge(name, hole_s=_HOLE_S))
        judge.takes(t_ns)
        return judge

    def _seen(self, name: str, image: ImageU8) -> ImageU8:
        """Return an image of the newest frame, black where it shows nothing of its own time."""
        t_ns = self._last_t_ns or 0
        is_dark = self._judge(name, t_ns).look(image, t_ns, t_ns)
        self._repeats.setdefault(name, Repeats()).take(image)
        is_frozen = name != "cam0" and self._is_stuck(name)  # of cam0, depth has to be asked, too
        return np.zeros_like(image) if is_frozen or is_dark else image

    def _is_stuck(self, name: str) -> bool:
        repeats = self._repeats.get(name)
        return repeats is not None and repeats.row >= _STUCK_ROWS and repeats.changed > _ALIVE

    @property
    def _is_depth_old(self) -> bool:
        """Whether depth is one of long ago, though the image before it is not; it may have a lower rate."""
        if not {"cam0", "depth0"} <= self._repeats.keys() or self._last_t_ns is None or self._repeats["cam0"].row:
            return False
        return self._last_t_ns - self._depth_ns > _OLD_NS
