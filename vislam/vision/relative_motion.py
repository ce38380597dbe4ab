"""How a visual motion between two body poses constrains them: residuals and Jacobians, compiled.

A residual is `measured - predicted`, so `residual(x + d) = residual(x) - J @ d`. Poses are perturbed by rotation on the
body side and position in world axes, in this order, as in `NavState`.
"""

from __future__ import annotations

import numpy as np

from vislam.core.geometry import (
    skew,
    so3_left_jacobian_inverse,
    so3_log,
    so3_right_jacobian_inverse,
    tangent_basis,
)
from vislam.core.jit import njit
from vislam.core.messages import Array


@njit(cache=True, nogil=True)
def metric_residual(T_world_a: Array, T_world_b: Array, T_a_b: Array) -> tuple[Array, Array, Array]:
    """Return the residual [6] of a measured `T_a_b` and its Jacobians [6, 6] by pose a and by pose b.

    The residual is rotation then translation, in axes of b, so that a body-side covariance of `T_a_b` is its noise.
    """
    R_a, R_b = T_world_a[:3, :3].copy(), T_world_b[:3, :3].copy()
    R_a_b, t_a_b = T_a_b[:3, :3].copy(), T_a_b[:3, 3].copy()
    R_b_a = R_b.T @ R_a
    r = np.empty(6)
    rotation = so3_log(R_b_a @ R_a_b)
    translation = R_b.T @ (T_world_a[:3, 3] + R_a @ t_a_b - T_world_b[:3, 3])
    r[:3] = rotation
    r[3:] = translation
    J_a, J_b = np.zeros((6, 6)), np.zeros((6, 6))
    J_b[:3, :3] = so3_left_jacobian_inverse(rotation)
    J_b[3:, :3] = -skew(translation)
    J_b[3:, 3:] = R_b.T
    J_a[:3, :3] = -so3_right_jacobian_inverse(rotation) @ R_a_b.T
    J_a[3:, :3] = R_b_a @ skew(t_a_b)
    J_a[3:, 3:] = -R_b.T
    return r, J_a, J_b


@njit(cache=True, nogil=True)
def camera_displacement(T_world_a: Array, T_world_b: Array, lever_m: Array) -> Array:
    """Return how far the camera, `lever_m` [3] from the body's origin, moved from a to b: [3] in body axes of a."""
    R_a_world = np.ascontiguousarray(T_world_a[:3, :3].T)
    R_b = T_world_b[:3, :3].copy()
    return R_a_world @ (T_world_b[:3, 3] - T_world_a[:3, 3] + R_b @ lever_m) - lever_m


@njit(cache=True, nogil=True)
def direction_residual(
    T_world_a: Array, T_world_b: Array, T_a_b: Array, lever_m: Array
) -> tuple[Array, Array, Array, Array, float]:
    """Return the residual of a motion without scale, its Jacobians by both poses, and the axes it is written in.

    `T_a_b` holds the rotation and, as translation, the unit direction u of the camera's displacement in body axes of a.
    With c the predicted displacement, the direction's residual is `|c| * axes.T @ (u - c / |c|)`, in metres, with two
    axes across c. Taking axes across the *measured* direction instead looks simpler, but then noise in u multiplies
    with the length of c, and every measurement makes the motion a little shorter.

    Returns:
        residual [5] (rotation, then the two across), Jacobians [5, 6] by pose a and by pose b, axes [3, 2] in body axes
        of a, and the displacement along u in metres: negative when the prediction goes the opposite way.
    """
    R_a, R_b = T_world_a[:3, :3].copy(), T_world_b[:3, :3].copy()
    R_a_b, direction = T_a_b[:3, :3].copy(), T_a_b[:3, 3].copy()
    rotation = so3_log(R_b.T @ R_a @ R_a_b)
    displacement = camera_displacement(T_world_a, T_world_b, lever_m)
    distance = np.sqrt(np.sum(displacement * displacement))
    axes = tangent_basis(displacement / distance if distance > 1e-9 else direction)
    across_T = np.ascontiguousarray(axes.T)
    r = np.empty(5)
    r[:3] = rotation
    r[3:] = distance * (across_T @ direction)
    J_a, J_b = np.zeros((5, 6)), np.zeros((5, 6))
    J_b[:3, :3] = so3_left_jacobian_inverse(rotation)
    J_b[3:, :3] = -(across_T @ (R_a.T @ R_b) @ skew(lever_m))
    J_b[3:, 3:] = across_T @ R_a.T
    J_a[:3, :3] = -so3_right_jacobian_inverse(rotation) @ R_a_b.T
    J_a[3:, :3] = across_T @ skew(displacement + lever_m)
    J_a[3:, 3:] = -(across_T @ R_a.T)
    along = np.sum(displacement * direction)
    return r, J_a, J_b, axes, along


@njit(cache=True, nogil=True)
def direction_noise(T_a_b: Array, covariance: Array, axes: Array, distance_m: float) -> Array:
    """Return the noise [5, 5] of `direction_residual`, for a displacement of `distance_m`.

    Args:
        T_a_b: the measurement, unit direction as translation.
        covariance: [6, 6], body-side; its translation block is that of the unit direction.
        axes: [3, 2] as returned with the residual.
        distance_m: how far the camera moved, as well as it is known.
    """
    M = np.zeros((5, 6))
    for i in range(3):
        M[i, i] = 1.0
    M[3:, 3:] = distance_m * (np.ascontiguousarray(axes.T) @ T_a_b[:3, :3].copy())
    return M @ covariance @ M.T
