"""Two trajectories brought to the same times, and how much of one the other covers.

Where nothing is given, the limits follow from how often both have a pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.core.geometry import sim3_parts
from vislam.core.messages import Array
from vislam.core.trajectory import Trajectory

Association = Literal["interpolate", "nearest"]

_GAP_S = 0.1  # interpolated across: at most two samples of 20 Hz motion capture, and of slower ones
_NEAREST_S = 0.01  # as evo and the TUM tools, or half the interval of the faster one
_HOLE_S = 1.0  # a longer hole in the estimate counts as not covered, in a slow one 2.5 intervals
_SLOWER = 1.5  # times the estimate's interval, and beyond _GAP_S: a path bends between poses of such a reference


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Poses of an estimate and of a reference at the same times."""

    t_ns: NDArray[np.int64]  # [M]
    estimate: Array  # [M, 4, 4]
    reference: Array  # [M, 4, 4]
    total: int  # poses whose times were asked for, matched or not
    limit_s: float = 0.0  # the longest gap that was interpolated across, or the largest difference in time
    at_reference: bool = False  # whether the reference's poses were asked for, else the estimate's
    has_rotation: bool = True  # of both; else the rotations mean nothing

    def __len__(self) -> int:
        return len(self.t_ns)

    def without_any(self) -> Pairs:
        """Return these pairs with none left."""
        return replace(self, t_ns=self.t_ns[:0], estimate=self.estimate[:0], reference=self.reference[:0])

    def aligned(self, S_reference_estimate: Array) -> Pairs:
        """Return the pairs with the estimate moved into the reference's world by a similarity [4, 4]."""
        scale, R, t = sim3_parts(S_reference_estimate)
        moved = self.estimate.copy()
        moved[:, :3, :3] = R @ self.estimate[:, :3, :3]
        moved[:, :3, 3] = scale * self.estimate[:, :3, 3] @ R.T + t
        return replace(self, estimate=moved)

    def position_errors_m(self) -> Array:
        """Return the distances [M] in metres between estimate and reference as they stand."""
        return np.linalg.norm(self.estimate[:, :3, 3] - self.reference[:, :3, 3], axis=1)

    def rotation_errors_rad(self) -> Array:
        """Return the angles [M] in radians between estimate and reference as they stand."""
        R = self.estimate[:, :3, :3].transpose(0, 2, 1) @ self.reference[:, :3, :3]
        return np.asarray(Rotation.from_matrix(R).magnitude()) if len(R) else np.empty(0)


def associate(
    estimate: Trajectory, reference: Trajectory, method: Association = "interpolate", max_gap_s: float | None = None
) -> Pairs:
    """Pair the poses of two trajectories in time.

    "interpolate" evaluates the reference at the estimate's times, never beyond its ends, nor across gaps of more than
    `max_gap_s` (default: 0.1 s, or two usual intervals). Where it has fewer than 10 poses a second and the estimate
    clearly more, only the pose of the estimate next to each of its own is taken. "nearest" takes the closest pose
    within `max_gap_s` (default: 0.01 s, or half the usual interval of the faster one), led by the shorter one, as evo.
    """
    intervals_s = usual_interval_s(estimate), usual_interval_s(reference)
    has_rotation = estimate.has_rotation and reference.has_rotation
    if method == "nearest":
        limit_s = max(_NEAREST_S, 0.5 * min(intervals_s)) if max_gap_s is None else max_gap_s
        at_reference = len(reference) < len(estimate)
        lead, other = (reference, estimate) if at_reference else (estimate, reference)
        t_ns, own, others = _nearest(lead, other, limit_s)
        poses = (others, own) if at_reference else (own, others)
        return Pairs(t_ns, *poses, len(lead), limit_s, at_reference, has_rotation)
    limit_s = max(_GAP_S, 2.0 * intervals_s[1]) if max_gap_s is None else max_gap_s
    at_reference = intervals_s[1] > max(_GAP_S, _SLOWER * intervals_s[0])
    asked, total = (_next_to(estimate, reference), len(reference)) if at_reference else (estimate, len(estimate))
    return Pairs(*_interpolated(asked, reference, limit_s), total, limit_s, at_reference, has_rotation)


def usual_interval_s(trajectory: Trajectory) -> float:
    """Return the median time between two poses in seconds, 0 where there are fewer than two."""
    return float(np.median(np.diff(trajectory.t_ns))) * 1e-9 if len(trajectory) > 1 else 0.0


def usual_hole_s(estimate: Trajectory) -> float:
    """Return the length in seconds from which on a hole in an estimate counts as not covered, if none is given."""
    return max(_HOLE_S, 2.5 * usual_interval_s(estimate))


