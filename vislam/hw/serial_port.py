"""A serial port that may go away, be another one, or belong to another program; nothing is ever written to it."""

from __future__ import annotations

import errno
import os
import termios
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vislam.core.errors import HardwareError, install_line
from vislam.hw.descriptor import received

if TYPE_CHECKING:
    from collections import Counter

    import serial

# pyserial raises all of them at a device that goes away; its own SerialException is an OSError
_ERRORS = (OSError, ValueError, TypeError, termios.error)


class SerialPort:
    """Owns a port, which is opened and closed again and again.

    Attributes:
        problem: why it cannot be read, for a person; empty: no reason is known.
    """

    def __init__(self, path: str, baud: int, counts: Counter[str]) -> None:
        """Take where it is, and where faults are counted; nothing is opened. Raises HardwareError without pyserial."""
        self._serial = _pyserial()
        self._path, self._baud, self._counts = path, baud, counts
        self._port: serial.Serial | None = None
        self.problem = f"{path} has not been opened"

    @property
    def is_open(self) -> bool:
        """Whether it can be read."""
        return self._port is not None

    def open(self) -> bool:
        """Try to open it; return whether that went, else `problem` has why."""
        try:
            # exclusive: two programs on one port would each get half of the bytes
            self._port = self._serial.Serial(self._path, self._baud, timeout=0, exclusive=True)
        except _ERRORS as error:
            self._counts["open_failures"] += 1
            self.problem = why_not_open(self._path, self._baud, error)
            return False
        self._counts["opened"] += 1
        return True

    def received(self, timeout_s: float) -> bytes | None:
        """Return what it has, waiting for the first byte; None where it went away, and was closed."""
        try:
            return received(self._port.fileno(), timeout_s) if self._port is not None else None
        except _ERRORS as error:
            self._went(error)
            return None

    def drain(self) -> None:
        """Throw away what it has kept."""
        try:
            if self._port is not None:
                self._port.reset_input_buffer()
        except _ERRORS as error:
            self._went(error)

    def lose(self, what: str, problem: str) -> None:
        """Close a port that is of no use, and count that."""
        self._counts[what] += 1
        self.problem = problem
        self.close()

    def close(self) -> None:
        """Close it; may be called twice."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except _ERRORS:
                self._counts["close_failures"] += 1

    def _went(self, error: Exception) -> None:
        self.lose("port_lost", f"{self._path} went away: {error}; plug it in again")


def check_port(path: str, baud: int) -> None:
    """Raise HardwareError where a port is missing or may not be opened, or pyserial is not installed.

    It is not opened: that would reset a board.
    """
    _pyserial()
    if not os.access(path, os.R_OK | os.W_OK):
        code = errno.EACCES if Path(path).exists() else errno.ENOENT
        raise HardwareError(why_not_open(path, baud, OSError(code, os.strerror(code))))


def why_not_open(path: str, baud: int, error: Exception) -> str:
    """Return what keeps a port from opening, and what to do about it."""
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        from serial.tools import list_ports

        there = ", ".join(port.device for port in list_ports.comports()) or "none"
        return f"there is no port {path}; there are: {there}. Plug the board in, or name another port"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{path} may not be opened; add yourself to the group that owns it (usually: "
            "sudo usermod -aG dialout $USER) and log in again"
        )
    if number in (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK):
        return f"{path} is used by another program; close it (the Arduino IDE's monitor?)"
    return f"{path} cannot be opened as a serial port at {baud} baud: {error}"


def _pyserial() -> Any:
    try:
        import serial as module
    except ImportError as error:
        raise HardwareError(f"a serial port needs pyserial; install it: {install_line('hw')}") from error
    return module
