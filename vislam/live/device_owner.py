"""The process that owns a camera with an IMU inside: such a device can be opened once, and two processes want it."""

import logging
import socket
import threading
import time
from contextlib import closing

from vislam.config import SensorsConfig
from vislam.core.messages import Frame
from vislam.hw.cameras.library_camera import LibraryCamera
from vislam.hw.library_cameras import frame_config, has_depth, open_with_imu
from vislam.live.handed_frames import FrameHander
from vislam.live.handed_imu import ImuHander
from vislam.live.processes.child import Life

_LOG = logging.getLogger(__name__)
_READ_S = 0.05
_TELL_S = 0.1
_TELL_FRAMES_S = 0.5  # without a frame
_JOIN_S = 2.0


def own_device(life: Life, name: str, sensors: SensorsConfig, memory: str, samples: socket.socket) -> None:
    """Open the device, and hand its samples to the fast process and its frames to the front process until the end.

    Args:
        life: of this process.
        name: of the camera, such as `realsense,depth`.
        sensors: settings.
        memory: name of the shared memory of the frames.
        samples: to the fast process.

    Raises HardwareError where the device is missing, or gives no samples.
    """
    settings = frame_config(name, sensors)
    handed = FrameHander(memory, settings.width_px, settings.height_px, has_depth(name))
    hander = ImuHander(samples)
    try:
        camera, imu = open_with_imu(name, sensors)
        with closing(camera), closing(imu):
            if not life.ready():
                return
            imu.read(0.0)  # what came before anybody could want it
            imu.health()
            _LOG.info("%s: images are stamped by %s; its IMU's samples by %s", name, camera.stamped_by, imu.stamped_by)
            frames = _Frames(camera, handed)
            reported_s, problem = 0.0, ""
            try:
                while not life.stopped:
                    hander.send(imu.read(_READ_S))
                    if time.monotonic() - reported_s > _TELL_S:
                        reported_s = time.monotonic()
                        problem = _report_change(name, problem, camera.problem)
                        hander.report(imu.health(), imu.counters(), problem)
            finally:
                frames.end()
    finally:
        hander.close()
        handed.close()


def _report_change(name: str, before: str, problem: str) -> str:
    """Log that a device went away, why it does not come back, or that it has; return its problem."""
    if problem and problem != before:
        _LOG.warning("%s: %s", name, problem)
    elif before and not problem:
        _LOG.warning("%s is back", name)
    return problem


class _Frames:
    """A thread that hands frames on, so that no sample waits for the copy of an image."""

    def __init__(self, camera: LibraryCamera[Frame], handed: FrameHander) -> None:
        self._camera, self._handed = camera, handed
        self._is_ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="frames", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """End the thread."""
        self._is_ending.set()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        reported_s = time.monotonic()
        while not self._is_ending.is_set():
            frame = self._camera.read(_READ_S)
            now_s = time.monotonic()
            if frame is not None:
                reported_s = now_s
                self._handed.hand(frame, self._camera.counters())
            elif now_s - reported_s > _TELL_FRAMES_S:
                reported_s = now_s
                self._handed.report(self._camera.counters())
