"""Waiting for the bytes of devices and sockets. `select`, and pyserial's `read`, fail from the 1024th open file on."""

import os
from select import POLLIN, poll

_READ_BYTES = 1 << 16


def is_readable(descriptor: int, timeout_s: float) -> bool:
    """Return whether a read would return at once, with bytes, an end or an error; waits for that, so long at most."""
    waiting = poll()
    waiting.register(descriptor, POLLIN)
    return bool(waiting.poll(1e3 * max(timeout_s, 0.0)))


def received(descriptor: int, timeout_s: float) -> bytes:
    """Return the bytes that a device has, waiting for the first of them, `timeout_s` at most; none: nothing came.

    The descriptor is in non-blocking mode. Raises OSError where the device went away.
    """
    if not is_readable(descriptor, timeout_s):
        return b""
    try:
        data = os.read(descriptor, _READ_BYTES)
    except BlockingIOError:  # another reader was faster
        return b""
    if not data:
        raise OSError("it has ended")
    return data
