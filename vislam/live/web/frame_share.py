"""What the front process puts into the page's wire: small pictures, left out without a reader."""

from __future__ import annotations

import time
from multiprocessing.connection import Connection

import cv2
import numpy as np

from vislam.core.messages import Array, Frame
from vislam.live.web.updates import FrameUpdate
from vislam.live.wire.mail import Outbox
from vislam.pipeline.steps import FrontStep

_FRAME_S = 0.2  # between two pictures
_WIDTH_PX = 480
_QUALITY = 70
_MAX_REASON = 200


class FrameShare:
    """Shows the page frames, a few a second: where the last one was not taken yet, none."""

    def __init__(self, to_web: Connection) -> None:
        """Take the page's wire, to be used in this process only."""
        self._box = Outbox(to_web, 1)
        self._due_s = 0.0

    def show(self, step: FrontStep) -> None:
        """Show a frame with the points that vision follows, if it is time for one."""
        now_s = time.monotonic()
        if now_s < self._due_s or len(self._box) or self._box.is_broken:
            return
        self._due_s = now_s + _FRAME_S
        track = step.track
        jpeg = picture(step.frame, track.observations.pixels_px)
        self._box.put(
            FrameUpdate(step.frame.t_ns, jpeg, str(track.vo.tracking), track.vo.inliers, track.reason[:_MAX_REASON])
        )


def picture(frame: Frame, pixels_px: Array) -> bytes:
    """Return a small JPEG of a frame with points [N, 2] on it; empty where the frame has no image."""
    image = frame.color if frame.color is not None else frame.images[0] if frame.images else None
    if image is None:
        return b""
    scale = min(1.0, _WIDTH_PX / image.shape[1])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    drawn = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else small
    for x, y in ((pixels_px + 0.5) * scale - 0.5)[np.isfinite(pixels_px).all(axis=1)].tolist():
        cv2.circle(drawn, (round(x), round(y)), 2, (90, 200, 60), -1, cv2.LINE_AA)
    _, encoded = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return encoded.tobytes()
