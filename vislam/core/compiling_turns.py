"""One process compiles a kernel; the others that need it wait for that, and read it from the cache."""

import fcntl
import os
import time
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache

_LONGEST_S = 120.0  # then it is compiled here, too: who compiles may have been stopped
_POLL_S = 0.02


class CacheInTurns(FunctionCache):  # type: ignore[misc]
    """A kernel's cache: what it lacks is compiled by one process at a time.

    Who finds nothing locks a file beside the kernel's until its code is stored. The system undoes the lock of a process
    that dies. Callees are compiled within their callers' turns; as no kernel calls itself, none waits in a circle.
    """

    _turn: int | None = None  # descriptor of the locked file

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel for a signature, None if this process is to compile it."""
        found = super().load_overload(sig, target_context)
        if found is None and self._turn is None and self._enabled and self._take_turn():
            found = super().load_overload(sig, target_context)  # what another process has stored meanwhile
            if found is not None:
                self._end_turn()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the kernel, and let others read it."""
        try:
            super().save_overload(sig, data)
        finally:
            self._end_turn()

    def _place(self) -> Path:
        return Path(self._cache_path, f"{self._impl.filename_base}.compiling")

    def _take_turn(self) -> bool:
        """Wait until no other process compiles this kernel; False where that cannot be known, or takes too long."""
        turn, latest_s = -1, time.monotonic() + _LONGEST_S
        try:
            self._impl.locator.ensure_cache_path()
            turn = os.open(self._place(), os.O_CREAT | os.O_RDWR, 0o600)
            while not _is_locked(turn):
                if time.monotonic() > latest_s:
                    raise TimeoutError
                time.sleep(_POLL_S)
        except OSError:  # also of file systems without locks
            if turn >= 0:
                os.close(turn)
            return False
        self._turn = turn
        return True

    def _end_turn(self) -> None:
        if self._turn is not None:
            self._place().unlink(missing_ok=True)
            os.close(self._turn)
            self._turn = None


def _is_locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
