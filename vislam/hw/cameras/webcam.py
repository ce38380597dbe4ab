"""A webcam through OpenCV and V4L2: settings that stay, capture stamps of the driver, the newest image only."""

import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import cv2

from vislam.config import BridgeClockConfig, WebcamConfig
from vislam.core.errors import HardwareError
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.cameras.library_camera import LibraryCamera, Setting
from vislam.hw.cameras.video import MAX_AGE_S
from vislam.hw.source import CapturedImage

_NS = 1_000_000_000
_MANUAL_EXPOSURE, _AUTO_EXPOSURE = 1.0, 3.0  # V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY
_EXPOSURES_PER_S = 10_000.0  # V4L2 counts exposure in units of 100 us
_PROBED = 5  # images after which it is settled whose stamps are used
_EARLY_NS = 2_000_000  # clocks are read one after the other
_NO_CLOCK, _OWN_CLOCK = "arrival", "driver, clock of its own"


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool: ...  # noqa: D102
    def set(self, prop: int, value: float, /) -> bool: ...  # noqa: D102
    def get(self, prop: int, /) -> float: ...  # noqa: D102
    def grab(self) -> bool: ...  # noqa: D102
    def retrieve(self) -> tuple[bool, Any]: ...  # noqa: D102
    def release(self) -> None: ...  # noqa: D102


class Webcam(LibraryCamera[CapturedImage]):
    """A camera on V4L2.

    Images are stamped by the driver where its clock is CLOCK_MONOTONIC or the wall clock. Stamps of a clock of the
    camera's own, whose rate may be off, are put on the line that lies under their arrivals, less `config.delay_s`;
    without any stamps arrivals less as much have to do. `stamped_by` names which.
    """

    def __init__(self, config: WebcamConfig, open_capture: Callable[[str], Capture] | None = None) -> None:
        """Open the camera and wait for its first image, see `LibraryCamera`.

        `open_capture` opens a device file; OpenCV does it by default.

        Raises:
            HardwareError: there is no such camera, it may not be opened, or it gives no image.
        """
        path, opened, known = device_path(config.device), open_capture or _open_v4l2, _Known(config)
        self._left_out = known.left_out
        super().__init__(path, lambda: WebcamStream(path, config, opened, known), config)

    def counters(self) -> dict[str, int]:
        """Return images captured, replaced or left out, each by its cause, and faults since the start."""
        return {name: n for name, n in super().counters().items() if name != "unstamped"} | self._left_out


class _Known:
    """What is known of a camera, however often it is opened: its clock, the size of its images, what was left out."""

    def __init__(self, config: WebcamConfig) -> None:
        self.stamper = _Stamper(config)
        self.shape: tuple[int, ...] | None = None
        self.left_out: Counter[str] = Counter()

    def takes(self, image: Any) -> bool:
        """Return whether an image is usable, and count it if not."""
        if image is None:
            self.left_out["undecodable"] += 1
            return False
        self.shape = image.shape if self.shape is None else self.shape
        if image.shape != self.shape:  # came back with another size: the calibration would be wrong
            self.left_out["wrong_size"] += 1
        return bool(image.shape == self.shape)


class WebcamStream:
    """Satisfies `Stream`: the device file, opened once."""

    def __init__(self, path: str, config: WebcamConfig, open_capture: Callable[[str], Capture], known: _Known) -> None:
        """Open the camera and set its format; raises HardwareError if it cannot be opened."""
        if problem := why_not_there(path):
            raise HardwareError(problem)
        self._capture = open_capture(path)
        if not self._capture.isOpened():
            self._capture.release()
            raise HardwareError(
                f"{path} cannot be opened as a camera: another program has it, or it is no capture device"
            )
        self.settings: tuple[Setting, ...] = ()
        self._path, self._config, self._known = path, config, known
        self._bad_before = known.stamper.bad
        _set_format(self._capture, config)

    @property
    def stamped_by(self) -> str:
        """Whose clock stamps."""
        return self._known.stamper.source

    @property
    def bad_stamps(self) -> int:
        """Images whose own stamp could not be believed."""
        return self._known.stamper.bad - self._bad_before

    def next(self) -> CapturedImage | None:
        """Return the next image; None for one that is left out. Raises HardwareError when the camera went away."""
        if not self._capture.grab():
            raise HardwareError(f"{self._path} went away or stopped giving images")
        arrival_ns, driver_ms = time.monotonic_ns(), self._capture.get(cv2.CAP_PROP_POS_MSEC)
        stamp_ns = self._known.stamper.stamp(driver_ms, arrival_ns, time.time_ns())
        is_decoded, image = self._capture.retrieve()
        # some drivers forget what is set before the stream runs
        if is_decoded and image is not None and not self.settings:
            self.settings = _set_controls(self._capture, self._config)
        return CapturedImage(stamp_ns, 0, image) if self._known.takes(image if is_decoded else None) else None

    def close(self) -> None:
        """Give the camera back."""
        self._capture.release()


