"""Video topics of bags: a frame a message, of which each needs those before it; decoded by PyAV, in one thread."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vislam.core.camera import Camera
from vislam.core.encoded_image import most_pixels
from vislam.core.errors import install_line
from vislam.core.messages import ImageU8
from vislam.datasets.bags.stored import DamagedError
from vislam.datasets.images import UnreadableImageError, check_size_px, grey_and_color

_CODECS = {  # decoders by Foxglove's names, and by those of FFmpeg's encoders, which ffmpeg_image_transport writes
    "h264": "h264", "x264": "h264", "h265": "hevc", "hevc": "hevc", "x265": "hevc", "vp9": "vp9", "av1": "libdav1d",
    "svtav1": "libdav1d", "aom": "libdav1d",
}  # fmt: skip
_MOST_BEHIND = 16  # messages that a decoder may want before it gives a frame: no standard has more


def codec_of(name: str) -> str:
    """Return the decoder of a format such as "h265" or "hevc_nvenc;yuv420p;bgr8;bgr8", empty for others."""
    return _CODECS.get(re.split(r"[;_ -]", name.lower(), maxsplit=1)[0].removeprefix("lib"), "")


def why_no_video() -> str:
    """Return why video cannot be decoded, empty where it can."""
    try:
        importlib.import_module("av")
    except ImportError as error:
        return f"video, which needs {error.name or 'av'}: {install_line('video')}"
    return ""


class Film:
    """The frames of a video topic, asked for in rising order; going back begins again."""

    def __init__(self, read: Callable[[int], Any], count: int) -> None:
        """Take what returns a message, with `format` and `data`, by its row; it may raise DamagedError."""
        self._read, self._count = read, count
        self._begin()

    def _begin(self) -> None:
        self._decoder: Any = None
        self._next = 0  # the row that is decoded next
        self._asked = -1
        self._is_whole = False  # what the next frame is made of: after damage nothing is, up to one that needs no other
        self._frames: dict[int, Any] = {}  # decoded, but not asked for yet

    def frame(self, row: int) -> Any:
        """Return the frame in the message of a row as PyAV has it, None where it cannot be decoded."""
        if row <= self._asked:
            self._begin()
        self._asked = row
        end = min(self._count, row + 1 + _MOST_BEHIND)
        while row not in self._frames and self._next < end:
            self._decode(self._next)
            self._next += 1
        if row not in self._frames and self._next == self._count:
            self._take(None)  # what the decoder holds back
        self._frames = {at: frame for at, frame in self._frames.items() if at >= row}
        return self._frames.get(row)

    def grey_or_color(self, row: int, camera: Camera, path: Path) -> tuple[ImageU8, ImageU8 | None]:
        """Return a frame as grey [H, W] and, if it has colour, as BGR [H, W, 3].

        Raises UnreadableImageError when it cannot be decoded, DataError when it is not of the camera's size.
        """
        frame = self.frame(row)
        if frame is None:
            raise UnreadableImageError("video frame that cannot be decoded", path)
        check_size_px((frame.width, frame.height), camera, path)
        if frame.format.name.startswith("gray"):
            return np.ascontiguousarray(frame.to_ndarray(format="gray"), dtype=np.uint8), None
        return grey_and_color(np.ascontiguousarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8))

    def _decode(self, row: int) -> None:
        try:
            message = self._read(row)
        except (DamagedError, OSError, StopIteration):
            message = None
        if message is None or not len(message.data):  # an empty packet would mean the end
            self._is_whole = False
            return
        av = importlib.import_module("av")
        if self._decoder is None and (codec := codec_of(str(message.format))):
            self._decoder = av.CodecContext.create(codec, "r")
            self._decoder.thread_count = 1
            self._decoder.options = {"max_pixels": str(most_pixels(8 * len(message.data)))}  # a tenth of a bit each
        packet = av.Packet(message.data.tobytes())
        packet.pts = row
        self._take(packet)

    def _take(self, packet: Any) -> None:
        if self._decoder is None:
            return
        try:
            for frame in self._decoder.decode(packet):
                self._is_whole = (self._is_whole or bool(frame.key_frame)) and not frame.is_corrupt
                if self._is_whole:
                    self._frames[frame.pts] = frame
        except importlib.import_module("av").FFmpegError:
            self._is_whole = False


def film_size(messages: Iterator[Any], count: int) -> tuple[int, int] | None:
    """Return width and height of the first frame that can be decoded of the first messages; None without one."""
    film = Film(lambda _: next(messages), count)
    frame = next((frame for row in range(count) if (frame := film.frame(row)) is not None), None)
    return None if frame is None else (frame.width, frame.height)
