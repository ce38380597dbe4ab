"""Images of a recording: lists with stamps, matching of two lists by time, decoding with bounds, and decoding ahead."""

from __future__ import annotations

import errno
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera
from vislam.core.cpu import working_ahead
from vislam.core.encoded_image import decoded, image_size, most_pixels
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
_MOST_AHEAD, _AHEAD_BYTES = 4, 2**27  # frames, and what all that are held at once may take
_TAIL_BYTES = 1024  # some cameras pad after the end mark
_GREY_16_BITS = b"\x10\x00"  # in a PNG's head: depth of its bits, kind of its pixels
_PNG_END, _JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"
_GREY_OR_COLOR = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_LOOKED_AT = 16  # 16-bit images of a camera, evenly spread
_DARK, _BRIGHT = 1.0, 99.0  # percentiles of an image: a stuck pixel, or the sun, widens nothing
_SPARED = 0.1  # of the images, at each end: one is black while a thermal camera's shutter is closed
_ROOM = 0.25  # of the span, on each side: between the images looked at there are others
_WIDE = 2**14  # in a range from so wide on the upper 8 bits show enough, and are what other programs show
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


def _bytes_of(path: Path) -> bytes:
    try:
        return read_bytes(path, MAX_IMAGE_BYTES)
    except FileNotFoundError as error:
        raise UnreadableImageError("missing image", path) from error
    except OSError as error:
        raise UnreadableImageError(_kind_of(error), path) from error


def _decode(data: bytes, camera: Camera, flags: int, path: Path) -> NDArray[np.generic]:
    # compared before decoding, so that a forged header cannot ask for gigabytes
    size = _checked_size(data[:_HEAD_BYTES], data[-_TAIL_BYTES:], path)
    check_size_px(size, camera, path)
    if size[0] * size[1] > most_pixels(len(data)):
        raise UnreadableImageError("image with far more pixels than its bytes can hold", path)
    image = decoded(data, flags, size)
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


def read_stored(path: Path, camera: Camera) -> NDArray[np.generic]:
    """Return the image of a file as it is stored, grey [H, W] or BGR [H, W, 3] of 8 or 16 bits.

    Raises UnreadableImageError when missing or damaged, DataError when it is not of the camera's size.
    """
    return decode_stored(_bytes_of(path), camera, path)


def decode_stored(data: bytes, camera: Camera, path: Path) -> NDArray[np.generic]:
    """Return the image in the bytes of a file as `read_stored`; `path` stands in errors."""
    return _decode(data, camera, _GREY_OR_COLOR, path)


def grey_and_color(image: ImageU8) -> tuple[ImageU8, ImageU8 | None]:
    """Return an image as grey [H, W] and, if it has colour, as BGR [H, W, 3]."""
    if image.ndim == 2:
        return image, None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8), image


class SixteenBits:
    """Owns what the 16-bit images of one camera, as of heat, become in the 8 bits that are tracked.

    Such cameras fill a small part of their 16 bits, in which the upper 8 hardly differ. Black and white are the same
    for the whole recording: a range that followed the scene would make every corner brighter or darker by itself.
    """

    def __init__(self, count: int, read: Callable[[int], NDArray[np.generic]]) -> None:
        """Take how many images there are, and what returns one as it is stored or raises UnreadableImageError."""
        self.said = ""  # the range, to end a sentence with, once an image of 16 bits was met
        self._count, self._read = count, read
        self._lock = Lock()  # images are decoded in threads
        self._table: ImageU8 | None = None  # [65536] what a value becomes

    def reduced(self, image: NDArray[np.generic]) -> ImageU8:
        """Return an image [H, W] or [H, W, 3] in 8 bits; one that has no more is returned as it is."""
        if image.dtype != np.uint16:
            return np.asarray(image, dtype=np.uint8)
        with self._lock:
            if self._table is None:
                self._table = self._look()
        return np.asarray(self._table[image])

    def _look(self) -> ImageU8:
        lows, highs = list[float](), list[float]()
        for row in np.unique(np.linspace(0, self._count - 1, _LOOKED_AT).astype(int)).tolist():
            with suppress(UnreadableImageError, DataError):  # which are reported elsewhere
                image = np.asarray(self._read(row), dtype=np.uint16)
                lows.append(float(np.percentile(image, _DARK)))
                highs.append(float(np.percentile(image, _BRIGHT)))
        low, high = float(np.quantile(lows or [0.0], _SPARED)), float(np.quantile(highs or [_WIDE], 1.0 - _SPARED))
        values = np.arange(2**16)
        if high - low >= _WIDE:
            self.said = "; of 16 bits the upper 8 are used"
            return (values >> 8).astype(np.uint8)
        low, high = low - _ROOM * (high - low), high + _ROOM * (high - low)
        self.said = f"; of 16 bits {low:.0f} is black and {high:.0f} white"
        return np.clip((values - low) * (255.0 / max(high - low, 1.0)), 0.0, 255.0).round().astype(np.uint8)


