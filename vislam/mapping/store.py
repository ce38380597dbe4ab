"""What is kept of every keyframe so that the map can be made again from other poses: some 60 to 120 kB each."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.errors import DataError
from vislam.memory import PackedScan

ImageU8 = NDArray[np.uint8]
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


class KeyframeStore:
    """Keyframe id -> compressed scan; memory per keyframe is bounded by the size of a depth image."""

    def __init__(self) -> None:
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

    def t_ns(self, keyframe_id: int) -> int:
        """Return the time of a stored keyframe."""
        return self._packed[keyframe_id].t_ns

    def packed(self, keyframe_id: int) -> PackedScan | None:
        """Return a keyframe's scan as it is stored, None if it has none."""
        return self._packed.get(keyframe_id)

    def put(self, keyframe_id: int, packed: PackedScan) -> None:
        """Keep a scan that `packed` gave."""
        self._packed[keyframe_id] = packed

    def add(self, keyframe_id: int, t_ns: int, scan: Scan) -> None:
        """Keep the scan of a new keyframe; depth is kept exactly. Raises DataError on an id that is there already."""
        if keyframe_id in self._packed:
            raise DataError(f"keyframe {keyframe_id} is in the map already; ids must be new")
        if scan.depth is not None:
            depth_png = _encode(".png", scan.depth, _PNG_OPTIONS)
            bgr = np.ascontiguousarray(scan.colors[..., ::-1])
            colors = _encode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            self._packed[keyframe_id] = PackedScan(t_ns, depth_png, b"", colors)
        elif scan.points_body_m is not None:
            points = np.ascontiguousarray(scan.points_body_m[:_MAX_SPARSE_POINTS], dtype=np.float32)
            colors = np.ascontiguousarray(scan.colors[:_MAX_SPARSE_POINTS]).tobytes()
            self._packed[keyframe_id] = PackedScan(t_ns, b"", zlib.compress(points.tobytes(), 1), colors)

    def scan(self, keyframe_id: int) -> Scan:
        """Return the scan of a stored keyframe; depth is exactly what was added."""
        packed = self._packed[keyframe_id]
        if packed.depth_png:
            depth = cv2.imdecode(np.frombuffer(packed.depth_png, np.uint8), cv2.IMREAD_UNCHANGED)
            bgr = cv2.imdecode(np.frombuffer(packed.colors, np.uint8), cv2.IMREAD_COLOR)
            return Scan(np.asarray(depth, np.uint16), None, np.ascontiguousarray(np.asarray(bgr, np.uint8)[..., ::-1]))
        points = np.frombuffer(zlib.decompress(packed.points), np.float32).reshape(-1, 3)
        return Scan(None, points, np.frombuffer(packed.colors, np.uint8).reshape(-1, 3))

    def geometry(self, keyframe_id: int) -> Scan:
        """Return the scan without decoding its colours (they are empty): all that occupancy needs."""
        packed = self._packed[keyframe_id]
        none = np.zeros((0, 3), np.uint8)
        if packed.depth_png:
            depth = cv2.imdecode(np.frombuffer(packed.depth_png, np.uint8), cv2.IMREAD_UNCHANGED)
            return Scan(np.asarray(depth, np.uint16), None, none)
        return Scan(None, np.frombuffer(zlib.decompress(packed.points), np.float32).reshape(-1, 3), none)


def _encode(kind: str, image: NDArray[np.generic], options: list[int]) -> bytes:
    done, data = cv2.imencode(kind, image, options)
    if not done:
        raise DataError(f"a keyframe's image of shape {image.shape} and type {image.dtype} cannot be stored as {kind}")
    return bytes(data)
