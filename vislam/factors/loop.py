"""Loop factors, and how well a pair of poses fits a loop."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.config import GraphConfig
from vislam.core.chi_square import chi_square_limit
from vislam.core.geometry import invert, se3_adjoint, se3_log
from vislam.core.memory import Tie
from vislam.core.messages import Array
from vislam.factors.journal import LoopRecord
from vislam.factors.keys import X, nearest_rigid
from vislam.factors.noise_models import DIRECTION_FLOOR_DEG, DIRECTION_SOFT_M, cauchy, conditioned, gaussian, inflated
from vislam.factors.visual import (
    DirectionMeasurement,
    direction_as_pose,
    direction_factor,
    direction_measurement,
    direction_residual,
    pose_factor,
)

LOOP_CAUCHY_K = 2.0  # whitened norm
LOOP_MIN_WEIGHT = 0.05  # a loop that optimisation leaves with less is taken out again
_RATIO_MAX = 1e12  # eigenvalues of an innovation covariance, for a stable inverse


class LoopModel:
    """One loop edge, metric or scale-free: its factor, its residual and its chi-square."""

    def __init__(self, record: LoopRecord, config: GraphConfig, lever_m: Array) -> None:
        """Prepare the edge; `lever_m` [3] is cam0 in the body."""
        self.record = record
        self._config = config
        self._lever_m = lever_m
        self.tie: Tie | None = None  # how the graph has it, when not as measured
        covariance = inflated(record.covariance, 1.0, np.deg2rad(config.loop_floor_deg), config.loop_floor_m)
        self._direction: DirectionMeasurement | None = None
        if not record.has_scale:
            floor = np.deg2rad(DIRECTION_FLOOR_DEG)
            covariance = inflated(record.covariance, 1.0, np.deg2rad(config.loop_floor_deg), 0.0)
            self._direction = direction_measurement(record.T_from_to, covariance, floor)
            covariance = self._direction.covariance
        self.covariance = conditioned(covariance, config.covariance_ratio_max)
        self.threshold = chi_square_limit(config.loop_gate_probability, len(self.covariance))

    @property
    def id(self) -> int:
        """Return the id of the loop."""
        return self.record.id

    def tie_to(self, anchor_id: int, T_anchor_from: Array, covariance: Array, T_from_to: Array, *, most: float) -> bool:
        """Let another keyframe stand for the older one: T_anchor_from [4, 4] is where that is, known to `covariance`.

        T_from_to [4, 4] is how the graph has the loop now: without scale, the loop takes the length of the way from it,
        and keeps the variance along the way of a length that was not measured. Returns False, and changes nothing,
        where that would add more than `most` times the loop's own variance in rotation or translation.
        """
        T, own = self.as_pose(T_from_to)
        carry = se3_adjoint(invert(T))
        added = carry @ covariance @ carry.T
        if any(np.trace(added[n, n]) > most * np.trace(own[n, n]) for n in (slice(3), slice(3, 6))):
            return False
        self.tie = Tie(anchor_id, nearest_rigid(T_anchor_from @ T), own + added)
        return True

    def as_pose(self, T_from_to: Array) -> tuple[Array, Array]:
        """Return the loop as a metric relative pose [4, 4] with covariance [6, 6]; T_from_to [4, 4] lends it length."""
        record = self.record
        if self._direction is None:
            return record.T_from_to, self.covariance
        covariance = inflated(record.covariance, 1.0, np.deg2rad(self._config.loop_floor_deg), 0.0)
        return direction_as_pose(record.T_from_to, covariance, self._lever_m, T_from_to)

    def factor(self, robust: bool, as_measured: bool = False) -> gtsam.NonlinearFactor:
        """Return the factor, under a Cauchy kernel when `robust`, between the loop's own ends when `as_measured`."""
        record, config = self.record, self._config
        tie = Tie(record.from_id, record.T_from_to, self.covariance)
        if self.tie is not None and not as_measured:
            tie = self.tie
        model: gtsam.noiseModel.Base = gaussian(tie.covariance, config.covariance_ratio_max)
        if robust:
            model = cauchy(model, LOOP_CAUCHY_K)
        a, b = X(tie.from_id), X(record.to_id)
        if self._direction is None or tie is self.tie:
            return pose_factor(a, b, tie.T_from_to, model)
        return direction_factor(a, b, self._direction, lever_m=self._lever_m, soft_m=DIRECTION_SOFT_M, model=model)

    def between(self, poses: Array, robust: bool) -> gtsam.BetweenFactorPose3:
        """Return a factor that is metric also without scale, for which poses [K, 4, 4] lend the length; see `factor`.

        Batch has no need of a function in Python per loop, which `factor` makes of one without scale.
        """
        a, b = self.record.from_id, self.record.to_id
        T, covariance = self.as_pose(invert(poses[a]) @ poses[b])
        model: gtsam.noiseModel.Base = gaussian(covariance, self._config.covariance_ratio_max)
        return pose_factor(X(a), X(b), T, cauchy(model, LOOP_CAUCHY_K) if robust else model)

    def eye(self, T_map_body: Array) -> Array:
        """Return where cam0 is [3], to which the direction of a loop without scale belongs."""
        return np.asarray(T_map_body[:3, :3] @ self._lever_m + T_map_body[:3, 3])

    def residual(self, T_from: Array, T_to: Array) -> tuple[Array, Array]:
        """Return the residual [n] at two map poses and its Jacobian [n, 6] by the relative pose (its end perturbed)."""
        if self._direction is None:
            return se3_log(invert(self.record.T_from_to) @ invert(T_from) @ T_to), np.eye(6)
        d = self._direction
        residual, _, J_b = direction_residual(
            T_from, T_to, d.R_a_b, d.direction_a, d.tangent, self._lever_m, DIRECTION_SOFT_M
        )
        rows = len(self.covariance)
        return residual[:rows], J_b[:rows]

    def chi2(self, T_from: Array, T_to: Array, relative_covariance: Array | None = None) -> float:
        """Return the chi-square of the residual; with the covariance [6, 6] of the relative pose, of the innovation."""
        residual, J = self.residual(T_from, T_to)
        S = self.covariance if relative_covariance is None else self.covariance + J @ relative_covariance @ J.T
        S = conditioned(S, _RATIO_MAX)  # a graph that knows nothing about a pair gives a singular one
        return float(residual @ np.linalg.solve(S, residual))

    def weight(self, T_from: Array, T_to: Array) -> float:
        """Return the weight, 0 to 1, that the Cauchy kernel leaves the edge."""
        k2 = LOOP_CAUCHY_K**2
        return k2 / (k2 + self.chi2(T_from, T_to))


def relative_covariance(T_a: Array, T_b: Array, joint: Array) -> Array:
    """Return the covariance [6, 6] of T_a_b, perturbed on the b side, from the joint one [12, 12] of both poses."""
    H = np.hstack([-se3_adjoint(invert(T_b) @ T_a), np.eye(6)])
    return np.asarray(H @ joint @ H.T)
