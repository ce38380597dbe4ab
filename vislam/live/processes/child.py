"""What every process of a live run does alike: report, notice the end, and carry its failure home whole."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.sharedctypes import RawValue
from typing import Any

from vislam.core import interrupts, log
from vislam.core.errors import VislamError, storage_failure

_POLL_S = 0.005
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


@dataclass(frozen=True, slots=True)
class Ready:
    """Everything is loaded and compiled."""

    role: str


@dataclass(frozen=True, slots=True)
class Note:
    """Values to show the user while it runs."""

    role: str
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Failure:
    """How a process ended that should not have."""

    role: str
    error: Exception | None  # as it was raised, if that can travel
    traceback: str


class Flag:
    """A byte in shared memory that only ever rises: unlike an Event it has no lock that a killed process could keep."""

    def __init__(self) -> None:
        """Begin low; travels to a process that is spawned with it."""
        self._byte = RawValue("b", 0)

    def set(self) -> None:
        """Raise it."""
        self._byte.value = 1

    def is_set(self) -> bool:
        """Return whether it was raised."""
        return bool(self._byte.value)

    def wait(self, timeout_s: float) -> bool:
        """Return whether it was raised, waiting at most so long for that."""
        deadline = time.monotonic() + timeout_s
        while not self.is_set() and time.monotonic() < deadline:
            time.sleep(_POLL_S)
        return self.is_set()


@dataclass(frozen=True, slots=True)
class Signals:
    """What the parent signals to all."""

    go: Flag  # every process is ready
    stop: Flag
    brief: Flag = field(default_factory=Flag)  # the end must come soon: what takes time is left for later


class Life:
    """Shows a child whether to go on, and its parent the child's state."""

    def __init__(self, role: str, report: Connection, signals: Signals) -> None:
        """Keep the parent's id: with another parent, the old one is dead."""
        self.role = role
        self.when_ready: Callable[[], None] = _do_nothing
        self.when_over: Callable[[], None] = _do_nothing  # no more measurements come
        self._report = report
        self._sending = threading.Lock()  # threads that read sensors may warn
        self._signals = signals
        self._parent = os.getppid()
        self._asked = 0.0
        self._is_orphan = False

    @property
    def stopped(self) -> bool:
        """Whether the run is to end, because the parent asked for it or is gone."""
        return self._signals.stop.is_set() or self.is_orphan

    @property
    def is_brief(self) -> bool:
        """Whether the run is to end at once, with what it has."""
        return self._signals.brief.is_set()

    @property
    def is_orphan(self) -> bool:
        """Whether the parent is gone; asked of the system four times a second."""
        now = time.monotonic()
        if now - self._asked > 0.25:
            self._asked, self._is_orphan = now, os.getppid() != self._parent
        return self._is_orphan

    def ready(self) -> bool:
        """Say that everything is loaded, wait for the others; False when the run ends before."""
        self.when_ready()
        self.send(Ready(self.role))
        _die_with_parent(False)  # from now on it looks after that itself, and ends in order
        while not self._signals.go.wait(0.1):
            if self.stopped:
                return False
        return True

    def note(self, **values: Any) -> None:
        """Send the parent values to show."""
        self.send(Note(self.role, values))

    def send(self, message: Ready | Note | Failure | logging.LogRecord) -> None:
        """Send a message; a parent that is gone needs none."""
        try:
            with self._sending:
                self._report.send(message)
        except OSError:
            self._is_orphan = True


class _Uncollected:
    """Is unpickled before the body, whose modules make 200,000 objects: the collector finds nothing among them."""

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        return gc.disable, ()


def _arrived(_: None, *arguments: Any) -> None:
    """Run `guarded` where all is imported, which lives as long as the process."""
    gc.freeze()
    gc.enable()
    try:
        guarded(*arguments)
    finally:
        gc.freeze()  # the end of the process looks for garbage among all that is not frozen


def guarded(
    role: str, report: Connection, signals: Signals, body: Callable[[Life], None], log_level: str = "info"
) -> None:
    """Run a child's body; report what it logs and whatever it raises, and leave with exit code 1 then.

    Ctrl-C reaches every process of a terminal; only the parent acts on it.
    """
    interrupts.ignore()
    _die_with_parent(True)
    life = Life(role, report, signals)
    try:
        with log.log_through(life.send, log_level):
            body(life)
    except Exception as error:
        life.send(Failure(role, _portable(error), traceback.format_exc()))
        raise SystemExit(1) from None


@dataclass(slots=True)
class Child:
    """A process that was started, as its parent sees it."""

    process: SpawnProcess
    report: Connection
    is_ready: bool = False

    @classmethod
    def started(cls, role: str, signals: Signals, body: Callable[[Life], None]) -> Child:
        """Start a process; no signal reaches it before it is ready for one."""
        context = get_context("spawn")
        report, sender = context.Pipe(duplex=False)
        process = context.Process(
            target=_arrived, args=(_Uncollected(), role, sender, signals, body, log.level()), name=f"vislam {role}"
        )
        before = signal.pthread_sigmask(signal.SIG_BLOCK, interrupts.SIGNALS)
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        sender.close()
        return cls(process, report)

    def messages(self) -> Iterator[Ready | Note | Failure]:
        """Yield the process's messages since; what it logged is logged here."""
        try:
            while not self.report.closed and self.report.poll():
                message = self.report.recv()
                if isinstance(message, logging.LogRecord):
                    log.take_record(message)
                else:
                    yield message
        except (EOFError, OSError):
            self.report.close()


def _die_with_parent(is_on: bool) -> None:
    """Have the system kill this process when its parent dies: what compiles for minutes does not look."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL if is_on else 0)
    parent = parent_process()
    if is_on and parent is not None and not parent.is_alive():
        os._exit(1)


def _do_nothing() -> None:
    """Do nothing."""


def _portable(error: Exception) -> Exception | None:
    """Return an error that the parent can load: one of ours, as it is, or what the system refused as one of ours."""
    if isinstance(error, OSError):
        return storage_failure(error)
    if not isinstance(error, VislamError):
        return None
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 what this very process wrote
    except Exception:
        return None
    return error


def measured(life: Life, body: Callable[[Life], None]) -> None:
    """Run the body of a process and report what the process cost, however the body ends.

    `late_kernels` is how often, between ready and over, a kernel was called for the first time (twice as often where
    it is compiled): what had been rehearsed is 0.
    """
    from vislam.core.compiling import on_each_kernel  # both load numba, which not all need
    from vislam.core.cpu import compile_cpu_s, cpu_s, kernels_taken, peak_memory_mb

    compiled: list[str] = []

    def show(name: str) -> None:
        compiled.append(name)
        life.note(compiled=len(compiled))

    on_each_kernel(show)
    ready: list[int] = []  # kernels that were there then
    over: list[int] = []
    life.when_ready = lambda: ready.append(kernels_taken())
    life.when_over = lambda: over.append(kernels_taken())
    try:
        body(life)
    finally:
        life.when_over()
        late = over[0] - ready[0] if ready else 0
        times = {"cpu_s": cpu_s(), "compile_cpu_s": compile_cpu_s()}
        life.note(cost={**times, "peak_memory_mb": peak_memory_mb(), "late_kernels": late})
