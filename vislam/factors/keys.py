"""Keys of the graph and the conversions between gtsam's values and numpy."""

from __future__ import annotations

import gtsam
import numpy as np

from vislam.core.messages import Array

_INDEX_BITS = 56
_POSE, _VELOCITY, _BIAS, _POINT, _OWN, _WALKING = (ord(c) << _INDEX_BITS for c in "xvblow")
_VARIABLE_BITS = 40  # above the id of a keyframe


def X(i: int) -> int:
    """Return the key of keyframe i's pose (equal to gtsam's symbol, ten times cheaper)."""
    return _POSE | i


def V(i: int) -> int:
    """Return the key of keyframe i's velocity in map, m/s."""
    return _VELOCITY | i


def B(i: int) -> int:
    """Return the key of keyframe i's IMU biases."""
    return _BIAS | i


def L(n: int) -> int:
    """Return the key of landmark n, a point in map."""
    return _POINT | n


def own_key(n: int) -> int:
    """Return the key of variable n of all that sensors have of their own, one that does not change."""
    return _OWN | n


def walking_key(n: int, i: int) -> int:
    """Return the key of variable n of all that sensors have of their own, one that walks, at keyframe i."""
    return _WALKING | n << _VARIABLE_BITS | i


def bias_of(gyro_rad_s: Array, accel_m_s2: Array) -> gtsam.imuBias.ConstantBias:
    """Return gtsam's bias, which orders accelerometer first."""
    return gtsam.imuBias.ConstantBias(accel_m_s2, gyro_rad_s)


def nearest_rigid(T: Array) -> Array:
    """Return the rigid motion [..., 4, 4] nearest to T, whose rotation is orthonormal but for rounding.

    Without this, rounding grows by a constant factor where motions are continued from the ones before.
    """
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    out = np.zeros(T.shape)
    out[..., :3, :3] = U @ Vt
    out[..., :3, 3] = T[..., :3, 3]
    out[..., 3, 3] = 1.0
    return out


def poses_of(values: gtsam.Values) -> Array:
    """Return all poses [M, 4, 4], in the order of keyframe ids."""
    rows = np.asarray(gtsam.utilities.extractPose3(values)).reshape(-1, 12)
    T = np.zeros((len(rows), 4, 4))
    T[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    T[:, :3, 3] = rows[:, 9:]
    T[:, 3, 3] = 1.0
    return T
