"""How long poses take from sample to publication."""

from __future__ import annotations

import numpy as np

_BIN_NS = 5_000
_BINS = 40_000  # up to 0.2 s; what is longer counts into the last
_PARTS = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}


class Latency:
    """A histogram: constant memory over days."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._largest_ns = 0

    def add(self, ns: int) -> None:
        """Count one duration."""
        self._counts[min(max(ns, 0) // _BIN_NS, _BINS - 1)] += 1
        self._largest_ns = max(self._largest_ns, ns)

    def summary_ms(self) -> dict[str, float]:
        """Return quantiles, the largest and the count; only the count while there is none."""
        count = int(self._counts.sum())
        if count == 0:
            return {"count": 0}
        below = np.cumsum(self._counts)
        quantiles = {name: (int(np.searchsorted(below, q * count)) + 1) * _BIN_NS * 1e-6 for name, q in _PARTS.items()}
        return {**quantiles, "max": self._largest_ns * 1e-6, "count": count}
