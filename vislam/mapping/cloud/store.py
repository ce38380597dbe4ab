"""What is kept of every keyframe so that the map can be made again from other poses: some 60 to 120 kB each."""

import zlib
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.encoded_image import decoded
from vislam.core.errors import DataError
from vislam.core.memory import PackedScan
from vislam.core.messages import ImageU8

_JPEG_QUALITY = 90
# differences to the left neighbour, run-length and Huffman coded: as small as the other ways, and twice as fast
_PNG_OPTIONS = [
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB,
]  # fmt: skip
_MAX_SPARSE_POINTS = 5000


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What one keyframe sees: a depth image on the mapper's rays, or a few points in the body frame, with colours."""

    depth: NDArray[np.uint16] | None  # [h, w] in the view's units, 0 where none
    points_body_m: NDArray[np.float32] | None  # [N, 3] where there is no depth image
    colors: ImageU8  # RGB [h, w, 3] of the depth image, or [N, 3] of the points
    labels: NDArray[np.uint16] | None = None  # [h, w] of the depth image, or [N] of the points; 0: unknown


class KeyframeStore:
    """Keyframe id -> compressed scan; memory per keyframe is bounded by the size of a depth image."""

    def __init__(self, size: tuple[int, int]) -> None:
        """Prepare for depth images of one size: width, height."""
        self._size = size
        self._packed: dict[int, PackedScan] = {}

    def __len__(self) -> int:
        return len(self._packed)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._packed

    @property
    def ids(self) -> list[int]:
        """Ids of the stored keyframes, in the order they came."""
        return list(self._packed)

    @property
    def nbytes(self) -> int:
        """Memory of the compressed scans, in bytes."""
        return sum(packed.nbytes for packed in self._packed.values())

    @property
    def has_labels(self) -> bool:
        """Whether any stored keyframe has labels."""
        return any(packed.labels_png for packed in self._packed.values())

    def t_ns(self, keyframe_id: int) -> int:
        """Return the time of a stored keyframe."""
        return self._packed[keyframe_id].t_ns

    def packed(self, keyframe_id: int) -> PackedScan | None:
        """Return a keyframe's scan as it is stored, None if it has none."""
        return self._packed.get(keyframe_id)

    def put(self, keyframe_id: int, packed: PackedScan) -> None:
        """Keep a scan that `packed` gave. Raises DataError when it is none."""
        if not all(isinstance(part, bytes) for part in _parts(packed)):
            raise _damaged(keyframe_id, "it is no sequence of bytes")
        self._packed[keyframe_id] = packed

    def add(self, keyframe_id: int, t_ns: int, scan: Scan) -> None:
        """Keep the scan of a new keyframe; depth is kept exactly. Raises DataError on an id that is there already."""
        if keyframe_id in self._packed:
            raise DataError(f"keyframe {keyframe_id} is in the map already; ids must be new")
        if scan.depth is not None:
            depth_png = _encode(".png", scan.depth, _PNG_OPTIONS)
            bgr = np.ascontiguousarray(scan.colors[..., ::-1])
            colors = _encode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            self._packed[keyframe_id] = PackedScan(t_ns, depth_png, b"", colors, packed_labels(scan.labels))
        elif scan.points_body_m is not None:
            points = np.ascontiguousarray(scan.points_body_m[:_MAX_SPARSE_POINTS], dtype=np.float32)
            colors = np.ascontiguousarray(scan.colors[:_MAX_SPARSE_POINTS]).tobytes()
            labels = None if scan.labels is None else scan.labels[None, :_MAX_SPARSE_POINTS]
            packed_points = zlib.compress(points.tobytes(), 1)
            self._packed[keyframe_id] = PackedScan(t_ns, b"", packed_points, colors, packed_labels(labels))

    def labels(self, keyframe_id: int) -> NDArray[np.uint16] | None:
        """Return the labels [h, w] of a stored keyframe's depth image, or [N] of its points; None: it has none.

        Raises DataError when what an earlier run stored is damaged.
        """
        packed = self._packed[keyframe_id]
        if not packed.labels_png:
            return None
        geometry = self.geometry(keyframe_id)
        points = geometry.points_body_m
        shape = (1, 0 if points is None else len(points)) if geometry.depth is None else geometry.depth.shape
        labels = decoded(packed.labels_png, cv2.IMREAD_UNCHANGED, shape[::-1])
        if labels is None or labels.dtype not in (np.uint8, np.uint16) or labels.shape != shape:
            raise _damaged(keyframe_id, "its labels are no image of the size of its depth")
        ids = labels.astype(np.uint16)
        return ids[0] if geometry.depth is None else ids

    def scan(self, keyframe_id: int) -> Scan:
        """Return the scan of a stored keyframe, without labels; depth is exactly what was added.

        Raises DataError when what an earlier run stored is damaged.
        """
        geometry, colors = self.geometry(keyframe_id), self._packed[keyframe_id].colors
        if geometry.depth is not None:
            bgr = decoded(colors, cv2.IMREAD_COLOR, self._size)
            if bgr is None:
                raise _damaged(keyframe_id, "its colours are no image of the size of its depth")
            return replace(geometry, colors=np.ascontiguousarray(np.asarray(bgr, np.uint8)[..., ::-1]))
        if geometry.points_body_m is None or len(colors) != 3 * len(geometry.points_body_m):
            raise _damaged(keyframe_id, "it has not as many colours as points")
        return replace(geometry, colors=np.frombuffer(colors, np.uint8).reshape(-1, 3))

    def labelled(self, keyframe_id: int) -> Scan:
        """Return the scan of a stored keyframe with its labels, if it has some; raises DataError as `scan`."""
        return replace(self.scan(keyframe_id), labels=self.labels(keyframe_id))

    def geometry(self, keyframe_id: int) -> Scan:
        """Return the scan without decoding its colours (they are empty): all that occupancy needs.

        Raises DataError as `scan`.
        """
        packed, none = self._packed[keyframe_id], np.zeros((0, 3), np.uint8)
        if packed.depth_png:
            depth = decoded(packed.depth_png, cv2.IMREAD_UNCHANGED, self._size)
            if depth is None or depth.dtype != np.uint16 or depth.shape != self._size[::-1]:
                raise _damaged(keyframe_id, "its depth is no image of 16 bits of {} x {}".format(*self._size))
            return Scan(np.asarray(depth, np.uint16), None, none)
        try:
            data = zlib.decompressobj().decompress(packed.points, 12 * _MAX_SPARSE_POINTS)
        except zlib.error as error:
            raise _damaged(keyframe_id, f"its points cannot be unpacked ({error})") from error
        if len(data) % 12:
            raise _damaged(keyframe_id, "its points are cut")
        return Scan(None, np.frombuffer(data, np.float32).reshape(-1, 3), none)


def _parts(packed: PackedScan) -> tuple[object, ...]:
    return packed.depth_png, packed.points, packed.colors, packed.labels_png


def packed_labels(labels: NDArray[np.uint16] | None) -> bytes:
    """Return labels as a PNG, of 8 bits where that is enough; empty where there are none."""
    if labels is None or not labels.any():
        return b""
    return _encode(".png", labels.astype(np.uint8) if labels.max() < 256 else labels, _PNG_OPTIONS)


def _damaged(keyframe_id: int, why: str) -> DataError:
    return DataError(f"what is stored of keyframe {keyframe_id} is damaged: {why}; run the recording again")


def _encode(kind: str, image: NDArray[np.generic], options: list[int]) -> bytes:
    done, data = cv2.imencode(kind, image, options)
    if not done:
        raise DataError(f"a keyframe's image of shape {image.shape} and type {image.dtype} cannot be stored as {kind}")
    return bytes(data)
