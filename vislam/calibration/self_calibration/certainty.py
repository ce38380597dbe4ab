"""How well a lens is known: what residuals say, or what the stretches say against each other where that is more."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from vislam.calibration.self_calibration.adjust import reduce_all
from vislam.calibration.self_calibration.lens_search import Solution
from vislam.core.jackknife import jackknife_variances, moves_without
from vislam.core.messages import Array

_ONE_SIGMA = 0.8413  # of a normal distribution


@dataclass(frozen=True, slots=True, eq=False)
class Certainty:
    """Covariance of the shared unknowns that there are (see `Shared.free`), and what it rests on."""

    covariance: Array  # [P, P]
    moves: Array  # [B, P] by which leaving out one stretch changes the answer
    grouping: float  # variance between stretches over that of independent pixels, the median of all unknowns
    wider: Array  # [P] sigmas over those of independent pixels

    @property
    def sigmas(self) -> Array:
        """Standard deviations [P]."""
        return np.sqrt(np.diag(self.covariance))


def certainty(solution: Solution, widened: float = 1.0) -> Certainty:
    """Return how sure a solution is; infinite where nothing is determined.

    A jackknife of one step over the stretches. Each unknown is widened by what the stretches show of it, at least by
    the median of all, for few stretches by Student's t, and `widened` times for what all stretches share.
    """
    parts = reduce_all(solution.pieces, solution.shared, solution.sigma_px)
    free = solution.shared.free
    parts = [replace(part, H=part.H[np.ix_(free, free)], g=part.g[free]) for part in parts]
    prior = solution.prior.equations(solution.shared)[0][np.ix_(free, free)]
    return left_out(prior, np.array([part.H for part in parts]), np.array([part.g for part in parts]), widened)


def left_out(prior: Array, informations: Array, gradients: Array, widened: float) -> Certainty:
    """Return the certainty of a solution of which B stretches say this [B, P, P], [B, P], beside a prior [P, P]."""
    n = len(informations)
    H = prior + informations.sum(axis=0)
    nothing = Certainty(np.full(H.shape, np.inf), np.zeros((n, len(H))), np.inf, np.full(len(H), np.inf))
    if n < 3 or not np.linalg.cond(H / np.sqrt(np.outer(np.diag(H), np.diag(H)))) < 1e12:
        return nothing
    white = np.linalg.inv(H)
    moves = moves_without(H, informations, -gradients)
    ratio = jackknife_variances(moves) / np.diag(white)
    moves -= moves.mean(axis=0)
    grouping = max(1.0, float(np.median(ratio)))
    wider = np.sqrt(np.maximum(ratio, grouping)) * student.ppf(_ONE_SIGMA, n - 1) * widened
    return Certainty(white * np.outer(wider, wider), moves, grouping, wider)
