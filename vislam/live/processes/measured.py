"""A process that tells what it cost; apart from the others, for not every process has to load numba."""

from __future__ import annotations

from collections.abc import Callable

from vislam.core.cpu import compile_cpu_s, cpu_s, peak_memory_mb
from vislam.live.processes.child import Life


def measured(life: Life, body: Callable[[Life], None]) -> None:
    """Run the body of a process and tell what the process cost, however the body ends."""
    try:
        body(life)
    finally:
        life.note(cost={"cpu_s": cpu_s(), "compile_cpu_s": compile_cpu_s(), "peak_memory_mb": peak_memory_mb()})
