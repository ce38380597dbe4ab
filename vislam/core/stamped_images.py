"""Grey PNG files beside a recording, named by the stamps of its images: labels of pixels, masks."""

from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.encoded_image import decoded
from vislam.core.errors import DataError
from vislam.core.reading import read_bytes, readable

_MAX_BYTES = 2**26  # of one file
_MAX_FILES = 2_000_000
_MAX_DIGITS = 19  # of a stamp in nanoseconds
_PNG_HEAD = b"\x89PNG\r\n\x1a\n"
_GREY = 0  # colour type of a PNG


class StampedFiles:
    """The PNG files of a folder by the stamps in their names."""

    def __init__(self, folder: Path, noun: str) -> None:
        """List the folder; `noun` is what its files are, for messages. Raises DataError when there are none."""
        stamps: dict[int, Path] = {}
        try:
            for path in sorted(folder.iterdir()):
                stamp_ns = _stamp_ns(path.stem) if path.suffix == ".png" else None
                if stamp_ns is not None:
                    stamps[stamp_ns] = path
                if len(stamps) > _MAX_FILES:
                    raise DataError(f"{folder} has more than {_MAX_FILES} {noun}; give those of this recording")
        except OSError as error:
            raise DataError(f"{folder} cannot be listed: {error.strerror}") from error
        if not stamps:
            raise DataError(
                f"{folder} has no {noun}; name them by the stamps of the images, such as "
                "1403636579763555584.png (nanoseconds) or 1305031452.791720.png (seconds)"
            )
        self._t_ns = np.array(sorted(stamps), dtype=np.int64)
        self.paths = [stamps[t_ns] for t_ns in self._t_ns.tolist()]

    def at(self, t_ns: int, tolerance_ns: int) -> Path | None:
        """Return the file of the image with a stamp; None where there is none within a tolerance."""
        i = int(np.searchsorted(self._t_ns, t_ns))
        near = (k for k in (i - 1, i) if 0 <= k < len(self._t_ns))
        apart_ns, nearest = min((abs(int(self._t_ns[k]) - t_ns), k) for k in near)
        return self.paths[nearest] if apart_ns <= tolerance_ns else None


def read_grey_png(path: Path, bits: tuple[int, int], check_size: Callable[[int, int], None]) -> NDArray[np.generic]:
    """Return the numbers [h, w] in a grey PNG of one of two depths in bits.

    `check_size` raises DataError for a width and height that may not be, before anything is decoded. Raises DataError
    also when the file is something else, or cut.
    """
    with readable(path):
        data = read_bytes(path, _MAX_BYTES)
    if not data.startswith(_PNG_HEAD) or len(data) < 26 or data[12:16] != b"IHDR":
        raise DataError(f"{path} is no PNG; the numbers must be stored without loss")
    if data[25] != _GREY or data[24] not in bits:
        depths = f"{bits[0]} or {bits[1]} bits"
        raise DataError(f"{path} is no grey PNG of {depths}: store the numbers themselves, not colours or a palette")
    try:
        check_size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    image = decoded(data, cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2 or b"IEND" not in data[-1024:]:
        raise DataError(f"{path} is damaged or cut")
    return image


def _stamp_ns(stem: str) -> int | None:
    """Return the stamp that a name states: whole nanoseconds, or seconds with a decimal point."""
    whole, point, part = stem.partition(".")
    if not (stem.isascii() and whole.isdecimal() and len(whole) <= _MAX_DIGITS):
        return None
    if not point:
        return int(whole) if int(whole) < 2**63 else None
    if not (part.isdecimal() and len(part) <= _MAX_DIGITS) or len(whole) > 10:
        return None
    stamp_ns = round(Decimal(stem) * 1_000_000_000)
    return stamp_ns if stamp_ns < 2**63 else None
