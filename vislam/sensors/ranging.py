"""The heading and place of a frame of anchors from ranges to them, found without any guess."""

import math
from typing import NamedTuple

import numpy as np

from vislam.core.angles import wrapped
from vislam.core.messages import Array
from vislam.sensors.measuring_frame import ENOUGH_YAW_RAD, about_up
from vislam.sensors.sensor import Begun

_HEADINGS = 8  # to start from; a start within 45 deg of the truth ends there
_FEWEST = 20  # ranges: four numbers are asked, five with a bias, and wild ones have to show
_STEPS = 60
_SAME_SIGMAS = 1.0
_DOUBT = 16.0  # a second solution that fits worse by less (4 sigmas) is as good as the first
_HUBER = 2.0
_MOST_SCALE = 3.0
_CLEAR = 3.0  # sigmas of a range by which the path is spread
_FAR = 6.0  # sigmas from a solution at which its cost is looked at
_RISE = 0.5  # of what it would rise by if it were quadratic
_NEAR = 0.1  # sigma of the place, as a share of the ranges, from which on a linear step is good


class Ranges(NamedTuple):
    """Ranges along a path."""

    world_m: Array  # [N, 3] antenna in the world
    anchors_m: Array  # [N, 3] in their frame
    ranges_m: Array  # [N]
    sigmas_m: Array  # [N]


class Prior(NamedTuple):
    """What is known of yaw, x, y, z and the bias before."""

    starts: Array  # [5]
    sigmas: Array  # [5]; 0: the number is known and stays


class _Solution(NamedTuple):
    values: Array  # [5]
    cost: float
    information: Array  # [5, 5]
    scale: float


def ranged_frame(seen: Ranges, prior: Prior) -> Begun | None:
    """Return T_frame_world as yaw, x, y, z and the bias, with sigmas; None: too early, or ambiguous.

    Gauss-Newton with Huber's weights from eight headings, and above and below the anchors. Refused are solutions that
    another one, such as a mirrored one, fits nearly as well; that are not sure of heading (5 deg) or place (a tenth
    of the ranges); that lie in a valley too bent for a covariance; and that fit worse than the ranges' noise allows.
    """
    if len(seen.ranges_m) < _FEWEST:
        return None
    spread_m = math.sqrt(float(seen.world_m[:, :2].var(axis=0).sum()))
    if spread_m < _CLEAR * float(np.median(seen.sigmas_m)):
        return None
    solutions = [_solved(start, seen, prior) for start in _starts(seen, prior)]
    best = min(solutions, key=lambda solution: solution.cost)
    free = prior.sigmas > 0.0
    information = best.information[np.ix_(free, free)]
    size = np.sqrt(np.diag(information))
    if not size.all() or np.linalg.cond(information / np.outer(size, size)) > 1e8:
        return None
    covariance = np.zeros((5, 5))
    covariance[np.ix_(free, free)] = best.scale**2 * np.linalg.inv(information)
    sigmas = np.sqrt(np.diag(covariance))
    if sigmas[0] > ENOUGH_YAW_RAD or best.scale > _MOST_SCALE or not _is_near(best.values, covariance, seen):
        return None
    if any(s.cost < best.cost + _DOUBT * best.scale**2 and _differs(s, best, sigmas) for s in solutions):
        return None
    return Begun(best.values, sigmas) if _is_round(best, covariance, seen, prior) else None


def _starts(seen: Ranges, prior: Prior) -> list[Array]:
    """Return values [5] to start from: every heading, with the place that fits it best, above and below the anchors."""
    starts = []
    for yaw in np.linspace(-math.pi, math.pi, _HEADINGS, endpoint=False):
        turned = seen.world_m @ about_up(yaw).T
        # |turned + t - anchor|^2 = range^2 is linear in t and |t|^2
        away = turned - seen.anchors_m
        A = np.column_stack([2.0 * away, np.ones(len(away))])
        t = np.linalg.lstsq(A, seen.ranges_m**2 - (away**2).sum(axis=1), rcond=1e-6)[0][:3]
        level = float(np.mean(seen.anchors_m[:, 2] - turned[:, 2]))
        off = float(np.sqrt(np.maximum(seen.ranges_m**2 - ((away + t)[:, :2] ** 2).sum(axis=1), 0.0)).mean())
        known_up = prior.sigmas[3] < 0.5 * float(np.median(seen.ranges_m))
        for up in [prior.starts[3]] if known_up else [level + off + 0.1, level - off - 0.1]:
            starts.append(np.array([yaw, t[0], t[1], up, prior.starts[4]]))
    return starts


