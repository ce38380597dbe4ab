"""Visual odometry factors: metric relative pose, and for one camera relative rotation with a direction of motion."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from vislam.core.geometry import skew, so3_log, so3_right_jacobian_inverse, tangent_basis
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.factors.noise_models import DIRECTION_FLOOR_DEG, DIRECTION_SCALE_SIGMA, DIRECTION_SOFT_M

_FACING_MIN = 0.1  # bounds the residual near the opposite direction
_NO_DIRECTION = 0.5  # a translation column shorter than this means no parallax


@dataclass(frozen=True, slots=True, eq=False)
class DirectionMeasurement:
    """Rotation of the body and direction of cam0's motion between two poses, with what the residual needs."""

    R_a_b: Array  # [3, 3]
    direction_a: Array  # [3] unit vector in the axes of body a; any vector when `has_direction` is false
    tangent: Array  # [3, 2] orthonormal basis of the plane across it
    covariance: Array  # [5, 5] rotation on the b side, then tangent plane; [3, 3] without direction
    has_direction: bool


def direction_measurement(T_a_b: Array, covariance: Array, floor_rad: float) -> DirectionMeasurement:
    """Return the measurement in an unscaled relative pose [4, 4] with covariance [6, 6] perturbed on the b side.

    The translation column is the unit direction of cam0's motion in the axes of body a, or zero without parallax.
    """
    R = np.ascontiguousarray(T_a_b[:3, :3])
    norm = float(np.linalg.norm(T_a_b[:3, 3]))
    if norm < _NO_DIRECTION:
        axis = np.array([1.0, 0.0, 0.0])
        return DirectionMeasurement(R, axis, tangent_basis(axis), covariance[:3, :3], False)
    direction = T_a_b[:3, 3] / norm
    tangent = tangent_basis(direction)
    project = np.zeros((5, 6))
    project[:3, :3] = np.eye(3)
    project[3:, 3:] = tangent.T @ R / norm
    reduced = project @ covariance @ project.T
    reduced[3:, 3:] += floor_rad**2 * np.eye(2)
    return DirectionMeasurement(R, direction, tangent, reduced, True)


def direction_as_pose(
    T_a_b: Array, covariance: Array, lever_m: Array, T_expected: Array, scale_sigma: float = DIRECTION_SCALE_SIGMA
) -> tuple[Array, Array]:
    """Return an unscaled relative pose as a metric one [4, 4] with covariance [6, 6], long along the unknown scale.

    All poses whose camera moved along the measured direction lie on a line, t = s d - (R - 1) lever, so a covariance
    that is long along d states exactly what was measured. The motion `T_expected` [4, 4] lends its length: that places
    the mean, with `scale_sigma` relative uncertainty, and turns the direction's angle into metres.

    A graph full of these needs no Python callback: gtsam copies all its values into each call of a CustomFactor, which
    makes linearising N of them cost N^2 (0.12 s an update at 300 keyframes). Loops are few and use `direction_factor`.
    """
    R = T_a_b[:3, :3]
    expected_m = float(np.linalg.norm(T_expected[:3, 3] + T_expected[:3, :3] @ lever_m - lever_m))
    step_m, floor_rad = max(expected_m, DIRECTION_SOFT_M), np.deg2rad(DIRECTION_FLOOR_DEG)
    out = np.eye(6)
    mean = np.eye(4)
    mean[:3, :3] = R
    out[:3, :3] = covariance[:3, :3]
    norm = float(np.linalg.norm(T_a_b[:3, 3]))
    lever_motion = (R - np.eye(3)) @ lever_m
    if norm < _NO_DIRECTION:
        mean[:3, 3] = -lever_motion
        out[3:, 3:] = np.eye(3) * (scale_sigma * step_m) ** 2
        return mean, out
    direction = T_a_b[:3, 3] / norm
    mean[:3, 3] = step_m * direction - lever_motion
    along = R.T @ direction
    across = np.eye(3) - np.outer(along, along)
    angular = covariance[3:, 3:] / norm**2 + floor_rad**2 * np.eye(3)
    out[3:, 3:] = step_m**2 * (across @ angular @ across + scale_sigma**2 * np.outer(along, along))
    return mean, out