def read_grey_or_color(
    images: ImageList, row: int, camera: Camera, bits: SixteenBits
) -> tuple[ImageU8, ImageU8 | None]:
    """Return an image of a camera as `grey_and_color`; raises as `read_stored`. `bits` are those of `images`."""
    return grey_and_color(bits.reduced(read_stored(images.path(row), camera)))


def bits_of(images: ImageList, camera: Camera) -> SixteenBits:
    """Return what the 16-bit images of a list become."""
    return SixteenBits(len(images.files), lambda row: read_stored(images.path(row), camera))


def read_any_size(path: Path) -> ImageU8 | None:
    """Return a grey image of whatever size its file has; None if it cannot be read, or is larger than any camera's."""
    try:
        width, height = probe(path)
        stored = read_stored(path, Camera(width, height, 1.0, 1.0, 0.0, 0.0))
        return grey_and_color(SixteenBits(1, lambda _row: stored).reduced(stored))[0]
    except (UnreadableImageError, DataError):
        return None


def read_depth(path: Path, color: Camera, how: DepthFormat) -> ImageF32:
    """Return depth in metres [H, W] of a 16-bit PNG, 0 where invalid; raises as `read_stored` does.

    It is not registered: where depth has a lens of its own, pixels are those of that lens.
    """
    return how.in_m(read_raw_depth(path, how.camera(color)))


def read_raw_depth(path: Path, camera: Camera) -> NDArray[np.uint16]:
    """Return the numbers of a 16-bit PNG [H, W] as they are; raises as `read_stored` does."""
    return decode_raw_depth(_bytes_of(path), camera, path)


def decode_raw_depth(data: bytes, camera: Camera, path: Path) -> NDArray[np.uint16]:
    """Return the numbers of a 16-bit PNG [H, W] in its bytes; `path` stands in errors."""
    may_be = data[24:26] == _GREY_16_BITS or image_size(data[:_HEAD_BYTES]) is None
    raw = _decode(data, camera, _RAW_DEPTH, path) if may_be else np.zeros(0)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise UnreadableImageError("depth image that is not 16-bit grey", path)
    return np.asarray(raw, dtype=np.uint16)


def frames_ahead(cameras: Sequence[Camera], depth: Camera | None) -> int:
    """Return how many frames may be decoded early, one that is used and one that is decoded beside them."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    colors = 3 * cameras[0].width * cameras[0].height
    depths = 0 if depth is None else 4 * depth.width * depth.height
    return min(max(_AHEAD_BYTES // (pixels + colors + depths) - 2, 0), _MOST_AHEAD)


def decode_ahead(
    jobs: Iterable[Job], load: Callable[[Job], Result], workers: int = 2, ahead: int = _MOST_AHEAD
) -> Generator[Result, None, None]:
    """Yield `load(job)` for each job in order, computed up to `ahead` jobs early in threads.

    OpenCV decodes without the interpreter's lock, so this overlaps with tracking. The answer does not depend on timing:
    order is kept, and an exception comes out at its place. Closing the generator ends the threads.
    """

    def timed(job: Job) -> Result:
        with working_ahead("decode"):
            return load(job)

    pool = ThreadPoolExecutor(max_workers=min(workers, ahead + 1), thread_name_prefix="decode")
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
