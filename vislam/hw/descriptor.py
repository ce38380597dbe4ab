"""Waiting for the bytes of devices and sockets. `select`, and pyserial's `read`, fail from the 1024th open file on."""

import os
from select import POLLIN, poll

_READ_BYTES = 1 << 16
_PIECE_BYTES, _NEXT_S = 2048, 0.002  # a terminal gives what it has kept in pieces of twice that, one soon after another


def is_readable(descriptor: int, timeout_s: float) -> bool:
    """Return whether a read would return at once, with bytes, an end or an error; waits for that, so long at most."""
    waiting = poll()
    waiting.register(descriptor, POLLIN)
    return bool(waiting.poll(1e3 * max(timeout_s, 0.0)))


def received(descriptor: int, timeout_s: float) -> bytes:
    """Return all bytes that a device has, waiting for the first of them, `timeout_s` at most; none: nothing came.

    The descriptor is in non-blocking mode. Raises OSError where the device went away.
    """
    data, last = b"", _PIECE_BYTES
    while last >= _PIECE_BYTES and len(data) < _READ_BYTES and is_readable(descriptor, _NEXT_S if data else timeout_s):
        try:
            piece = os.read(descriptor, _READ_BYTES)
        except BlockingIOError:  # another reader was faster
            break
        if not piece and not data:
            raise OSError("it has ended")
        data, last = data + piece, len(piece)
    return data
