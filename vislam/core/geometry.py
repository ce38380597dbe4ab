"""Rotations and rigid motions on numpy arrays: SO(3), SE(3), Sim(3).

Tangent vectors of SE(3) are ordered rotation, then translation, and perturb on the right: `T @ se3_exp(xi)`, as in
gtsam. Formulas follow Barfoot, "State Estimation for Robotics", chapter 7, and Sola et al., "A micro Lie theory for
state estimation in robotics", 2018. The small functions are compiled, so that kernels elsewhere call the same code.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.core.jit import njit
from vislam.core.messages import Array

_SMALL_RAD = 1e-7  # below this angle, series of second order are exact to double precision


@njit(cache=True)
def skew(v: Array) -> Array:
    """Return the matrix [3, 3] with `skew(v) @ u == cross(v, u)`."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True)
def so3_exp(w: Array) -> Array:
    """Return the rotation [3, 3] of a rotation vector [3] in radians (Rodrigues)."""
    theta = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    K = skew(w)
    if theta < _SMALL_RAD:
        return np.eye(3) + K + 0.5 * (K @ K)
    return np.eye(3) + (np.sin(theta) / theta) * K + ((1.0 - np.cos(theta)) / (theta * theta)) * (K @ K)


@njit(cache=True)
def quaternion_wxyz(R: Array) -> Array:
    """Return the unit quaternion [w, x, y, z], w >= 0, of a rotation [3, 3] (Shepperd's method: stable everywhere)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    choice = np.argmax(np.array([trace, R[0, 0], R[1, 1], R[2, 2]]))
    if choice == 0:
        q[0] = 1.0 + trace
        q[1] = R[2, 1] - R[1, 2]
        q[2] = R[0, 2] - R[2, 0]
        q[3] = R[1, 0] - R[0, 1]
    else:
        i = choice - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + k] = R[k, i] + R[i, k]
    q /= np.sqrt(np.sum(q * q))
    return -q if q[0] < 0.0 else q


@njit(cache=True)
def so3_log(R: Array) -> Array:
    """Return the rotation vector [3] in radians, norm <= pi, of a rotation [3, 3]."""
    q = quaternion_wxyz(R)
    v = q[1:].copy()
    sine = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if sine < _SMALL_RAD:
        return 2.0 * v / q[0]
    return v * (2.0 * np.arctan2(sine, q[0]) / sine)


@njit(cache=True)
def so3_left_jacobian(w: Array) -> Array:
    """Return J_l [3, 3] with `so3_exp(w + dw) ~ so3_exp(J_l @ dw) @ so3_exp(w)` (Barfoot 7.77)."""
    theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    K = skew(w)
    if theta2 < 1e-8:
        return np.eye(3) + (0.5 - theta2 / 24.0) * K + (1.0 / 6.0 - theta2 / 120.0) * (K @ K)
    theta = np.sqrt(theta2)
    return np.eye(3) + ((1.0 - np.cos(theta)) / theta2) * K + ((theta - np.sin(theta)) / (theta2 * theta)) * (K @ K)


@njit(cache=True)
def so3_right_jacobian(w: Array) -> Array:
    """Return J_r [3, 3] with `so3_exp(w + dw) ~ so3_exp(w) @ so3_exp(J_r @ dw)`."""
    return so3_left_jacobian(-w)


@njit(cache=True)
def so3_left_jacobian_inverse(w: Array) -> Array:
    """Return the inverse of `so3_left_jacobian(w)` for |w| < 2 pi."""
    theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    K = skew(w)
    if theta2 < 1e-8:
        return np.eye(3) - 0.5 * K + (1.0 / 12.0 + theta2 / 720.0) * (K @ K)
    half = 0.5 * np.sqrt(theta2)
    return np.eye(3) - 0.5 * K + ((1.0 - half * np.cos(half) / np.sin(half)) / theta2) * (K @ K)


@njit(cache=True)
def so3_right_jacobian_inverse(w: Array) -> Array:
    """Return the inverse of `so3_right_jacobian(w)` for |w| < 2 pi."""
    return so3_left_jacobian_inverse(-w)


@njit(cache=True)
def transform(R: Array, t: Array) -> Array:
    """Return T [4, 4] from a rotation [3, 3] and a translation [3]."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


@njit(cache=True)
def invert(T: Array) -> Array:
    """Return T_b_a of a rigid T_a_b [4, 4]."""
    out = np.eye(4)
    R_inverse = np.ascontiguousarray(T[:3, :3].T)
    out[:3, :3] = R_inverse
    out[:3, 3] = -R_inverse @ np.ascontiguousarray(T[:3, 3])
    return out


@njit(cache=True)
def se3_exp(xi: Array) -> Array:
    """Return T [4, 4] of a tangent vector [6], rotation then translation."""
    w = xi[:3].copy()
    return transform(so3_exp(w), so3_left_jacobian(w) @ xi[3:].copy())


@njit(cache=True)
def se3_log(T: Array) -> Array:
    """Return the tangent vector [6], rotation then translation, of T [4, 4]."""
    w = so3_log(T[:3, :3].copy())
    out = np.empty(6)
    out[:3] = w
    out[3:] = so3_left_jacobian_inverse(w) @ T[:3, 3].copy()
    return out


