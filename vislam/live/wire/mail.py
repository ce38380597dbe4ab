"""A bounded queue between two processes whose end is noticed on either side, even in the middle of a message.

`multiprocessing.Queue` is not used: everybody holds its writing end, so a reader never learns that the writer was
killed, and waits for ever for the rest of what it was writing.
"""

from __future__ import annotations

import queue
import threading
from multiprocessing.connection import Connection
from typing import Any


class Outbox:
    """Owns the sending end; a thread sends, so that whoever puts something in only waits while it is full."""

    def __init__(self, connection: Connection, capacity: int) -> None:
        """Take the connection, to be used in this process only."""
        self._connection = connection
        self._waiting: queue.Queue[Any] = queue.Queue(capacity)
        self.is_broken = False  # the other side is gone; what is put in is lost
        self._thread = threading.Thread(target=self._send, name="outbox", daemon=True)
        self._thread.start()

    def put(self, value: object, timeout_s: float = 0.0) -> bool:
        """Put something in; False when it is full for so long."""
        if self.is_broken:
            return True
        try:
            self._waiting.put(value, block=timeout_s > 0.0, timeout=timeout_s or None)
        except queue.Full:
            return False
        return True

    def __len__(self) -> int:
        """Return how much waits."""
        return self._waiting.qsize()

    def close(self) -> None:
        """Send all that waits, then end the stream."""
        while not self.put(_End(), 0.1):
            continue
        self._thread.join()
        self._connection.close()

    def _send(self) -> None:
        while not isinstance(value := self._waiting.get(), _End):
            if self.is_broken:
                continue
            try:
                self._connection.send(value)
            except OSError:
                self.is_broken = True


class _End:
    """Ends the thread."""


class Inbox:
    """Owns the receiving end."""

    def __init__(self, connection: Connection) -> None:
        """Take the connection, to be used in this process only."""
        self._connection = connection
        self.is_over = False  # the other side closed it, or was killed

    def get(self, timeout_s: float = 0.0) -> Any | None:
        """Return the next value, waiting at most so long; None if none came."""
        if self.is_over:
            return None
        try:
            return self._connection.recv() if self._connection.poll(timeout_s) else None
        except (EOFError, OSError):
            self.is_over = True
            return None
