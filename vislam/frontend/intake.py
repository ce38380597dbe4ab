"""The door of a front end: what every frame is checked for before it is looked at."""

from __future__ import annotations

import cv2

from vislam.camera import Rig
from vislam.errors import DataError
from vislam.messages import Frame


class Intake:
    """Refuses frames that do not fit the rig or do not advance in time, and seeds OpenCV's random numbers per frame."""

    def __init__(self, rig: Rig, seed: int) -> None:
        """Take the rig that frames must fit."""
        self._rig = rig
        self._seed = seed
        self._t_ns: int | None = None

    def accept(self, frame: Frame) -> float:
        """Return the seconds since the previous frame, 0 for the first.

        Raises DataError when time does not advance, an image is missing or has not the calibrated size.
        """
        if not frame.images:
            raise DataError(f"frame {frame.index} has no image")
        if self._t_ns is not None and frame.t_ns <= self._t_ns:
            raise DataError(
                f"frame {frame.index} at {frame.t_ns} ns does not come after the one at {self._t_ns} ns; "
                "frames must be in time order"
            )
        for camera, image in zip(self._rig.cameras, frame.images, strict=False):
            camera.check_image(image)
        if frame.depth_m is not None:
            self._rig.cameras[0].check_image(frame.depth_m)
        dt_s = 0.0 if self._t_ns is None else (frame.t_ns - self._t_ns) * 1e-9
        self._t_ns = frame.t_ns
        cv2.setRNGSeed((self._seed + frame.index) % 2**31)
        return dt_s
