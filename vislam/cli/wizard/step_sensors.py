"""The sensors of a calibration step: those that the run will have, raw, or a recording in real time."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, closing

import cv2

from vislam.cli.wizard.run_setup import RunSetup
from vislam.config import Config, SensorsConfig
from vislam.core.errors import HardwareError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.recording import with_camera
from vislam.hw.cameras.library_camera import LibraryCamera
from vislam.hw.imu_source import InertialSource
from vislam.hw.library_cameras import WITH_IMU, gives_frames, open_frame_camera, open_with_imu, reads_own_imu
from vislam.hw.sensors import open_camera, open_inertial, with_raw_samples
from vislam.hw.source import CapturedImage, ImageSource
from vislam.runs.sources import open_source

Value = ImuSample | MagSample | Frame
_NO_FRAMES_NS = 1 << 62
_NS = 1e-9


def why_not(source: str, has_images: bool) -> str:
    """Return why a live run's source has no camera, or no IMU, that a person could move; empty where it may have."""
    _, plus, camera = source.partition("+")
    if source.startswith("replay:") or _is_camera_alone(source):
        return ""
    if not plus:
        return f"{source} has nothing that a hand could move; calibrate with a cart's sensors or a replay"
    return f"{source} has no camera to calibrate" if has_images and camera == "none" else ""


def _is_camera_alone(source: str) -> bool:
    """Return whether a source is a camera with the IMU inside it."""
    return "+" not in source and source.partition(",")[0].partition(":")[0] in WITH_IMU


class CartSensors:
    """Devices of this machine."""

    is_over = False

    def __init__(self, inertial: str, camera: str, sensors: SensorsConfig, has_images: bool) -> None:
        """Open the IMU, or the camera if images are asked for; raises HardwareError."""
        self._devices = ExitStack()
        self._images: ImageSource | LibraryCamera[Frame] | None = None
        self._inertial: InertialSource | None = None
        raw = with_raw_samples(sensors)
        if not inertial and not has_images:
            device, own = open_with_imu(camera, raw)
            self._devices.enter_context(closing(device))
            self._inertial = self._devices.enter_context(closing(own))
        elif has_images:
            is_rig = gives_frames(camera)
            self._images = open_frame_camera(camera, sensors) if is_rig else open_camera(camera, sensors)
            self._devices.enter_context(closing(self._images))
        else:
            self._inertial = self._devices.enter_context(closing(open_inertial(inertial, raw)))

    def read(self, timeout_s: float) -> list[Value]:
        """Return samples, or the newest image, waiting at most so long for the first."""
        if self._inertial is not None:
            return list(self._inertial.read(timeout_s))
        assert self._images is not None
        captured = self._images.read(timeout_s)
        return [] if captured is None else [_frame(captured)]

    def close(self) -> None:
        """Give the devices back; may be called twice."""
        self._devices.close()


class PlayedSensors:
    """A recording in real time; frames that are not taken in time are left out."""

    def __init__(self, uri: str, config: Config, has_images: bool) -> None:
        """Begin to play; raises HardwareError where there is nothing to play."""
        recording = open_source(uri, config.seed, config.calibration)
        if has_images:
            with_camera(recording)
        self._values: Iterator[Value] = iter(recording.events(None if has_images else _NO_FRAMES_NS))
        self._next = next(self._values, None)
        if self._next is None:
            raise HardwareError(f"{uri} has nothing to play")
        self._zero_ns, self._begun_s = self._next.t_ns, time.monotonic()
        self._has_images = has_images

    @property
    def is_over(self) -> bool:
        """Whether the recording has been played."""
        return self._next is None

    def read(self, timeout_s: float) -> list[Value]:
        """Return the values whose time has come, waiting at most so long for the first; of frames the newest."""
        out: deque[Value] = deque(maxlen=1 if self._has_images else None)
        deadline_s = time.monotonic() + timeout_s
        while self._next is not None:
            due_s = self._begun_s + (self._next.t_ns - self._zero_ns) * _NS
            if due_s > min(time.monotonic(), deadline_s):
                if out or due_s > deadline_s:
                    break
                time.sleep(max(0.0, due_s - time.monotonic()))
            if isinstance(self._next, Frame) == self._has_images:
                out.append(self._next)
            self._next = next(self._values, None)
        if not out:
            time.sleep(max(0.0, deadline_s - time.monotonic()))
        return list(out)

    def close(self) -> None:
        """Stop reading."""
        self._next = None


def opened(setup: RunSetup, has_images: bool) -> CartSensors | PlayedSensors:
    """Return the cameras, or the IMU, of a live run's source.

    Raises UsageError where it has none that a person could move, HardwareError where one is missing.
    """
    source = setup.source
    if refusal := why_not(source, has_images):
        raise UsageError(refusal)
    if source.startswith("replay:"):
        return PlayedSensors(source.removeprefix("replay:"), setup.config, has_images)
    inertial, plus, camera = source.partition("+")
    if _is_camera_alone(source):
        inertial, camera = "", source
    elif plus and reads_own_imu(inertial, camera):
        inertial = ""
    return CartSensors(inertial, camera, setup.sensors, has_images)


def _frame(captured: CapturedImage | Frame) -> Frame:
    if isinstance(captured, Frame):
        return captured
    image = captured.image
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return Frame(captured.t_ns, captured.index, (grey,))