@njit(cache=True)
def direction_residual(
    T_a: Array, T_b: Array, R_a_b: Array, direction_a: Array, tangent: Array, lever_m: Array, soft_m: float
) -> tuple[Array, Array, Array]:
    """Return the residual [5] and its Jacobians [5, 6] with respect to both poses, perturbed on the body side.

    Rotation: `Log(R_a_b^T R_a^T R_b)`. Direction: the stereographic image `2 tangent^T n / (1 + n . direction)` of
    n = t / sqrt(t^2 + soft^2), t the motion of the camera at `lever_m` [3] in body a. Unlike the plain projection it
    does not vanish at the opposite direction, and baselines below `soft_m` fade out instead of making it singular.
    """
    Ra_t = np.ascontiguousarray(T_a[:3, :3].T)
    R = Ra_t @ np.ascontiguousarray(T_b[:3, :3])
    r = so3_log(np.ascontiguousarray(R_a_b.T) @ R)
    moved = Ra_t @ (T_b[:3, 3] - T_a[:3, 3]) + R @ lever_m  # cam0 at b, in body a's frame
    t = moved - lever_m
    length = float(np.sqrt(t @ t + soft_m * soft_m))
    n = t / length
    raw_facing = 1.0 + float(n @ direction_a)
    facing = max(raw_facing, _FACING_MIN)
    tangent_t = np.ascontiguousarray(tangent.T)
    across = tangent_t @ n

    residual = np.empty(5)
    residual[:3] = r
    residual[3:] = 2.0 * across / facing

    d_n = 2.0 * tangent_t / facing
    if raw_facing > _FACING_MIN:
        d_n = d_n - np.outer(2.0 * across / (facing * facing), direction_a)
    d_t = d_n @ ((np.eye(3) - np.outer(n, n)) / length)
    J_inverse = so3_right_jacobian_inverse(r)
    J_a, J_b = np.zeros((5, 6)), np.zeros((5, 6))
    J_a[:3, :3] = -J_inverse @ np.ascontiguousarray(R.T)
    J_b[:3, :3] = J_inverse
    J_a[3:, :3] = d_t @ skew(moved)
    J_a[3:, 3:] = -d_t
    J_b[3:, :3] = -d_t @ R @ skew(lever_m)
    J_b[3:, 3:] = d_t @ R
    return residual, J_a, J_b


def direction_factor(
    key_a: int,
    key_b: int,
    measured: DirectionMeasurement,
    *,
    lever_m: Array,
    soft_m: float,
    model: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:
    """Return the scale-free factor between two poses; 3 rows without direction, else 5. `lever_m`: cam0 in the body."""
    rows = 5 if measured.has_direction else 3
    R, direction, tangent = measured.R_a_b, measured.direction_a, measured.tangent
    lever = np.ascontiguousarray(lever_m)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        T_a, T_b = values.atPose3(key_a).matrix(), values.atPose3(key_b).matrix()
        residual, J_a, J_b = direction_residual(
            np.ascontiguousarray(T_a), np.ascontiguousarray(T_b), R, direction, tangent, lever, soft_m
        )
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(J_a[:rows])
            jacobians[1] = np.asfortranarray(J_b[:rows])
        return np.asarray(residual[:rows])

    return gtsam.CustomFactor(model, [key_a, key_b], error)


def pose_factor(key_a: int, key_b: int, T_a_b: Array, model: gtsam.noiseModel.Base) -> gtsam.BetweenFactorPose3:
    """Return the metric relative pose factor."""
    return gtsam.BetweenFactorPose3(key_a, key_b, gtsam.Pose3(T_a_b), model)


def measurement_of(factor: gtsam.BetweenFactorPose3) -> tuple[Array, Array]:
    """Return the motion [4, 4] of a relative pose factor without a kernel, and its information [6, 6]."""
    model = factor.noiseModel()
    assert isinstance(model, gtsam.noiseModel.Gaussian)
    return factor.measured().matrix(), model.information()
