"""Geometric verification: whether two views show the same place, and the relative pose if they do.

Matches by descriptor, PnP with RANSAC (the points of one view in the pixels of the other), guided re-matching with
the pose found, refinement on all inliers in both directions. Without points on either side the essential matrix gives
rotation and direction. The covariance is that of the fit, inflated and floored by what TUM's motion capture showed
(`LoopConfig`).
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.core.angles import angle_between
from vislam.core.camera import Rig
from vislam.core.geometry import invert, se3_adjoint, transform
from vislam.core.messages import Array, LoopDecision, LoopEdge
from vislam.loop.verification.guided import match_guided
from vislam.loop.verification.likeness import (
    INLIER_PX,
    INVERSE_DEPTH_SIGMA_1_M,
    MATCH_MAX_DISTANCE,
    Likeness,
    compare,
    repeated_step,
)
from vislam.loop.verification.relative_pose import Matched, errors, refine
from vislam.loop.view import View
from vislam.vision.locate import pnp
from vislam.vision.two_view import epipolar_distances, essential_ransac, refine_two_view

_GUIDED_RADIUS_PX = 8.0  # search around a point's predicted place once a pose is known
_SEARCH_RADIUS_PX = 24.0  # and where only its turn is known
_ALIKE_M = 0.25  # farther from where the map has it, a second place may fit
_TWICE = 2  # times the inliers that a pose needs: those that PnP found fit one pose without any guess
# of a keypoint; only its ratio to the depth sigma matters, residuals set the scale
_FEATURE_SIGMA_PX = 1.0
_EPIPOLAR_PX = 1.5  # Sampson error of an inlier where no depth is known
_MIN_PARALLAX_PX = 6.0  # median that rotation does not explain; less, and the direction is noise
_MAX_PLANE_SHARE = 0.8  # of the matches; a plane seen twice fits two directions (one was wrong by 109 deg)
_DIRECTION_FLOOR_DEG = 2.0  # of a direction without scale: the lever arm of the camera is not in it
_MIN_PNP_POINTS = 6  # P3P needs four; two more let RANSAC mean something
_PNP_TRIES = 300  # finds 12 inliers among 50 matches with 0.98; more mostly prolongs the search in vain
_PNP_LOCAL_TRIES = 1  # OpenCV's five find the same inliers in twice the time; the pose is refined here afterwards
_MIN_AGREEING = 8  # matches with two points before their agreement is judged
_REFINE_PASSES = 2  # guided matching, then once more with the better pose
_MIN_MATCHES = 8
_TRIES = 400  # find 25 inliers among 60 matches with 0.99; more mostly prolong the search in vain
_CAUCHY = 2.0  # in sigmas
_LIMIT_SIGMAS = 3.0  # of an inlier
_MEDIAN_CHI2_1 = 0.4549  # median of chi-square with one degree of freedom
_BOTH_ENDS = 2.0**0.5  # a keypoint is as noisy in one view as in the other
_CONFIDENCE = 0.999
_MAX_SIGMA_ANY_M = 0.10  # a worse pose is no edge: it can be half a metre off
_MIN_AGREEMENT_SHARE = 0.5  # of matches that also agree the other way round, and in depth
_MAX_TILT_DEG = 5.0  # against gravity; well above the error of a good edge and of the map's own tilt
_MAX_ROTATION_SIGMA_DEG = 2.0  # of an edge without scale
_MAX_DIRECTION_SIGMA_DEG = 5.0  # of its direction


def usac(threshold: float, tries: int, seed: int, local_tries: int | None = None) -> Any:
    """Return OpenCV's settings for an inlier's `threshold` on z = 1 and a largest number of tries.

    `local_tries` refine each new best one; None leaves OpenCV's number.
    """
    settings = cv2.UsacParams()
    settings.randomGeneratorState = seed % 2**31
    settings.threshold = threshold
    settings.confidence = _CONFIDENCE
    settings.maxIterations = tries
    settings.sampler = cv2.SAMPLING_UNIFORM
    settings.score = cv2.SCORE_METHOD_MSAC
    settings.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    if local_tries is not None:
        settings.loIterations = local_tries
    settings.isParallel = False
    return settings


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Rotation and unit direction between two cameras."""

    T_a_b: Array  # [4, 4], translation of length 1
    covariance: Array  # [6, 6] of the fit, perturbed in b, singular along the direction
    inliers: NDArray[np.bool_]  # [N]
    parallax: float  # median displacement of the inliers that rotation does not explain, on z = 1
    plane_share: float  # of the inliers that one plane explains; near 1, two directions fit equally well


