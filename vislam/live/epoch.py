"""The moment at which something played back, or simulated, begins: one for all processes of a run."""

import signal
import time
from multiprocessing import get_context

from vislam.core.interrupts import SIGNALS

_LEAD_NS = 200_000_000  # so that every process is there when it begins


class Epoch:
    """CLOCK_MONOTONIC ns of the beginning; the first who asks decides."""

    def __init__(self) -> None:
        # the first lock starts the process that removes locks; it ignores signals, but not SIGHUP
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            self._value = get_context("spawn").Value("q", 0)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def begin_ns(self) -> int:
        """Return when it begins, or began."""
        with self._value.get_lock():
            if self._value.value == 0:
                self._value.value = time.monotonic_ns() + _LEAD_NS
            return int(self._value.value)

    def peek_ns(self) -> int:
        """Return when it begins, 0 before the first call of `now`."""
        return int(self._value.value)
