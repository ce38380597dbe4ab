"""Depth images at their poses: of keyframes, as a map keeps them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array, ImageU8
from vislam.mapping.cloud.store import Scan
from vislam.mapping.depth.image import DepthView


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """What a pinhole camera saw, and from where."""

    depth_m: NDArray[np.float32]  # [h, w], 0 where none
    colors: ImageU8  # [h, w, 3] RGB
    K: Array  # [3, 3]
    T_map_view: Array  # [4, 4]
    max_range_m: float  # farther depth is not used


def posed_views(scans: Iterable[tuple[Scan, Array]], view: DepthView) -> Iterator[PosedView]:
    """Yield scans that have a depth image, with their T_map_body, as a pinhole camera would have seen them."""
    for scan, T_map_body in scans:
        depth, colors = scan.depth, scan.colors
        if depth is None:
            continue
        if view.to_pinhole is not None:
            depth = cv2.remap(depth, *view.to_pinhole, cv2.INTER_NEAREST)
            colors = np.asarray(cv2.remap(colors, *view.to_pinhole, cv2.INTER_LINEAR), np.uint8)
        depth_m = depth.astype(np.float32) * np.float32(view.unit_m)
        yield PosedView(depth_m, colors, view.K, T_map_body @ view.T_body_view, view.max_range_m)