def relative_direction(xy_a: Array, xy_b: Array, limit: float, seed: int) -> Direction | None:
    """Return rotation and direction from matches [N, 2] on z = 1 with inlier `limit` there; None when there is none."""
    start = essential_ransac(None, xy_a, xy_b, limit, _MIN_MATCHES, usac(limit, _TRIES, seed))
    if start is None:
        return None
    R, direction, inliers = start
    seen = np.where(inliers[:, None], xy_b, np.nan)
    sigma = _BOTH_ENDS * limit / _LIMIT_SIGMAS
    found = refine_two_view(R, direction, xy_a, seen, sigma, _CAUCHY)
    inliers = found.inliers
    if not found.converged or np.count_nonzero(inliers) < _MIN_MATCHES:
        return None
    R, in_b = found.R_key_cam, np.eye(6)
    T_a_b = np.asarray(transform(R, found.direction_key))
    in_b[3:, 3:] = R.T
    turned = np.column_stack([xy_b[inliers], np.ones(np.count_nonzero(inliers))]) @ R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.linalg.norm(turned[:, :2] / turned[:, 2:] - xy_a[inliers], axis=1)
    plane = _plane_share(xy_a[inliers], xy_b[inliers], 2.0 * limit, seed)
    # most keypoints scatter less than the limit, which is made for the worst of them
    scatter = np.median(epipolar_distances(T_a_b, xy_a, seen)[inliers] ** 2) / (_MEDIAN_CHI2_1 * sigma**2)
    covariance = found.covariance * scatter / max(1.0, found.variance)
    return Direction(T_a_b, in_b @ covariance @ in_b.T, inliers, float(np.nanmedian(shift)), plane)


def _plane_share(xy_a: Array, xy_b: Array, limit: float, seed: int) -> float:
    """Return the largest share of matches [N, 2] that one homography explains."""
    try:
        _, mask = cv2.findHomography(xy_a, xy_b, usac(limit, _TRIES, seed))
    except cv2.error:  # degenerate samples only
        return 1.0
    return 1.0 if mask is None else float(np.mean(mask.ravel() > 0))


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """What verification of an older view a against a newer view b found."""

    reason: str  # why there is no pose; with one, by what it was found, where that was not matches
    matches: int
    inliers: int = 0  # of RANSAC, before guided matching: what the acceptance rule counts
    supporters: int = 0  # matches that agree with the refined pose, guided ones included
    T_a_b: Array | None = None  # [4, 4] body to body
    covariance: Array | None = None  # [6, 6] of T_a_b, rotation first, perturbed in b
    has_scale: bool = True
    sigma_m: float = float("nan")  # largest standard deviation of the translation; of the unit direction without scale
    reverse_agreement: float = float("nan")  # share of matches that also agree the other way round; NaN: none could
    depth_agreement: float = float("nan")  # share of matches with two depths whose depths agree; NaN: too few
    pairs: NDArray[np.int64] | None = None  # [M, 2] features of a and b that agree with the pose; without one, matched

    def edge(self, number: int, from_id: int, to_id: int, score: float) -> LoopEdge:
        """Return the pose that was found as an edge."""
        assert self.T_a_b is not None and self.covariance is not None
        return LoopEdge(number, from_id, to_id, self.T_a_b, self.covariance, self.has_scale, self.inliers, score)


