"""A camera behind a library: a thread that opens, captures and opens again, and the newest shot only."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from vislam.config import LibraryCameraConfig
from vislam.core.errors import HardwareError
from vislam.core.messages import Frame
from vislam.hw.cameras.mailbox import Mailbox
from vislam.hw.health import Health
from vislam.hw.source import CapturedImage

_NS = 1_000_000_000
_JOIN_S = 3.0  # a library ends a stream in about a second; a driver may hold a thread for 10, and is left to it

Shot = TypeVar("Shot", CapturedImage, Frame)
Shot_co = TypeVar("Shot_co", CapturedImage, Frame, covariant=True)


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


class Stream(Protocol[Shot_co]):
    """A camera that is open and streams; used by one thread."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """What was asked of the camera and what it does."""
        ...

    @property
    def stamped_by(self) -> str:
        """Where the stamp of the last shot came from."""
        ...

    @property
    def bad_stamps(self) -> int:
        """Shots whose own stamp could not be believed."""
        ...

    def next(self) -> Shot_co | None:
        """Return the next shot; None where one came that cannot be used, or stamped yet.

        Raises HardwareError, or what the library raises, when the camera went away or gives nothing for a second.
        """
        ...

    def close(self) -> None:
        """Give the camera back."""
        ...


class LibraryCamera(Generic[Shot]):
    """Satisfies `ImageSource` with streams of images, `FrameSource` with streams of frames.

    `read` never waits for the library. A camera that goes away is looked for every `config.reopen_s`.
    """

    def __init__(self, name: str, open_stream: Callable[[], Stream[Shot]], config: LibraryCameraConfig) -> None:
        """Open the camera and wait for its first shot, `config.start_s` at most.

        Args:
            name: for messages.
            open_stream: opens the camera, again and again; HardwareError, or what the library raises, if it cannot.
            config: rate and times.

        Raises:
            HardwareError: there is no such camera, or it gives no image.
        """
        self.path = name
        self.rate_hz = config.rate_hz
        self.settings: tuple[Setting, ...] = ()
        self.stamped_by = "not known yet"
        self.problem = ""
        self._open_stream: Callable[[], Stream[Shot]] = open_stream
        self._config = config
        self._mailbox: Mailbox[Shot] = Mailbox()
        self._counts: Counter[str] = Counter()  # written by the thread alone, after it has started
        self._newest_ns = 0  # arrival
        self._stamp_ns = 0
        self._is_stopping = threading.Event()
        self._has_tried = threading.Event()  # a shot came, or the camera could not be opened
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self._has_tried.wait(config.start_s)
        if self._newest_ns == 0:
            self.close()
            raise HardwareError(self.problem or f"{name} gives no image within {config.start_s:g} s; replug it")

    def read(self, timeout_s: float) -> Shot | None:
        """Return the newest shot not yet returned, waiting at most `timeout_s`; None if none came."""
        return self._mailbox.take(timeout_s)

    def health(self) -> Health:
        """Return CAMERA_MISSING or nothing."""
        missing = time.monotonic_ns() - self._newest_ns > self._config.missing_s * _NS
        return Health.CAMERA_MISSING if missing else Health(0)

    def counters(self) -> dict[str, int]:
        """Return shots captured, replaced by newer ones before they were read, and faults since the start."""
        return {**self._counts, "replaced": self._mailbox.replaced}

    def close(self) -> None:
        """Give the camera back; may be called twice."""
        self._is_stopping.set()
        self._mailbox.close()
        self._thread.join(_JOIN_S)

    # ---- the thread -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._is_stopping.is_set():
            try:
                stream = self._open_stream()
            except Exception as error:  # such libraries raise whatever they like, and the thread must not die
                self._failed("open_failures", error)
                self._has_tried.set()
            else:
                self._counts["opened"] += 1
                self._capture(stream)
            self._is_stopping.wait(self._config.reopen_s)

    def _capture(self, stream: Stream[Shot]) -> None:
        """Capture until the camera goes away."""
        bad_before = self._counts["bad_stamps"]
        try:
            while not self._is_stopping.is_set():
                shot = stream.next()
                self.settings, self.stamped_by = stream.settings, stream.stamped_by
                self._counts["bad_stamps"] = bad_before + stream.bad_stamps
                self._offer(shot)
        except Exception as error:
            self._failed("lost", error)
        finally:
            try:
                stream.close()
            except Exception as error:  # a camera that was pulled out cannot be closed either
                self._failed("close_failures", error)

    def _failed(self, what: str, error: Exception) -> None:
        self._counts[what] += 1
        self.problem = str(error) if isinstance(error, HardwareError) else f"{self.path}: {error}; replug it"

    def _offer(self, shot: Shot | None) -> None:
        if shot is None:
            self._counts["unstamped"] += 1
            return
        index = self._counts["captured"]
        self._counts["captured"] += 1
        self._newest_ns = time.monotonic_ns()
        self.problem = ""
        self._has_tried.set()
        if shot.t_ns <= self._stamp_ns:
            self._counts["stamps_not_rising"] += 1
            return
        self._stamp_ns = shot.t_ns
        self._mailbox.put(replace(shot, index=index))


def named(config: LibraryCameraConfig) -> str:
    """Return the device that is asked for with a space before it, for a message; nothing where any will do."""
    return f" {config.device}" if config.device else ""
