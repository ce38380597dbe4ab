"""Loop closing: recognise places seen before and measure the relative pose, precision first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.loop.closer import LoopCloser
    from vislam.loop.detector import Loop, LoopDetector
    from vislam.loop.table import LoopRow, read_loops
    from vislam.loop.view import View

__all__ = ["Loop", "LoopCloser", "LoopDetector", "LoopRow", "View", "read_loops"]

__getattr__ = late(
    __name__,
    {
        "Loop": "vislam.loop.detector",
        "LoopCloser": "vislam.loop.closer",
        "LoopDetector": "vislam.loop.detector",
        "LoopRow": "vislam.loop.table",
        "View": "vislam.loop.view",
        "read_loops": "vislam.loop.table",
    },
)
