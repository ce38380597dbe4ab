"""When a hand-held or mounted sensor stood still, from its own samples (Tedaldi, Pretto, Menegatti, ICRA 2014).

Their detector is the variance of force in a sliding window against a multiple of that at rest; here the rate has to be
quiet as well, which separates a slow turn about the vertical from rest. `imu/resting.py` has limits, not multiples,
also of the mean rate, which do not hold before calibration; and a pause is cut out to the sample here.
"""

from dataclasses import dataclass

import numpy as np

from vislam.calibration.inertial.tables import Table
from vislam.core.messages import Array

_WINDOW_S = 0.6  # long enough for a spread at 50 Hz, short enough for the pause between two movements
_LEAST_WINDOW = 10  # samples
_FLOOR = np.array([0.002, 0.01])  # rad/s, m/s^2: sensors so coarse that they do not flicker at rest


@dataclass(frozen=True, slots=True, eq=False)
class Movement:
    """Spread [N, 2] of rate (rad/s) and of force (m/s^2) in a window around every sample; infinite beside holes."""

    spread: Array
    usual: Array  # [2] spread when quiet

    def rests(self, factor: float, least: int) -> list[slice]:
        """Return where both spreads stay below `factor` times the quiet ones for at least `least` samples."""
        still = np.all(self.spread <= factor * self.usual, axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
        return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= least]


def movement(table: Table, quiet_share: float) -> Movement:
    """Return how much a sensor moved around every sample.

    Args:
        table: rates and forces [N, 6].
        quiet_share: at least so much of the time it was still; the spread of that quantile is the quiet one.
    """
    half = max(_LEAST_WINDOW, round(_WINDOW_S / table.period_s)) // 2
    spread = np.full((len(table.t_ns), 2), np.inf)
    for piece in table.pieces():
        values = table.values[piece]
        if len(values) > 2 * half:
            inner = slice(piece.start + half, piece.stop - half)
            variance = _sliding_variance(values, 2 * half + 1)
            spread[inner, 0] = np.sqrt(variance[:, :3].mean(axis=1))
            spread[inner, 1] = np.sqrt(variance[:, 3:].mean(axis=1))
    known = spread[np.isfinite(spread[:, 0])]
    usual = np.quantile(known, quiet_share, axis=0) if len(known) else np.zeros(2)
    return Movement(spread, np.maximum(usual, _FLOOR))


def _sliding_variance(values: Array, width: int) -> Array:
    """Return the variance [N - width + 1, C] in every window of `width` rows."""
    centred = values - values.mean(axis=0)  # sums of squares of large numbers would lose the small differences
    zero = np.zeros((1, values.shape[1]))
    first = np.cumsum(np.vstack([zero, centred]), axis=0)
    second = np.cumsum(np.vstack([zero, centred**2]), axis=0)
    mean = (first[width:] - first[:-width]) / width
    return np.asarray(np.maximum((second[width:] - second[:-width]) / width - mean**2, 0.0))
