"""First estimates that agree on scale, place and attitude, whether or not the motion shows them.

In uniform motion, "everything larger" is a direction that nothing measures: positions from each other and velocities,
times one factor. A linearised inertial link finds that direction free only where the states that it is linearised at
move uniformly themselves. States that the marginal prior holds are linearised where they were first; the estimate of
scale wanders within its sigma, so newer states are at another scale, the step between the two looks like an
acceleration, and acceleration shows scale. The newer ones are therefore linearised where they would be had they been
estimated together with the held ones: at their scale, place and attitude (tilt wanders too, against the bias of force).
Huang, Mourikis and Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators", IJRR 2010;
for scale under constant acceleration: Wu et al., "VINS on wheels", ICRA 2017. At rest the same goes for tilt and the
bias of force, which are one there.

It is done always, not only in uniform motion: the step is there just when a straight way ends in its first turn and the
estimates move most, and where motion does show scale both agree anyway.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array

_EXTENT_M = 0.1  # of the held keyframes about their mean, root of the sum of squares: less has no scale to agree on


def at_first_scale(X: Array, X_first: Array, held: NDArray[np.bool_]) -> Array:
    """Return where to linearise states [M, 21]: those held where they were first, others as if they were with them."""
    out = np.where(held[:, None], X_first, X)
    others, of_prior = np.flatnonzero(~held), np.flatnonzero(held)
    if len(others) == 0:
        return out
    k = of_prior[-1]
    turn = X_first[k, :9].reshape(3, 3) @ X[k, :9].reshape(3, 3).T
    now, first = X[of_prior, 9:12] @ turn.T, X_first[of_prior, 9:12]
    away, away_first = now - now.mean(axis=0), first - first.mean(axis=0)
    square = float(np.sum(away * away))
    factor = float(np.sum(away * away_first)) / square if square > _EXTENT_M**2 else 1.0
    out[others, :9] = (turn @ X[others, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    out[others, 9:12] = first[-1] + factor * (X[others, 9:12] @ turn.T - now[-1])
    out[others, 12:15] = factor * X[others, 12:15] @ turn.T
    return out
