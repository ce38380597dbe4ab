"""The motion of a simulated body: smooth splines whose derivatives are exact, so that the truth is exact.

Position and the angles roll, pitch, yaw are uniform quintic B-splines, four times continuously differentiable. The
control points are used as they are (not interpolated): support is local, so a body whose control points stand still is
exactly at rest, and a designed motion is smoothed instead of made to ring.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from vislam.core.errors import UsageError
from vislam.core.messages import Array

_DEGREE = 5
_ROUNDING_S = 1e-6  # times this little outside are taken as the end
_MAX_PITCH_RAD = 1.4  # angles are singular at 90 degrees of pitch; no world goes near it

Design = Callable[[Array], tuple[Array, Array]]
"""Maps times in seconds [N] to wanted positions [N, 3] in metres and roll, pitch, unwrapped yaw [N, 3] in radians."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The exact state of the body at N times."""

    T_world_body: Array  # [N, 4, 4]
    velocity_world_m_s: Array  # [N, 3]
    acceleration_world_m_s2: Array  # [N, 3], without gravity
    rate_body_rad_s: Array  # [N, 3]


class BodySpline:
    """A body trajectory over `[0, duration_s]`."""

    def __init__(self, positions_m: Array, angles_rad: Array, spacing_s: float) -> None:
        """Build the spline from control points.

        Args:
            positions_m: control points of the position [M, 3]; point i acts around the time `(i - 2) * spacing_s`.
            angles_rad: control points of roll, pitch, yaw [M, 3]; `R_world_body = Rz(yaw) @ Ry(pitch) @ Rx(roll)`.
            spacing_s: time between control points.

        Raises:
            UsageError: fewer than six control points, different lengths, not finite, or pitch close to 90 degrees.
        """
        control = np.hstack([positions_m, angles_rad]) if len(positions_m) == len(angles_rad) else np.empty((0, 6))
        if len(control) <= _DEGREE or not np.all(np.isfinite(control)) or spacing_s <= 0.0:
            raise UsageError(
                f"a body spline needs at least {_DEGREE + 1} finite control points with as many angles and a positive "
                f"spacing, got {len(positions_m)} positions, {len(angles_rad)} angles and {spacing_s} s"
            )
        if np.max(np.abs(angles_rad[:, 1])) > _MAX_PITCH_RAD:
            raise UsageError(f"pitch of a body spline must stay within {_MAX_PITCH_RAD} rad; turn the path instead")
        knots = spacing_s * (np.arange(len(control) + _DEGREE + 1) - _DEGREE)
        self.duration_s = float(spacing_s * (len(control) - _DEGREE))
        self._value = BSpline(knots, control, _DEGREE, extrapolate=False)
        self._first = self._value.derivative(1)
        self._second = self._value.derivative(2)

    @classmethod
    def from_design(cls, design: Design, duration_s: float, spacing_s: float) -> BodySpline:
        """Build a spline that follows a designed motion, smoothed over about three spacings.

        The design is asked for times slightly outside `[0, duration_s]` as well and should hold its ends there.
        """
        count = int(np.ceil(duration_s / spacing_s - 1e-9)) + _DEGREE
        times_s: Array = spacing_s * (np.arange(count, dtype=np.float64) - 2.0)
        positions, angles = design(times_s)
        return cls(positions, angles, spacing_s)

    def at(self, t_s: Array) -> Motion:
        """Return the exact motion at times [N] in seconds since the start.

        Raises UsageError for times outside `[0, duration_s]`.
        """
        t_s = np.asarray(t_s, dtype=np.float64)
        held = np.clip(t_s, 0.0, self.duration_s)
        t_s = np.asarray(np.where(np.abs(held - t_s) < _ROUNDING_S, held, t_s))
        value = self._value(t_s)
        if not np.all(np.isfinite(value)):
            raise UsageError(f"asked for the body outside its trajectory of {self.duration_s:.3f} s")
        first, second = self._first(t_s), self._second(t_s)
        T = np.zeros((len(t_s), 4, 4))
        T[:, :3, :3] = Rotation.from_euler("ZYX", value[:, [5, 4, 3]]).as_matrix()
        T[:, :3, 3] = value[:, :3]
        T[:, 3, 3] = 1.0
        return Motion(T, first[:, :3], second[:, :3], _rate_body(value[:, 3:], first[:, 3:]))


def _rate_body(angles: Array, angle_rates: Array) -> Array:
    """Return the body rates [N, 3] of roll, pitch, yaw and their derivatives (Diebel 2006, eq. 79)."""
    roll, pitch = angles[:, 0], angles[:, 1]
    roll_dot, pitch_dot, yaw_dot = angle_rates.T
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    return np.stack(
        [roll_dot - yaw_dot * sp, pitch_dot * cr + yaw_dot * sr * cp, yaw_dot * cr * cp - pitch_dot * sr], axis=1
    )
