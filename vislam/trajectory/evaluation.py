"""How good a trajectory is against the truth: ATE, RPE, scale, coverage and consistency (NEES).

Definitions follow Sturm et al. 2012 (ATE, RPE), Zhang and Scaramuzza 2018 (yaw-only alignment for visual-inertial
systems) and Bar-Shalom et al. 2001 (NEES); with equal association the numbers are those of evo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import align_points, invert, invert_many, sim3, sim3_parts
from vislam.core.messages import Array
from vislam.core.trajectory import Trajectory
from vislam.trajectory.association import Association, Pairs, associate, coverage, usual_hole_s, why_few

Alignment = Literal["se3", "sim3", "yaw", "first", "none"]

_SEGMENTS_M = (1.0, 5.0, 10.0)
_SEGMENT_TOLERANCE = 0.1  # of the length, as evo
_MISORDERED_DEG, _MISORDERED_SHARE = 2.0, 0.3  # of relative rotations over 1 s, and what another order leaves of them


@dataclass(frozen=True, slots=True, eq=False)
class RelativeErrors:
    """Errors of relative motions over segments of equal duration or equal length."""

    translation_m: Array  # [K]
    rotation_rad: Array  # [K]
    length_m: Array  # [K] travelled along the reference
    t_ns: NDArray[np.int64]  # [K] start of each segment

    def summary(self) -> dict[str, float | None]:
        """Return RMS errors in m, degrees, percent of the length and degrees per metre; None where undefined."""
        moving = self.length_m > 1e-3
        percent = 100.0 * self.translation_m[moving] / self.length_m[moving]
        per_metre = np.rad2deg(self.rotation_rad[moving]) / self.length_m[moving]
        return {
            "m": _rms(self.translation_m),
            "deg": _rms(np.rad2deg(self.rotation_rad)),
            "percent": _rms(percent),
            "deg_per_m": _rms(per_metre),
            "segments": float(len(self.translation_m)),
        }


def align(pairs: Pairs, mode: Alignment) -> Array:
    """Return the similarity [4, 4] that brings the estimate's world into the reference's.

    "se3" and "sim3" are least squares over positions (Umeyama 1991), "yaw" turns about the vertical only (both worlds
    have z up), "first" makes the first poses coincide, "none" is the identity. Raises DataError with too few pairs,
    UsageError for an unknown mode.
    """
    if mode not in get_args(Alignment):
        raise UsageError(f"no alignment '{mode}'; there are: {', '.join(get_args(Alignment))}")
    needed = {"none": 0, "first": 1, "yaw": 2}.get(mode, 3)
    if len(pairs) < needed:
        raise DataError(f"alignment {mode} needs {needed} matching poses, got {len(pairs)} of {pairs.total}")
    if mode == "none":
        return np.eye(4)
    if mode == "first":
        if not pairs.has_rotation:
            raise UsageError("alignment first needs rotations, there are positions only; use se3, sim3 or yaw")
        return np.asarray(pairs.reference[0] @ invert(pairs.estimate[0]))
    source, target = pairs.estimate[:, :3, 3], pairs.reference[:, :3, 3]
    if mode == "yaw":
        return _align_yaw(source, target)
    return align_points(source, target, with_scale=mode == "sim3")


def ate(pairs: Pairs) -> dict[str, float]:
    """Return RMSE, mean, median and maximum of the position errors in metres, pairs taken as already aligned."""
    if not len(pairs):
        raise DataError("no poses match in time")
    errors = pairs.position_errors_m()
    return {
        "rmse_m": float(np.sqrt(np.mean(errors**2))),
        "mean_m": float(errors.mean()),
        "median_m": float(np.median(errors)),
        "max_m": float(errors.max()),
    }


def rpe(pairs: Pairs, duration_s: float | None = None, length_m: float | None = None) -> RelativeErrors:
    """Return the errors of relative motion over all segments of a duration, or of a length along the reference.

    A segment ends at the pose closest to the asked duration or length and is left out when that is more than 10 % off.
    The relative motion does not depend on the alignment, except on its scale.
    """
    steps = np.linalg.norm(np.diff(pairs.reference[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate(([0.0], np.cumsum(steps)))[: len(pairs)]
    if duration_s is not None:
        start, end = _segments((pairs.t_ns - pairs.t_ns[:1]).astype(np.float64) * 1e-9, duration_s)
    elif length_m is not None:
        start, end = _segments(distance, length_m)
    else:
        raise UsageError("rpe needs duration_s or length_m")
    Q = invert_many(pairs.reference[start]) @ pairs.reference[end]
    P = invert_many(pairs.estimate[start]) @ pairs.estimate[end]
    error = invert_many(Q) @ P
    return RelativeErrors(
        translation_m=np.linalg.norm(error[:, :3, 3], axis=1),
        rotation_rad=_angles_rad(error[:, :3, :3]),
        length_m=distance[end] - distance[start],
        t_ns=pairs.t_ns[start],
    )


def scale_error(pairs: Pairs) -> float:
    """Return s - 1, s the factor that the estimate must be multiplied with to fit the reference best (Sim3).

    NaN when one of them does not move: there is no scale then. Raises DataError with fewer than 3 pairs.
    """
    for poses in (pairs.estimate, pairs.reference):
        if len(poses) >= 3 and np.ptp(poses[:, :3, 3], axis=0).max() < 1e-9:
            return float("nan")
    return sim3_parts(align(pairs, "sim3"))[0] - 1.0


def gauge_alignment(has_gravity: bool, knows_scale: bool) -> Alignment:
    """Return how a run's trajectories may be moved onto the truth: by what no sensor of it can know.

    With an IMU that found gravity: yaw and position. One camera alone knows no scale either (Sim3).
    Cameras with depth but no IMU do not know which way is up (SE3).
    """
    if has_gravity:
        return "yaw"
    return "se3" if knows_scale else "sim3"


def evaluate(
    estimate: Trajectory,
    truth: Trajectory,
    alignment: Alignment | str = "se3",
    *,
    association: Association = "interpolate",
    span_ns: tuple[int, int] | None = None,
    max_gap_s: float | None = None,
    max_hole_s: float | None = None,
) -> dict[str, Any]:
    """Return the accuracy entry of a run: ATE, RPE over 1 s and over 1, 5, 10 m, scale, coverage, path length.

    `span_ns` is the time of the recording's frames; without it, coverage refers to the whole truth. Limits as in
    `associate` and `coverage`. Numbers that cannot be computed are None: what needs rotations where one of the two has
    positions only. Raises DataError when too few poses match, UsageError for an unknown alignment.
    """
    if alignment not in get_args(Alignment):
        raise UsageError(f"no alignment '{alignment}'; there are: {', '.join(get_args(Alignment))}")
    mode: Alignment = alignment  # type: ignore[assignment]
    pairs = associate(estimate, truth, association, max_gap_s)
    try:
        aligned = pairs.aligned(align(pairs, mode))
        errors = ate(aligned)
    except DataError as error:
        raise DataError(f"{error}; {why_few(pairs, estimate, truth)}") from error
    over_time = _relative(aligned, duration_s=1.0)
    scale = 1.0 + scale_error(pairs) if len(pairs) >= 3 else float("nan")
    return {
        **{f"ate_{name}": value for name, value in errors.items()},
        "rotation_rmse_deg": _rms(np.rad2deg(aligned.rotation_errors_rad())) if pairs.has_rotation else None,
        "alignment": mode,
        "association": association,
        "at": "reference" if pairs.at_reference else "estimate",
        "max_gap_s": pairs.limit_s,
        "max_hole_s": usual_hole_s(estimate) if max_hole_s is None else max_hole_s,
        "scale": float(scale) if np.isfinite(scale) else None,
        "coverage": coverage(estimate, truth, span_ns, max_hole_s),
        "matched": len(pairs),
        "total": pairs.total,
        "rpe_1s_m": over_time["m"],
        "rpe_1s_deg": over_time["deg"],
        "rpe_segments": {f"{length:g}": _relative(aligned, length_m=length) for length in _SEGMENTS_M},
        "path_m": float(np.linalg.norm(np.diff(pairs.reference[:, :3, 3], axis=0), axis=1).sum()),
    }


def are_misordered(
    estimate: Trajectory, truth: Trajectory, association: Association = "interpolate", max_gap_s: float | None = None
) -> bool:
    """Return whether rotations fit each other only with one quaternion's w at the other end; which one cannot be seen.

    In the wrong order a motion turns the inverse way, whatever the frames are.
    """
    pairs = associate(estimate, truth, association, max_gap_s)
    usual_deg = _relative(pairs, duration_s=1.0)["deg"]
    if usual_deg is None or usual_deg < _MISORDERED_DEG:
        return False
    q_xyzw = Rotation.from_matrix(pairs.estimate[:, :3, :3]).as_quat()
    others = [pairs.estimate.copy(), pairs.estimate.copy()]
    for other, shift in zip(others, (-1, 1), strict=True):
        other[:, :3, :3] = Rotation.from_quat(np.roll(q_xyzw, shift, axis=1)).as_matrix()
    found = [_relative(replace(pairs, estimate=other), duration_s=1.0)["deg"] or 0.0 for other in others]
    return min(found) < _MISORDERED_SHARE * usual_deg


def _relative(pairs: Pairs, duration_s: float | None = None, length_m: float | None = None) -> dict[str, float | None]:
    """Return the summary of `rpe`; of none where a rotation is not known, since relative motions are turned by it."""
    return rpe(pairs if pairs.has_rotation else pairs.without_any(), duration_s, length_m).summary()


def _align_yaw(source: Array, target: Array) -> Array:
    """Return the least-squares rotation about z and translation (Zhang and Scaramuzza 2018, section IV-A)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    R = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
    return sim3(1.0, R, target.mean(axis=0) - R @ source.mean(axis=0))


def _segments(along: Array, delta: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return index pairs (start, end) whose difference of the non-decreasing `along` [N] is closest to `delta`."""
    start = np.arange(max(len(along) - 1, 0))
    target = along[start] + delta
    high = np.clip(np.searchsorted(along, target, side="left"), start + 1, len(along) - 1)
    low = np.maximum(np.searchsorted(along, along[np.maximum(high - 1, start)], side="left"), start + 1)
    low = np.minimum(low, high)
    off_low, off_high = np.abs(along[low] - along[start] - delta), np.abs(along[high] - along[start] - delta)
    end = np.where(off_low <= off_high, low, high)
    good = np.minimum(off_low, off_high) <= _SEGMENT_TOLERANCE * delta
    return start[good], end[good]


def _angles_rad(R: Array) -> Array:
    return np.asarray(Rotation.from_matrix(R).magnitude()) if len(R) else np.empty(0)


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
