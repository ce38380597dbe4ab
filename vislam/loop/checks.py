"""Whether a verified pose may become an edge, and why: the rule that let no gross error through when measured.

Enough inliers alone do not do: what remains wrong after PnP is the right place with a bad pose, or an object that
exists twice. A small standard deviation, or the agreement of an independent neighbour through odometry, sorts those
out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from vislam.config import LoopConfig
from vislam.geometry import invert, so3_log
from vislam.loop.pose_table import PoseTable
from vislam.loop.verifier import Verification
from vislam.messages import Array, LoopDecision

_REFERENCE_DEPTH_M = 2.0  # the tolerances in metres hold for scenes at this depth and grow with it


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A relative pose that verification found, with the map's poses of both ends at that time."""

    from_id: int
    to_id: int
    T_from_to: Array  # [4, 4]
    has_scale: bool
    median_depth_m: float
    sigma_m: float  # of the translation


@dataclass(frozen=True, slots=True)
class Judgement:
    """A decision and its reason, for people."""

    decision: LoopDecision
    reason: str


def tilt_error_rad(T_from_to: Array, T_map_from: Array, T_map_to: Array) -> float:
    """Return by how much a relative pose disagrees with gravity, in radians; its heading plays no role.

    Down is known in both keyframes of a gravity-aligned map; the relative rotation must turn one into the other.
    """
    measured = T_from_to[:3, :3] @ T_map_to[2, :3]
    return float(np.arccos(np.clip(measured @ T_map_from[2, :3], -1.0, 1.0)))


def agree(one: Measured, other: Measured, poses: PoseTable, config: LoopConfig) -> bool:
    """Return whether two measurements say the same about one pose, going from one to the other through the map's poses.

    With scale, the poses must agree; without, the rotations, and the
    two rays must meet in front of both.
    """
    ends = poses[one.from_id], poses[one.to_id], poses[other.from_id], poses[other.to_id]
    ahead, back, angle_rad, apart_m = _differences(one.T_from_to, other.T_from_to, *ends)
    if not angle_rad <= math.radians(config.agreement_deg):
        return False
    if one.has_scale and other.has_scale:
        depth = np.fmax(_REFERENCE_DEPTH_M, np.fmax(one.median_depth_m, other.median_depth_m))
        both = config.agreement_sigmas * math.hypot(one.sigma_m, other.sigma_m) + config.agreement_slack_m
        return bool(apart_m <= min(config.agreement_m * depth / _REFERENCE_DEPTH_M, both))
    if one.has_scale or other.has_scale:
        return False
    offset = ahead[:3, 3] + ahead[:3, :3] @ other.T_from_to[:3, :3] @ back[:3, 3]
    return _rays_meet(one.T_from_to[:3, 3], offset, ahead[:3, :3] @ other.T_from_to[:3, 3], config.agreement_deg)


@njit(cache=True, nogil=True)
def _differences(
    T_one: Array, T_other: Array, T_map_from: Array, T_map_to: Array, T_map_other_from: Array, T_map_other_to: Array
) -> tuple[Array, Array, float, float]:
    """Return the ways between the first ends and between the last ones [4, 4], and by how many rad and m poses differ.

    Compiled, because a keyframe asks some hundred times.
    """
    ahead = invert(T_map_from) @ T_map_other_from
    back = invert(T_map_other_to) @ T_map_to
    predicted = ahead @ T_other @ back
    turn = so3_log(np.ascontiguousarray(T_one[:3, :3].T) @ np.ascontiguousarray(predicted[:3, :3]))
    return ahead, back, float(np.linalg.norm(turn)), float(np.linalg.norm(T_one[:3, 3] - predicted[:3, 3]))


def _rays_meet(direction: Array, origin: Array, other_direction: Array, limit_deg: float) -> bool:
    """Return whether `s * direction` meets `origin + u * other_direction` for some s, u > 0 within an angle."""
    A = np.stack([direction, -other_direction], axis=1)
    (s, u), _, rank, _ = np.linalg.lstsq(A, origin, rcond=1e-4)
    slack = np.tan(np.deg2rad(limit_deg))
    if rank < 2 or np.linalg.norm(origin) < 1e-9:  # parallel rays: from far away the same direction is all there is
        return bool(direction @ other_direction > np.cos(np.deg2rad(limit_deg)))
    gap = np.linalg.norm(s * direction - origin - u * other_direction)
    return bool(s > 0.0 and u > 0.0 and gap <= slack * max(s, u))


