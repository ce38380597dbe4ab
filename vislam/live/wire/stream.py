"""Inertial samples from the fast process to the front process: nothing is dropped, and the sender never waits."""

import socket
import struct
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from vislam.core.errors import HardwareError
from vislam.core.messages import ImuSample, MagSample
from vislam.ekf.correction import Hint

Value = ImuSample | MagSample | Hint
_RECORD = struct.Struct("<qq6d")  # kind, time, gyro and accel
_IMU, _MAG, _REST, _WHEELS = 0, 1, 2, 3
_BACKLOG = 30 * 1000  # records: 30 s at 1 kHz; a front process that is so late has failed
_READ_BYTES = 1024 * _RECORD.size


class SampleSender:
    """Sends what the socket takes and keeps the rest for the next call."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._socket = sock
        self._pending = bytearray()
        self._is_open = True

    def send(self, value: Value) -> None:
        """Add a value and send what goes. Raises HardwareError when the front process does not take any for too long.

        A front process that has ended takes nothing; the parent knows of it, and the pose goes on for that moment.
        """
        if isinstance(value, ImuSample):
            numbers = (*value.gyro_rad_s.tolist(), *value.accel_m_s2.tolist())
            self._pending += _RECORD.pack(_IMU, value.t_ns, *numbers)
        elif isinstance(value, MagSample):
            self._pending += _RECORD.pack(_MAG, value.t_ns, *value.field_ut.tolist(), 0.0, 0.0, 0.0)
        else:
            self._pending += _RECORD.pack(_REST if value.at_rest else _WHEELS, value.t_ns, *([0.0] * 6))
        self.flush()
        if len(self._pending) > _BACKLOG * _RECORD.size:
            raise HardwareError(
                f"the front process left {_BACKLOG} inertial samples lying: this machine is too slow for it; "
                "use a smaller image or fewer tracks (--frontend.max-tracks)"
            )

    def flush(self) -> None:
        """Send what goes now."""
        try:
            while self._is_open and self._pending:
                del self._pending[: self._socket.send(self._pending)]
        except BlockingIOError:
            return
        except OSError:
            self._is_open = False
        if not self._is_open:
            self._pending.clear()

    def close(self, timeout_s: float = 5.0) -> None:
        """Send the rest and end the stream."""
        self._socket.settimeout(timeout_s)
        with suppress(OSError):
            self._socket.sendall(self._pending)
        self._socket.close()


class SampleReceiver:
    """Takes what has come, without waiting."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._socket = sock
        self._pending = b""
        self.ended = False

    def receive(self, take: Callable[[Value], None]) -> None:
        """Give every value that is here to `take`, in order; `ended` states whether more will come."""
        while not self.ended:
            try:
                data = self._socket.recv(_READ_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            self.ended = not data
            self._pending += data
            whole = len(self._pending) - len(self._pending) % _RECORD.size
            for kind, t_ns, *numbers in _RECORD.iter_unpack(self._pending[:whole]):
                if kind == _IMU:
                    take(ImuSample(t_ns, np.array(numbers[:3]), np.array(numbers[3:])))
                else:
                    take(MagSample(t_ns, np.array(numbers[:3])) if kind == _MAG else Hint(t_ns, kind == _REST))
            self._pending = self._pending[whole:]
