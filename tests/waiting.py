"""Waiting for what threads and processes do, however slow the machine is."""

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import psutil

from vislam.runs.record import Recorded

HUNG_S = 600.0  # only ends a hang; nothing waits so long otherwise
Found = TypeVar("Found")


def wait_for(condition: Callable[[], Found], what: Callable[[], object] = lambda: "what should come") -> Found:
    """Return what a condition gives as soon as it holds; `what` tells what was waited for."""
    end_s = time.monotonic() + HUNG_S
    while not (found := condition()):
        assert time.monotonic() < end_s, f"waited in vain for {what()}"
        time.sleep(0.005)
    return found


def is_gone(process: psutil.Process) -> bool:
    """Return whether a process has ended; whoever inherited it may not have asked for its exit code yet."""
    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.Error:
        return True


def until_it_holds(frames: int = 0, imu: int = 0) -> dict[str, Any]:
    """Return arguments of `record` that end it once it holds so many frames and samples, or hangs."""
    stop = threading.Event()

    def progress(recorded: Recorded) -> None:
        if recorded.counts["frames"] >= frames and recorded.counts["imu samples"] >= imu:
            stop.set()

    return {"seconds": HUNG_S, "stop": stop, "progress": progress}


class Looks:
    """A clock for loops over a device that runs in real time: each look at it takes 10 ms, whatever has passed."""

    def __init__(self) -> None:
        self._t_ns = 10**12

    def now_ns(self) -> int:
        self._t_ns += 10_000_000
        return self._t_ns

    def sleep_until(self, t_ns: int) -> None:
        """Has no time to pass."""