def _solved(start: Array, seen: Ranges, prior: Prior) -> _Solution:
    """Return where Levenberg and Marquardt's steps end from one start."""
    values, damping = start, 1e-3
    free = prior.sigmas > 0.0
    here = _system(values, seen, prior)
    for _ in range(_STEPS):
        information, gradient, cost, _ = here
        step = np.zeros(5)
        damped = information + damping * np.diag(np.diag(information))
        step[free] = np.linalg.lstsq(damped[np.ix_(free, free)], gradient[free], rcond=None)[0]
        there = _system(values + step, seen, prior)
        if there[2] < cost:
            values, here, damping = values + step, there, max(damping / 5.0, 1e-9)
            if cost - there[2] < 1e-6 * (1.0 + cost):
                break
        else:
            damping *= 5.0
            if damping > 1e6:
                break
    return _Solution(np.array([wrapped(float(values[0])), *values[1:]]), here[2], here[0], here[3])


def _system(values: Array, seen: Ranges, prior: Prior) -> tuple[Array, Array, float, float]:
    """Return information [5, 5], gradient [5], cost, and by what the residuals exceed their sigmas."""
    turned = seen.world_m @ about_up(float(values[0])).T
    away = turned + values[1:4] - seen.anchors_m
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
    rays = away / distance[:, None]
    J = np.column_stack([rays[:, 1] * turned[:, 0] - rays[:, 0] * turned[:, 1], rays, np.ones(len(rays))])
    J /= seen.sigmas_m[:, None]
    errors = (seen.ranges_m - distance - values[4]) / seen.sigmas_m
    size = np.abs(errors)
    weights = np.where(size > _HUBER, _HUBER / np.maximum(size, 1e-12), 1.0)
    cost = float(np.where(size > _HUBER, 2.0 * _HUBER * size - _HUBER**2, size**2).sum())
    free = prior.sigmas > 0.0
    pull = np.where(free, 1.0 / np.where(free, prior.sigmas, 1.0) ** 2, 0.0)
    pull[0] = 0.0  # of a heading nothing is known
    off = prior.starts - values
    information = J.T @ (weights[:, None] * J) + np.diag(pull)
    scale = max(1.0, float(np.median(size)) / 0.6745)
    return information, J.T @ (weights * errors) + pull * off, cost + float(pull @ off**2), scale


def _differs(one: _Solution, best: _Solution, sigmas: Array) -> bool:
    away = np.abs(one.values - best.values)
    away[0] = abs(wrapped(float(away[0])))
    return bool((away > _SAME_SIGMAS * sigmas + 1e-3).any())


def _is_round(best: _Solution, covariance: Array, seen: Ranges, prior: Prior) -> bool:
    """Return whether the cost rises around a solution by its covariance; in a valley that bends it does not."""
    lengths, directions = np.linalg.eigh(covariance)
    for step in (_FAR * np.sqrt(np.maximum(lengths, 0.0)) * directions).T:
        if not step.any():
            continue  # a number that is known
        costs = [_system(best.values + sign * step, seen, prior)[2] for sign in (1.0, -1.0)]
        if min(costs) - best.cost < _RISE * (_FAR * best.scale) ** 2:
            return False
    return True


def _is_near(values: Array, covariance: Array, seen: Ranges) -> bool:
    """Return whether the middle of the path is known in the frame to a small share of the ranges."""
    middle = about_up(float(values[0])) @ seen.world_m.mean(axis=0)
    J = np.zeros((3, 5))
    J[:, 0] = [-middle[1], middle[0], 0.0]
    J[:, 1:4] = np.eye(3)
    sigma = math.sqrt(float(np.linalg.eigvalsh(J @ covariance @ J.T)[-1]))
    return sigma < _NEAR * float(np.median(seen.ranges_m))
