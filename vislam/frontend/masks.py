"""Which pixels of the images are not to be used: a robot's own parts, and what moves by itself."""

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.messages import Frame, ImageU8, chosen
from vislam.core.stamped_images import StampedFiles, read_grey_png
from vislam.vision.features import LEAST_USED, are_used

_MARGIN_PX = 8  # not used around what is masked: half a window of Lucas-Kanade, and what masks and depth are late
_AROUND = np.ones((2 * _MARGIN_PX + 1, 2 * _MARGIN_PX + 1), np.uint8)
_TOLERANCE_NS = 2_000_000  # between an image's stamp and that in a name, as between the images of a pair
_MISSING = "images without a mask of their own"
_REFUSED = "masks that cannot be used"
_COVERED = "images that a mask leaves nothing of"
_NOTHING = "it leaves no pixel to use; below 128 stands for what is not used, 255 for the rest"
_LOG = logging.getLogger(__name__)


class Masks:
    """Owns the mask files of a run; what of them cannot be used is left out, counted in `problems` and said once."""

    def __init__(self, folder: str | None, rig: Rig) -> None:
        """Look for `camK.png` (all images) and `camK/STAMP.png` (one image) of each camera; None: there are no files.

        Raises DataError where there are none, or the first ones are not grey PNG files of the images' size.
        """
        self.problems: Counter[str] = Counter()
        self._cameras = rig.cameras
        self._whole: dict[int, ImageU8] = {}
        self._stamped: dict[int, StampedFiles] = {}
        if folder is None:
            return
        for k, camera in enumerate(rig.cameras):
            whole, parts = Path(folder, f"cam{k}.png"), Path(folder, f"cam{k}")
            if whole.exists():
                self._whole[k] = _read(whole, camera)
                if not _without_margin(self._whole[k]).any():
                    raise DataError(f"{whole}: {_NOTHING}")
            if parts.exists():
                self._stamped[k] = StampedFiles(parts, "masks")
                _read(self._stamped[k].paths[0], camera)
        if not self._whole and not self._stamped:
            raise DataError(
                f"{folder} holds no masks of this recording's {len(rig.cameras)} cameras; name them cam0.png (for all "
                "images of cam0) or cam0/STAMP.png (for the one with that stamp)"
            )

    def examine(self) -> None:
        """Read all files, and count in `problems` those that cannot be used, or leave nothing of an image."""
        for k, files in self._stamped.items():
            for path in files.paths:
                mask = self._usable(path, self._cameras[k])
                if mask is not None and not _without_margin(mask).any():
                    self._count(_COVERED, f"{path} is the first; {_NOTHING}")

    def onto(self, frame: Frame) -> Frame:
        """Return a frame, stamped by the camera's own clock, with 255 in its masks for what is used and 0 for the rest.

        The masks are those it brings and those in files, with a margin around what they hide; depth and given tracks
        there are left out. Raises DataError when a mask that it brings is not 8 bits and of the size of its image.
        """
        hidden = [self._of(k, camera, frame) for k, camera in enumerate(self._cameras)]
        if all(mask is None for mask in hidden):
            return frame
        masks = tuple(None if mask is None else _without_margin(mask) for mask in hidden)
        for k, mask in enumerate(masks):
            if mask is not None and not mask.any():
                self._count(_COVERED, f"cam{k} at {frame.t_ns} ns is the first; {_NOTHING}")
        first, depth_m, tracks = masks[0], frame.depth_m, frame.tracks
        if first is not None and depth_m is not None:
            depth_m = np.where(first > 0, depth_m, np.float32(0.0))
        if first is not None and tracks is not None:
            tracks = chosen(tracks, are_used(first, tracks.pixels_px))
        return replace(frame, masks=masks, depth_m=depth_m, tracks=tracks)

    def _of(self, k: int, camera: Camera, frame: Frame) -> ImageU8 | None:
        given = [mask for mask in (frame.mask(k), self._of_file(k, camera, frame.t_ns)) if mask is not None]
        for mask in given:
            if mask.shape != (camera.height, camera.width) or mask.dtype != np.uint8:
                size = "x".join(map(str, mask.shape[::-1]))
                raise DataError(f"mask of cam{k} in frame {frame.index} is {mask.dtype} {size}, {_other_size(camera)}")
        masks = [*given, self._whole[k]] if k in self._whole else given
        return np.asarray(np.minimum.reduce(masks), np.uint8) if masks else None

    def _of_file(self, k: int, camera: Camera, t_ns: int) -> ImageU8 | None:
        if k not in self._stamped:
            return None
        path = self._stamped[k].at(t_ns, _TOLERANCE_NS)
        if path is None:
            self._count(_MISSING, f"that of cam{k} at {t_ns} ns is the first")
            return None
        return self._usable(path, camera)

    def _usable(self, path: Path, camera: Camera) -> ImageU8 | None:
        try:
            return _read(path, camera)
        except DataError as error:
            self._count(_REFUSED, str(error))
            return None

    def _count(self, kind: str, what: str) -> None:
        if kind not in self.problems:
            _LOG.warning("%s: %s", kind, what)
        self.problems[kind] += 1


def mask_warnings(counters: Mapping[str, int]) -> list[str]:
    """Return one line for each kind of problem in `Masks.problems`, for a report."""
    return [f"{count} {kind}; log.txt names the first" for kind, count in counters.items()]


def _read(path: Path, camera: Camera) -> ImageU8:
    def check(width: int, height: int) -> None:
        if (width, height) != (camera.width, camera.height):
            raise DataError(f"it is {width}x{height}, {_other_size(camera)}")

    mask = read_grey_png(path, (1, 8), check)
    return np.asarray(mask, np.uint8)


def _other_size(camera: Camera) -> str:
    return f"the camera's images {camera.width}x{camera.height}; masks are 8 bits and as large as the images"


def _without_margin(mask: ImageU8) -> ImageU8:
    """Return 255 for pixels of a mask [H, W] that are used, as are all around them, and 0 for the others."""
    used = np.where(np.asarray(mask) >= LEAST_USED, np.uint8(255), np.uint8(0))
    return np.asarray(cv2.erode(used, _AROUND), np.uint8)
