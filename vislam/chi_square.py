"""The limit that every chi-square gate goes by."""

from __future__ import annotations

from scipy.special import gammaincinv  # `scipy.stats` has it too, thirty times slower, and takes 0.6 s to load


def chi_square_limit(probability: float, degrees: int) -> float:
    """Return the value that a chi-square variable of so many degrees of freedom stays below with this probability."""
    return float(2.0 * gammaincinv(0.5 * degrees, probability))
