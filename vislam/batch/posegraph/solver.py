"""Nonlinear least squares on pose graphs: Gauss-Newton guarded by Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vislam.batch.posegraph.structure import NormalEquations, Structure
from vislam.core.messages import Array

Progress = Callable[[int, float], None]  # iteration, cost

_DAMPING_FIRST = 1e-9
_DAMPING_MAX = 1e8


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
