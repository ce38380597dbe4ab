"""Images of a recording: lists with stamps, matching of two lists by time, decoding with bounds, and decoding ahead."""

from __future__ import annotations

import errno
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.cpu import working_ahead
from vislam.core.encoded_image import decoded, image_size
from vislam.core.errors import DataError
from vislam.core.messages import ImageF32, ImageU8
from vislam.core.reading import open_file, read_bytes
from vislam.vision.depth_registration import DepthCamera

Stamps = NDArray[np.int64]
Job = TypeVar("Job")
Result = TypeVar("Result")

NO_DEPTH = 65535  # saturated: no sensor measures it, and several write it for "nothing measured"
MAX_IMAGE_BYTES = 2**28  # of one image file; an uncompressed 60 megapixel image
_SHORT_HEAD_BYTES = 2**12  # holds the size of most images
_HEAD_BYTES = 2**18  # enough to reach the size in a JPEG with an embedded preview and profile
_TAIL_BYTES = 1024  # some cameras pad after the end mark
_PNG_END, _JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"
_GREY_OR_COLOR = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
_RAW_DEPTH = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION


class UnreadableImageError(Exception):
    """One image that is missing or damaged: skipped and counted by the reader, never seen by its users."""

    def __init__(self, kind: str, path: Path) -> None:
        super().__init__(f"{kind}: {path}")
        self.kind = kind
        self.path = path


@dataclass(frozen=True, slots=True, eq=False)
class ImageList:
    """The images of one camera: strictly rising stamps [N] and a file name for each."""

    name: str  # "cam0", "cam1", "depth0"
    folder: Path
    t_ns: Stamps
    files: tuple[str, ...]
    rate_hz: float | None = None  # as declared by its sensor file

    def path(self, i: int) -> Path:
        """Return the path of image `i`."""
        return self.folder / self.files[i]


@dataclass(frozen=True, slots=True)
class DepthFormat:
    """What the numbers in depth images mean, and through which lens, where and when they were measured."""

    units_per_m: float = 1.0
    invalid: tuple[int, ...] = ()  # raw values that mean "nothing measured", besides 0 and the largest of 16 bits
    offset_px: tuple[float, float] = (0.0, 0.0)  # by which depth lies right of and below where it should
    time_offset_s: float = 0.0  # its stamps plus this are by the clock of the colour image; the list has it already
    own: DepthCamera | None = None  # its lens and place; None: each pixel is that of the colour image

    def camera(self, color: Camera) -> Camera:
        """Return the camera whose pixels depth images as stored have."""
        return color if self.own is None else self.own.camera

    def in_m(self, raw: NDArray[np.uint16]) -> ImageF32:
        """Return depth in metres [H, W], 0 where invalid, shifted back by whole pixels."""
        depth = raw.astype(np.float32) / np.float32(self.units_per_m)
        for value in (NO_DEPTH, *self.invalid):
            depth[raw == value] = 0.0
        return moved_back(depth, self.offset_px)


def moved_back(depth_m: ImageF32, offset_px: tuple[float, float]) -> ImageF32:
    """Return depth [H, W] as it is without an offset, rounded to whole pixels; 0 comes in from outside."""
    dx, dy = round(offset_px[0]), round(offset_px[1])
    if dx == 0 and dy == 0:
        return depth_m
    shift = np.array([[1.0, 0.0, -dx], [0.0, 1.0, -dy]])
    size = (depth_m.shape[1], depth_m.shape[0])
    return np.asarray(cv2.warpAffine(depth_m, shift, size, flags=cv2.INTER_NEAREST), dtype=np.float32)


def match_by_time(a_ns: Stamps, b_ns: Stamps, tolerance_ns: int) -> Stamps:
    """Return for each stamp of a [N] the index of its partner in b, or -1; both rise.

    The closest pair is joined first and nothing is used twice, as in the TUM benchmark's `associate.py`; joining all
    that are each other's nearest, then looking again at the rest, comes to the same.
    """
    partner = np.full(len(a_ns), -1, dtype=np.int64)
    free_a, free_b = np.arange(len(a_ns)), np.arange(len(b_ns))
    while len(free_a) and len(free_b):
        a, b = a_ns[free_a], b_ns[free_b]
        a_to_b, b_to_a = _nearest(a, b), _nearest(b, a)
        joined = (np.abs(b[a_to_b] - a) <= tolerance_ns) & (b_to_a[a_to_b] == np.arange(len(a)))
        if not joined.any():
            break
        partner[free_a[joined]] = free_b[a_to_b[joined]]
        free_b = np.delete(free_b, a_to_b[joined])
        free_a = free_a[~joined]
    return partner


def _nearest(a_ns: Stamps, b_ns: Stamps) -> Stamps:
    right = np.clip(np.searchsorted(b_ns, a_ns), 0, len(b_ns) - 1)
    left = np.maximum(right - 1, 0)
    take_left = np.abs(a_ns - b_ns[left]) <= np.abs(b_ns[right] - a_ns)
    return np.where(take_left, left, right).astype(np.int64)


