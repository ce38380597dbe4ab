"""Images as files and messages have them: PNG and JPEG only, decoded where their heads state a size that may be."""

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.reading import MAX_PIXELS

_FREE_PIXELS, _PIXELS_PER_BYTE = 2**23, 8  # 4K of any content; cameras write more than a bit for each pixel


def image_size(head: bytes) -> tuple[int, int] | None:
    """Return width and height that the head of a PNG or JPEG file declares, or None if it is neither."""
    if head.startswith(b"\x89PNG\r\n\x1a\n") and head[12:16] == b"IHDR":
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if not head.startswith(b"\xff\xd8"):
        return None
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker, length = head[at + 1], int.from_bytes(head[at + 2 : at + 4], "big")
        if marker == 0xFF:  # fill byte
            at += 1
        elif marker <= 0x01 or 0xD0 <= marker <= 0xD9:  # without a length: what follows reads otherwise to a decoder
            return None
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame, any coding
            return int.from_bytes(head[at + 7 : at + 9], "big"), int.from_bytes(head[at + 5 : at + 7], "big")
        else:
            at += 2 + length
    return None


def most_pixels(size_bytes: int) -> int:
    """Return how many pixels an image of that size may have when packed: one beyond 4K must have a content."""
    return min(MAX_PIXELS, _FREE_PIXELS + _PIXELS_PER_BYTE * size_bytes)


def decoded(data: bytes, flags: int, size: tuple[int, int] | None = None) -> NDArray[np.generic] | None:
    """Return the image in the bytes of a PNG or JPEG file as OpenCV's flags ask for it; None where there is none.

    It must be of `size` (width, height) if given, and of `most_pixels` at most; a head that states another is not
    decoded, so that it cannot ask for gigabytes.
    """
    stated = image_size(data)
    if stated is None or not 0 < stated[0] * stated[1] <= most_pixels(len(data)) or size not in (None, stated):
        return None
    if data.startswith(b"\x89PNG") and not _holds_its_chunks(data):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        return None
    return None if image is None or image.shape[1::-1] != stated else np.asarray(image)


def _holds_its_chunks(data: bytes) -> bool:
    """Return whether each chunk of a PNG file ends within it: the decoder takes memory by a chunk's length first."""
    at = 8
    while at + 12 <= len(data) and data[at + 4 : at + 8] != b"IEND":
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return at + 12 <= len(data)
