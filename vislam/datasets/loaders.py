"""Loading of frame i of a recording: from image files, or from a video that is read front to back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.messages import ImageF32, ImageU8
from vislam.core.reading import check_file
from vislam.datasets.images import (
    DepthFormat,
    ImageList,
    Stamps,
    UnreadableImageError,
    check_size_px,
    read_depth,
    read_grey_or_color,
)
from vislam.vision.depth_registration import DepthCamera, DepthRegistration


@dataclass(frozen=True, slots=True, eq=False)
class LoadedImages:
    """The images of one frame, or the reason why there are none; `trouble` beside images means depth is missing."""

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
    """Loads the images of frame i; `workers` threads may call it at once."""

    workers: int

    def load(self, i: int) -> LoadedImages:
        """Return the images of frame `i`; raises DataError when an image is not of the calibrated size."""
        ...

    def close(self) -> None:
        """Let go of what is open."""
        ...


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

    def load(self, i: int) -> LoadedImages:
        """Return the images of frame `i`; raises DataError when an image is not of the calibrated size."""
        images, color = [], None
        try:
            for index, (camera, stream) in enumerate(zip(self._rig.cameras, self._cameras, strict=False)):
                grey, bgr = read_grey_or_color(stream.path(int(self._frames.camera_rows[i, index])), camera)
                images.append(grey)
                color = bgr if index == 0 else color
        except UnreadableImageError as error:
            return LoadedImages((), trouble=error)
        depth_row = int(self._frames.depth_rows[i])
        if self._depth is None or depth_row < 0:
            return LoadedImages(tuple(images), color)
        try:
            depth_m = read_depth(self._depth.path(depth_row), self._rig.cameras[0], self._depth_format)
        except UnreadableImageError as error:
            return LoadedImages(tuple(images), color, trouble=error)
        return LoadedImages(tuple(images), color, depth_m)

    def close(self) -> None:
        """Nothing is held open."""


class RegisteringLoader:
    """Loads frames whose depth has a lens of its own, registered to the first camera's pixels."""

    def __init__(self, loader: Loader, depth: DepthCamera, color: Camera) -> None:
        """Take what loads the images as they are stored."""
        self.workers = loader.workers
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
        image = np.asarray(image, dtype=np.uint8)
        if image.ndim == 2:
            return LoadedImages((image,))
        return LoadedImages((np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8),), image)

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


def open_video(path: Path) -> cv2.VideoCapture:
    """Return an open video; raises DataError when it cannot be read or decoded."""
    try:
        check_file(path)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DataError(f"{path} cannot be opened as a video; check that it plays, or convert it to H.264 or MJPEG")
    return capture


def _video_size(capture: cv2.VideoCapture) -> tuple[int, int]:
    return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
