"""The stages of a run in processes of their own, driven by live sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.live.wire.published_pose import PublishedPose
    from vislam.live.wire.publisher import PosePublisher, PoseReader

__all__ = [
    "PosePublisher",
    "PoseReader",
    "PublishedPose",
]

__getattr__ = late(
    __name__,
    {
        "PosePublisher PoseReader": "vislam.live.wire.publisher",
        "PublishedPose": "vislam.live.wire.published_pose",
    },
)
