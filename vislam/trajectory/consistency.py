"""Whether a filter knows how wrong it is: NEES of keyframe states in the gauge that they were estimated in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.chi_square import chi_square_limit
from vislam.core.errors import DataError
from vislam.core.messages import Array, NavState
from vislam.core.trajectory import Trajectory
from vislam.trajectory.association import associate

if TYPE_CHECKING:
    from vislam.trajectory.truth_fit import TruthFit

_HALF_WINDOW_NS = 150_000_000  # of the fit that gives true velocities: 1 mm of noise at 200 Hz becomes 4 mm/s
_MAX_HALF_WINDOW_NS = 500_000_000  # a rarer truth has no velocity
_MIN_SAMPLES = 10  # of the truth in the window, for four coefficients
_REACH = 0.6  # of half the window, on both sides


@dataclass(frozen=True, slots=True)
class Consistency:
    """The average of a chi-square statistic per degree of freedom: 1 when the covariance is right."""

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
    low, high = (chi_square_limit(share, freedom) / freedom for share in (0.025, 0.975))
    return Consistency(total / freedom, low, high, count)


def nees(
    states: Sequence[NavState], truth: Trajectory, gravity: bool = True, fit: TruthFit | None = None
) -> dict[str, Array]:
    """Return the normalised estimation error squared of states: "rotation", "position" and "velocity", [M], 3 dof each.

    Position and yaw of the first state (its attitude, without `gravity`) are a free choice, so the truth is brought
    into the states' world by them: the error there is zero and grows with drift, as the covariance does. Where that
    state was not certain of them, what it was wrong by moves and turns the truth, and its covariance joins that of
    every other state. A fit over all states would hide drift, and find the first ones, which are surest, wrong.
    The true velocity is that of a fit to the true positions, and its variance joins the state's. By the `fit` of the
    truth to the IMU what it is turned, displaced and late is undone, and its noise joins the covariances; other errors
    of the true poses count as the state's. NaN is what was not estimated, and the first state.
    Raises DataError with fewer than 2 matching states.
    """
    estimate = Trajectory(
        np.array([s.t_ns for s in states], dtype=np.int64),
        np.array([s.T_world_body for s in states]).reshape(-1, 4, 4),
    )
    of_truth = np.zeros(3) if fit is None else np.array([fit.noise_rad, fit.noise_m, fit.velocity_m_s])
    truth = truth if fit is None else fit.of_imu(truth)
    pairs = associate(estimate, truth)
    if len(pairs) < 2:
        raise DataError(f"consistency needs 2 states within the truth, got {len(pairs)} of {len(states)}")
    matched = [s for s, inside in zip(states, np.isin(estimate.t_ns, pairs.t_ns), strict=True) if inside]
    R = pairs.estimate[0, :3, :3] @ pairs.reference[0, :3, :3].T
    if gravity:
        R = Rotation.from_rotvec([0.0, 0.0, _heading_rad(R)]).as_matrix()
    true_R = R @ pairs.reference[:, :3, :3]
    true_p = (pairs.reference[:, :3, 3] - pairs.reference[0, :3, 3]) @ R.T + pairs.estimate[0, :3, 3]
    velocity, velocity_variance = _velocities(truth, pairs.t_ns)
    velocities = np.array([s.velocity_world_m_s for s in matched])
    errors = {
        "rotation": Rotation.from_matrix(pairs.estimate[:, :3, :3].transpose(0, 2, 1) @ true_R).as_rotvec(),
        "position": true_p - pairs.estimate[:, :3, 3],
        "velocity": velocity @ R.T - velocities,
    }
    covariance = np.array([s.covariance for s in matched])
    covariance[:, range(9), range(9)] += np.repeat(of_truth**2, 3)  # also of the first true pose
    of_anchor = _of_anchor(pairs.estimate, velocities, covariance[0, :6, :6], gravity)
    results = {}
    for i, (name, error) in enumerate(errors.items()):
        P = covariance[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3] + of_anchor[name]
        if name == "velocity":
            P = P + velocity_variance[:, None, None] * np.eye(3)
        results[name] = _squared_mahalanobis(error, P)
        results[name][0] = np.nan
    return results


def anees(states: Sequence[NavState], truth: Trajectory, fit: TruthFit | None = None) -> dict[str, Consistency]:
    """Return the average per degree of freedom of each `nees` that has a value; raises DataError as that does."""
    finite = {name: values[np.isfinite(values)] for name, values in nees(states, truth, fit=fit).items()}
    return {name: chi_square_mean(float(v.sum()), len(v), 3) for name, v in finite.items() if len(v)}


def stated_scale_sigma(states: Sequence[NavState]) -> float:
    """Return the relative sigma of the size of a trajectory that its states claim, NaN where nothing moved.

    It is the sigma of the position farthest from the first one, along the way to it, relative to the distance: what
    else than the scale is unsure there is in it, too.
    """
    if not states:
        return float("nan")
    away = np.array([state.T_world_body[:3, 3] - states[0].T_world_body[:3, 3] for state in states])
    distances = np.linalg.norm(away, axis=1)
    i = int(np.argmax(distances))
    if not distances[i] > 0.0:
        return float("nan")
    along = away[i] / distances[i]
    return float(np.sqrt(along @ states[i].covariance[3:6, 3:6] @ along) / distances[i])


def _of_anchor(poses: Array, velocities: Array, covariance: Array, gravity: bool) -> dict[str, Array]:
    """Return what the first state's own uncertainty adds to the errors of all states: by name, [M, 3, 3].

    `poses` [M, 4, 4] and `velocities` [M, 3] are the estimate, `covariance` [6, 6] that of the first one's attitude
    (on the body side) and position. With `gravity` only its heading turns the truth.
    """
    R_first = poses[0, :3, :3]
    P_turn = R_first @ covariance[:3, :3] @ R_first.T  # world axes
    if gravity:
        P_turn = np.diag([0.0, 0.0, P_turn[2, 2]])
    R, way = poses[:, :3, :3], poses[:, :3, 3] - poses[0, :3, 3]
    by_turn = {"rotation": R.transpose(0, 2, 1), "position": _cross(way), "velocity": _cross(velocities)}
    added = {name: J @ P_turn @ J.transpose(0, 2, 1) for name, J in by_turn.items()}
    added["position"] += covariance[3:, 3:]
    return added


def _cross(vectors: Array) -> Array:
    """Return the matrices [M, 3, 3] of the cross products with vectors [M, 3]."""
    return np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1)


def _heading_rad(R: Array) -> float:
    """Return the angle of the rotation about z that is closest to a rotation."""
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def _velocities(truth: Trajectory, t_ns: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return true velocities [N, 3], NaN near the ends and holes of the truth, and their variances [N].

    A cubic in time is fitted to the true positions around each time; what it leaves over shows the noise of the truth.
    """
    period_ns = float(np.median(np.diff(truth.t_ns))) if len(truth) > 1 else np.inf
    half_ns = max(_HALF_WINDOW_NS, 0.5 * _MIN_SAMPLES * period_ns)
    velocity, variance = np.full((len(t_ns), 3), np.nan), np.full(len(t_ns), np.nan)
    for i, now_ns in enumerate(t_ns.tolist()):
        first, last = np.searchsorted(truth.t_ns, (now_ns - half_ns, now_ns + half_ns))
        s = (truth.t_ns[first:last] - now_ns) / half_ns
        if len(s) < _MIN_SAMPLES or s[0] > -_REACH or s[-1] < _REACH or half_ns > _MAX_HALF_WINDOW_NS:
            continue
        basis = np.vander(s, 4, increasing=True)
        solution = np.linalg.lstsq(basis, truth.positions_m[first:last], rcond=None)[0]
        rest = truth.positions_m[first:last] - basis @ solution
        unit_variance = np.linalg.inv(basis.T @ basis)[1, 1] / (half_ns * 1e-9) ** 2
        velocity[i] = solution[1] / (half_ns * 1e-9)
        variance[i] = unit_variance * float(np.sum(rest**2)) / (3 * (len(s) - 4))
    return velocity, variance


def _squared_mahalanobis(error: Array, covariance: Array) -> Array:
    values = np.full(len(error), np.nan)
    for i, (e, P) in enumerate(zip(error, covariance, strict=True)):
        if np.isfinite(e).all() and np.isfinite(P).all():
            try:
                values[i] = e @ np.linalg.solve(P, e)
            except np.linalg.LinAlgError:  # a state that is known exactly has no say in consistency
                continue
    return values
