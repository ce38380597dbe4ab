"""A camera as the front process sees it: the newest frame, or none."""

import time

import cv2

from vislam.core.messages import Frame
from vislam.hw.health import Health
from vislam.hw.source import ImageSource


class OneCamera:
    """Frames of one camera."""

    def __init__(self, camera: ImageSource) -> None:
        """Own the camera."""
        self._camera = camera

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest image as a frame; see `FrameSource`."""
        captured = self._camera.read(timeout_s)
        if captured is None:
            return None
        if captured.image.ndim == 2:
            return Frame(captured.t_ns, captured.index, (captured.image,))
        grey = cv2.cvtColor(captured.image, cv2.COLOR_BGR2GRAY)
        return Frame(captured.t_ns, captured.index, (grey,), captured.image)

    def health(self) -> Health:
        """Return that of the camera."""
        return self._camera.health()

    def counters(self) -> dict[str, int]:
        """Return those of the camera."""
        return self._camera.counters()

    def close(self) -> None:
        """Give the camera back."""
        self._camera.close()


class NoCamera:
    """In the place of the cameras of a run without any: no frame ever comes."""

    def read(self, timeout_s: float) -> Frame | None:
        """Wait, and return None."""
        time.sleep(timeout_s)
        return None

    def health(self) -> Health:
        """Return nothing: a camera that was not asked for is not missing."""
        return Health(0)

    def counters(self) -> dict[str, int]:
        """Return nothing."""
        return {}

    def close(self) -> None:
        """Do nothing."""
