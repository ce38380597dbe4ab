"""What speaks against a verified pose by itself, whatever other loops say: all that passes is offered to the graph.

Enough inliers alone do not do: what remains wrong after PnP is the right place with a bad pose, or an object that
exists twice. The first shows in its own measurement; which of two places it is, only the graph can tell.
"""

import numpy as np

from vislam.core.angles import angle_between
from vislam.core.messages import Array, LoopDecision
from vislam.loop.verification.verifier import Verification

_MAX_SIGMA_ANY_M = 0.10  # a worse pose is no edge: it can be half a metre off
_MIN_AGREEMENT_SHARE = 0.5  # of matches that also agree the other way round, and in depth
_MAX_TILT_DEG = 5.0  # against gravity; well above the error of a good edge and of the map's own tilt
_MAX_ROTATION_SIGMA_DEG = 2.0  # of an edge without scale
_MAX_DIRECTION_SIGMA_DEG = 5.0  # of its direction


def tilt_error_rad(T_from_to: Array, T_map_from: Array, T_map_to: Array) -> float:
    """Return by how much a relative pose disagrees with gravity, in radians; its heading plays no role.

    Down is known in both keyframes of a gravity-aligned map; the relative rotation must turn one into the other.
    """
    measured = T_from_to[:3, :3] @ T_map_to[2, :3]
    return angle_between(measured, T_map_from[2, :3])


def judge(found: Verification, tilt_rad: float | None) -> tuple[LoopDecision, str]:
    """Return whether a candidate is offered to the graph, by its verification and its tilt (None: unknown), and why."""
    if found.T_a_b is None:
        return LoopDecision.REJECTED, found.reason
    seen = found.reason or f"{found.inliers} inliers, {found.supporters} with guided matching"
    against = objection(found, tilt_rad)
    if against:
        return LoopDecision.REJECTED, f"{against} ({seen})"
    if found.has_scale:
        return LoopDecision.ACCEPTED, f"{seen}, sigma {100.0 * found.sigma_m:.1f} cm"
    return LoopDecision.ACCEPTED, f"{seen}, direction good to {np.rad2deg(found.sigma_m):.1f} deg"


def objection(found: Verification, tilt_rad: float | None) -> str:
    """Return what speaks against a verified pose whatever the neighbours say, or an empty string."""
    if tilt_rad is not None and not np.rad2deg(tilt_rad) <= _MAX_TILT_DEG:
        return f"its pose leans: {np.rad2deg(tilt_rad):.1f} deg off gravity, limit {_MAX_TILT_DEG:g}"
    for name, share in (("the other way round", found.reverse_agreement), ("in depth", found.depth_agreement)):
        if share < _MIN_AGREEMENT_SHARE:
            return f"too few matches agree {name}: {share:.0%}, needs {_MIN_AGREEMENT_SHARE:.0%}"
    if found.has_scale and not found.sigma_m <= _MAX_SIGMA_ANY_M:
        limit_cm = 100.0 * _MAX_SIGMA_ANY_M
        return f"its place is too uncertain: sigma {100.0 * found.sigma_m:.0f} cm, limit {limit_cm:g}"
    if not found.has_scale and found.covariance is not None:
        worst = np.rad2deg(np.sqrt([np.linalg.eigvalsh(found.covariance[:3, :3])[-1], found.sigma_m**2]))
        if not (worst[0] <= _MAX_ROTATION_SIGMA_DEG and worst[1] <= _MAX_DIRECTION_SIGMA_DEG):
            return (
                f"its rotation and direction are too uncertain: {worst[0]:.1f} and {worst[1]:.1f} deg, "
                f"limits {_MAX_ROTATION_SIGMA_DEG:g} and {_MAX_DIRECTION_SIGMA_DEG:g}"
            )
    return ""
