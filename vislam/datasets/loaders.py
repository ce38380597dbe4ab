"""Loading of frame i of a recording: from image files, or from a video that is read front to back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from vislam.core.camera import Camera, Rig
from vislam.core.encoded_image import most_pixels
from vislam.core.errors import DataError
from vislam.core.messages import NO_IMAGE, ImageF32, ImageU8
from vislam.core.reading import check_file, readable
from vislam.core.recording import Problems
from vislam.datasets.images import (
    DepthFormat,
    ImageList,
    SixteenBits,
    Stamps,
    UnreadableImageError,
    bits_of,
    check_size_px,
    grey_and_color,
    read_depth,
    read_grey_or_color,
)
from vislam.vision.depth_registration import DepthCamera, DepthRegistration


@dataclass(frozen=True, slots=True, eq=False)
class LoadedImages:
    """The images of one frame, or the reason why there are none.

    `trouble` beside images means that depth is missing, or the image of a further camera.
    """

    images: tuple[ImageU8, ...]
    color: ImageU8 | None = None
    depth_m: ImageF32 | None = None
    trouble: UnreadableImageError | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrameTable:
    """Which images make up each frame, by index into the lists they come from."""

    t_ns: Stamps  # [F] the stamp of cam0
    camera_rows: Stamps  # [F, cameras]
    depth_rows: Stamps  # [F], -1 where a frame has no depth


class Loader(Protocol):
    """Loads the images of frame i; `workers` threads may call it at once, and `bits` are those of its cameras."""

    workers: int
    bits: Sequence[SixteenBits]

    def load(self, i: int) -> LoadedImages:
        """Return the images of frame `i`; raises DataError when an image is not of the calibrated size."""
        ...

    def close(self) -> None:
        """Let go of what is open."""
        ...


def load_cameras(
    rig: Rig, rows: Sequence[int], read: Callable[[int, int], tuple[ImageU8, ImageU8 | None]]
) -> LoadedImages:
    """Return the images of a frame's cameras; none where one that is needed cannot be read.

    Args:
        rig: of at least as many cameras.
        rows: which image of each camera it is; -1: a further camera has none.
        read: returns grey and colour of a camera's image by its number and row.
    """
    images: list[ImageU8] = []
    color, trouble = None, None
    for camera, row in enumerate(rows):
        try:
            grey, bgr = (NO_IMAGE, None) if row < 0 else read(camera, row)
        except UnreadableImageError as error:
            if camera not in rig.further:
                return LoadedImages((), trouble=error)
            grey, bgr, trouble = NO_IMAGE, None, error
        images.append(grey)
        color = bgr if camera == 0 else color
    return LoadedImages(tuple(images), color, trouble=trouble)


class FolderLoader:
    """Loads frames from image files."""

    workers = 2

    def __init__(
        self,
        frames: FrameTable,
        cameras: tuple[ImageList, ...],
        depth: ImageList | None,
        rig: Rig,
        depth_format: DepthFormat,
    ) -> None:
        self._frames = frames
        self._cameras = cameras
        self._depth = depth
        self._rig = rig
        self._depth_format = depth_format
        self.bits: Sequence[SixteenBits] = [bits_of(*each) for each in zip(cameras, rig.cameras, strict=False)]

    def load(self, i: int) -> LoadedImages:
        """Return the images of frame `i`; raises DataError when an image is not of the calibrated size."""
        rows = self._frames.camera_rows[i].tolist()[: len(self._cameras)]
        loaded = load_cameras(
            self._rig, rows,
            lambda k, row: read_grey_or_color(self._cameras[k], row, self._rig.cameras[k], self.bits[k]),
        )  # fmt: skip
        depth_row = int(self._frames.depth_rows[i])
        if not loaded.images or self._depth is None or depth_row < 0:
            return loaded
        try:
            depth_m = read_depth(self._depth.path(depth_row), self._rig.cameras[0], self._depth_format)
        except UnreadableImageError as error:
            return replace(loaded, trouble=error)
        return replace(loaded, depth_m=depth_m)

    def close(self) -> None:
        """Nothing is held open."""


class RegisteringLoader:
    """Loads frames whose depth has a lens of its own, registered to the first camera's pixels."""

    def __init__(self, loader: Loader, depth: DepthCamera, color: Camera) -> None:
        """Take what loads the images as they are stored."""
        self.workers, self.bits = loader.workers, loader.bits
        self._loader, self._registration = loader, DepthRegistration(depth, color)

    def load(self, i: int) -> LoadedImages:
        """Return the images of frame `i`; raises DataError when an image is not of the calibrated size."""
        loaded = self._loader.load(i)
        if loaded.depth_m is None:
            return loaded
        return replace(loaded, depth_m=self._registration.registered(loaded.depth_m))

    def close(self) -> None:
        """Let go of what is open."""
        self._loader.close()


