"""The chi-square distribution that every gate uses."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, gammaincinv  # `scipy.stats` has them too, thirty times slower: 0.6 s to load


def chi_square_limit(probability: float, degrees: int) -> float:
    """Return the value that a chi-square variable with `degrees` of freedom stays below with this probability."""
    return float(2.0 * gammaincinv(0.5 * degrees, probability))


def chi_square_limits(probability: float, degrees: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return `chi_square_limit` of many degrees of freedom [N]."""
    return np.asarray(2.0 * gammaincinv(0.5 * degrees, probability), dtype=np.float64)


def chi_square_tail(value: float, degrees: int) -> float:
    """Return the probability that a chi-square variable with `degrees` of freedom is above a value."""
    return float(chdtrc(degrees, value))
