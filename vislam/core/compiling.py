"""Reports when numba compiles while a user waits."""

import time
from collections.abc import Callable
from typing import Any

_WORTH_SAYING_S = 1.0  # of CPU: a kernel or two for new kinds of arguments are no reason for a message


def on_compilation(say: Callable[[], None]) -> None:
    """Call `say` once, when numba has compiled for a second from now on; what is read from the cache does not count."""
    from numba.core import event

    event.Listener.register(_Listener)  # no subclass, for numba is imported here only
    event.register("numba:compile", _Listener(say))


def on_each_kernel(say: Callable[[str], None]) -> None:
    """Call `say` with the name of every kernel of vislam that is compiled, when it is."""
    from numba.core import event

    event.Listener.register(_Each)
    event.register("numba:compile", _Each(say))


class _Each:
    """Reports the names of what was compiled, but for numba's own functions."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def notify(self, event: Any) -> None:
        """Take an event of numba."""
        function = event.data["dispatcher"].py_func
        if event.is_end and function.__module__.startswith("vislam."):
            self._say(f"{function.__module__.removeprefix('vislam.')}.{function.__name__}")


class _Listener:
    """Adds up the outermost compilations, within which others happen."""

    def __init__(self, say: Callable[[], None]) -> None:
        self._say: Callable[[], None] | None = say
        self._depth, self._begun_s, self._before_s = 0, 0.0, 0.0

    def notify(self, event: Any) -> None:
        """Take an event of numba."""
        if self._say is None:
            return
        now_s = time.process_time()
        if self._depth == 0:
            self._begun_s = now_s
        self._depth += 1 if event.is_start else -1
        compiled_s = self._before_s + now_s - self._begun_s
        if self._depth == 0:
            self._before_s = compiled_s
        if compiled_s > _WORTH_SAYING_S:
            say, self._say = self._say, None
            say()
