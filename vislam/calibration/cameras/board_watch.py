"""Views of a board, kept while it is moved before a live camera: which parts of the image and which slants lack."""

import shutil
from pathlib import Path

import cv2
import numpy as np

from vislam.calibration.cameras.board import View, board_of
from vislam.calibration.cameras.camera import calibrate_camera, coverage
from vislam.calibration.cameras.views import differing
from vislam.calibration.options import BoardOptions, CameraOptions
from vislam.calibration.outcome import Outcome
from vislam.calibration.watching import Progress, Value
from vislam.core.errors import DataError, StorageError
from vislam.core.files import storage
from vislam.core.messages import Array, Frame, ImageU8

_VIEWS = "camera-views"  # folder of the images that were kept
_WANTED_VIEWS = 20
_LEAST_VIEWS = 6
_MOST_VIEWS = 60
_WANTED_COVER = 0.9
_STILL_PX = 2.0  # a board whose middle moved more since the last image would be blurred
_NEW = 0.08  # of the image's diagonal, in place, size and slant: a view that differs less from one that is kept
_SLANTED = 0.25  # tangent of a slant that counts: 14 degrees
_USUAL_FOCAL = 0.8  # of the image's width, before the camera is known
_WIDTH_PX = 480


class BoardWatch:
    """Satisfies `Watch`: keeps images in which the board was held still somewhere new."""

    has_images = True

    def __init__(self, folder: Path, board: BoardOptions) -> None:
        """Begin with no view; those of an earlier try go."""
        self._options = CameraOptions(str(folder / _VIEWS), board, out=folder, overwrite=True)
        self._folder = folder / _VIEWS
        self._board = board_of(board)
        self._views: list[View] = []
        self._slants: set[str] = set()
        self._size: tuple[int, int] | None = None
        self._last: Array | None = None  # middle of the board in the image before
        self._said, self._jpeg = "hold the board before the camera", b""
        shutil.rmtree(self._folder, ignore_errors=True)

    def take(self, value: Value) -> None:
        """Search an image for the board, and keep it where it shows something new."""
        if not isinstance(value, Frame) or not value.images:
            return
        image = value.images[0]
        size = (image.shape[1], image.shape[0])
        self._size = self._size or size
        view = self._board.find(image, f"view_{len(self._views):03d}.png") if size == self._size else None
        self._said = self._judged(view, image)
        self._jpeg = _picture(image, view)

    def _judged(self, view: View | None, image: ImageU8) -> str:
        """Keep an image if it is worth that; return what to do next."""
        assert self._size is not None
        last, self._last = self._last, None if view is None else view.pixels.mean(axis=0)
        if view is None:
            return "the board is not seen: nearer, less glare, and is it this kind of board?"
        if last is None or self._last is None or np.linalg.norm(self._last - last) > _STILL_PX:
            return "hold it still for a moment"
        if len(self._views) >= _MOST_VIEWS:
            return "these are enough: finish"
        if not differing(view, self._views, self._size, _NEW):
            return self._lacking()
        with storage(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            is_written = cv2.imwrite(str(self._folder / view.name), image)
        if not is_written:
            raise StorageError(f"{self._folder / view.name} cannot be written; is the disk full?")
        self._views.append(view)
        self._slants |= _slants(view, self._size[0])
        return "kept; " + self._lacking()

    def _lacking(self) -> str:
        missing = [way for way in ("left", "right", "top", "bottom") if way not in self._slants]
        if missing:
            return f"tilt the board by 30 degrees, its {missing[0]} side nearer to the camera"
        assert self._size is not None
        cells = coverage(self._views, self._size) > 0
        parts = {"top": cells[0], "bottom": cells[-1], "left": cells[:, 0], "right": cells[:, -1]}
        empty = [name for name, part in parts.items() if np.mean(part) < 1.0]
        if empty:
            return f"show it at the {empty[0]} of the image, up to the edge"
        return "show it elsewhere, nearer and farther" if len(self._views) < _WANTED_VIEWS else "finish when you like"

    def progress(self) -> Progress:
        """Return which cells have seen corners, and which slants were shown."""
        counts = np.zeros((4, 6)) if not self._views or self._size is None else coverage(self._views, self._size)
        covered = float(np.mean(counts > 0))
        parts = (len(self._views) / _WANTED_VIEWS, covered / _WANTED_COVER, len(self._slants) / 4.0)
        return Progress(
            share=min(1.0, *parts),
            can_finish=len(self._views) >= _LEAST_VIEWS,
            advice=self._said,
            facts={
                "Views": f"{len(self._views)} of {_WANTED_VIEWS}",
                "Image covered": f"{covered:.0%}",
                "Sides nearer once": ", ".join(sorted(self._slants)) or "none yet",
            },
            cells=np.minimum(counts / 20.0, 1.0).tolist(),
            jpeg=self._jpeg,
        )

    def calibrate(self) -> Outcome:
        """Calibrate on the kept images, as `vislam calibrate camera`."""
        if not self._views:
            raise DataError("the camera cannot be determined: no view of the board was kept")
        return calibrate_camera(self._options)


def _slants(view: View, width_px: int) -> set[str]:
    """Return which sides of the board are clearly nearer to the camera, as the image shows it.

    Over the image of a plane, inverse depth is affine in the pixel: the last row of the homography from image to plane.
    Its relative slope, times the focal length, is about the tangent of the slant.
    """
    H = cv2.findHomography(view.pixels, view.points_m[:, :2])[0]
    if H is None:
        return set()
    tangent = _USUAL_FOCAL * width_px * H[2, :2] / (H[2, :2] @ view.pixels.mean(axis=0) + H[2, 2])
    found = {"right": tangent[0] > _SLANTED, "left": tangent[0] < -_SLANTED}
    found |= {"bottom": tangent[1] > _SLANTED, "top": tangent[1] < -_SLANTED}
    return {name for name, is_so in found.items() if is_so}


def _picture(image: ImageU8, view: View | None) -> bytes:
    """Return a small JPEG of an image with the corners that were found."""
    scale = min(1.0, _WIDTH_PX / image.shape[1])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    drawn = cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    for x, y in () if view is None else ((view.pixels + 0.5) * scale - 0.5).tolist():
        cv2.circle(drawn, (round(x), round(y)), 3, (90, 200, 60), -1, cv2.LINE_AA)
    _, encoded = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 70])
    return encoded.tobytes()