class _Stamper:
    """Finds out which clock the driver stamps with, and stamps."""

    def __init__(self, config: WebcamConfig) -> None:
        self.bad = 0
        self.source = "not known yet"
        self._clock = DeviceClock(BridgeClockConfig())  # of the camera, where it has one of its own
        self._max_age_ns = round(MAX_AGE_S * _NS)
        self._delay_ns = round(config.delay_s * _NS)
        self._votes: Counter[str] = Counter()

    def stamp(self, driver_ms: float, arrival_ns: int, wall_ns: int) -> int:
        """Return when an image was captured, on CLOCK_MONOTONIC."""
        driver_ns = round(driver_ms * 1e6)
        ages_ns = {"driver": arrival_ns - driver_ns, "driver, wall clock": wall_ns - driver_ns}
        possible = [name for name, age in ages_ns.items() if -_EARLY_NS <= age <= self._max_age_ns and driver_ns > 0]
        on_line_ns = None if possible or driver_ns <= 0 else self._clock.stamp(driver_ns // 1000 % 2**32, arrival_ns)
        if self._votes.total() < _PROBED:
            self._votes[possible[0] if possible else _NO_CLOCK] += 1
            self.source = self._votes.most_common(1)[0][0]
        if self.source in possible:
            age_ns = max(ages_ns[self.source], 0)
            self._delay_ns = age_ns  # for an image whose own stamp is bad
            return arrival_ns - age_ns
        if self.source in (_NO_CLOCK, _OWN_CLOCK):
            self.source = _NO_CLOCK if on_line_ns is None else _OWN_CLOCK
            return (arrival_ns if on_line_ns is None else on_line_ns) - self._delay_ns
        self.bad += 1
        return arrival_ns - self._delay_ns


def device_path(device: str) -> str:
    """Return the device file of a camera's index or path."""
    return f"/dev/video{int(device)}" if device.isdigit() else device


def _open_v4l2(path: str) -> Capture:
    return cv2.VideoCapture(path, cv2.CAP_V4L2)


def why_not_there(path: str) -> str | None:
    """Return why a device file cannot be opened, None if it can be tried."""
    if not Path(path).exists():
        there = [f"{name} ({_camera_name(name)})" for name in sorted(map(str, Path("/dev").glob("video*")))]
        return f"there is no camera {path}; there are: {', '.join(there) or 'none'}. Plug it in, or name another one"
    if not os.access(path, os.R_OK | os.W_OK):
        return (
            f"{path} may not be opened; add yourself to the group that owns it (usually: sudo usermod -aG video $USER) "
            "and log in again"
        )
    return None


def _camera_name(path: str) -> str:
    try:
        return (Path("/sys/class/video4linux") / Path(path).name / "name").read_text(encoding="utf-8").strip()
    except OSError:
        return "unknown"


def _set_format(capture: Capture, config: WebcamConfig) -> None:
    """Ask for format, size and rate, before the stream runs: each change makes the driver set up its buffers again."""
    capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.width_px)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.height_px)
    capture.set(cv2.CAP_PROP_FPS, config.rate_hz)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, config.buffers)


def _set_controls(capture: Capture, config: WebcamConfig) -> tuple[Setting, ...]:
    """Fix what the camera would change by itself, and return all settings as read back."""
    wanted: list[tuple[str, int, float, float]] = []  # name, property, value of the property, its unit
    if config.exposure_s is None:
        wanted.append(("auto exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _AUTO_EXPOSURE, 1.0))
    else:
        wanted.append(("auto exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE, 1.0))
        wanted.append(("exposure [s]", cv2.CAP_PROP_EXPOSURE, config.exposure_s * _EXPOSURES_PER_S, _EXPOSURES_PER_S))
    if config.gain is not None:
        wanted.append(("gain", cv2.CAP_PROP_GAIN, config.gain, 1.0))
    if config.focus is not None:
        wanted.append(("autofocus", cv2.CAP_PROP_AUTOFOCUS, 0.0, 1.0))
        wanted.append(("focus", cv2.CAP_PROP_FOCUS, config.focus, 1.0))
    if config.white_balance_k is not None:
        wanted.append(("auto white balance", cv2.CAP_PROP_AUTO_WB, 0.0, 1.0))
        wanted.append(("white balance [K]", cv2.CAP_PROP_WB_TEMPERATURE, config.white_balance_k, 1.0))
    for _, prop, value, _ in wanted:
        capture.set(prop, value)
    settings = [
        Setting("format", config.fourcc, _fourcc_text(capture.get(cv2.CAP_PROP_FOURCC))),
        Setting("width [px]", float(config.width_px), capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
        Setting("height [px]", float(config.height_px), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        Setting("rate [Hz]", config.rate_hz, capture.get(cv2.CAP_PROP_FPS)),
    ]
    for name, prop, value, unit in wanted:
        got = capture.get(prop)
        settings.append(Setting(name, value / unit, None if got == -1.0 else got / unit))
    return tuple(settings)


def _fourcc_text(code: float) -> str:
    return int(code).to_bytes(4, "little", signed=False).decode("ascii", "replace") if 0 <= code < 2**32 else "unknown"