class Verifier:
    """Verifies pairs of views; holds only configuration and calibration."""

    def __init__(self, config: LoopConfig, rig: Rig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._T_body_cam: Array = rig.T_body_cams[0]
        camera = rig.cameras[0]
        self._px = 2.0 / (camera.fx + camera.fy)  # one pixel on the plane z = 1

    def compare(self, a: View, b: View) -> Likeness:
        """Match an older view a with a newer view b and say whether they are worth verifying."""
        return compare(a, b, self._config, self._px)

    def verify(self, a: View, b: View, known: Likeness | None = None, T_guess: Array | None = None) -> Verification:
        """Verify an older view a against a newer view b, whose likeness may be known; deterministic for a pair.

        `T_guess` [4, 4] is where the map has the body at b, as seen from the body at a; None: it does not know.
        """
        config = self._config
        pairs = (known or self.compare(a, b)).pairs
        if len(pairs) < config.min_inliers:
            return Verification(f"too few matches: {len(pairs)}, needs {config.min_inliers}", len(pairs), pairs=pairs)
        if not a.has_points and not b.has_points:
            if len(pairs) < config.min_inliers_direction:
                reason = f"too few matches: {len(pairs)}, needs {config.min_inliers_direction} without depth"
                return Verification(reason, len(pairs), has_scale=False, pairs=pairs)
            return self._verify_direction(a, b, pairs)
        found = self._pnp(a, b, pairs)
        if found is None or found[1] < config.min_inliers:
            count = 0 if found is None else found[1]
            reason = f"too few matches fit one pose: {count} of {len(pairs)}, needs {config.min_inliers}"
            return Verification(reason, len(pairs), count, pairs=pairs)
        verified = self._refine(a, b, found[0], len(pairs), found[1])
        return verified if T_guess is None else self._nearest(a, b, verified, T_guess)

    def _nearest(self, a: View, b: View, found: Verification, T_guess: Array) -> Verification:
        """Return what fits nearest to where the map has it: a wall of equal panels fits one panel further as well."""
        if found.T_a_b is None:
            return found
        off_m = float(np.linalg.norm(found.T_a_b[:3, 3] - T_guess[:3, 3]))
        return found if off_m <= _ALIKE_M else self._fitting(a, b, found, T_guess[:3, 3], 0.5 * off_m) or found

    def rivals(self, a: View, b: View, found: Verification) -> list[Verification]:
        """Return what fits one step further along or back as well, where the older view looks like itself there."""
        step = None if found.T_a_b is None else repeated_step(a, self._px, self._config.min_inliers)
        if step is None or found.T_a_b is None or not found.has_scale:
            return []
        t, step_m = found.T_a_b[:3, 3], self._T_body_cam[:3, :3] @ step
        fits = [
            self._fitting(a, b, found, t + sign * step_m, 0.5 * float(np.linalg.norm(step))) for sign in (-1.0, 1.0)
        ]
        return [one for one in fits if one is not None]

    def _fitting(self, a: View, b: View, found: Verification, t_m: Array, reach_m: float) -> Verification | None:
        """Return what fits within a reach of another translation [3] than the one found; None: nothing does."""
        assert found.T_a_b is not None
        T = transform(np.ascontiguousarray(found.T_a_b[:3, :3]), np.ascontiguousarray(t_m))
        T_cams = invert(self._T_body_cam) @ T @ self._T_body_cam
        for radius_px in (_SEARCH_RADIUS_PX, _GUIDED_RADIUS_PX):
            again = self._refine(a, b, T_cams, found.matches, found.inliers, radius_px)
            if again.T_a_b is None or again.supporters < _TWICE * self._config.min_inliers:
                return None
            T_cams = invert(self._T_body_cam) @ again.T_a_b @ self._T_body_cam
        is_near = again.T_a_b is not None and np.linalg.norm(again.T_a_b[:3, 3] - t_m) < reach_m
        return replace(again, inliers=min(again.inliers, again.supporters)) if is_near else None

    def _pnp(self, a: View, b: View, pairs: NDArray[np.int64]) -> tuple[Array, int] | None:
        """Return T_a_b [4, 4] of the cameras and its inliers, from the side that knows more matched points."""
        a_to_b = np.count_nonzero(a.known[pairs[:, 0]]) >= np.count_nonzero(b.known[pairs[:, 1]])
        if a_to_b:
            points, xy = a.points_or_nan()[pairs[:, 0]], b.xy[pairs[:, 1]]
        else:
            points, xy = b.points_or_nan()[pairs[:, 1]], a.xy[pairs[:, 0]]
        if np.count_nonzero(np.isfinite(points[:, 2])) < max(_MIN_PNP_POINTS, self._config.min_inliers):
            return None
        threshold = INLIER_PX * self._px
        search = usac(threshold, _PNP_TRIES, self._pair_seed(a, b), _PNP_LOCAL_TRIES)
        found = pnp(points, xy.astype(np.float64), threshold, search)
        if found is None:
            return None
        return (invert(found[0]) if a_to_b else found[0]), found[1]

    def _refine(
        self, a: View, b: View, T_a_b: Array, matches: int, inliers: int, radius_px: float = _GUIDED_RADIUS_PX
    ) -> Verification:
        config = self._config
        radius, limit = radius_px * self._px, INLIER_PX * self._px
        sigma_xy = _FEATURE_SIGMA_PX * self._px
        refined, matched = None, Matched(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2)))
        support, agreeing = matched, np.empty(0, np.bool_)
        pairs = np.empty((0, 2), np.int64)
        for _ in range(_REFINE_PASSES):
            pairs = match_guided(a, b, T_a_b, radius, MATCH_MAX_DISTANCE)
            matched = Matched(
                a.points_or_nan()[pairs[:, 0]],
                b.points_or_nan()[pairs[:, 1]],
                a.xy[pairs[:, 0]].astype(np.float64),
                b.xy[pairs[:, 1]].astype(np.float64),
            )
            support = matched.take(_agreeing(T_a_b, matched, 2.0 * limit))
            refined = refine(T_a_b, support, sigma_xy, INVERSE_DEPTH_SIGMA_1_M) if len(support) else None
            if refined is None:
                return Verification("the matches do not determine a pose", matches, inliers, pairs=pairs)
            T_a_b = refined.T_a_b
            agreeing = _agreeing(T_a_b, matched, limit)
            support = matched.take(agreeing)
        if len(support) < config.min_inliers or refined is None:
            reason = f"too few matches fit the refined pose: {len(support)}, needs {config.min_inliers}"
            return Verification(reason, matches, inliers, len(support), pairs=pairs)
        covariance_cam = self._covariance(refined.information, refined.variance_scale)
        adjoint = se3_adjoint(self._T_body_cam)
        covariance = adjoint @ covariance_cam @ adjoint.T
        reverse, depth = _agreements(T_a_b, matched, limit, 3.0 * INVERSE_DEPTH_SIGMA_1_M)
        return Verification(
            reason="",
            matches=matches,
            inliers=inliers,
            supporters=len(support),
            T_a_b=self._T_body_cam @ T_a_b @ invert(self._T_body_cam),
            covariance=0.5 * (covariance + covariance.T),
            sigma_m=float(np.sqrt(np.linalg.eigvalsh(covariance_cam[3:, 3:])[-1])),
            reverse_agreement=reverse,
            depth_agreement=depth,
            pairs=pairs[agreeing],
        )

    def _covariance(self, information: Array, variance_scale: float) -> Array:
        """Return the covariance [6, 6] of the camera's relative pose: that of the fit, inflated, above the floor."""
        config = self._config
        fit = np.linalg.inv(information) * max(variance_scale, 0.25) * config.covariance_inflation
        floor_rad = np.deg2rad(config.sigma_floor_deg)
        return np.asarray(fit + np.diag([floor_rad**2] * 3 + [config.sigma_floor_m**2] * 3), dtype=np.float64)

    def _verify_direction(self, a: View, b: View, pairs: NDArray[np.int64]) -> Verification:
        """Verify without points: rotation and direction only; more inliers, since wrong matches agree easily."""
        config = self._config
        xy_a, xy_b = a.xy[pairs[:, 0]].astype(np.float64), b.xy[pairs[:, 1]].astype(np.float64)
        found = relative_direction(xy_a, xy_b, _EPIPOLAR_PX * self._px, self._pair_seed(a, b))
        count = 0 if found is None else int(np.count_nonzero(found.inliers))
        reason = ""
        if found is None or count < config.min_inliers_direction:
            reason = f"{count} of {len(pairs)}, needs {config.min_inliers_direction} without depth"
            reason = f"too few matches fit one direction: {reason}"
        elif found.parallax < _MIN_PARALLAX_PX * self._px:
            reason = f"the views are too near: parallax {found.parallax / self._px:.1f} px, needs {_MIN_PARALLAX_PX:g}"
        elif found.plane_share > _MAX_PLANE_SHARE:
            reason = f"two directions fit, all is on one plane: {found.plane_share:.0%} of the matches"
        if reason or found is None:
            return Verification(reason, len(pairs), count, has_scale=False, pairs=pairs)
        R = self._T_body_cam[:3, :3]
        T_a_b = np.eye(4)
        T_a_b[:3, :3] = R @ found.T_a_b[:3, :3] @ R.T
        T_a_b[:3, 3] = R @ found.T_a_b[:3, 3]  # the lever arm is of unknown size against a unit direction
        turn = np.kron(np.eye(2), R)
        covariance = turn @ found.covariance @ turn.T * config.covariance_inflation
        in_b = found.T_a_b[:3, :3].T @ found.T_a_b[:3, 3]
        across = np.eye(3) - np.outer(in_b, in_b)
        covariance[:3, :3] += np.eye(3) * np.deg2rad(config.sigma_floor_deg) ** 2
        covariance[3:, 3:] += R @ across @ R.T * np.deg2rad(_DIRECTION_FLOOR_DEG) ** 2
        return Verification(
            reason="",
            matches=len(pairs),
            inliers=count,
            supporters=count,
            T_a_b=T_a_b,
            covariance=0.5 * (covariance + covariance.T),
            has_scale=False,
            sigma_m=float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])),
            pairs=pairs[found.inliers],
        )

    def _pair_seed(self, a: View, b: View) -> int:
        return (self._seed * 1_000_003 + a.id * 8191 + b.id) % 2**31


