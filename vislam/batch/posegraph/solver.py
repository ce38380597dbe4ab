"""Nonlinear least squares on pose graphs: Gauss-Newton guarded by Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vislam.batch.posegraph.problem import PoseGraphProblem
from vislam.batch.posegraph.structure import NormalEquations, Structure
from vislam.core.messages import Array

Progress = Callable[[int, float], None]  # iteration, cost

_DAMPING_FIRST = 1e-9
_DAMPING_MAX = 1e8
Mask = NDArray[np.bool_]
Kernel = Literal["cauchy", "geman-mcclure", "dcs"]

KERNEL_CHI2 = 4.0  # the last scale: a loop of this chi2 has the weight 1/2, 1/4, and 1 under the three kernels
_SHRINK = 1.5  # of the scale, per step
_STEPS_MAX = 60
_WEIGHTLESS = 1e-3
_AT_REST = 1e-3  # of the trajectory's extent: motion of a step below which nothing changes any more


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


def kernel_weights(kernel: Kernel, chi2: Array, scale: float) -> Array:
    """Return the weights [M] of loops by their chi2 [M].

    Dynamic covariance scaling ("dcs"): Agarwal, Tipaldi, Spinello, Stachniss, Burgard, ICRA 2013.
    """
    if kernel == "cauchy":
        return scale / (scale + chi2)
    if kernel == "geman-mcclure":
        return (scale / (scale + chi2)) ** 2
    return np.minimum(1.0, 2.0 * scale / (scale + chi2)) ** 2


def kernel_route(
    problem: PoseGraphProblem,
    trusted: Mask,
    poses: Array,
    kernel: Kernel,
    first_scale: float,
    give_up: bool,
    progress: Progress | None = None,
) -> tuple[Array, Array] | None:
    """Return poses [N, d + 1, d + 1] under the kernel and the weights [E] of the edges; those trusted [E] have 1.

    The scale goes from what odometry errs by to its last value, as graduated non-convexity does (Yang, Antonante,
    Tzoumas, Carlone, RA-L 2020). Loops that weigh next to nothing are left out of the equations: false ones join
    far-off poses and would fill the factor.

    With `give_up`, None where too many loops count for their factor to be cheap: few that agree do not fill it.
    `poses` is where to start; `first_scale` is the chi2 of loops that still count there, KERNEL_CHI2 at least.
    """
    weights = np.ones(len(problem.edges))
    scale = max(first_scale, KERNEL_CHI2)
    live, structure = trusted, None
    extent = float(np.ptp(poses[:, :-1, -1], axis=0).max(initial=0.0))
    for _ in range(_STEPS_MAX):
        weights[~trusted] = kernel_weights(kernel, problem.edge_chi2(poses)[~trusted], scale)
        now = trusted | (weights > _WEIGHTLESS)
        if structure is None or not np.array_equal(now, live):
            live, structure = now, Structure(problem.with_edges(now))
            if structure.is_clustered(problem.tangent) and give_up:
                return None
        descent = levenberg_marquardt(structure, poses, weights[live], iterations=1, tolerance=0.0)
        moved = float(np.abs(descent.poses - poses)[:, :-1, -1].max(initial=0.0))
        poses = descent.poses
        if progress is not None:
            progress(0, descent.costs[-1])
        if scale <= KERNEL_CHI2 and moved <= _AT_REST * extent:
            break
        scale = max(scale / _SHRINK, KERNEL_CHI2)
    weights[~trusted] = kernel_weights(kernel, problem.edge_chi2(poses)[~trusted], KERNEL_CHI2)
    return poses, weights
