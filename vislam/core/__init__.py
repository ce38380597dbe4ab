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
        NO_IMAGE,
        Array,
        Frame,
        FurtherTracks,
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
    from vislam.core.recording import MaskedRecording, Problems, Recording

__all__ = [
    "NO_IMAGE",
    "Array",
    "Camera",
    "DataError",
    "Frame",
    "FurtherTracks",
    "ImuSample",
    "ImuSpan",
    "Keyframe",
    "KeyframePacket",
    "MagSample",
    "MaskedRecording",
    "NavState",
    "Observations",
    "Problems",
    "Reading",
    "Recording",
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
        "NO_IMAGE Array Frame FurtherTracks ImuSample ImuSpan Keyframe KeyframePacket": "vislam.core.messages",
        "MagSample NavState Observations Tracking VoMeasurement": "vislam.core.messages",
        "Camera Rig": "vislam.core.camera",
        "DataError UsageError VislamError": "vislam.core.errors",
        "MaskedRecording Problems Recording": "vislam.core.recording",
        "Reading": "vislam.core.readings",
        "StageClock": "vislam.core.clock",
        "align_points invert level_rotation se3_exp se3_log sim3_parts so3_exp so3_log": "vislam.core.geometry",
        "transform transform_points": "vislam.core.geometry",
    },
)