def probe(path: Path) -> tuple[int, int]:
    """Return width and height of an image file from its head, without decoding; raises UnreadableImageError.

    The end mark is checked too: decoders show the missing part of a file that was cut short as grey, without an error.
    """
    try:
        with open_file(path) as file:
            head = file.read(_SHORT_HEAD_BYTES)
            if image_size(head) is None:
                head += file.read(_HEAD_BYTES - _SHORT_HEAD_BYTES)
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES))
            tail = file.read(_TAIL_BYTES)
    except FileNotFoundError as error:
        raise UnreadableImageError("missing image", path) from error
    except OSError as error:
        raise UnreadableImageError(_kind_of(error), path) from error
    return _checked_size(head, tail, path)


def _kind_of(error: OSError) -> str:
    """Return what is wrong with an image that cannot be opened; what is no file of its kind is named."""
    return f"image that is {error.strerror}" if error.errno == errno.EINVAL else "unreadable image"


def _checked_size(head: bytes, tail: bytes, path: Path) -> tuple[int, int]:
    size = image_size(head)
    if size is None or (_PNG_END if head[0] == 0x89 else _JPEG_END) not in tail:
        raise UnreadableImageError("unreadable image", path)
    return size


def _decode(path: Path, camera: Camera, flags: int) -> NDArray[np.generic]:
    try:
        data = read_bytes(path, MAX_IMAGE_BYTES)
    except FileNotFoundError as error:
        raise UnreadableImageError("missing image", path) from error
    except OSError as error:
        raise UnreadableImageError(_kind_of(error), path) from error
    return decode_image(data, camera, flags, path)


def decode_image(data: bytes, camera: Camera, flags: int, path: Path) -> NDArray[np.generic]:
    """Return the image in the bytes of a PNG or JPEG file as OpenCV's flags ask for it; `path` stands in errors.

    Raises UnreadableImageError when it is damaged, DataError when it is not of the camera's size.
    """
    # compared before decoding, so that a forged header cannot ask for gigabytes
    check_size_px(_checked_size(data[:_HEAD_BYTES], data[-_TAIL_BYTES:], path), camera, path)
    image = decoded(data, flags, (camera.width, camera.height))
    if image is None:
        raise UnreadableImageError("unreadable image", path)
    return image


def check_size_px(size: tuple[int, int], camera: Camera, path: Path) -> None:
    """Raise DataError unless an image of `size` (width, height) is what the camera was calibrated for."""
    if size != (camera.width, camera.height):
        raise DataError(
            f"{path} is {size[0]}x{size[1]} but its calibration is for {camera.width}x{camera.height}; "
            "correct the calibration's resolution (and intrinsics), or use the images it was made for"
        )


def read_grey_or_color(path: Path, camera: Camera) -> tuple[ImageU8, ImageU8 | None]:
    """Return the image of a file as grey [H, W] and, if it has colour, as BGR [H, W, 3]; 16-bit images lose 8 bits.

    Raises UnreadableImageError when missing or damaged, DataError when it is not of the camera's size.
    """
    image = np.asarray(_decode(path, camera, _GREY_OR_COLOR), dtype=np.uint8)
    if image.ndim == 2:
        return image, None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8), image


def read_any_size(path: Path) -> ImageU8 | None:
    """Return a grey image of whatever size its file has; None if it cannot be read, or is larger than any camera's."""
    try:
        width, height = probe(path)
        return read_grey_or_color(path, Camera(width, height, 1.0, 1.0, 0.0, 0.0))[0]
    except (UnreadableImageError, DataError):
        return None


def read_depth(path: Path, color: Camera, how: DepthFormat) -> ImageF32:
    """Return depth in metres [H, W] of a 16-bit PNG, 0 where invalid; raises as `read_grey_or_color` does.

    It is not registered: where depth has a lens of its own, pixels are those of that lens.
    """
    return how.in_m(read_raw_depth(path, how.camera(color)))


def read_raw_depth(path: Path, camera: Camera) -> NDArray[np.uint16]:
    """Return the numbers of a 16-bit PNG [H, W] as they are; raises as `read_grey_or_color` does."""
    raw = _decode(path, camera, _RAW_DEPTH)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise UnreadableImageError("depth image that is not 16-bit grey", path)
    return np.asarray(raw, dtype=np.uint16)


def decode_ahead(
    jobs: Iterable[Job], load: Callable[[Job], Result], workers: int = 2, ahead: int = 4
) -> Generator[Result, None, None]:
    """Yield `load(job)` for each job in order, computed up to `ahead` jobs early in threads.

    OpenCV decodes without the interpreter's lock, so this overlaps with tracking. The answer does not depend on timing:
    order is kept, and an exception comes out at its place. Closing the generator ends the threads.
    """

    def timed(job: Job) -> Result:
        with working_ahead("decode"):
            return load(job)

    pool = ThreadPoolExecutor(max_workers=workers, thread_name_prefix="decode")
    pending: deque[Future[Result]] = deque()
    try:
        for job in jobs:
            pending.append(pool.submit(timed, job))
            if len(pending) > ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
