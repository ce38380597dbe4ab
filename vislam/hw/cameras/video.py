"""A video file in the place of a webcam, in real time by its own stamps or as fast as it is read."""

import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2

from vislam.core.errors import HardwareError
from vislam.hw.cameras.mailbox import Mailbox
from vislam.hw.health import Health
from vislam.hw.source import CapturedImage

MAX_AGE_S = 1.0  # of a stamp at arrival; older, it is from another clock
_NS = 1_000_000_000
_JOIN_S = 5.0  # decoding one image takes milliseconds
_STEP_S = 0.2  # at most, before looking whether to stop


class VideoCamera:
    """Satisfies `ImageSource`. The first image is captured when it is opened, the others follow as in the file.

    In real time an image that is not read in time is replaced by the next, as with a camera. At full speed each waits
    until it is read; stamps are the same, and run ahead of the clock.
    """

    def __init__(self, path: Path, stamps_ns: Sequence[int] | None = None, in_real_time: bool = True) -> None:
        """Open a file; `stamps_ns` are the times of its images, rising, in place of those in the file.

        Raises:
            HardwareError: there is no such file, or it is no video.
        """
        self.path = path
        self.stamped_by = "the file" if stamps_ns is None else "the table beside the file"
        self.is_finished = False
        self._stamps_ns = stamps_ns
        self._in_real_time = in_real_time
        self._mailbox: Mailbox[CapturedImage] = Mailbox()
        self._counts: Counter[str] = Counter()
        if not path.is_file():
            raise HardwareError(f"there is no video {path} to stand in for a camera; give a camera's index or a file")
        self._video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._video.isOpened() or not self._video.grab():
            self._video.release()
            raise HardwareError(f"{path} cannot be read as a video; give a file such as an .mp4 or .avi")
        self._begin_ns = time.monotonic_ns()
        self._is_stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="video-camera", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the newest image, see `ImageSource`."""
        return self._mailbox.take(timeout_s)

    def health(self) -> Health:
        """Return CAMERA_MISSING after the last image, nothing before."""
        return Health.CAMERA_MISSING if self.is_finished else Health(0)

    def counters(self) -> dict[str, int]:
        """Return images captured, replaced by newer ones before they were read, and faults since the start."""
        return {**self._counts, "replaced": self._mailbox.replaced}

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._is_stopping.set()
        self._mailbox.close()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        place, first_ns, last_ns = 0, None, -1
        is_there = True  # the first image has been grabbed
        while is_there and not self._is_stopping.is_set():
            own_ns = self._own_stamp(place)
            if own_ns is None:
                break
            first_ns = own_ns if first_ns is None else first_ns
            stamp_ns = self._begin_ns + own_ns - first_ns
            is_decoded, image = self._video.retrieve()
            if not is_decoded:
                self._counts["undecodable"] += 1
            elif stamp_ns <= last_ns:
                self._counts["stamps_not_rising"] += 1
            elif self._is_time(stamp_ns):
                self._mailbox.put(CapturedImage(stamp_ns, self._counts["captured"], image))
                self._counts["captured"] += 1
                last_ns = stamp_ns
            place += 1
            is_there = self._video.grab()
        self._video.release()
        self.is_finished = True

    def _own_stamp(self, place: int) -> int | None:
        if self._stamps_ns is None:
            return round(self._video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        return self._stamps_ns[place] if place < len(self._stamps_ns) else None

    def _is_time(self, stamp_ns: int) -> bool:
        """Wait for the time of an image, or until the last one is read; False when it is to stop."""
        while not self._is_stopping.is_set():
            if self._in_real_time:
                left_s = (stamp_ns - time.monotonic_ns()) / _NS
                if left_s <= 0.0:
                    return True
                self._is_stopping.wait(min(left_s, _STEP_S))
            elif self._mailbox.wait_until_empty(_STEP_S):
                return not self._is_stopping.is_set()
        return False
