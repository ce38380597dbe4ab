"""What every room knows: messages, geometry, cameras, errors, clocks, files.

Compiled by hand: 350 lines (cameras, geometry, 3 x 3 helpers). Kernels elsewhere call them, so no library can take
their place while those are compiled; no peer has been measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.core.camera import Camera, Rig
    from vislam.core.clock import StageClock
    from vislam.core.errors import DataError, UsageError, VislamError
    from vislam.core.geometry import (
        align_points,
        invert,
        level_rotation,
        se3_exp,
        se3_log,
        sim3_parts,
        so3_exp,
        so3_log,
        transform,
        transform_points,
    )
    from vislam.core.messages import (
        Array,
        Frame,
        ImuSample,
        ImuSpan,
        Keyframe,
        KeyframePacket,
        MagSample,
        NavState,
        Observations,
        Tracking,
        VoMeasurement,
    )
    from vislam.core.readings import Reading

__all__ = [
    "Array",
    "Camera",
    "DataError",
    "Frame",
    "ImuSample",
    "ImuSpan",
    "Keyframe",
    "KeyframePacket",
    "MagSample",
    "NavState",
    "Observations",
    "Reading",
    "Rig",
    "StageClock",
    "Tracking",
    "UsageError",
    "VislamError",
    "VoMeasurement",
    "align_points",
    "invert",
    "level_rotation",
    "se3_exp",
    "se3_log",
    "sim3_parts",
    "so3_exp",
    "so3_log",
    "transform",
    "transform_points",
]

__getattr__ = late(
    __name__,
    {
        "Array": "vislam.core.messages",
        "Camera": "vislam.core.camera",
        "DataError": "vislam.core.errors",
        "Frame": "vislam.core.messages",
        "ImuSample": "vislam.core.messages",
        "ImuSpan": "vislam.core.messages",
        "Keyframe": "vislam.core.messages",
        "KeyframePacket": "vislam.core.messages",
        "MagSample": "vislam.core.messages",
        "NavState": "vislam.core.messages",
        "Observations": "vislam.core.messages",
        "Reading": "vislam.core.readings",
        "Rig": "vislam.core.camera",
        "StageClock": "vislam.core.clock",
        "Tracking": "vislam.core.messages",
        "UsageError": "vislam.core.errors",
        "VislamError": "vislam.core.errors",
        "VoMeasurement": "vislam.core.messages",
        "align_points": "vislam.core.geometry",
        "invert": "vislam.core.geometry",
        "level_rotation": "vislam.core.geometry",
        "se3_exp": "vislam.core.geometry",
        "se3_log": "vislam.core.geometry",
        "sim3_parts": "vislam.core.geometry",
        "so3_exp": "vislam.core.geometry",
        "so3_log": "vislam.core.geometry",
        "transform": "vislam.core.geometry",
        "transform_points": "vislam.core.geometry",
    },
)
