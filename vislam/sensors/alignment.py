"""The heading and place of a measuring frame from points that are known in it and in the world."""

import math
from collections.abc import Sequence

import numpy as np

from vislam.core.messages import Array
from vislam.sensors.measuring_frame import ENOUGH_YAW_RAD, about_up
from vislam.sensors.sensor import Begun, Variable

_ROUNDS = 15  # of reweighing: a tenth of wild points lose their weight within five
_CAUCHY = 2.385  # sigmas at which a point has half its weight; 95 % efficient on normal noise
_FEWEST = 5  # points: four numbers are asked, and a wild point has to show
_CLEAR = 3.0  # sigmas of a point by which the path is spread, however many points lie at one place
_MOST_SCALE = 3.0  # the points then do not lie on this path


def aligned_frame(world_m: Array, frame_m: Array, variances_m2: Array) -> Begun | None:
    """Return T_frame_world as yaw, x, y, z of points [N, 3] in the world and in the frame; None: too early to say.

    The heading that fits best is closed form (Horn 1987, in the plane), the points reweighed by how well they fit
    (Cauchy), so that wild ones do not count. Sigmas come from the points' variances [N, 2] (horizontal per axis, up),
    raised by as much as the points fit worse than that. A heading with a sigma above 5 deg is too early, and so is a
    path spread by less than three sigmas of one point: errors of neighbouring points are often alike.
    """
    if len(world_m) < _FEWEST:
        return None
    weights = np.ones(len(world_m))
    for _ in range(_ROUNDS):
        yaw, shift, mean_m, moment = _fit(world_m[:, :2], frame_m[:, :2], weights / variances_m2[:, 0])
        R = about_up(yaw)[:2, :2]
        errors = np.linalg.norm(frame_m[:, :2] - world_m[:, :2] @ R.T - shift, axis=1) / np.sqrt(variances_m2[:, 0])
        weights = 1.0 / (1.0 + (errors / _CAUCHY) ** 2)
    scale = max(1.0, float(np.median(errors)) / math.sqrt(2.0 * math.log(2.0)))  # the median of Rayleigh's distribution
    total = float(np.sum(weights / variances_m2[:, 0]))
    sigma_yaw = scale / math.sqrt(max(moment, 1e-300))
    spread_m = math.sqrt(moment / total)
    if sigma_yaw > ENOUGH_YAW_RAD or scale > _MOST_SCALE or spread_m < _CLEAR * _typical_sigma(variances_m2[:, 0]):
        return None
    up, sigma_up = _mean_up(frame_m[:, 2] - world_m[:, 2], variances_m2[:, 1])
    across_m = R @ np.array([-mean_m[1], mean_m[0]])  # how the origin moves when the points stay and the heading turns
    sigmas_xy = np.sqrt(scale**2 / total + (sigma_yaw * across_m) ** 2)
    return Begun(np.array([yaw, *shift, up]), np.array([sigma_yaw, *sigmas_xy, sigma_up]))


def with_shared_errors(
    found: Begun, rows: Sequence[int], variables: Sequence[Variable], H_own: Array, noise: Array
) -> Begun:
    """Return a beginning whose variables `rows` were found from readings, made less sure by the others' sigmas.

    An error that readings share, as that of a lever arm or of an anchor's place, does not get less by more of them. It
    moves what is found as it moves least squares.

    Args:
        found: all own variables; those that are not in `rows` with what is known of them.
        rows: of the variables that were found.
        variables: what was known before.
        H_own: [M, V] by the own variables, of the residuals of all readings.
        noise: [M] standard deviations of the residuals.
    """
    others = np.setdiff1d(np.arange(len(found.sigmas)), rows)
    known = np.diag([variables[row].sigma ** -2.0 for row in rows])
    white = H_own / noise[:, None]
    J, K = white[:, rows], white[:, others]
    moves = np.linalg.solve(J.T @ J + known, J.T @ K) * found.sigmas[others]
    sigmas = found.sigmas.copy()
    sigmas[rows] = np.hypot(sigmas[rows], np.linalg.norm(moves, axis=1))
    return Begun(found.values, sigmas)


def with_starts(found: Begun | None, variables: Sequence[Variable]) -> Begun | None:
    """Return a beginning of the first own variables completed by the starts of the others."""
    if found is None:
        return None
    rest = variables[len(found.values) :]
    return Begun(
        np.concatenate([found.values, [variable.start for variable in rest]]),
        np.concatenate([found.sigmas, [variable.sigma for variable in rest]]),
    )


def _fit(world_m: Array, frame_m: Array, weights: Array) -> tuple[float, Array, Array, float]:
    """Return yaw, shift [2], the points' mean in the world [2] and their weighted moment about it."""
    total = weights.sum()
    mean, mean_frame = weights @ world_m / total, weights @ frame_m / total
    a, b = world_m - mean, frame_m - mean_frame
    sine = float(weights @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    yaw = math.atan2(sine, float(weights @ (a * b).sum(axis=1)))
    return yaw, mean_frame - about_up(yaw)[:2, :2] @ mean, mean, float(weights @ (a * a).sum(axis=1))


def _typical_sigma(variances: Array) -> float:
    return math.sqrt(float(np.median(variances)))


def _mean_up(differences_m: Array, variances_m2: Array) -> tuple[float, float]:
    """Return the weighed mean of differences [N] and its sigma, wild ones left out as above."""
    at, scale, weights = float(np.median(differences_m)), 1.0, 1.0 / variances_m2
    for _ in range(_ROUNDS):
        errors = np.abs(differences_m - at) / np.sqrt(variances_m2)
        weights = 1.0 / (1.0 + (errors / _CAUCHY) ** 2) / variances_m2
        at = float(weights @ differences_m / weights.sum())
        scale = max(1.0, float(np.median(errors)) / 0.6745)
    return at, scale / math.sqrt(weights.sum())
