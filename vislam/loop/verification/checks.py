"""What speaks against a verified pose by itself, whatever other loops say: all that passes is offered to the graph.

Enough inliers alone do not do: what remains wrong after PnP is the right place with a bad pose, or an object that
exists twice. The first shows in its own measurement; which of two places it is, only the graph can tell.
"""

from __future__ import annotations

import numpy as np

from vislam.config import LoopConfig
from vislam.core.messages import Array, LoopDecision
from vislam.loop.verification.verifier import Verification


def tilt_error_rad(T_from_to: Array, T_map_from: Array, T_map_to: Array) -> float:
    """Return by how much a relative pose disagrees with gravity, in radians; its heading plays no role.

    Down is known in both keyframes of a gravity-aligned map; the relative rotation must turn one into the other.
    """
    measured = T_from_to[:3, :3] @ T_map_to[2, :3]
    return float(np.arccos(np.clip(measured @ T_map_from[2, :3], -1.0, 1.0)))


def judge(found: Verification, tilt_rad: float | None, config: LoopConfig) -> tuple[LoopDecision, str]:
    """Return whether a candidate is offered to the graph, by its verification and its tilt (None: unknown), and why."""
    if found.T_a_b is None:
        return LoopDecision.REJECTED, found.reason
    seen = found.reason or f"{found.inliers} inliers, {found.supporters} with guided matching"
    against = objection(found, tilt_rad, config)
    if against:
        return LoopDecision.REJECTED, f"{against} ({seen})"
    if found.has_scale:
        return LoopDecision.ACCEPTED, f"{seen}, sigma {100.0 * found.sigma_m:.1f} cm"
    return LoopDecision.ACCEPTED, f"{seen}, direction good to {np.rad2deg(found.sigma_m):.1f} deg"


def objection(found: Verification, tilt_rad: float | None, config: LoopConfig) -> str:
    """Return what speaks against a verified pose whatever the neighbours say, or an empty string."""
    if tilt_rad is not None and not np.rad2deg(tilt_rad) <= config.max_tilt_deg:
        return f"its pose leans: {np.rad2deg(tilt_rad):.1f} deg off gravity, limit {config.max_tilt_deg:g}"
    for name, share in (("the other way round", found.reverse_agreement), ("in depth", found.depth_agreement)):
        if share < config.min_agreement_share:
            return f"too few matches agree {name}: {share:.0%}, needs {config.min_agreement_share:.0%}"
    if found.has_scale and not found.sigma_m <= config.max_sigma_any_m:
        limit_cm = 100.0 * config.max_sigma_any_m
        return f"its place is too uncertain: sigma {100.0 * found.sigma_m:.0f} cm, limit {limit_cm:g}"
    if not found.has_scale and found.covariance is not None:
        worst = np.rad2deg(np.sqrt([np.linalg.eigvalsh(found.covariance[:3, :3])[-1], found.sigma_m**2]))
        if not (worst[0] <= config.max_rotation_sigma_deg and worst[1] <= config.max_direction_sigma_deg):
            return (
                f"its rotation and direction are too uncertain: {worst[0]:.1f} and {worst[1]:.1f} deg, "
                f"limits {config.max_rotation_sigma_deg:g} and {config.max_direction_sigma_deg:g}"
            )
    return ""