def agrees_with_map(one: Measured, poses: PoseTable, config: LoopConfig) -> bool:
    """Return whether a measurement says what the map says already; without scale, the rotation only."""
    T = invert(poses[one.from_id]) @ poses[one.to_id]
    measured = Measured(one.from_id, one.to_id, T, one.has_scale, one.median_depth_m, one.sigma_m)
    if one.has_scale:
        return agree(one, measured, poses, config)
    return _angle_rad(one.T_from_to, T) <= np.deg2rad(config.agreement_deg)


def objection(found: Verification, tilt_rad: float | None, config: LoopConfig) -> str:
    """Return what speaks against a verified pose whatever the neighbours say, or an empty string."""
    if tilt_rad is not None and not np.rad2deg(tilt_rad) <= config.max_tilt_deg:
        return f"{np.rad2deg(tilt_rad):.1f} deg off gravity, limit {config.max_tilt_deg:g}"
    for name, share in (("the other way round", found.reverse_agreement), ("in depth", found.depth_agreement)):
        if share < config.min_agreement_share:
            return f"only {share:.0%} agree {name}, needs {config.min_agreement_share:.0%}"
    if found.has_scale and not found.sigma_m <= config.max_sigma_any_m:
        return f"sigma {100.0 * found.sigma_m:.0f} cm, limit {100.0 * config.max_sigma_any_m:g}"
    if not found.has_scale and found.covariance is not None:
        worst = np.rad2deg(np.sqrt([np.linalg.eigvalsh(found.covariance[:3, :3])[-1], found.sigma_m**2]))
        if not (worst[0] <= config.max_rotation_sigma_deg and worst[1] <= config.max_direction_sigma_deg):
            return (
                f"rotation and direction good to {worst[0]:.1f} and {worst[1]:.1f} deg only, "
                f"limits {config.max_rotation_sigma_deg:g} and {config.max_direction_sigma_deg:g}"
            )
    return ""


def judge(
    found: Verification, tilt_rad: float | None, agreeing: int, disagreeing: int, config: LoopConfig,
    joined: bool = True,
) -> Judgement:  # fmt: skip
    """Decide about a candidate from its verification, its tilt (None: unknown) and what its neighbours say.

    Unless its keyframes are `joined` by odometry or other loops, it never goes without a witness.
    """
    if found.T_a_b is None:
        return Judgement(LoopDecision.REJECTED, found.reason)
    seen = f"{found.inliers} inliers, {found.supporters} with guided matching"
    against = objection(found, tilt_rad, config)
    if against:
        return Judgement(LoopDecision.REJECTED, f"{seen}, but {against}")
    if found.has_scale:
        seen += f", sigma {100.0 * found.sigma_m:.1f} cm"
    else:
        seen += f", direction good to {np.rad2deg(found.sigma_m):.1f} deg"
    doubt = _doubt(found, agreeing, disagreeing, config, joined)
    if doubt:
        return Judgement(LoopDecision.PARKED, f"{seen}, but {doubt}")
    return Judgement(LoopDecision.ACCEPTED, f"{seen}, {agreeing} of {agreeing + disagreeing} neighbours agree")


def _doubt(found: Verification, agreeing: int, disagreeing: int, config: LoopConfig, joined: bool) -> str:
    """Return why a pose that nothing speaks against has to wait for witnesses, or an empty string."""
    if disagreeing > config.max_disagreeing_share * (agreeing + disagreeing):
        return f"{disagreeing} of {agreeing + disagreeing} neighbours disagree"
    if not found.has_scale:  # never taken alone: wrong matches fit an essential matrix too easily
        needed = config.min_agreeing_direction
        return "" if agreeing >= needed else f"{agreeing} neighbours agree so far, needs {needed} without depth"
    if not joined:
        return "" if agreeing else "no other frame agrees yet on where its piece of trajectory belongs"
    if found.needs_witness and agreeing == 0:
        return "no neighbour agrees yet, and a tag alone can be misread"
    limit = config.max_sigma_m * np.fmax(_REFERENCE_DEPTH_M, found.median_depth_m) / _REFERENCE_DEPTH_M
    if agreeing >= 1 or found.sigma_m <= limit:
        return ""
    return f"that is above {100.0 * limit:.1f} cm and no neighbour agrees yet"


def _angle_rad(T: Array, other: Array) -> float:
    return float(np.linalg.norm(so3_log(np.ascontiguousarray(T[:3, :3].T @ other[:3, :3]))))
