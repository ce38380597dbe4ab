"""Where a job's measurements come from: rendered worlds are recorded once, and every frame's time is taken."""

import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from vislam.config import CalibrationConfig
from vislam.core.errors import StorageError, UsageError
from vislam.core.messages import Frame, ImuSample, MagSample
from vislam.core.recording import Recording, WrappedRecording
from vislam.datasets import open_dataset
from vislam.datasets.recorder import record
from vislam.experiment.identity import code_sha256, sha256_of
from vislam.runs.sources import open_source, recorded_path

_SIMULATOR = Path(__file__).resolve().parent.parent / "sim"


def open_cached(source: str, seed: int, cache: Path, calibration: CalibrationConfig | None = None) -> Recording:
    """Open a source; a simulated world is rendered into `cache` first, unless it is there.

    Jobs that want the same world at the same time wait for the one that renders it. A recording appears whole or not
    at all. Raises as `open_source` and `record` do.
    """
    if not source.startswith("sim:"):
        return open_source(source, seed, calibration)
    return open_dataset(f"euroc:{_rendered(source, seed, cache)}")


def on_disk(source: str, seed: int, cache: Path) -> Path:
    """Return the folder of a source, for who reads it by himself; see `open_cached`. Raises UsageError without one."""
    if source.startswith("sim:"):
        return _rendered(source, seed, cache)
    path = recorded_path(source) if is_on_disk(source) else None
    if path is None:
        raise UsageError(f"{source} is not on disk, where a command could read it")
    return path


def is_on_disk(source: str) -> bool:
    """Whether a source is a folder, or becomes one as a rendered world does; others are made as they are asked for."""
    return not source.startswith(("points:", "eqvio:"))


def _rendered(source: str, seed: int, cache: Path) -> Path:
    """Return the recording of a simulated world (EuRoC), which is rendered unless it is there."""
    key = sha256_of([source, seed, code_sha256(_SIMULATOR)])[:24]
    folder = cache / key
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with (cache / f"{key}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.is_dir():
                unfinished = cache / f"{key}.unfinished"
                shutil.rmtree(unfinished, ignore_errors=True)
                record(open_source(source, seed), unfinished)
                os.replace(unfinished, folder)
    except OSError as error:
        raise StorageError(f"{cache} cannot hold recordings: {error}; free space or give another --cache") from error
    return folder


class TimedRecording(WrappedRecording):
    """A recording that notes how long its consumer was busy with each frame.

    A frame is finished by the inertial sample after it, so `frame_done` states when, and the whole time since the
    consumer took that value counts.

    Attributes:
        latencies_s: busy time per finished frame.
        span_ns: times of the first and the last frame; None before there was one.
    """

    def __init__(self, recording: Recording) -> None:
        """Wrap a recording (see `vislam.core.recording.Recording`)."""
        super().__init__(recording)
        self.latencies_s: list[float] = []
        self.span_ns: tuple[int, int] | None = None
        self._finished = 0

    def frame_done(self, _done: int, _total: int, _note: str) -> None:
        """Note that the value that was taken last finished a frame; fits `vislam.runs.Progress`."""
        self._finished += 1

    def events(self, from_ns: int | None = None) -> Iterator[ImuSample | MagSample | Frame]:
        """Yield the recording's values."""
        for value in self._recording.events(from_ns):
            if isinstance(value, Frame):
                self.span_ns = (self.span_ns[0] if self.span_ns else value.t_ns, value.t_ns)
            before, taken_s = self._finished, time.perf_counter()
            yield value
            if self._finished > before:
                busy_s = time.perf_counter() - taken_s
                self.latencies_s += [busy_s / (self._finished - before)] * (self._finished - before)
