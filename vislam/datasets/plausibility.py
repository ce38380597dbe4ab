"""Does a recording fit its calibration? Checks of physics without SLAM: gravity, gyro against image, epipolar lines.

They return numbers; `inspect.py` judges them.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vislam.core.angles import angle_between
from vislam.core.camera import Rig
from vislam.core.messages import Array
from vislam.datasets.tables import Row
from vislam.imu.resting import is_still

Stamps = NDArray[np.int64]

_WINDOW_NS = 500_000_000
_REST = (0.05, 0.3, 0.2)  # rad/s, m/s^2: a hand or an idling motor shakes more; rad/s: above any sane gyro bias
_CORNERS = 300
_MIN_TRACKS = 40
_INLIER_PX = 1.5
_MIN_TURN_RAD = np.deg2rad(3.0)  # a smaller turn shows little beside bias and noise of a few tracks


@dataclass(frozen=True, slots=True, eq=False)
class ImuFacts:
    """Inertial data at a glance: stamps [N] and statistics of windows of half a second [W]."""

    t_ns: Stamps
    window_t_ns: Stamps  # [W] begin
    accel_mean: Array  # [W, 3]
    gyro_mean: Array  # [W, 3]
    at_rest: NDArray[np.bool_]  # [W]

    @property
    def gyro_bias_rad_s(self) -> Array:
        """Mean rate [3] over the windows at rest; zero when there are none."""
        return np.asarray(self.gyro_mean[self.at_rest].mean(axis=0)) if self.at_rest.any() else np.zeros(3)


def imu_facts(rows: Iterable[Row[list[float]]]) -> ImuFacts:
    """Return the facts of inertial rows (gyro, then accelerometer) in time order; only stamps are kept of them."""
    stamps = array("q")
    windows: list[tuple[int, Array, bool]] = []
    current: list[list[float]] = []

    def finish() -> None:
        if len(current) > 1:
            values = np.array(current)
            windows.append((begin_ns, values.mean(axis=0), is_still(values[:, :3], values[:, 3:], _REST)))

    begin_ns = 0
    for t_ns, values in rows:
        if not current or t_ns - begin_ns >= _WINDOW_NS:
            finish()
            current, begin_ns = [], t_ns
        current.append(values)
        stamps.append(t_ns)
    finish()
    means = np.array([window[1] for window in windows]).reshape(-1, 6)
    return ImuFacts(
        t_ns=np.array(stamps, dtype=np.int64),
        window_t_ns=np.array([window[0] for window in windows], dtype=np.int64),
        accel_mean=means[:, 3:],
        gyro_mean=means[:, :3],
        at_rest=np.array([window[2] for window in windows], dtype=np.bool_),
    )


def mean_force(facts: ImuFacts) -> tuple[float, bool]:
    """Return the mean specific force in whatever unit it is given, and whether that is at rest, not on average."""
    rest = bool(facts.at_rest.any())
    if rest:
        return float(np.linalg.norm(facts.accel_mean[facts.at_rest], axis=1).mean()), True
    return float(np.linalg.norm(facts.accel_mean.mean(axis=0))), False


def force_seems_in_g(force: float) -> bool:
    """Return whether a mean force is that of the earth in g, not in m/s^2."""
    return abs(force - 1.0) < 0.1


def rates_seem_in_degrees(facts: ImuFacts) -> bool:
    """Return whether rates are beyond what anything that carries a camera turns at, were they in rad/s."""
    rate = np.linalg.norm(facts.gyro_mean, axis=1)
    return bool(float(np.median(rate)) > 10.0 or float(rate.max()) > 40.0)


def unit_doubt(facts: ImuFacts) -> tuple[str, str] | None:
    """Return what speaks against the units of inertial data and what to do about it; None when nothing does."""
    if not len(facts.window_t_ns):
        return None
    force, rest = mean_force(facts)
    if force_seems_in_g(force):
        return f"specific force {force:.2f} m/s^2 {'at rest' if rest else 'on average'}, the unit seems to be g", (
            "convert it to m/s^2"
        )
    if rates_seem_in_degrees(facts):
        fastest = float(np.linalg.norm(facts.gyro_mean, axis=1).max())
        return f"gyro of up to {fastest:.0f} rad/s, the unit seems to be deg/s", "convert it to rad/s"
    return None


def camera_tilt_rad(facts: ImuFacts, rig: Rig) -> float:
    """Return the angle between up, as the accelerometer feels it, and the top of cam0's image, through `T_BS`."""
    chosen = facts.accel_mean[facts.at_rest] if facts.at_rest.any() else facts.accel_mean
    up_cam = rig.T_body_cams[0][:3, :3].T @ chosen.mean(axis=0)
    return angle_between(up_cam, np.array([0.0, -1.0, 0.0]))