def _agreeing(T_a_b: Array, matched: Matched, limit: float) -> NDArray[np.bool_]:
    """Return which matches reproject within `limit` in every direction that has a point."""
    forward, reverse, _ = errors(T_a_b, matched)
    return np.asarray(np.nan_to_num(np.fmax(forward, reverse), nan=np.inf) <= limit, dtype=np.bool_)


def _agreements(T_a_b: Array, matched: Matched, limit: float, limit_inverse_m: float) -> tuple[float, float]:
    """Return which share of the matches agrees the other way round, and in depth; NaN when too few have depth."""
    forward, reverse, depth = errors(T_a_b, matched)
    both = np.isfinite(matched.points_a[:, 2]) & np.isfinite(matched.points_b[:, 2])
    either = both & (np.fmin(forward, reverse) <= limit)
    if np.count_nonzero(either) < _MIN_AGREEING:
        return float("nan"), float("nan")
    other_way = float(np.mean(np.fmax(forward, reverse)[either] <= 2.0 * limit))
    return other_way, float(np.mean(np.abs(depth[either]) <= limit_inverse_m))


def tilt_error_rad(T_from_to: Array, T_map_from: Array, T_map_to: Array) -> float:
    """Return by how much a relative pose disagrees with gravity, in radians; its heading plays no role.

    Down is known in both keyframes of a gravity-aligned map; the relative rotation must turn one into the other.
    """
    measured = T_from_to[:3, :3] @ T_map_to[2, :3]
    return angle_between(measured, T_map_from[2, :3])


def judge(found: Verification, tilt_rad: float | None) -> tuple[LoopDecision, str]:
    """Return whether a candidate is offered to the graph, by its verification and its tilt (None: unknown), and why.

    Enough inliers alone do not do: what remains wrong after PnP is the right place with a bad pose, or an object that
    exists twice. The first shows in its own measurement; which of two places it is, only the graph can decide.
    """
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
