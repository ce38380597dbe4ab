"""How a measured inverse depth changes the belief about a pixel."""

from __future__ import annotations

import math

from vislam.core.jit import njit

_SQRT_2_PI = math.sqrt(2.0 * math.pi)


@njit(cache=True, nogil=True, error_model="numpy")
def fuse_gaussian(rho: float, variance: float, measured: float, measured_variance: float) -> tuple[float, float]:
    """Return mean and variance of the product of two normal distributions."""
    total = variance + measured_variance
    return (measured_variance * rho + variance * measured) / total, variance * measured_variance / total


@njit(cache=True, nogil=True, error_model="numpy")
def fuse_beta(
    rho: float, variance: float, a: float, b: float, measured: float, measured_variance: float, spread: float
) -> tuple[float, float, float, float]:
    """Return mean, variance, and the Beta parameters of the share of good measurements.

    A measurement is either normal around the truth or uniform over `spread`, the whole range of inverse depth; the
    posterior is fitted by its moments (Vogiatzis and Hernandez, "Video-based, real-time multi-view stereo", IVC 2011,
    equations 19 to 28; also in SVO and REMODE).
    """
    total = variance + measured_variance
    off = measured - rho
    mean, fused = fuse_gaussian(rho, variance, measured, measured_variance)
    good = a / (a + b) * math.exp(-0.5 * off * off / total) / (_SQRT_2_PI * math.sqrt(total))
    bad = b / (a + b) / spread
    good, bad = good / (good + bad), bad / (good + bad)
    n = a + b
    first = good * (a + 1.0) / (n + 1.0) + bad * a / (n + 1.0)
    second = (good * (a + 1.0) * (a + 2.0) + bad * a * (a + 1.0)) / ((n + 1.0) * (n + 2.0))
    new = good * mean + bad * rho
    # moments about the new mean: no difference of large numbers
    new_variance = good * (fused + (mean - new) ** 2) + bad * (variance + (rho - new) ** 2)
    new_a = (second - first) / (first - second / first)
    return new, new_variance, new_a, new_a * (1.0 - first) / first
