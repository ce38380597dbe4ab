"""The body on a true path, for sensors that are drawn on it: a world's, or that of a recording with truth."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vislam.core.errors import DataError
from vislam.core.trajectory import Trajectory
from vislam.sensors.body import BodyState

_KNOT_NS = 50_000_000  # finer, the noise of a measured truth would be taken for motion
_MIN_KNOTS = 8


def bodies_on(truth: Trajectory, t_ns: NDArray[np.int64]) -> list[BodyState]:
    """Return the body at times [N] within a true path, smooth between poses 50 ms apart; biases are zero.

    Raises DataError where the path is too short.
    """
    kept = [0]
    for k, stamp in enumerate(truth.t_ns.tolist()):
        if stamp - int(truth.t_ns[kept[-1]]) >= _KNOT_NS:
            kept.append(k)
    if len(truth) == 0 or len(kept) < _MIN_KNOTS:
        raise DataError(f"sensors can be drawn on a path of {_MIN_KNOTS} poses 50 ms apart, got {len(truth)} poses")
    zero_ns = int(truth.t_ns[0])
    knots_s = (truth.t_ns[kept] - zero_ns) * 1e-9
    place = CubicSpline(knots_s, truth.positions_m[kept])
    attitude = RotationSpline(knots_s, Rotation.from_matrix(truth.T_world_body[kept, :3, :3]))
    at_s = (t_ns - zero_ns) * 1e-9
    R, rate = attitude(at_s).as_matrix(), attitude(at_s, 1)  # in body axes
    positions, velocities, none = place(at_s), place(at_s, 1), np.zeros(3)
    return [
        BodyState(int(t), R[k], positions[k], velocities[k], none, none, rate[k]) for k, t in enumerate(t_ns.tolist())
    ]
