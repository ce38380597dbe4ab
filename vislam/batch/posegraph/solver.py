"""Nonlinear least squares on pose graphs: Gauss-Newton guarded by Levenberg-Marquardt, and Powell's dogleg."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vislam.batch.posegraph.structure import NormalEquations, Structure
from vislam.core.messages import Array

Progress = Callable[[int, float], None]  # iteration, cost

_DAMPING_FIRST = 1e-9
_DAMPING_MAX = 1e8
_RADIUS_MIN = 1e-12  # of the trust region: no step lowers the cost any more


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """What an optimisation ended with."""

    poses: Array  # [N, d + 1, d + 1]
    costs: tuple[float, ...]  # at the start and after each iteration
    converged: bool  # False: the limit of iterations, or no step that lowers the cost


def levenberg_marquardt(
    structure: Structure,
    poses: Array,
    weights: Array,
    *,
    iterations: int,
    tolerance: float,
    progress: Progress | None = None,
) -> Descent:
    """Lower the cost from `poses`; undamped steps as long as they do, damped ones (Marquardt) otherwise.

    It ends when the decrease still to come, extrapolated from the last two, is below `tolerance` of the cost.
    """
    equations = NormalEquations(structure, structure.solver(structure.problem.tangent))
    poses, candidate = poses.copy(), np.empty_like(poses)
    cost = equations.linearise(poses, weights)
    costs, damping, last_gain = [cost], 0.0, 0.0
    converged = not len(structure.free)
    while len(costs) <= iterations and not converged:
        while damping <= _DAMPING_MAX:
            if equations.factorise(damping):
                equations.retract(poses, equations.step(), candidate)
                cost = structure.problem.chi2(candidate, weights)
                if cost <= costs[-1] * (1.0 + 1e-12):
                    break
            damping = max(_DAMPING_FIRST, 10.0 * damping)
        else:
            break
        poses, candidate = candidate, poses
        gain = costs[-1] - cost
        costs.append(cost)
        if progress is not None:
            progress(len(costs) - 1, cost)
        rest = gain * min(1.0, gain / last_gain) if damping == 0.0 and last_gain > 0.0 else gain
        converged = rest <= tolerance * cost or cost < 1e-12
        last_gain = gain
        damping = 0.0 if damping <= _DAMPING_FIRST else 0.1 * damping
        if not converged:
            equations.linearise(poses, weights)
    return Descent(poses, tuple(costs), converged)


def dogleg(
    structure: Structure,
    poses: Array,
    weights: Array,
    *,
    iterations: int,
    tolerance: float,
    progress: Progress | None = None,
) -> Descent:
    """Lower the cost from `poses` by Powell's dogleg: Gauss-Newton within a trust region, else along the gradient.

    A rejected step costs no factorisation. Rosen, Kaess, Leonard, "RISE", T-RO 2014, section III. It ends as
    `levenberg_marquardt` does.
    """
    equations = NormalEquations(structure, structure.solver(structure.problem.tangent))
    poses, candidate = poses.copy(), np.empty_like(poses)
    cost = equations.linearise(poses, weights)
    costs, radius, last_gain = [cost], np.inf, 0.0
    converged = not len(structure.free)
    while len(costs) <= iterations and not converged:
        gradient = equations.gradient
        damping = 0.0
        while not equations.factorise(damping) and damping <= _DAMPING_MAX:
            damping = max(_DAMPING_FIRST, 10.0 * damping)
        newton = equations.step()
        slope, curvature = float(np.sum(gradient**2)), equations.curvature(gradient)
        descent = -gradient * (slope / max(curvature, 1e-300))
        radius = min(radius, float(np.linalg.norm(newton)))
        shrunk = False
        while radius > _RADIUS_MIN:
            step = _dogleg_step(newton, descent, radius)
            equations.retract(poses, step, candidate)
            cost = structure.problem.chi2(candidate, weights)
            predicted = -2.0 * float(np.sum(gradient * step)) - equations.curvature(step)
            ratio = (costs[-1] - cost) / max(predicted, 1e-300)
            if cost <= costs[-1] * (1.0 + 1e-12):
                break
            radius, shrunk = 0.25 * min(radius, float(np.linalg.norm(step))), True
        else:
            break
        length = float(np.linalg.norm(step))
        whole = step is newton
        radius = 0.5 * length if ratio < 0.25 else np.inf if whole else 3.0 * radius if ratio > 0.75 else radius
        poses, candidate = candidate, poses
        gain = costs[-1] - cost
        costs.append(cost)
        if progress is not None:
            progress(len(costs) - 1, cost)
        rest = gain * min(1.0, gain / last_gain) if whole and not shrunk and last_gain > 0.0 else gain
        converged = (rest <= tolerance * cost and (whole or shrunk)) or cost < 1e-12
        last_gain = gain
        if not converged:
            equations.linearise(poses, weights)
    return Descent(poses, tuple(costs), converged)


def _dogleg_step(newton: Array, descent: Array, radius: float) -> Array:
    """Return the point of the dogleg path at the distance `radius`, or the whole Gauss-Newton step."""
    if float(np.linalg.norm(newton)) <= radius:
        return newton
    length = float(np.linalg.norm(descent))
    if length >= radius:
        return descent * (radius / length)
    towards = newton - descent
    a, b, c = float(np.sum(towards**2)), float(np.sum(towards * descent)), length**2 - radius**2
    return descent + towards * ((-b + np.sqrt(max(b * b - a * c, 0.0))) / a)