def coverage(
    estimate: Trajectory,
    reference: Trajectory,
    span_ns: tuple[int, int] | None = None,
    max_hole_s: float | None = None,
) -> float:
    """Return which share of the time (that of the reference, or of `span_ns` within it) the estimate covers.

    Holes of the estimate longer than `max_hole_s` (default: 1 s, or 2.5 usual intervals of it) in which the reference
    has a pose are not covered.
    """
    if not len(estimate) or not len(reference):
        return 0.0
    first, last = int(reference.t_ns[0]), int(reference.t_ns[-1])
    if span_ns is not None:
        first, last = max(first, span_ns[0]), min(last, span_ns[1])
    if last <= first:
        return 0.0
    steps = np.diff(np.clip(estimate.t_ns, first, last))
    limit_s = usual_hole_s(estimate) if max_hole_s is None else max_hole_s
    begun = np.searchsorted(reference.t_ns, estimate.t_ns[:-1], side="right")
    unseen = begun == np.searchsorted(reference.t_ns, estimate.t_ns[1:], side="left")  # by the reference, too
    held = unseen | (np.diff(estimate.t_ns) <= limit_s * 1e9)
    return float(steps[held].sum() / (last - first))


def spans(estimate: Trajectory, reference: Trajectory) -> str:
    """Return from when to when both last, in words."""
    ends = [
        f"{t.t_ns[0] * 1e-9:.2f} to {t.t_ns[-1] * 1e-9:.2f} s" if len(t) else "nothing" for t in (estimate, reference)
    ]
    return f"the estimate spans {ends[0]}, the reference {ends[1]}"


def why_few(pairs: Pairs, estimate: Trajectory, reference: Trajectory) -> str:
    """Return in words why so few poses of two trajectories match, and the next step."""
    if (
        not len(estimate)
        or not len(reference)
        or (estimate.t_ns[0] > reference.t_ns[-1] or reference.t_ns[0] > estimate.t_ns[-1])
    ):
        return f"{spans(estimate, reference)}, which do not overlap: are both on the same clock?"
    every = [f"{usual_interval_s(t):.3g} s" for t in (estimate, reference)]
    return (
        f"the estimate has a pose every {every[0]}, the reference every {every[1]}, and {pairs.limit_s:.3g} s apart is "
        f"the limit; {spans(estimate, reference)}; a longer --max-gap-s allows more"
    )


def _next_to(estimate: Trajectory, reference: Trajectory) -> Trajectory:
    """Return the poses of an estimate within a slower reference that are next to its own, an interval away at most."""
    inside = (estimate.t_ns >= reference.t_ns[0]) & (estimate.t_ns <= reference.t_ns[-1])
    t_ns, poses = estimate.t_ns[inside], estimate.T_world_body[inside]
    if len(t_ns):
        right = np.clip(np.searchsorted(t_ns, reference.t_ns), 1, max(len(t_ns) - 1, 1)).clip(max=len(t_ns) - 1)
        left = np.maximum(right - 1, 0)
        row = np.where(reference.t_ns - t_ns[left] <= t_ns[right] - reference.t_ns, left, right)
        near = np.abs(t_ns[row] - reference.t_ns) <= usual_interval_s(estimate) * 1e9
        row = np.unique(row[near])
        t_ns, poses = t_ns[row], poses[row]
    return Trajectory(t_ns, poses, estimate.has_rotation)


def _interpolated(lead: Trajectory, other: Trajectory, limit_s: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Return times [M] of `lead`, its poses and those of `other` there."""
    if not len(lead) or not len(other):
        return _nothing()
    times = other.t_ns
    after = np.searchsorted(times, lead.t_ns, side="left")  # the first time not before that of the lead
    inside = (lead.t_ns >= times[0]) & (lead.t_ns <= times[-1])
    after = np.clip(after, 0, len(times) - 1)
    exact = times[after] == lead.t_ns
    gap = times[after] - times[np.maximum(after - 1, 0)]
    chosen = inside & (exact | (gap <= limit_s * 1e9))
    t_ns = lead.t_ns[chosen]
    return t_ns, lead.T_world_body[chosen], other.at(t_ns) if len(t_ns) else np.empty((0, 4, 4))


def _nearest(lead: Trajectory, other: Trajectory, limit_s: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Return times [M] of `lead`, its poses and those of `other` closest to them."""
    if not len(lead) or not len(other):
        return _nothing()
    right = np.clip(np.searchsorted(other.t_ns, lead.t_ns, side="right"), 0, len(other) - 1)
    left = np.maximum(right - 1, 0)
    take_left = np.abs(lead.t_ns - other.t_ns[left]) <= np.abs(other.t_ns[right] - lead.t_ns)
    nearest = np.where(take_left, left, right)
    chosen = np.abs(other.t_ns[nearest] - lead.t_ns) <= round(limit_s * 1e9)
    return lead.t_ns[chosen], lead.T_world_body[chosen], other.T_world_body[nearest[chosen]]


def _nothing() -> tuple[NDArray[np.int64], Array, Array]:
    return np.empty(0, np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4))