class VideoLoader:
    """Loads frames from a video file and those that follow it, in rising order only, in one thread."""

    workers = 1
    bits: Sequence[SixteenBits] = ()

    def __init__(
        self, path: Path, frame_numbers: tuple[str, ...], camera: Camera, later: tuple[tuple[Path, int], ...] = ()
    ) -> None:
        self._path = path
        self._later = list(later)  # files, and the numbers of their first frames
        self._frame_numbers = frame_numbers
        self._camera = camera
        self._next = 0
        self._capture = open_video(path)
        check_size_px(_video_size(self._capture), camera, path)

    def load(self, i: int) -> LoadedImages:
        """Return frame `i`; raises DataError when the size changes within the video."""
        wanted = int(self._frame_numbers[i])
        while self._later and wanted >= self._later[0][1]:
            self._capture.release()
            self._path, self._next = self._later.pop(0)
            self._capture = open_video(self._path)
        while self._next <= wanted:
            if not self._capture.grab():
                return LoadedImages((), trouble=UnreadableImageError("video frame", self._path))
            self._next += 1
        ok, image = self._capture.retrieve()
        if not ok or image is None:
            return LoadedImages((), trouble=UnreadableImageError("video frame", self._path))
        check_size_px((image.shape[1], image.shape[0]), self._camera, self._path)
        grey, color = grey_and_color(np.asarray(image, dtype=np.uint8))
        return LoadedImages((grey,), color)

    def close(self) -> None:
        """Close the video file."""
        self._capture.release()


def video_facts(path: Path) -> tuple[tuple[int, int], int]:
    """Return (width, height) and frame count of a video, the count 0 if unknown; raises DataError if unreadable."""
    capture = open_video(path)
    try:
        return _video_size(capture), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        capture.release()


def check_film(path: Path, images: ImageList, rig: Rig | None, problems: Problems) -> None:
    """Count frames of a film behind the last of its images, whose files are numbers of frames, and compare its size.

    Raises DataError where it cannot be read, or is not of the size of the rig's camera.
    """
    size, frames = video_facts(path)  # some containers do not know how many; of joined films they are the first's
    last = int(images.files[-1]) + 1 if images.files else 0
    problems.count("video frame without a stamp", times=max(0, frames - last))
    if rig is not None:
        check_size_px(size, rig.cameras[0], path)


def open_video(path: Path) -> cv2.VideoCapture:
    """Return an open video; raises DataError when it cannot be read or decoded."""
    with readable(path):
        check_file(path)
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DataError(f"{path} cannot be opened as a video; check that it plays, or convert it to H.264 or MJPEG")
    width, height = _video_size(capture)
    if width * height > most_pixels(path.stat().st_size):
        raise DataError(f"{path}: {width}x{height} pixels are far more than its bytes can hold; convert it smaller")
    return capture


def _video_size(capture: cv2.VideoCapture) -> tuple[int, int]:
    return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
