"""How long each stage of the pipeline took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


class StageClock:
    """Collects wall-clock durations per stage; stages themselves never see a clock."""

    def __init__(self) -> None:
        self._durations_s: dict[str, list[float]] = {}
        self._others: dict[str, dict[str, float]] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time spent in the `with` block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._durations_s.setdefault(stage, []).append(time.perf_counter() - start)

    def add(self, summary_ms: dict[str, dict[str, float]]) -> None:
        """Take over the summary of stages that ran in another process."""
        self._others |= summary_ms

    def summary_ms(self) -> dict[str, dict[str, float]]:
        """Return p50, p95, p99 in milliseconds, the total in seconds and the count of each stage."""
        summary = dict(self._others)
        for stage, durations_s in self._durations_s.items():
            p50, p95, p99 = np.percentile(np.array(durations_s) * 1e3, [50, 95, 99])
            summary[stage] = {
                "p50": float(p50),
                "p95": float(p95),
                "p99": float(p99),
                "total_s": float(np.sum(durations_s)),
                "count": len(durations_s),
            }
        return summary
