"""Does a recording fit its calibration? Checks of physics without SLAM: gravity, gyro against image, epipolar lines.

They return numbers; `inspect.py` judges them.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.core.angles import angle_between
from vislam.core.camera import Rig
from vislam.core.geometry import invert, skew
from vislam.core.messages import Array, ImageU8
from vislam.datasets.tables import Row
from vislam.imu.rest import is_still

Stamps = NDArray[np.int64]

_WINDOW_NS = 500_000_000
_REST = (0.05, 0.3, 0.2)  # rad/s, m/s^2: a hand or an idling motor shakes more; rad/s: above any sane gyro bias
_CORNERS = 300
_MIN_TRACKS = 40
_MATCH_RATIO = 0.8
_EPIPOLAR_LIMIT_PX = 2.0
_INLIER_PX = 1.5
_TURN_SPAN_NS = 200_000_000
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


@dataclass(frozen=True, slots=True)
class EpipolarFacts:
    """How matched features of stereo pairs fit the extrinsics."""

    matches: int
    on_line: float  # fraction of matches within 2 px of their epipolar line
    in_front: float  # fraction of those that lie in front of both cameras


def epipolar_facts(rig: Rig, pairs: Iterable[tuple[ImageU8, ImageU8]]) -> EpipolarFacts:
    """Match ORB features between the cameras and compare with the epipolar geometry of the rig.

    Raises DataError where both cameras sit at one place.
    """
    rig.check_baseline()
    T_cam1_cam0 = invert(rig.T_cam0_cam1)
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    E = skew(t) @ R
    matches, on_line, in_front = 0, 0, 0
    for left, right in pairs:
        pixels = _match(left, right)
        first, second = rig.cameras[0].unproject(pixels[:, :2]), rig.cameras[1].unproject(pixels[:, 2:])
        usable = np.all(np.isfinite(np.hstack([first, second])), axis=1)
        first, second = first[usable], second[usable]
        lines1, lines0 = first @ E.T, second @ E
        slope = np.sum(lines1[:, :2] ** 2, axis=1) + np.sum(lines0[:, :2] ** 2, axis=1)
        sampson_px = np.abs(np.sum(second * lines1, axis=1)) / np.sqrt(np.maximum(slope, 1e-18)) * rig.cameras[0].fx
        close = sampson_px < _EPIPOLAR_LIMIT_PX
        matches += len(first)
        on_line += int(close.sum())
        in_front += _count_in_front(first[close] @ R.T, second[close], t)
    return EpipolarFacts(matches, on_line / max(matches, 1), in_front / max(on_line, 1))


def _match(left: ImageU8, right: ImageU8) -> Array:
    """Return matched pixels [N, 4] (left x, y, right x, y) that pass the ratio test."""
    orb = cv2.ORB.create(nfeatures=800)
    points0, descriptors0 = orb.detectAndCompute(left, None)
    points1, descriptors1 = orb.detectAndCompute(right, None)
    if descriptors0 is None or descriptors1 is None or len(points1) < 2:
        return np.empty((0, 4))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors0, descriptors1, k=2)
    good = [m[0] for m in pairs if len(m) == 2 and m[0].distance < _MATCH_RATIO * m[1].distance]
    return np.array([[*points0[m.queryIdx].pt, *points1[m.trainIdx].pt] for m in good]).reshape(-1, 4)


def _count_in_front(rays0: Array, rays1: Array, t: Array) -> int:
    """Count points with positive depth on both rays: least squares of depth0 * ray0 + t = depth1 * ray1, cam1 axes."""
    a, b, c = np.sum(rays0**2, axis=1), np.sum(rays0 * rays1, axis=1), np.sum(rays1**2, axis=1)
    d, e = rays0 @ t, rays1 @ t
    # times the determinant a c - b b, which is never negative and near zero for points far away: those count as seen
    depth0, depth1 = b * e - c * d, a * e - b * d
    far = (a * c - b * b) < 1e-6 * a * c
    return int(np.count_nonzero(far | ((depth0 > 0.0) & (depth1 > 0.0))))
