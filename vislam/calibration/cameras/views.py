"""Images that show a calibration board, from a folder, a video, a recording or a live camera."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from vislam.calibration.cameras.board import Board, View
from vislam.core.errors import DataError
from vislam.core.messages import Array, ImageU8
from vislam.datasets import survey
from vislam.datasets.formats.video import SUFFIXES as VIDEO_SUFFIXES
from vislam.datasets.images import read_any_size
from vislam.datasets.loaders import open_video
from vislam.hw.source import ImageSource

_SUFFIXES = (".png", ".jpg", ".jpeg")
_LIVE_WAIT_S = 1.0
_LIVE_EVERY_S = 0.4  # between two searches in a live image
_SAME_PX = 3.0  # a board that moved less in between is the same view

Images = Iterator[tuple[str, ImageU8 | None]]  # name and grey image; None where one cannot be read


@dataclass(frozen=True, slots=True)
class Found:
    """What a source showed of a board."""

    views: list[View]
    size: tuple[int, int]  # width, height of all images
    searched: int
    unreadable: int


def find_views(images: Images, board: Board) -> Found:
    """Search images for a board; raises DataError when sizes differ or nothing can be read."""
    views: list[View] = []
    size: tuple[int, int] | None = None
    searched = unreadable = 0
    for name, image in images:
        if image is None:
            unreadable += 1
            continue
        this = (image.shape[1], image.shape[0])
        if size not in (None, this):
            raise DataError(f"{name} is {this[0]}x{this[1]}, the images before it {size}; calibrate one size at a time")
        size = this
        searched += 1
        view = board.find(image, name)
        if view is not None:
            views.append(view)
    if size is None:
        raise DataError(
            f"none of {unreadable} images could be read; give a folder of PNG or JPEG, a video or a recording"
        )
    return Found(views, size, searched, unreadable)


def images_of(source: str, at_most: int) -> Images:
    """Yield grey images of a folder, a video or a recording's cam0, evenly spaced; raises DataError without any."""
    path = Path(source)
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        return _video(path, at_most)
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES) if path.is_dir() else []
    if not files:
        cameras = survey(source).cameras
        if not cameras:
            raise DataError(f"{source} holds neither PNG nor JPEG images nor a recording with a camera")
        files = [cameras[0].path(i) for i in range(len(cameras[0].files))]
    return ((file.name, read_any_size(file)) for file in _evenly(files, at_most))


def live_images(source: ImageSource, seconds: float, clock: Callable[[], float] = time.monotonic) -> Images:
    """Yield images of a live camera for some time, a few a second; raises DataError when none comes for a second."""
    end = clock() + seconds
    while clock() < end:
        captured = source.read(_LIVE_WAIT_S)
        if captured is None:
            raise DataError("the camera gives no images; `vislam doctor` shows more")
        image = captured.image
        yield f"image {captured.index}", image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        time.sleep(min(_LIVE_EVERY_S, max(end - clock(), 0.0)))


def choose(views: list[View], size: tuple[int, int], at_most: int) -> list[View]:
    """Return views that differ as much as possible: each next one is farthest from all before, in place and slant."""
    if not views:
        return []
    features = np.array([_feature(view, size) for view in views])
    chosen = [int(np.argmax([len(view.points_m) for view in views]))]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    least = _SAME_PX / float(np.hypot(*size))
    while len(chosen) < at_most and distance.max() > least:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return [views[i] for i in sorted(chosen)]


def differing(view: View, others: list[View], size: tuple[int, int], least: float) -> bool:
    """Return whether a view differs from all others by `least`, in place, size and slant in parts of the image."""
    feature = _feature(view, size)
    return all(np.linalg.norm(feature - _feature(other, size)) > least for other in others)


def _feature(view: View, size: tuple[int, int]) -> Array:
    """Return where, how large and how slanted a board is seen [6], in parts of the image."""
    diagonal = float(np.hypot(*size))
    pixels = (view.pixels - 0.5 * np.array(size)) / diagonal
    H = cv2.findHomography(view.points_m[:, :2], pixels)[0]
    if H is None:
        return np.zeros(6)
    extent = float(np.ptp(view.points_m[:, :2], axis=0).max())
    jacobian = (H[:2, :2] - np.outer(pixels.mean(axis=0), H[2, :2])) / H[2, 2] * extent
    return np.concatenate([pixels.mean(axis=0), jacobian.ravel()])


def _evenly(files: list[Path], at_most: int) -> list[Path]:
    if len(files) <= at_most:
        return files
    return [files[i] for i in np.linspace(0, len(files) - 1, at_most).round().astype(int)]


def _video(path: Path, at_most: int) -> Images:
    capture = open_video(path)
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        every = max(count // at_most, 1)
        number = 0
        while capture.grab():
            if number % every == 0:
                good, image = capture.retrieve()
                grey = image if good and image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if good else None
                yield f"frame {number}", None if grey is None else np.asarray(grey, dtype=np.uint8)
            number += 1
    finally:
        capture.release()
