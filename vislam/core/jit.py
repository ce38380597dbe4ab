"""How kernels are compiled: `njit` as vislam uses it, which takes about half of the time that numba's own takes.

What makes the difference: no entry for C, less optimisation, no collector, and what `numba_internals` replaces.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from typing import Any

import numba
from numba.core import config, event

from vislam.core.numba_internals import cache_with_callees, replace_internals


def njit(**options: Any) -> Any:
    """Return numba's decorator for compiled functions, without the entry for C, which is never called."""
    decorate = numba.njit(no_cfunc_wrapper=True, **options)

    def compiled(function: Callable[..., Any]) -> Any:
        kernel = decorate(function)
        cache_with_callees(kernel)
        return kernel

    return compiled


class _Quicker(event.Listener):  # type: ignore[misc]
    """While a kernel is compiled: no third level of optimisation, which made none faster, and no collector.

    The collector would go over all that is imported again and again. numba compiles under a lock, so starts and ends
    of all threads nest; what is compiled first decides.
    """

    def __init__(self) -> None:
        self._depth, self._had_collector, self._level = 0, False, config.OPT

    def on_start(self, _: Any) -> None:
        """Take the beginning of a compilation, which may be within another."""
        if self._depth == 0:
            self._had_collector, self._level = gc.isenabled(), config.OPT
            gc.disable()
            if "NUMBA_OPT" not in os.environ:
                config.OPT = type(config.OPT)(2)
        self._depth += 1

    def on_end(self, _: Any) -> None:
        """Take the end of a compilation."""
        self._depth -= 1
        if self._depth == 0:
            config.OPT = self._level
            if self._had_collector:
                gc.enable()


replace_internals()
event.register("numba:compile", _Quicker())
