"""Images and views: features, two-view geometry, pose of a camera, shutter, brightness.

Compiled by hand: 540 lines. No peer has been measured. OpenCV has the matching, the essential matrix and the pose
from points, without their covariances: each submap is to be dropped when it is measured and the peer is as fast and as
good.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.vision.features import describe, detect_corners, find_tags, follow, match

__all__ = [
    "describe",
    "detect_corners",
    "find_tags",
    "follow",
    "match",
]

__getattr__ = late(
    __name__,
    {
        "describe": "vislam.vision.features",
        "detect_corners": "vislam.vision.features",
        "find_tags": "vislam.vision.features",
        "follow": "vislam.vision.features",
        "match": "vislam.vision.features",
    },
)
