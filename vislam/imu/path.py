"""What a whole recording of inertial samples shows of a body's path: attitude and position, integrated."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from vislam.core.messages import Array

_GYRO_DRIFT_S = 20.0  # between the knots of its drift; at 40 the accelerometer of V2_01 fits worse, at 10 that of V1_01


class SmoothAttitude:
    """A smooth rotation through matrices [N, 3, 3] at times [N]: cubic in the quaternion, normalised."""

    def __init__(self, t_s: Array, R: Array) -> None:
        q = Rotation.from_matrix(R).as_quat()
        flips = np.cumprod(np.where(np.einsum("ni,ni->n", q[1:], q[:-1]) < 0.0, -1.0, 1.0))
        q[1:] *= flips[:, None]
        self._q = CubicSpline(t_s, q)

    def at(self, t_s: Array) -> Array:
        """Return rotations [M, 3, 3] at times [M]."""
        return np.asarray(Rotation.from_quat(self._q(t_s)).as_matrix())


def integrate_twice(t_s: Array, acceleration: Array) -> tuple[Array, Array]:
    """Return velocity and position [N, 3] of an acceleration that is linear between samples."""
    h = np.diff(t_s)[:, None]
    a, b = acceleration[:-1], acceleration[1:]
    velocity = np.vstack([np.zeros(3), np.cumsum(0.5 * h * (a + b), axis=0)])
    position = np.vstack([np.zeros(3), np.cumsum(h * velocity[:-1] + h * h * (2.0 * a + b) / 6.0, axis=0)])
    return velocity, position


def mean_rate_ahead(t_s: Array, turned: Array, R: Array) -> Array:
    """Return the mean rate [3] by which `turned` turns faster than `R` (both [N, 3, 3]) between the times."""
    a = turned[:-1].transpose(0, 2, 1) @ turned[1:]
    b = R[:-1].transpose(0, 2, 1) @ R[1:]
    ahead = Rotation.from_matrix(b.transpose(0, 2, 1) @ a).as_rotvec()
    return np.asarray(np.median(ahead / np.diff(t_s)[:, None], axis=0))


def drift_knots(t_s: Array) -> Array:
    """Return the knots of a cubic spline over times [N] that follows a gyroscope's drift and nothing faster."""
    begin_s, end_s = float(t_s[0]), float(t_s[-1])
    inner = np.linspace(begin_s, end_s, max(round((end_s - begin_s) / _GYRO_DRIFT_S), 1) + 1)[1:-1]
    return np.concatenate([np.repeat(begin_s, 4), inner, np.repeat(end_s, 4)])


def apart(t_ns: NDArray[np.int64], spacing_s: float) -> NDArray[np.int64]:
    """Return indices of stamps that are at least a spacing apart (less the rounding of stamps)."""
    chosen: list[int] = []
    next_ns = -(1 << 62)
    for i, stamp in enumerate(t_ns.tolist()):
        if stamp >= next_ns:
            chosen.append(i)
            next_ns = stamp + round((spacing_s - 1e-4) * 1e9)
    return np.array(chosen, dtype=np.int64)


def gaps(t_s: Array, longest_s: float) -> Array:
    """Return begin and end [M, 2] of what is longer than `longest_s` between two of the times."""
    wide = np.flatnonzero(np.diff(t_s) > longest_s)
    return np.column_stack([t_s[wide], t_s[wide + 1]])
