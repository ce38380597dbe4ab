"""A webcam through OpenCV and V4L2: settings that stay, capture stamps of the driver, the newest image only."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2

from vislam.config import BridgeClockConfig, WebcamConfig
from vislam.core.errors import HardwareError
from vislam.hw.bridge.clock import DeviceClock
from vislam.hw.cameras.mailbox import Mailbox
from vislam.hw.cameras.video import MAX_AGE_S
from vislam.hw.health import Health
from vislam.hw.source import CapturedImage

_NS = 1_000_000_000
_MANUAL_EXPOSURE, _AUTO_EXPOSURE = 1.0, 3.0  # V4L2_EXPOSURE_MANUAL, V4L2_EXPOSURE_APERTURE_PRIORITY
_EXPOSURES_PER_S = 10_000.0  # V4L2 counts exposure in units of 100 us
_PROBED = 5  # images after which it is settled whose stamps are used
_EARLY_NS = 2_000_000  # clocks are read one after the other
_NO_CLOCK, _OWN_CLOCK = "arrival", "driver, clock of its own"
_JOIN_S = 1.0  # a driver may hold a thread for 10 s; it is then left to end by itself


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool: ...  # noqa: D102
    def set(self, prop: int, value: float, /) -> bool: ...  # noqa: D102
    def get(self, prop: int, /) -> float: ...  # noqa: D102
    def grab(self) -> bool: ...  # noqa: D102
    def retrieve(self) -> tuple[bool, Any]: ...  # noqa: D102
    def release(self) -> None: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class Setting:
    """What was asked of the camera and what it reports to do; None: it does not offer it."""

    name: str
    asked: float | str
    got: float | str | None

    @property
    def differs(self) -> bool:
        """Whether the camera does something else."""
        if isinstance(self.asked, float) and isinstance(self.got, float):
            return abs(self.got - self.asked) > 0.02 * abs(self.asked)
        return self.asked != self.got


class Webcam:
    """Satisfies `ImageSource`. A thread captures; `read` never waits for the driver.

    Images are stamped by the driver where its clock is CLOCK_MONOTONIC or the wall clock. Stamps of a clock of the
    camera's own, whose rate may be off, are put on the line that lies under their arrivals, less `config.delay_s`;
    without any stamps arrivals less as much have to do. `stamped_by` names which. A camera that goes away is looked
    for every `config.reopen_s`.
    """

    def __init__(
        self,
        config: WebcamConfig,
        must_be_there: bool = True,
        open_capture: Callable[[str], Capture] | None = None,
    ) -> None:
        """Open the camera and wait for its first image, `config.start_s` at most.

        With `must_be_there` False nothing is waited for and a missing camera is no error. `open_capture` opens a
        device file; OpenCV does it by default.

        Raises:
            HardwareError: there is no such camera, it may not be opened, or it gives no image.
        """
        self.path = device_path(config.device)
        self.rate_hz = config.rate_hz
        self.settings: tuple[Setting, ...] = ()
        self.stamped_by = "not known yet"
        self.problem = ""
        self._config = config
        self._open_capture = _open_v4l2 if open_capture is None else open_capture
        self._mailbox: Mailbox[CapturedImage] = Mailbox()
        self._counts: Counter[str] = Counter()  # written by the thread alone, after it has started
        self._newest_ns = 0  # arrival
        self._stamper = _Stamper(config)
        self._stamp_ns = 0
        self._shape: tuple[int, ...] | None = None
        self._is_stopping = threading.Event()
        self._has_tried = threading.Event()  # an image came, or the camera could not be opened
        self._thread = threading.Thread(target=self._run, name="webcam", daemon=True)
        self._thread.start()
        if must_be_there:
            self._has_tried.wait(config.start_s)
            if self._newest_ns == 0:
                self.close()
                raise HardwareError(
                    self.problem or f"{self.path} gives no image within {config.start_s:g} s; replug it"
                )

    def read(self, timeout_s: float) -> CapturedImage | None:
        """Return the newest image, see `ImageSource`."""
        return self._mailbox.take(timeout_s)

    def health(self) -> Health:
        """Return CAMERA_MISSING or nothing."""
        missing = time.monotonic_ns() - self._newest_ns > self._config.missing_s * _NS
        return Health.CAMERA_MISSING if missing else Health(0)

    def counters(self) -> dict[str, int]:
        """Return images captured, replaced by newer ones before they were read, and faults since the start."""
        return {**self._counts, "replaced": self._mailbox.replaced, "bad_stamps": self._stamper.bad}

    def close(self) -> None:
        """Give the camera back; may be called twice."""
        self._is_stopping.set()
        self._mailbox.close()
        self._thread.join(_JOIN_S)

    # ---- the thread -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._is_stopping.is_set():
            capture = self._opened()
            if capture is not None:
                self._capture(capture)
                capture.release()
            self._has_tried.set()
            self._is_stopping.wait(self._config.reopen_s)

    def _opened(self) -> Capture | None:
        """Return the camera with its format set; None, and `problem`, if it cannot be opened."""
        problem = why_not_there(self.path)
        if problem is None:
            capture = self._open_capture(self.path)
            if capture.isOpened():
                self._counts["opened"] += 1
                _set_format(capture, self._config)
                return capture
            capture.release()
            problem = f"{self.path} cannot be opened as a camera: another program has it, or it is no capture device"
        self.problem = problem
        self._counts["open_failures"] += 1
        return None

    def _capture(self, capture: Capture) -> None:
        """Capture until the camera goes away."""
        have_controls = False
        while not self._is_stopping.is_set():
            if not capture.grab():
                self._counts["lost"] += 1
                self.problem = f"{self.path} went away or stopped giving images"
                return
            arrival_ns = time.monotonic_ns()
            stamp_ns = self._stamper.stamp(capture.get(cv2.CAP_PROP_POS_MSEC), arrival_ns, time.time_ns())
            is_decoded, image = capture.retrieve()
            if not is_decoded or image is None:
                self._counts["undecodable"] += 1
                continue
            if not have_controls:  # some drivers forget what is set before the stream runs
                self.settings = _set_controls(capture, self._config)
                have_controls = True
            self._offer(image, stamp_ns, arrival_ns)

    def _offer(self, image: Any, stamp_ns: int, arrival_ns: int) -> None:
        self.stamped_by = self._stamper.source
        self._shape = image.shape if self._shape is None else self._shape
        if image.shape != self._shape:  # came back with another size: the calibration would be wrong
            self._counts["wrong_size"] += 1
            return
        index = self._counts["captured"]
        self._counts["captured"] += 1
        self._newest_ns = arrival_ns
        self.problem = ""
        self._has_tried.set()
        if stamp_ns <= self._stamp_ns:
            self._counts["stamps_not_rising"] += 1
            return
        self._stamp_ns = stamp_ns
        self._mailbox.put(CapturedImage(stamp_ns, index, image))


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
