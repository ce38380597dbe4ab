"""An imitation of OpenCV's `VideoCapture`, with every fault."""

import threading
import time
from collections.abc import Callable

import cv2
import numpy as np

AGE_NS = 20_000_000  # of an image when it arrives


class FakeCapture:
    """A camera with limited abilities: a test sets its faults, and what it sees by `size` or `view`."""

    def __init__(
        self, clock: Callable[[], int] = time.monotonic_ns, rate_hz: float = 200.0,
        view: Callable[[int], np.ndarray] | None = None,
    ) -> None:  # fmt: skip
        self.values: dict[int, float] = {cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0}
        self.clock, self.period_s, self.view = clock, 1.0 / rate_hz, view
        self.unplugged = self.closed = self.damaged = False
        self.hang = threading.Event()
        self.hang.set()
        self.grabbed = 0
        self.stamp_ms = 0.0
        self.size: tuple[int, int] | None = None
        self.unsupported = {cv2.CAP_PROP_FOCUS, cv2.CAP_PROP_AUTOFOCUS}

    def isOpened(self) -> bool:
        return not self.unplugged

    def set(self, prop: int, value: float) -> bool:
        if prop in self.unsupported:
            return False
        if prop == cv2.CAP_PROP_FRAME_WIDTH:
            value = min(value, 800)
        self.values[prop] = round(value)
        return True

    def get(self, prop: int) -> float:
        if prop == cv2.CAP_PROP_POS_MSEC:
            return self.stamp_ms
        return self.values.get(prop, -1.0)

    def grab(self) -> bool:
        self.hang.wait(60.0)  # what a test leaves hanging ends some time
        time.sleep(self.period_s)
        self.grabbed += 1
        self.stamp_ms = (self.clock() - AGE_NS) / 1e6
        return not self.unplugged

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        if self.view is not None:
            return True, self.view(self.grabbed)
        width, height = self.size or (int(self.get(cv2.CAP_PROP_FRAME_WIDTH)), int(self.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        return not self.damaged, None if self.damaged else np.full((height, width, 3), self.grabbed % 251, np.uint8)

    def release(self) -> None:
        self.closed = True
