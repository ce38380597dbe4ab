"""What this process has used so far: CPU time, compilation apart, and memory."""

import ctypes
import resource
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from numba.core import event


class _Compiling(event.Listener):  # type: ignore[misc] # numba has no types
    """Adds up the CPU time in which numba compiled; what is compiled within a compilation counts once."""

    def __init__(self) -> None:
        self.cpu_s = 0.0  # of all threads
        self.here = threading.local()  # of one thread: depth, begun_s, cpu_s
        self._lock = threading.Lock()

    def on_start(self, event: object) -> None:
        depth = getattr(self.here, "depth", 0)
        if depth == 0:
            self.here.begun_s = time.thread_time()
        self.here.depth = depth + 1

    def on_end(self, event: object) -> None:
        self.here.depth -= 1
        if self.here.depth == 0:
            took_s = time.thread_time() - self.here.begun_s
            self.here.cpu_s = getattr(self.here, "cpu_s", 0.0) + took_s
            with self._lock:
                self.cpu_s += took_s


_compiling, _taking = _Compiling(), event.RecordingListener()
event.register("numba:compile", _compiling)
event.register("numba:compiler_lock", _taking)
_ahead_s: dict[str, float] = {}
_ahead_lock = threading.Lock()


def cpu_s() -> float:
    """Return the CPU time of this process, of all its threads, without compilation."""
    return time.process_time() - compile_cpu_s()


def thread_cpu_s() -> float:
    """Return the CPU time of this thread, without compilation."""
    return time.thread_time() - getattr(_compiling.here, "cpu_s", 0.0)


def compile_cpu_s() -> float:
    """Return the CPU time in which this process compiled kernels, since this module was imported."""
    return _compiling.cpu_s


def kernels_taken() -> int:
    """Return how often a kernel was called for the first time: each compiles, or waits for the disk."""
    return sum(taken.is_start for _, taken in _taking.buffer)


@contextmanager
def working_ahead(stage: str) -> Iterator[None]:
    """Add the CPU time of the `with` block to a stage that threads of this process work at ahead of the others."""
    begun_s = thread_cpu_s()
    try:
        yield
    finally:
        with _ahead_lock:
            _ahead_s[stage] = _ahead_s.get(stage, 0.0) + thread_cpu_s() - begun_s


def ahead_cpu_s() -> dict[str, float]:
    """Return the CPU time of each stage that threads of this process worked at ahead."""
    with _ahead_lock:
        return dict(_ahead_s)


def peak_memory_mb() -> float:
    """Return the most resident memory that this process ever had."""
    try:  # ru_maxrss begins with the size of the parent process, this does not
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        unit = 2**20 if sys.platform == "darwin" else 2**10
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def return_freed_memory() -> None:
    """Hand what was freed back to the system: after much work in small pieces glibc keeps it; a no-op elsewhere."""
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
