"""Turns by the gyroscope against those of a stretch's keyframes: rows for the joint adjustment.

The rotation part of Kalibr (Furgale et al., IROS 2013), by `imu/gyro_turns.py`, with the gyroscope's scale unknown as
far as its calibration leaves it: an exact one would give the focal length better than most cameras can.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.messages import Array
from vislam.imu.gyro_turns import GyroTurns, SeenTurns, turn_errors

UNKNOWNS = 8  # turn of R_cam_body on the camera's side, time offset, bias, scale error
OFFSET, SCALE = 3, 7
BIAS = slice(4, 7)
_SHARE = 0.003  # of an angle, by which axes that are not square and a flexing mount are off
_FLOOR_RAD = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Gyro:
    """Samples of a gyroscope and how good they are."""

    zero_ns: int
    t_s: Array  # [N] since then
    rate_rad_s: Array  # [N, 3]
    density: float  # rad/s/sqrt(Hz)
    scale_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class TurnRows:
    """Differences [n - 1, 3] between successive keyframes' turns and the gyroscope's, with what takes them off."""

    errors: Array
    by_second: Array  # [n - 1, 3, 3] by the later keyframe's turn; by the earlier one's it is the identity
    by_gyro: Array  # [n - 1, 3, UNKNOWNS]
    information: Array  # [n - 1], zero where samples are missing


def turn_rows(
    R: Array, t_ns: NDArray[np.int64], gyro: Gyro, turns: GyroTurns, R_cam_body: Array, offset_s: float
) -> TurnRows:
    """Return the rows of attitudes [n, 3, 3] at stamps [n] of the camera."""
    t_s = np.asarray((t_ns - gyro.zero_ns) * 1e-9, dtype=np.float64)
    between = R[:-1].transpose(0, 2, 1) @ R[1:]
    seen = SeenTurns(t_s[:-1].copy(), t_s[1:].copy(), np.ascontiguousarray(between))
    errors, J = turn_errors(turns, seen, np.ascontiguousarray(R_cam_body), offset_s, 0.0)
    vectors = Rotation.from_matrix(between).as_rotvec()
    variance = gyro.density**2 * np.diff(t_s) + _SHARE**2 * np.sum(vectors**2, axis=1) + _FLOOR_RAD**2
    known = np.isfinite(errors).all(axis=1)
    by_gyro = np.concatenate([J[:, :, 4:7], J[:, :, :4], vectors[:, :, None]], axis=2)
    return TurnRows(np.where(known[:, None], errors, 0.0), -between, by_gyro * known[:, None, None], known / variance)
