"""Medians and quantiles of short rows of numbers, in a fifth of the time that numpy takes to look at what it got."""

import numpy as np

from vislam.core.messages import Array


def median(values: Array) -> float:
    """Return what `np.median` does of values [N], N > 0, that are all numbers."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    below, above = np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].tolist()
    return float((below + above) / 2.0)


def quantile(ordered: Array, share: float) -> float:
    """Return what `np.quantile` does of ascending values [N], N > 0, that are all numbers."""
    place = (len(ordered) - 1) * share
    below = int(place)
    low, high = ordered[below : below + 2].tolist() if below + 1 < len(ordered) else (float(ordered[-1]),) * 2
    along, apart = place - below, high - low
    return float(low + apart * along if along < 0.5 else high - apart * (1.0 - along))
