"""Label images: which class each pixel of the colour image shows, from a folder or from any network."""

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.core.camera import Camera, Rig
from vislam.core.errors import DataError
from vislam.core.messages import Frame
from vislam.core.stamped_images import StampedFiles, read_grey_png
from vislam.mapping.depth.image import DepthView
from vislam.mapping.semantic.classes import FILE_NAME, UNLABELLED, LabelClasses

Labels = NDArray[np.uint16]

_TOLERANCE_NS = 1_000_000  # between an image's stamp and that in the name of its labels
_MISSING = "keyframes without a label image"
_REFUSED = "label images that cannot be used"
_UNKNOWN = "label images with ids that have no name"
_LOG = logging.getLogger(__name__)


class Labeller(Protocol):
    """The source of keyframes' labels: a folder of images, or a network that looks at each."""

    classes: LabelClasses

    def __call__(self, frame: Frame, camera_t_ns: int) -> NDArray[np.integer] | None:
        """Return the labels [H, W] of a frame's first image, 0 where unknown; None where there are none.

        They are as large as the image, or smaller by a whole factor. `camera_t_ns` is the image's stamp by the camera's
        own clock; `frame.t_ns` is by the IMU's.
        """


class LabelFolder:
    """Label images as PNG files that are named by the stamps of the images, beside `labels.toml`.

    What cannot be used is left out, counted in `problems` and said once of each kind.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """List the folder. Raises DataError when there are no label images, or no names of their ids."""
        self.classes = LabelClasses.read(folder / FILE_NAME)
        self.problems: Counter[str] = Counter()
        self._camera = camera
        self._known = self.classes.known
        self._files = StampedFiles(folder, "label images")

    def __call__(self, frame: Frame | None, camera_t_ns: int) -> Labels | None:
        """Return the labels [h, w] of the image with a stamp; None where there are none that can be used."""
        path = self._files.at(camera_t_ns, _TOLERANCE_NS)
        if path is None:
            self._count(_MISSING, f"the one at {camera_t_ns} ns is the first")
            return None
        try:
            labels = checked(read_labels(path, self._camera), self._camera)
        except DataError as error:
            self._count(_REFUSED, str(error))
            return None
        unknown = ~self._known[labels]
        if unknown.any():
            self._count(_UNKNOWN, f"{path} has {labels[unknown][0]}; name it in {FILE_NAME}")
            labels = np.where(unknown, np.uint16(UNLABELLED), labels)
        return labels

    def _count(self, kind: str, what: str) -> None:
        if kind not in self.problems:
            _LOG.warning("%s: %s", kind, what)
        self.problems[kind] += 1


class LabelRays:
    """Where the rays of a mapper's depth images lie in a label image."""

    def __init__(self, view: DepthView, rig: Rig) -> None:
        """Prepare for the view of a rig; labels are those of its first camera."""
        self._camera = camera = rig.cameras[0]
        rays = view.rays_body.reshape(-1, 3).astype(np.float64)
        pixels = camera.project(rays @ rig.T_body_cams[0][:3, :3])  # they begin where the camera is
        inside = camera.contains(np.round(pixels))
        self._pixels = np.where(inside[:, None], np.round(np.nan_to_num(pixels)), -1.0).astype(np.int64)
        self._shape = view.rays_body.shape[:2]

    def sample(self, labels: Labels) -> Labels:
        """Return the labels [h, w] on the view's rays of an image [H, W] that `checked` gave; 0 outside of it."""
        return self.at(labels, self._pixels).reshape(self._shape)

    def at(self, labels: Labels, pixels: NDArray[np.int64]) -> Labels:
        """Return the labels [N] at whole pixels [N, 2] of the camera; 0 outside of it."""
        factor = self._camera.height // labels.shape[0]
        columns, rows = pixels[:, 0], pixels[:, 1]
        inside = (columns >= 0) & (rows >= 0) & (columns < self._camera.width) & (rows < self._camera.height)
        out = np.zeros(len(pixels), np.uint16)
        out[inside] = labels[rows[inside] // factor, columns[inside] // factor]
        return out


def label_warnings(counters: Mapping[str, int]) -> list[str]:
    """Return those of a map's counters by which label images were missing or bad."""
    found = [(kind, counters.get(kind, 0)) for kind in (_MISSING, _REFUSED, _UNKNOWN)]
    return [f"{count} {kind}; log.txt names the first" for kind, count in found if count]


def camera_t_ns(t_ns: int, time_offset_s: float) -> int:
    """Return a keyframe's stamp by the camera's own clock; `t_ns` is by the IMU's, which is so much later."""
    return t_ns - round(time_offset_s * 1e9)


def checked(labels: NDArray[np.generic], camera: Camera) -> Labels:
    """Return labels [h, w] as 16 bits; raises DataError unless they are whole numbers over a camera's image."""
    array = np.asarray(labels)
    if array.ndim != 2 or not np.issubdtype(array.dtype, np.integer):
        raise DataError(f"labels must be whole numbers [H, W], got {array.dtype} of shape {array.shape}")
    rows, columns = array.shape
    _check_size((columns, rows), camera)
    if array.dtype not in (np.uint8, np.uint16) and (array.min() < 0 or array.max() > np.iinfo(np.uint16).max):
        raise DataError(f"labels must be ids from 0 to 65535, got {array.min()} to {array.max()}")
    return array.astype(np.uint16)


def read_labels(path: Path, camera: Camera) -> Labels:
    """Return the ids [h, w] in a grey PNG of 8 or 16 bits.

    Raises DataError as `read_grey_png` does, also unless the size is that of the camera's images or a whole fraction.
    """
    image = read_grey_png(path, (8, 16), lambda width, height: _check_size((width, height), camera))
    return np.asarray(image, dtype=np.uint16)


def _check_size(size: tuple[int, int], camera: Camera) -> None:
    width, height = size
    whole = width > 0 and height > 0 and camera.width % width == 0 and camera.height % height == 0
    if not whole or camera.width // width != camera.height // height:
        raise DataError(
            f"labels are {width}x{height}, the camera's images {camera.width}x{camera.height}; "
            "they must be as large, or smaller by a whole factor"
        )
