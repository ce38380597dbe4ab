"""How long each stage of the pipeline took, by the wall and in CPU time."""

import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from vislam.core.cpu import thread_cpu_s


class StageClock:
    """Collects durations per stage, by the wall and of the thread's CPU; stages themselves never see a clock."""

    def __init__(self) -> None:
        self._durations_s: dict[str, array[float]] = {}  # eight bytes per call: stages at IMU rate have millions
        self._cpu_s: dict[str, float] = {}
        self._others: dict[str, dict[str, float]] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time spent in the `with` block to a stage."""
        start, begun_s = time.perf_counter(), thread_cpu_s()
        try:
            yield
        finally:
            self._durations_s.setdefault(stage, array("d")).append(time.perf_counter() - start)
            self._cpu_s[stage] = self._cpu_s.get(stage, 0.0) + thread_cpu_s() - begun_s

    def add(self, summary_ms: dict[str, dict[str, float]]) -> None:
        """Take over the summary of stages that ran in another process."""
        self._others |= summary_ms

    def summary_ms(self) -> dict[str, dict[str, float]]:
        """Return p50, p95, p99 in milliseconds, the total and its CPU time in seconds, and the count of each stage."""
        summary = dict(self._others)
        for stage, durations_s in self._durations_s.items():
            p50, p95, p99 = np.percentile(np.array(durations_s) * 1e3, [50, 95, 99])
            summary[stage] = {
                "p50": float(p50),
                "p95": float(p95),
                "p99": float(p99),
                "total_s": float(np.sum(durations_s)),
                "cpu_s": self._cpu_s[stage],
                "count": len(durations_s),
            }
        return summary
