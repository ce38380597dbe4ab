"""The bytes of requests, read within bounds of size for all headers, and of time for the whole request."""

from __future__ import annotations

import socket
import time

MOST_HEAD_BYTES = 16_384
MOST_BODY_BYTES = 4096
_CHUNK = 4096


class TooLarge(Exception):
    """A request has more bytes than any of ours."""


class RequestReader:
    """In the place of a socket's file: no request is read longer than its time, however slowly its bytes drip."""

    def __init__(self, sock: socket.socket, idle_s: float, request_s: float) -> None:
        """Read from a socket.

        Args:
            sock: a connected one.
            idle_s: that a connection may wait for its next request.
            request_s: from the first byte of a request to its last.
        """
        self._socket, self._idle_s, self._request_s = sock, idle_s, request_s
        self._pending = bytearray()
        self._left = MOST_HEAD_BYTES
        self._deadline = 0.0
        self._is_begun = False
        self.closed = False

    def begin(self) -> None:
        """Expect a new request: with it, bounds begin again."""
        self._left = MOST_HEAD_BYTES
        self._is_begun = False
        self._deadline = time.monotonic() + self._idle_s

    def readline(self, limit: int = -1) -> bytes:
        """Return the next line, with its end; shorter at the end of the stream. `limit` is that of the whole head.

        Raises TooLarge, or TimeoutError when the request takes too long.
        """
        while (end := self._pending.find(b"\n")) < 0:
            if len(self._pending) > self._left:
                raise TooLarge
            if not self._fill():
                return self._take(len(self._pending))
        if end + 1 > self._left:
            raise TooLarge
        self._left -= end + 1
        return self._take(end + 1)

    def read(self, count: int) -> bytes:
        """Return `count` bytes of a body, fewer at the end of the stream; raises as `readline`."""
        if count > MOST_BODY_BYTES:
            raise TooLarge
        while len(self._pending) < count and self._fill():
            continue
        return self._take(min(count, len(self._pending)))

    def close(self) -> None:
        """Do nothing: the socket belongs to the caller."""
        self.closed = True

    def _fill(self) -> bool:
        left_s = self._deadline - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError("the request took too long")
        self._socket.settimeout(left_s)
        data = self._socket.recv(_CHUNK)
        if data and not self._is_begun:
            self._is_begun = True
            self._deadline = time.monotonic() + self._request_s
        self._pending += data
        return bool(data)

    def _take(self, count: int) -> bytes:
        taken = bytes(self._pending[:count])
        del self._pending[:count]
        return taken
