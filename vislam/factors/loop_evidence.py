"""What speaks for loops: the density of what each claims if it is true, against that of a false one.

A false loop may claim anything in the space of the trajectory. One volume of that space, one ladder of evidence, one
idea of a place: for the loops of a run as they come (`graph.belief`), and for those of finished runs, of sessions that
are joined and of files, which are decided as a whole (`batch.posegraph`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vislam.core.messages import Array

Mask = NDArray[np.bool_]

SOUND = 4.0  # log-odds from which on a loop is believed by itself
LADDER = (16.0, 12.0, 8.0, SOUND, 2.0, 0.0)  # log-odds of a loop that enters; lower ones once there is nothing above
APART = 8.0  # log-likelihood by which one set of loops must be likelier than another that contradicts it
PLACE = 10  # poses that follow each other make one place, at most this number before and behind each
_ROTATION = {2: 2.0 * math.pi, 3: (8.0 * math.pi**2) ** (1.0 / 3.0)}  # sides of the box of all rotations, in rad


def extent(positions: Array) -> float:
    """Return the geometric mean of the sides of the box around positions [N, d], none below a tenth of the longest."""
    sides = np.ptp(positions, axis=0)
    return float(np.exp(np.mean(np.log(np.maximum(sides, max(0.1 * sides.max(initial=0.0), 1e-9))))))


def spread(positions: Array) -> Array:
    """Return the sigmas [k], rotation first, of a Gaussian whose density at its peak is that of a false loop.

    `positions` [N, d] are the trajectory's: within their box a false loop may put a pose, turned in any way.
    """
    d = positions.shape[1]
    sides = [*[_ROTATION[d]] * (2 * d - 3), *[extent(positions)] * d]
    return np.array(sides) / math.sqrt(2.0 * math.pi)


def log_volume(positions: Array) -> float:
    """Return the logarithm of the volume of the relative poses that a false loop may claim, in rad and m."""
    return float(np.sum(np.log(math.sqrt(2.0 * math.pi) * spread(positions))))


def innovation(residual: Array, S: Array) -> tuple[Array, Array]:
    """Return chi-squares [M] of errors [M, k] whose covariances are S [M, k, k], and the log-density where they are 0.

    With S of the loop and of a solution without it, volume + log-density - chi-square / 2 are the log-odds of the loop.
    """
    solved = np.linalg.solve(S, residual[..., None])[..., 0]
    return np.sum(residual * solved, axis=-1), -0.5 * np.linalg.slogdet(2.0 * np.pi * S)[1]


def entering(evidence: Array, level: int, least: float = LADDER[-1]) -> tuple[Mask, int]:
    """Return which loops [M] are on the highest rung, from `level` on down to `least`, that has any, and that rung."""
    while LADDER[level] > least and not np.any(evidence > LADDER[level]):
        level += 1
    return evidence > LADDER[level], level
