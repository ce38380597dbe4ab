"""Up from an accelerometer without a gyroscope: forces turned into the map by known poses, where motion averages out.

The poses say how the sensor was turned, so gravity stands still in the map while the sensor's bias turns with it: both
come from one robust least-squares fit. Accelerations of a hand are the noise; they average out over seconds, for who
does not fly off ends at the speed at which he began.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import tangent_basis
from vislam.core.messages import Array
from vislam.core.trajectory import Trajectory
from vislam.core.up import Up

_GRAVITY_M_S2 = 9.81
_UNITS_M_S2 = {"m/s^2": 1.0, "g": _GRAVITY_M_S2, "cm/s^2": 0.01}
_NORM_RANGE = (0.7, 1.3)  # of gravity: the median norm shows the unit, also of a poor sensor in motion
_MOST = 5000  # samples that are looked at
_LEAST = 20
_LEAST_S = 2.0  # of recording: a hand's swing takes about one second
_BIAS_SIGMA_M_S2 = 0.5  # of a cheap chip without calibration (50 mg)
_SCALE_SIGMA = 0.03
_KERNEL_M_S2 = 1.0  # Cauchy's; hands accelerate by so much
_CORRELATED_S = 0.25  # samples nearer than this err alike: they belong to one move of the hand
_SPEED_SIGMA_M_S = 0.3  # by how much speed at the end may differ from that at the beginning
_MOST_SCATTER_M_S2 = 3.0  # more is no hand: the axes or the stamps are others
_MOST_SIGMA_DEG = 5.0


def up_of_forces(trajectory: Trajectory, t_ns: NDArray[np.int64], forces: Array) -> Up:
    """Return which way is up by specific forces at rest and in motion; unknown where they do not show it.

    Args:
        trajectory: of the body in the map.
        t_ns: rising stamps [N] by the camera's clock.
        forces: [N, 3] in body axes, in m/s^2, g or cm/s^2: which is seen from their size; +g upwards at rest.
    """
    if len(trajectory) < 2:
        return _unknown("there is no trajectory to turn it by")
    inside = np.flatnonzero((t_ns >= trajectory.t_ns[0]) & (t_ns <= trajectory.t_ns[-1]))
    inside = inside[:: max(1, -(-len(inside) // _MOST))]
    if len(inside) < _LEAST:
        return _unknown(f"{len(inside)} of its {len(t_ns)} samples lie in the time of the images")
    span_s = float(t_ns[inside[-1]] - t_ns[inside[0]]) * 1e-9
    if span_s < _LEAST_S:
        return _unknown(f"its {span_s:.1f} s are too short for motion to average out; {_LEAST_S:g} s are needed")
    norm = float(np.median(np.linalg.norm(forces[inside], axis=1)))
    unit = _unit(norm)
    if unit is None:
        return _unknown(f"its samples have a norm of {norm:.3g}, which is gravity in none of {', '.join(_UNITS_M_S2)}")
    R = trajectory.at(t_ns[inside])[:, :3, :3]
    return _fitted(R, forces[inside] * _UNITS_M_S2[unit], span_s, unit)


def _unknown(reason: str) -> Up:
    return Up.unknown(f"the accelerometer does not show it: {reason}")


def _unit(norm: float) -> str | None:
    """Return the unit in which a norm is that of gravity."""
    low, high = (_GRAVITY_M_S2 * share for share in _NORM_RANGE)
    return next((name for name, factor in _UNITS_M_S2.items() if low <= norm * factor <= high), None)


def _fitted(R: Array, forces: Array, span_s: float, unit: str) -> Up:
    """Fit gravity in the map and the sensor's bias to forces [N, 3] in m/s^2 at rotations R [N, 3, 3]."""
    n = len(forces)
    J = np.concatenate([R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2)  # gravity, bias
    x = np.concatenate([np.median(np.einsum("nij,nj->ni", R, forces), axis=0), np.zeros(3)])
    independent = max(1.0, span_s / _CORRELATED_S)
    H = np.eye(6)
    for _ in range(20):
        e = forces - J @ x
        w = 1.0 / (1.0 + np.sum(e * e, axis=1) / _KERNEL_M_S2**2)
        sigma = float(np.sqrt(np.sum(w * np.sum(e * e, axis=1)) / (3.0 * np.sum(w))))
        weight = w / max(sigma, 0.05) ** 2 * min(1.0, independent / n)
        H = np.einsum("n,nij,nik->jk", weight, J, J)
        r = np.einsum("n,nij,ni->j", weight, J, forces)
        H[3:, 3:] += np.eye(3) / _BIAS_SIGMA_M_S2**2
        along = np.concatenate([x[:3] / np.linalg.norm(x[:3]), np.zeros(3)])  # its size is known
        H += np.outer(along, along) / (_SCALE_SIGMA * _GRAVITY_M_S2) ** 2
        r += along * _GRAVITY_M_S2 / (_SCALE_SIGMA * _GRAVITY_M_S2) ** 2
        x = np.linalg.solve(H, r)
    scatter = float(np.sqrt(np.mean(np.sum((forces - J @ x) ** 2, axis=1)) / 3.0))
    if scatter > _MOST_SCATTER_M_S2:
        return _unknown(f"turned by the poses it scatters by {scatter:.1f} m/s^2: other axes, or another clock")
    up = x[:3] / np.linalg.norm(x[:3])
    B = tangent_basis(up)
    level = B.T @ np.linalg.inv(H)[:3, :3] @ B / float(x[:3] @ x[:3])
    still = _SPEED_SIGMA_M_S / span_s / _GRAVITY_M_S2
    sigma_deg = float(np.rad2deg(np.hypot(np.sqrt(np.linalg.eigvalsh(level)[-1]), still)))
    if sigma_deg > _MOST_SIGMA_DEG:
        return _unknown(f"it leaves {sigma_deg:.1f} deg open; turn the camera more, or record for longer")
    bias = float(np.linalg.norm(x[3:]))
    said = f"{n} samples over {span_s:.1f} s, in {unit}, scatter by {scatter:.2f} m/s^2; bias {bias:.2f} m/s^2"
    return Up("accelerometer", up, sigma_deg, 1.0, said)
