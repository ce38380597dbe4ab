"""How the body moves at a frame, and how well its pose and velocity are known: 30 numbers of the filter's state.

Axes and order are those of ROS's nav_msgs/Odometry: velocity [3] in axes of the body, covariance [6, 6] of position and
rotation about X, Y, Z in axes of `odom`, and [3, 3] of the velocity in axes of the body. Units are m, rad and s.
"""

from __future__ import annotations

import numpy as np

from vislam.core.messages import Array, NavState

MOTION_NUMBERS = 30
_UPPER_6, _UPPER_3 = np.triu_indices(6), np.triu_indices(3)


def motion_of(state: NavState) -> Array:
    """Return the motion [30] of a state; what was not estimated, or is not finite, is NaN, as all that hangs on it."""
    R, P = state.T_world_body[:3, :3], state.covariance[:9, :9]
    velocity = R.T @ state.velocity_world_m_s
    J, K = np.zeros((6, 6)), np.hstack([np.cross(velocity, np.eye(3)).T, R.T])
    J[:3, 3:], J[3:, :3] = np.eye(3), R  # states perturb rotation on the body's side
    known = np.r_[0:3, 6:9]
    with np.errstate(invalid="ignore"):
        of_pose, of_velocity = J @ P[:6, :6] @ J.T, K @ P[np.ix_(known, known)] @ K.T
    return np.concatenate([velocity, of_pose[_UPPER_6], of_velocity[_UPPER_3]])


def motion_parts(motion: Array) -> tuple[Array, Array, Array]:
    """Return velocity [3], covariance of the pose [6, 6] and of the velocity [3, 3] of a motion [30]."""
    of_pose, of_velocity = np.zeros((6, 6)), np.zeros((3, 3))
    of_pose[_UPPER_6], of_velocity[_UPPER_3] = motion[3:24], motion[24:]
    return motion[:3], of_pose + np.triu(of_pose, 1).T, of_velocity + np.triu(of_velocity, 1).T
