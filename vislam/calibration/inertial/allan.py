"""Allan deviation of a still sensor, and the white noise, bias instability and random walk that explain it.

IEEE Std 952-1997, annex C: the Allan variance of a rate with white noise of density N, flicker of level B and random
walk of density K is `N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3`. Degrees of freedom after Stable32 (Riley, NIST SP
1065, section 5.4).
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from vislam.core.chi_square import chi_square_tail
from vislam.core.messages import Array

_FLICKER = 2.0 * np.log(2.0) / np.pi
_LEAST_CLUSTERS = 9  # the longest averaging time goes so often into the recording
_ROUNDS = 6  # of reweighting by the fitted curve
_FREQUENCIES = 3000  # of the integrals for the covariance
_LOWEST = 30.0  # the lowest frequency is so much below the longest averaging time's
_JITTER = 1e-6  # keeps a covariance of rounding errors regular
_LEAST_POINTS = 5  # a fit of two or three numbers must be testable
_PROBABLE = 0.01  # a fit worse than by this chance means that the model does not hold
_UPPER_SIGMAS = 2.0  # of an upper limit


@dataclass(frozen=True, slots=True, eq=False)
class AllanCurve:
    """Overlapping Allan deviation [M] at averaging times [M] in octaves, of `count` samples at `rate_hz`."""

    tau_s: Array
    deviation: Array
    count: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """White noise and random walk of one axis, each with its sigma; units of the samples per (or times) root Hz."""

    white: float
    white_sigma: float
    walk: float
    walk_sigma: float  # of `walk` where that is determined
    walk_limit: float  # two sigmas above
    flicker: float  # 0: the curve needs none
    tau_min_s: float  # shorter averaging times are not those of white noise: the sensor filters or rounds
    misfit: float  # chi-square per degree of freedom

    @property
    def walk_determined(self) -> bool:
        """Whether the random walk stands out from zero by two sigmas."""
        return self.walk > 0.0 and self.walk > 2.0 * self.walk_sigma

    def deviation(self, tau_s: Array) -> Array:
        """Return the fitted Allan deviation at averaging times."""
        return np.sqrt(self.white**2 / tau_s + _FLICKER * self.flicker**2 + self.walk**2 * tau_s / 3.0)


def allan_curve(values: Array, rate_hz: float) -> AllanCurve:
    """Return the overlapping Allan deviation of evenly spaced samples [N]; N must be 32 at least."""
    angle = np.concatenate([[0.0], np.cumsum(values - values.mean())]) / rate_hz
    lengths = 2 ** np.arange(int(np.log2(len(values) / _LEAST_CLUSTERS)) + 1)
    deviations = [
        np.sqrt(0.5 * np.mean((angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]) ** 2)) * rate_hz / m
        for m in lengths
    ]
    return AllanCurve(lengths / rate_hz, np.array(deviations), len(values), rate_hz)


def fit_noise(curve: AllanCurve) -> NoiseFit:
    """Fit the fewest terms over the longest range of averaging times that explain a curve.

    Where nothing explains it, the best fit is taken and its sigmas are widened by the misfit.
    """
    tries = []
    for terms in (2, 3):
        for first in range(max(len(curve.tau_s) - _LEAST_POINTS - 1, 1)):
            fit, probability = _fit(curve, first, terms)
            if probability > _PROBABLE:
                return fit
            tries.append(fit)
    return min(tries, key=lambda fit: fit.misfit)


def _fit(curve: AllanCurve, first: int, terms: int) -> tuple[NoiseFit, float]:
    """Fit from averaging time `first` on; return the fit and the chance of one that is worse."""
    tau = curve.tau_s[first:]
    variance = curve.deviation[first:] ** 2
    columns = np.column_stack([1.0 / tau, tau / 3.0, np.full(len(tau), _FLICKER)])[:, :terms]
    filters = _filters(curve, first)
    found = np.array([variance[0] * tau[0], 0.0, 0.0])[:terms]
    for _ in range(_ROUNDS):
        whiten = np.linalg.inv(np.linalg.cholesky(_covariance(curve, filters, found)))
        found = nnls(whiten @ columns, whiten @ variance)[0]
        if not found.any():
            break  # nothing but zeros was measured
    whitened = whiten @ columns
    freedom = max(len(tau) - terms, 1)
    chi2 = float(np.sum((whiten @ variance - whitened @ found) ** 2))
    widened = max(1.0, np.sqrt(chi2 / freedom))
    spread = np.sqrt(np.diag(np.linalg.pinv(whitened.T @ whitened))) * widened
    white, walk = np.sqrt(found[:2])
    return NoiseFit(
        white=float(white),
        white_sigma=float(spread[0] / (2.0 * white)) if white > 0.0 else float(np.sqrt(spread[0])),
        walk=float(walk),
        walk_sigma=float(spread[1] / (2.0 * walk)) if walk > 0.0 else float(np.sqrt(spread[1])),
        walk_limit=float(np.sqrt(found[1] + _UPPER_SIGMAS * spread[1])),
        flicker=float(np.sqrt(found[2])) if terms == 3 else 0.0,
        tau_min_s=float(tau[0]),
        misfit=chi2 / freedom,
    ), chi_square_tail(chi2, freedom)


@dataclass(frozen=True, slots=True, eq=False)
class _Filters:
    """Averaging times as filters of the samples, over a grid of frequencies."""

    lengths: Array  # [M] samples
    gain: Array  # [M, F] squared
    sine: Array  # [F] of pi times the frequency in cycles per sample
    step: Array  # [F] of the integral over frequency, both signs


def _filters(curve: AllanCurve, first: int) -> _Filters:
    m = np.round(curve.tau_s[first:] * curve.rate_hz)
    edges = np.geomspace(1.0 / (_LOWEST * m[-1]), 0.5, _FREQUENCIES + 1)
    f = np.sqrt(edges[1:] * edges[:-1])
    sine = np.sin(np.pi * f)
    return _Filters(m, 2.0 * np.sin(np.pi * np.outer(m, f)) ** 4 / (m[:, None] * sine) ** 2, sine, 2.0 * np.diff(edges))


def _covariance(curve: AllanCurve, filters: _Filters, found: Array) -> Array:
    """Return the covariance [M, M] of the Allan variances of Gaussian noise with fitted squared densities [2 or 3].

    Two means of squares of Gaussian series have the covariance 2 / length times the integral of both squared gains and
    the squared spectrum. Flicker is taken as `B^2 / (2 pi f)`.
    """
    per_sample = found[0] * curve.rate_hz + found[1] / curve.rate_hz / (4.0 * filters.sine**2)
    if len(found) == 3:
        per_sample = per_sample + found[2] / (2.0 * filters.sine)
    through = filters.gain * per_sample
    root_used = np.sqrt(curve.count + 1.0 - 2.0 * filters.lengths)
    covariance = 2.0 * ((through * filters.step) @ through.T) / np.outer(root_used, root_used)
    return np.asarray(covariance + np.diag(_JITTER * np.diag(covariance)))
