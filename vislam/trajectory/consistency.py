"""Whether a filter knows how wrong it is: NEES of keyframe states in the gauge that they were estimated in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from vislam.errors import DataError
from vislam.messages import NavState
from vislam.trajectory.evaluation import associate
from vislam.trajectory.poses import Trajectory

Array = NDArray[np.float64]

_HALF_STEP_NS = 25_000_000  # true velocity by central difference: 0.1 mm of noise are 3 mm/s


@dataclass(frozen=True, slots=True)
class Consistency:
    """The average of a chi-square statistic per degree of freedom: 1 when the covariance tells the truth."""

    mean: float  # per degree of freedom
    low: float  # 95 % of consistent estimators lie between low and high, if their errors were independent
    high: float
    count: int  # independent or not


def chi_square_mean(total: float, count: int, dof: int) -> Consistency:
    """Return a sum of `count` chi-square values of `dof` degrees of freedom as an average with its 95 % bounds.

    Bar-Shalom et al. 2001, section 5.4. Raises ValueError without values.
    """
    freedom = count * dof
    if freedom < 1:
        raise ValueError("an average needs at least one value")
    low, high = chi2.ppf((0.025, 0.975), freedom) / freedom
    return Consistency(total / freedom, float(low), float(high), count)


def anees(states: Sequence[NavState], truth: Trajectory) -> dict[str, Consistency]:
    """Return the average NEES per degree of freedom of "rotation", "position" and "velocity" (3 each).

    Yaw and position of the first state are a free choice that its covariance does not hold, so the truth is brought
    into the states' world by them: the error there is zero and grows with drift, as the covariance does. A fit over
    all states would hide drift. The true velocity is the difference of true positions 25 ms before and after.
    What was not estimated (NaN) is left out; so is the first state. Raises DataError with fewer than 2 matching states.
    """
    estimate = Trajectory(
        np.array([s.t_ns for s in states], dtype=np.int64),
        np.array([s.T_world_body for s in states]).reshape(-1, 4, 4),
    )
    pairs = associate(estimate, truth)
    if len(pairs) < 2:
        raise DataError(f"consistency needs 2 states within the truth, got {len(pairs)} of {len(states)}")
    matched = [s for s, inside in zip(states, np.isin(estimate.t_ns, pairs.t_ns), strict=True) if inside]
    yaw = _heading_rad(pairs.estimate[0, :3, :3] @ pairs.reference[0, :3, :3].T)
    R = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
    true_R = R @ pairs.reference[:, :3, :3]
    true_p = (pairs.reference[:, :3, 3] - pairs.reference[0, :3, 3]) @ R.T + pairs.estimate[0, :3, 3]
    velocity, has_velocity = _velocities(truth, pairs.t_ns)
    errors = {
        "rotation": Rotation.from_matrix(pairs.estimate[:, :3, :3].transpose(0, 2, 1) @ true_R).as_rotvec(),
        "position": true_p - pairs.estimate[:, :3, 3],
        "velocity": velocity @ R.T - np.array([s.velocity_world_m_s for s in matched]),
    }
    covariance = np.array([s.covariance for s in matched])
    results = {}
    for i, (name, error) in enumerate(errors.items()):
        values = _squared_mahalanobis(error, covariance[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
        usable = np.isfinite(values) & (has_velocity if name == "velocity" else True)
        usable[0] = False
        if usable.any():
            results[name] = chi_square_mean(float(values[usable].sum()), int(usable.sum()), 3)
    return results


def _heading_rad(R: Array) -> float:
    """Return the angle of the rotation about z that is closest to a rotation."""
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def _velocities(truth: Trajectory, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
    """Return true velocities [N, 3] and where there are any: not at the ends of the truth."""
    inside = (t_ns - _HALF_STEP_NS >= truth.t_ns[0]) & (t_ns + _HALF_STEP_NS <= truth.t_ns[-1])
    velocity = np.full((len(t_ns), 3), np.nan)
    after, before = truth.at(t_ns[inside] + _HALF_STEP_NS), truth.at(t_ns[inside] - _HALF_STEP_NS)
    velocity[inside] = (after[:, :3, 3] - before[:, :3, 3]) / (2e-9 * _HALF_STEP_NS)
    return velocity, inside


def _squared_mahalanobis(error: Array, covariance: Array) -> Array:
    values = np.full(len(error), np.nan)
    for i, (e, P) in enumerate(zip(error, covariance, strict=True)):
        if np.isfinite(e).all() and np.isfinite(P).all():
            try:
                values[i] = e @ np.linalg.solve(P, e)
            except np.linalg.LinAlgError:  # a state that is known exactly has no say in consistency
                continue
    return values
