"""A bounded queue between two processes whose end is noticed on either side, even in the middle of a message.

`multiprocessing.Queue` is not used: everybody holds its writing end, so a reader never learns that the writer was
killed, and waits for ever for the rest of what it was writing.
"""

import queue
import threading
import time
from multiprocessing.connection import Connection
from typing import Any


class Outbox:
    """Owns the sending end; a thread sends, so that the caller of `put` only waits while it is full."""

    def __init__(self, connection: Connection, capacity: int) -> None:
        """Take the connection, to be used in this process only."""
        self._connection = connection
        self._waiting: queue.Queue[Any] = queue.Queue(capacity)
        self.is_broken = False  # the other side is gone; what is put in is lost
        self._sends_ns: int | None = None  # when what is being sent now was put in; None: nothing is
        self._thread = threading.Thread(target=self._send, name="outbox", daemon=True)
        self._thread.start()

    def put(self, value: object, timeout_s: float = 0.0) -> bool:
        """Put something in; False when it is full for so long."""
        return self.is_broken or self._puts(value, timeout_s)

    def __len__(self) -> int:
        """Return how much waits."""
        return self._waiting.qsize()

    @property
    def age_s(self) -> float:
        """How long the oldest of what waits has waited to be taken."""
        since_ns = self._sends_ns
        return 0.0 if since_ns is None else (time.monotonic_ns() - since_ns) * 1e-9

    def close(self) -> None:
        """Send all that waits, then end the stream; where the other side is gone, at once."""
        while not self._puts(_End(), 0.1):
            continue
        self._thread.join()
        self._connection.close()

    def _puts(self, value: object, timeout_s: float) -> bool:
        try:
            self._waiting.put((time.monotonic_ns(), value), block=timeout_s > 0.0, timeout=timeout_s or None)
        except queue.Full:
            return False
        return True

    def _send(self) -> None:
        while not isinstance((stamped := self._waiting.get())[1], _End):
            if self.is_broken:
                continue
            self._sends_ns = stamped[0]
            try:
                self._connection.send(stamped)
            except OSError:
                self.is_broken = True
            self._sends_ns = None


class _End:
    """Ends the thread."""


class Inbox:
    """Owns the receiving end."""

    def __init__(self, connection: Connection) -> None:
        """Take the connection, to be used in this process only."""
        self._connection = connection
        self.is_over = False  # the other side closed it, or was killed
        self.age_s = 0.0  # that the newest value had waited when it was taken

    def get(self, timeout_s: float = 0.0) -> Any | None:
        """Return the next value, waiting at most so long; None if none came."""
        if self.is_over:
            return None
        try:
            if not self._connection.poll(timeout_s):
                return None
            put_ns, value = self._connection.recv()
        except (EOFError, OSError):
            self.is_over = True
            return None
        self.age_s = (time.monotonic_ns() - put_ns) * 1e-9
        return value
