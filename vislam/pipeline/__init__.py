"""The halves of the pipeline: what runs at the rate of the sensors, and what runs at that of keyframes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.pipeline.back import Back
    from vislam.pipeline.front import Front, odometry
    from vislam.pipeline.steps import Finish, Step

__all__ = [
    "Back",
    "Finish",
    "Front",
    "Step",
    "odometry",
]

__getattr__ = late(
    __name__,
    {
        "Back": "vislam.pipeline.back",
        "Finish": "vislam.pipeline.steps",
        "Front": "vislam.pipeline.front",
        "Step": "vislam.pipeline.steps",
        "odometry": "vislam.pipeline.front",
    },
)