@njit(cache=True)
def tangent_basis(direction: Array) -> Array:
    """Return two orthonormal columns [3, 2] perpendicular to a unit direction [3]."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(direction))] = 1.0
    first = np.cross(direction, axis)
    first /= np.sqrt(np.sum(first * first))
    out = np.empty((3, 2))
    out[:, 0] = first
    out[:, 1] = np.cross(direction, first)
    return out


@njit(cache=True)
def se3_adjoint(T: Array) -> Array:
    """Return Ad [6, 6] with `T @ se3_exp(xi) @ invert(T) == se3_exp(Ad @ xi)`."""
    R = T[:3, :3].copy()
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[3:, 3:] = R
    out[3:, :3] = skew(T[:3, 3].copy()) @ R
    return out


def are_rotations(R: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return which matrices [..., 3, 3] are rotations: no entry of R^T R is off by more than that, none is mirrored."""
    with np.errstate(invalid="ignore", over="ignore"):
        errors = np.abs(R.swapaxes(-1, -2) @ R - np.eye(3)).max(axis=(-2, -1))
        return np.asarray((errors <= tolerance) & (np.linalg.det(R) > 0.0))


def are_rigid(T: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return which matrices [..., 4, 4] are finite rigid motions, as `are_rotations` judges their rotations."""
    framed = np.isfinite(T).all(axis=(-2, -1)) & (T[..., 3, :] == [0.0, 0.0, 0.0, 1.0]).all(axis=-1)
    return np.asarray(framed & are_rotations(T[..., :3, :3], tolerance))


def transform_points(T: Array, points: Array) -> Array:
    """Return points [N, 3] of frame b in frame a, given T_a_b [4, 4]; also for a Sim(3) matrix."""
    return points @ T[:3, :3].T + T[:3, 3]


def invert_many(T: Array) -> Array:
    """Return the inverses of rigid transforms [N, d + 1, d + 1], in space (d = 3) or in the plane (d = 2)."""
    d = T.shape[1] - 1
    out = np.zeros_like(T)
    out[:, :d, :d] = T[:, :d, :d].transpose(0, 2, 1)
    out[:, :d, d] = -np.einsum("nij,nj->ni", out[:, :d, :d], T[:, :d, d])
    out[:, d, d] = 1.0
    return out


def interpolate(T_a: Array, T_b: Array, alpha: float) -> Array:
    """Return the pose at fraction `alpha` between two poses: geodesic in rotation, straight in position."""
    out = np.eye(4)
    out[:3, :3] = T_a[:3, :3] @ so3_exp(alpha * so3_log(T_a[:3, :3].T @ T_b[:3, :3]))
    out[:3, 3] = (1.0 - alpha) * T_a[:3, 3] + alpha * T_b[:3, 3]
    return out


def rotation_from_quaternion_xyzw(q: Array) -> Array:
    """Return rotations [..., 3, 3] of quaternions [..., 4] ordered x, y, z, w; they need not be normalised.

    Raises ValueError on a quaternion of zero norm.
    """
    return Rotation.from_quat(q).as_matrix()


def quaternion_xyzw_from_rotation(R: Array) -> Array:
    """Return unit quaternions [..., 4] ordered x, y, z, w with w >= 0 of rotations [..., 3, 3]."""
    return Rotation.from_matrix(R).as_quat(canonical=True)


def level_rotation(up_body: Array) -> Array:
    """Return R_world_body [3, 3] with zero yaw that turns the body's up direction [3] onto +z."""
    up = up_body / np.linalg.norm(up_body)
    roll = np.arctan2(up[1], up[2])
    pitch = np.arctan2(-up[0], np.hypot(up[1], up[2]))
    return Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()


def sim3(scale: float, R: Array, t: Array) -> Array:
    """Return the similarity [4, 4] that maps p to `scale * R @ p + t`."""
    S = np.eye(4)
    S[:3, :3] = scale * R
    S[:3, 3] = t
    return S


def sim3_parts(S: Array) -> tuple[float, Array, Array]:
    """Return scale, rotation [3, 3] and translation [3] of a similarity [4, 4]."""
    scale = float(np.cbrt(np.linalg.det(S[:3, :3])))
    return scale, S[:3, :3] / scale, S[:3, 3].copy()


def align_points(source: Array, target: Array, with_scale: bool = False) -> Array:
    """Return the similarity [4, 4] that best maps source [N, 3] onto target [N, 3] in the least-squares sense.

    Without scale it is rigid. Umeyama, PAMI 1991. Raises ValueError with fewer than 3 points, DataError for
    points too far apart to count with.
    """
    if len(source) < 3 or len(source) != len(target):
        raise ValueError(f"alignment needs at least 3 pairs of points, got {len(source)} and {len(target)}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred_source, centred_target = source - mean_source, target - mean_target
    with np.errstate(over="ignore", invalid="ignore"):
        moments = centred_target.T @ centred_source / len(source)
    if not np.isfinite(moments).all():  # of which no decomposition would come to an end
        raise DataError("the positions are too far apart to be aligned; is a number damaged?")
    U, singular, Vt = np.linalg.svd(moments)
    sign = np.ones(3)
    sign[2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = U @ np.diag(sign) @ Vt
    spread = float(np.mean(np.sum(centred_source**2, axis=1)))
    scale = float(singular @ sign) / spread if with_scale and spread > 0.0 else 1.0
    return sim3(scale, R, mean_target - scale * R @ mean_source)
