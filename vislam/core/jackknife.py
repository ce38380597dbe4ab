"""The jackknife: how sure an answer is, by how much it moves where one group of its measurements is left out.

Measurements of one group (an image, a stretch of a recording) share errors, so that their residuals, taken for
independent, promise too much (Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982).
"""

import numpy as np

from vislam.core.messages import Array


def moves_without(H: Array, informations: Array, gradients: Array) -> Array:
    """Return by how much the solution moves [B, P] without each of B groups, in one step of Gauss-Newton.

    Args:
        H: information [P, P] of all groups and priors at the solution.
        informations: that of each group [B, P, P].
        gradients: of half the squared residuals of each group [B, P].
    """
    return np.array(
        [np.linalg.lstsq(H - one, g, rcond=None)[0] for one, g in zip(informations, gradients, strict=True)]
    )


def jackknife_variances(left_out: Array) -> Array:
    """Return the variances [P] of an answer, from the answers or moves [B, P] with one group left out each."""
    count = len(left_out)
    return np.asarray((count - 1) / count * np.sum((left_out - left_out.mean(axis=0)) ** 2, axis=0))
