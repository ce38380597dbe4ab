"""The motion of a body that was really measured: sparse true poses, filled in between by its own inertial data.

Truth at 20 Hz misses what the body does between two poses, and its derivatives are rough. The IMU knows exactly that,
but drifts. So both are joined as a complementary filter joins them: the inertial data are integrated, and the slow
difference to the truth is a smooth spline. It passes through every true position that was used. Rotations of motion
capture are worse than a gyroscope's over seconds (against it, those of EuRoC's V1_01 and V2_01 err by 0.07 to 0.09 deg
within half a second and 0.4 to 0.5 deg within five; on MH_01 0.01 and 0.05 deg): truth only shows how the gyroscope
drifts. So what a virtual camera sees agrees with the real inertial data, as that of a real camera does.

The world of a motion capture is never quite level (half a degree in EuRoC's V2_01, 2 cm over its room). The
accelerometer shows how much, and the world is turned upright.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline, make_interp_spline, make_lsq_spline
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError
from vislam.core.geometry import level_rotation
from vislam.core.messages import Array
from vislam.imu.gyro_turns import integrate_gyro
from vislam.imu.path import SmoothAttitude, apart, drift_knots, gaps, integrate_twice, mean_rate_ahead
from vislam.sim.motion.spline import Motion
from vislam.trajectory import Trajectory

_KNOT_S = 0.04  # true poses closer than this are left out: their rounding would become velocity
_MAX_TRUTH_GAP_S = 0.25  # over longer gaps the drift of the inertial data is no longer a smooth spline
_MAX_IMU_GAP_S = 0.03  # over longer gaps the body may do anything
_MIN_KNOTS = 8
_GRAVITY_M_S2 = 9.81
_PIECE_S = 0.5
_PIECE_SIGMA_M_S = 0.02  # what is left of the change of velocity over a piece: the bias wanders
_BIAS_SIGMA_M_S2, _TILT_SIGMA_M_S2 = 0.3, 0.1  # of a good accelerometer, and of a levelled motion capture (0.6 deg)


class MeasuredMotion:
    """Motion over `[begin_s, end_s]`, in seconds since the first true pose that inertial data cover.

    Attributes:
        begin_s: always 0.
        end_s: time of the last pose.
        zero_ns: stamp of `begin_s`.
        gyro_bias_rad_s: mean difference [3] between the gyroscope and the true turns.
        R_level_world: rotation [3, 3] that turned the truth's world upright.
    """

    def __init__(self, t_ns: NDArray[np.int64], gyro_rad_s: Array, accel_m_s2: Array, truth: Trajectory) -> None:
        """Join inertial samples at times [N] (gyro and accel [N, 3], body frame) with the true poses of the body.

        Raises DataError when fewer than eight true poses lie within the inertial data.
        """
        if len(t_ns) < 2 or len(truth) == 0:
            raise DataError(f"motion needs inertial data and true poses, got {len(t_ns)} samples, {len(truth)} poses")
        inside = (truth.t_ns >= t_ns[0]) & (truth.t_ns <= t_ns[-1])
        chosen = apart(truth.t_ns[inside], _KNOT_S)
        stamps, poses = truth.t_ns[inside][chosen], truth.T_world_body[inside][chosen]
        if len(stamps) < _MIN_KNOTS:
            raise DataError(f"only {len(stamps)} true poses lie within the inertial data, {_MIN_KNOTS} are needed")
        used = slice(int(np.searchsorted(t_ns, stamps[0], "right")) - 1, int(np.searchsorted(t_ns, stamps[-1])) + 1)
        self.zero_ns = int(stamps[0])
        self.begin_s, self.end_s = 0.0, float(stamps[-1] - stamps[0]) * 1e-9
        imu_s, knots_s = _seconds(t_ns[used], self.zero_ns), _seconds(stamps, self.zero_ns)
        self._gaps_s = np.vstack([gaps(imu_s, _MAX_IMU_GAP_S), gaps(knots_s, _MAX_TRUTH_GAP_S)])
        self.gyro_bias_rad_s = np.zeros(3)
        for _ in range(2):  # the second time without the bias, so that little is left to the spline
            turned = SmoothAttitude(imu_s, integrate_gyro(imu_s, gyro_rad_s[used] - self.gyro_bias_rad_s))
            drift = poses[:, :3, :3] @ turned.at(knots_s).transpose(0, 2, 1)
            self.gyro_bias_rad_s = self.gyro_bias_rad_s + mean_rate_ahead(knots_s, turned.at(knots_s), poses[:, :3, :3])
        R = _smooth_drift(knots_s, drift, np.clip(imu_s, 0.0, self.end_s)) @ turned.at(imu_s)
        self.R_level_world = level_rotation(_up(imu_s, R, accel_m_s2[used], CubicSpline(knots_s, poses[:, :3, 3])))
        R = self.R_level_world @ R
        positions = poses[:, :3, 3] @ self.R_level_world.T
        self._attitude = SmoothAttitude(imu_s, R)
        acceleration = np.einsum("nij,nj->ni", R, accel_m_s2[used])
        acceleration = acceleration - acceleration.mean(axis=0)
        velocity, position = integrate_twice(imu_s, acceleration)
        self._sensed = make_interp_spline(imu_s, np.hstack([acceleration, gyro_rad_s[used] - self.gyro_bias_rad_s]), 1)
        self._path = CubicHermiteSpline(imu_s, position, velocity)
        self._drift = CubicSpline(knots_s, positions - self._path(knots_s))

    def at(self, t_s: Array) -> Motion:
        """Return the motion at times [N] in seconds; times outside are held at the ends.

        Rates and accelerations are the IMU's, less mean bias and drift: they carry its noise.
        """
        t_s = np.clip(np.asarray(t_s, dtype=np.float64), self.begin_s, self.end_s)
        T = np.zeros((len(t_s), 4, 4))
        T[:, :3, :3], T[:, 3, 3] = self._attitude.at(t_s), 1.0
        T[:, :3, 3] = self._path(t_s) + self._drift(t_s)
        velocity = self._path(t_s, 1) + self._drift(t_s, 1)
        sensed = self._sensed(t_s)
        return Motion(T, velocity, sensed[:, :3] + self._drift(t_s, 2), sensed[:, 3:])

    def covers(self, t_s: Array, margin_s: float = 0.0) -> NDArray[np.bool_]:
        """Return at which times [N] the motion is known: not within `margin_s` of a gap in truth or inertial data."""
        t_s = np.asarray(t_s, dtype=np.float64)
        known = (t_s >= self.begin_s) & (t_s <= self.end_s)
        for begin_s, end_s in self._gaps_s:
            known &= (t_s <= begin_s - margin_s) | (t_s >= end_s + margin_s)
        return np.asarray(known, dtype=np.bool_)


def _smooth_drift(t_s: Array, drift: Array, at_s: Array) -> Array:
    """Return rotations [M, 3, 3] at times [M] that follow those [N, 3, 3] at times [N] as slowly as a gyro drifts."""
    middle = Rotation.from_matrix(drift).mean()
    small = (middle.inv() * Rotation.from_matrix(drift)).as_rotvec()
    return np.asarray((middle * Rotation.from_rotvec(make_lsq_spline(t_s, small, drift_knots(t_s))(at_s))).as_matrix())


def _seconds(t_ns: NDArray[np.int64], zero_ns: int) -> Array:
    return (t_ns - zero_ns).astype(np.float64) * 1e-9


def _up(t_s: Array, R: Array, accel: Array, path: CubicSpline) -> Array:
    """Return the unit vector [3] that is up in the truth's world, by the changes of velocity in half-second pieces.

    A constant bias [3] in the body and a tilt of gravity [2] in the world explain best what the accelerometer and the
    positions disagree on; a body that does not turn does not separate them, and then the world counts as level.
    """
    step = max(round(_PIECE_S / float(np.median(np.diff(t_s)))), 1)
    h = np.diff(t_s)[:, None]
    force = np.einsum("nij,nj->ni", R, accel)
    velocity = np.vstack([np.zeros(3), np.cumsum(0.5 * h * (force[:-1] + force[1:]), axis=0)])[::step]
    turned = np.cumsum(0.5 * h[..., None] * (R[:-1] + R[1:]), axis=0)
    turned = np.concatenate([np.zeros((1, 3, 3)), turned])[::step]
    sides = np.diff(velocity - path(t_s[::step], 1), axis=0)
    length = np.diff(t_s[::step])
    sides[:, 2] -= _GRAVITY_M_S2 * length
    rows = np.zeros((len(length), 3, 5))
    rows[:, :, :3] = np.diff(turned, axis=0)
    rows[:, 0, 3] = rows[:, 1, 4] = length
    near = length < 2.0 * _PIECE_S
    prior = np.diag(_PIECE_SIGMA_M_S / np.array([_BIAS_SIGMA_M_S2] * 3 + [_TILT_SIGMA_M_S2] * 2))
    A, b = np.vstack([rows[near].reshape(-1, 5), prior]), np.concatenate([sides[near].ravel(), np.zeros(5)])
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    up = np.array([found[3], found[4], _GRAVITY_M_S2])
    return np.asarray(up / np.linalg.norm(up))
