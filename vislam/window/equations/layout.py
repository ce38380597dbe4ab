"""How states, measurements and unknowns lie in memory.

A keyframe's state is a row of 21: rotation (row-major 9), position, velocity, gyro bias, accel bias. The unknowns are
ordered velocity and biases of keyframe 0, 1, ..., then poses of keyframe 0, 1, ..., then calibration: elimination in
this order keeps the factor sparse, and what has to be known with its covariance comes last. A keyframe's error is
rotation (body side), position (world), velocity, gyro bias, accel bias, as in `NavState`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import so3_exp, so3_log
from vislam.core.jit import njit
from vislam.core.lens import Lenses
from vislam.core.messages import Array
from vislam.core.small import product, product_back

STATE = 21
# Time offset, rotation of the camera (3), readout; relative errors of the focal length and of what measures metres (the
# baseline or the depth image), rotation of the right camera (3); relative errors of the axes of gyroscope (3) and
# accelerometer (3)
CALIBRATION, FOCAL, METRES, RIGHT, AXES = 16, 5, 6, 7, 10
Ints = NDArray[np.int64]


class States(NamedTuple):
    """Keyframes, and where to linearise them."""

    X: Array  # [M, 21]
    first: Array  # [M, 21] where the marginal prior has those that it holds: their derivatives are taken there
    held: NDArray[np.bool_]  # [M]


class Normal(NamedTuple):
    """Normal equations that measurements are added to."""

    A: Array  # [D, D] upper triangle
    g: Array  # [D]


class Views(NamedTuple):
    """Observations [N] of landmarks [L], those of a landmark in a row and its host first."""

    first: Ints  # [L + 1]
    host: Ints  # [L] keyframe whose camera, that of the first observation, holds bearing and inverse depth
    keyframe: Ints  # [N]
    camera: Ints  # [N]
    values: (
        Array  # [N, 8] x and y on z = 1; pixel from the principal point and 1 / its sigma; row of the image, -0.5 at
    )
    # the top to 0.5; 1/z that was measured, 1/m, and 1 / its sigma, 0 where it was not


class Links(NamedTuple):
    """What ties keyframe k to k + 1, [M - 1] each, and what is known of keyframe k alone, [M]."""

    inertial: NDArray[np.bool_]
    dt: Array
    dR: Array  # [., 3, 3]
    dv: Array  # [., 3]
    dp: Array  # [., 3]
    by_imu: Array  # [., 9, 12] rotation, velocity, position by the biases and the errors of the axes, gyroscope first
    information: Array  # [., 9, 9]
    bias: Array  # [., 6] that was taken off
    walk_information: Array  # [., 6]
    guess: Array  # [., 4, 4] motion of the body
    guess_weight: Array  # [., 2] 1 / sigma of rotation and of translation; 0: no such factor
    velocity_weight: Array  # [.] 1 / sigma that velocity stays
    extra: NDArray[np.bool_]  # [.] whether further sensors measured the motion: `b @ d + d @ H @ d / 2` of both poses
    extra_H: Array  # [., 12, 12]
    extra_b: Array  # [., 12]
    extra_at: Array  # [., 2, 21] the states around which d [12] counts
    rest_weight: Array  # [M] 1 / sigma that velocity is zero


class Camera(NamedTuple):
    """Geometry and timing of the cameras."""

    T_body_cam: Array  # [4, 4] of camera 0
    T_cam0_cams: Array  # [C, 4, 4]
    lenses: Lenses  # of all cameras
    right: int  # the camera whose place counts in metres and which may be turned; -1: none makes a pair with camera 0
    rate: Array  # [M, 3] of the body at each keyframe, rad/s
    applied_offset_s: Array  # [M] time offset that is already in the stamp
    active: NDArray[np.bool_]  # [16] what is estimated
    huber_k: Array  # [C + 1] of a pixel's error in each camera, and of a depth's, whitened
    rho_information: float  # of the prior of inverse depth


class Prior(NamedTuple):
    """Cost `b @ dx + dx @ H @ dx / 2` of calibration and the first keyframes, around where they were linearised."""

    H: Array  # [16 + n * S, 10 + n * S], S = 15, or 6 without an IMU
    b: Array
    calibration: Array  # [16]


@njit(cache=True, nogil=True, error_model="numpy")
def rotation(x: Array) -> Array:
    """Return the rotation [3, 3] of a state [21]."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = x[3 * i + j]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def retract(x: Array, d: Array) -> None:
    """Move a state [21] by an error [15] (or [6]: its pose) in place."""
    R = product(rotation(x), so3_exp(d[:3]))
    for i in range(3):
        for j in range(3):
            x[3 * i + j] = R[i, j]
    for i in range(3, len(d)):
        x[6 + i] += d[i]


@njit(cache=True, nogil=True, error_model="numpy")
def difference(x: Array, x0: Array) -> Array:
    """Return the error [15] that moves state x0 to x."""
    turn = so3_log(product_back(rotation(x0), rotation(x)))
    out = np.empty(15)
    for i in range(3):
        out[i] = turn[i]
    for i in range(3, 15):
        out[i] = x[6 + i] - x0[6 + i]
    return out


def positions(count: int, inertial: bool) -> Ints:
    """Return where [count, 15] (or [count, 6]) each keyframe's error lies among the unknowns."""
    if not inertial:
        return np.arange(6 * count).reshape(count, 6)
    others = np.arange(9 * count).reshape(count, 9)
    return np.hstack([9 * count + np.arange(6 * count).reshape(count, 6), others])


def prior_positions(count: int, held: int, inertial: bool) -> Ints:
    """Return where the prior's unknowns (calibration, then the first `held` keyframes) lie among all."""
    where = positions(count, inertial)
    return np.concatenate([where.size + np.arange(CALIBRATION), where[:held].ravel()])
