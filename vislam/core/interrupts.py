"""Ctrl-C, SIGTERM and the end of a terminal (SIGHUP): they end a process alike, and whatever it is doing.

Python runs the handler of a signal between two of its own steps, so what the main thread has called, such as a compiler
or a disk, keeps the handler waiting. A thread, which receives each signal, too, ends the process after a while
where the main thread did not.
"""

import atexit
import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
EXIT_CODE = 130
_GRACE_S = 1.0
_SAID = "\nvislam: interrupted; what was written by then is kept\n"
_SHOW_CURSOR = "\033[?25h"  # a progress bar had hidden it


class Asked:
    """How often the end was asked for."""

    def __init__(self) -> None:
        """Begin with never."""
        self.count = 0
        self.spare = 0  # signals that do not start the clock

    def take_time(self) -> None:
        """Answer the first signal in order, however long that takes; the second one starts the clock."""
        if self.count == 0:
            self.spare = 1


class _Clock:
    """Ends the process some time after a signal."""

    def __init__(self) -> None:
        self.asked = Asked()
        self._signals, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        threading.Thread(target=self._watch, name="interrupts", daemon=True).start()

    def _watch(self) -> None:
        while True:
            number = os.read(self._signals, 1)[0]
            if number == signal.SIGHUP:
                leave_terminal()
            if number not in SIGNALS:
                continue
            if self.asked.spare == 0:
                break
            self.asked.spare -= 1
        time.sleep(_GRACE_S)
        with suppress(OSError):
            os.write(2, ((_SHOW_CURSOR if os.isatty(2) else "") + _SAID).encode())
        os._exit(EXIT_CODE)


_clocks: list[_Clock] = []  # of the process: one, once it is asked for
_came: list[int] = []  # signals
_raised: list[int] = []  # that became a KeyboardInterrupt


def has_come() -> bool:
    """Return whether a signal asked for the end."""
    return bool(_came)


def has_raised() -> bool:
    """Return whether a signal became a KeyboardInterrupt in `bounded`."""
    return bool(_raised)


@contextmanager
def bounded() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first signal; end the process with exit code 130 where it goes on after that.

    For the main thread of a program that is about to end: the clock is not stopped by leaving the block.
    """
    if not _clocks:
        _clocks.append(_Clock())
    with _handled(Asked(), raises=True):
        yield


@contextmanager
def counted() -> Iterator[Asked]:
    """Count signals in place of raising KeyboardInterrupt; the caller looks at `count` now and then.

    In a thread that is not the main one none is counted: there they raise in the main thread.
    """
    asked = Asked()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    with _handled(asked, raises=False):
        yield asked


@contextmanager
def _handled(asked: Asked, raises: bool) -> Iterator[None]:
    def take(number: int, frame: object) -> None:
        asked.count += 1
        _came.append(number)
        if number == signal.SIGHUP:
            leave_terminal()
        if raises and asked.count == 1:  # another one would disturb the end that the first began
            _raised.append(number)
            raise KeyboardInterrupt

    # what is ignored stays so: by nohup, or in the background of a shell
    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    outer = [clock.asked for clock in _clocks]
    for clock in _clocks:
        clock.asked = asked
    for number in before:
        signal.signal(number, take)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for clock, was in zip(_clocks, outer, strict=True):
            clock.asked = was


def leave(code: int = EXIT_CODE) -> NoReturn:
    """End the process without taking it apart, which may take seconds of its own."""
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    os._exit(code)


def ignore() -> None:
    """Ignore the signals, in a process whose parent acts on them."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def leave_terminal() -> None:
    """Write to nowhere what would go to a terminal that is gone: it would be an error each time."""
    nowhere = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
    for descriptor in (0, 1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode) and not os.isatty(descriptor):
                os.dup2(nowhere, descriptor)
    os.close(nowhere)
