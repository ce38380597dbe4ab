"""A process that tells what it cost; apart from the others, for not every process has to load numba."""

from __future__ import annotations

from collections.abc import Callable

from vislam.core.cpu import compile_cpu_s, cpu_s, kernels_taken, peak_memory_mb
from vislam.live.processes.child import Life


def measured(life: Life, body: Callable[[Life], None]) -> None:
    """Run the body of a process and tell what the process cost, however the body ends.

    `late_kernels` is how often, between ready and over, a kernel was called for the first time (twice as often where
    it is compiled): what had been rehearsed is 0.
    """
    ready: list[int] = []  # kernels that were there then
    over: list[int] = []
    life.when_ready = lambda: ready.append(kernels_taken())
    life.when_over = lambda: over.append(kernels_taken())
    try:
        body(life)
    finally:
        life.when_over()
        late = over[0] - ready[0] if ready else 0
        times = {"cpu_s": cpu_s(), "compile_cpu_s": compile_cpu_s()}
        life.note(cost={**times, "peak_memory_mb": peak_memory_mb(), "late_kernels": late})
