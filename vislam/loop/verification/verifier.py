"""Geometric verification: whether two views show the same place, and the relative pose if they do.

Matches by descriptor, PnP with RANSAC (the points of one view in the pixels of the other), guided re-matching with
the pose found, refinement on all inliers in both directions. Without points on either side the essential matrix gives
rotation and direction. The covariance is that of the fit, inflated and floored by what TUM's motion capture showed
(`LoopConfig`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import LoopConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert, se3_adjoint, transform
from vislam.core.messages import Array
from vislam.loop.verification.epipolar import relative_direction
from vislam.loop.verification.guided import match_guided
from vislam.loop.verification.likeness import INLIER_PX, INVERSE_DEPTH_SIGMA_1_M, MATCH_MAX_DISTANCE, Likeness, compare
from vislam.loop.verification.relative_pose import Matched, errors, refine
from vislam.loop.view import View
from vislam.vision.locate import pnp
from vislam.vision.ransac import usac

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
        if off_m <= _ALIKE_M:
            return found
        T = transform(np.ascontiguousarray(found.T_a_b[:3, :3]), np.ascontiguousarray(T_guess[:3, 3]))
        T_cams = invert(self._T_body_cam) @ T @ self._T_body_cam
        for radius_px in (_SEARCH_RADIUS_PX, _GUIDED_RADIUS_PX):
            again = self._refine(a, b, T_cams, found.matches, found.inliers, radius_px)
            if again.T_a_b is None or again.supporters < _TWICE * self._config.min_inliers:
                return found
            T_cams = invert(self._T_body_cam) @ again.T_a_b @ self._T_body_cam
        nearer = again.T_a_b is not None and np.linalg.norm(again.T_a_b[:3, 3] - T_guess[:3, 3]) < 0.5 * off_m
        return replace(again, inliers=min(again.inliers, again.supporters)) if nearer else found

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
        if found is None or count < config.min_inliers_direction:
            reason = (
                f"too few matches fit one direction: {count} of {len(pairs)}, "
                f"needs {config.min_inliers_direction} without depth"
            )
            return Verification(reason, len(pairs), count, has_scale=False, pairs=pairs)
        if found.parallax < _MIN_PARALLAX_PX * self._px:
            reason = f"the views are too near: parallax {found.parallax / self._px:.1f} px, needs {_MIN_PARALLAX_PX:g}"
            return Verification(reason, len(pairs), count, has_scale=False, pairs=pairs)
        if found.plane_share > _MAX_PLANE_SHARE:
            reason = f"two directions fit, all is on one plane: {found.plane_share:.0%} of the matches"
            return Verification(reason, len(pairs), count, has_scale=False, pairs=pairs)
        R = self._T_body_cam[:3, :3]
        T_a_b = np.eye(4)
        T_a_b[:3, :3] = R @ found.T_a_b[:3, :3] @ R.T
        T_a_b[:3, 3] = R @ found.T_a_b[:3, 3]  # the lever arm is of unknown size against a unit direction
        turn = np.kron(np.eye(2), R)
        covariance = turn @ found.covariance @ turn.T * config.covariance_inflation
        across = np.eye(3) - np.outer(
            found.T_a_b[:3, :3].T @ found.T_a_b[:3, 3], found.T_a_b[:3, :3].T @ found.T_a_b[:3, 3]
        )
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
    """Return which share of the matches agrees the other way round, and in depth; NaN when too few can tell."""
    forward, reverse, depth = errors(T_a_b, matched)
    both = np.isfinite(matched.points_a[:, 2]) & np.isfinite(matched.points_b[:, 2])
    either = both & (np.fmin(forward, reverse) <= limit)
    if np.count_nonzero(either) < _MIN_AGREEING:
        return float("nan"), float("nan")
    other_way = float(np.mean(np.fmax(forward, reverse)[either] <= 2.0 * limit))
    return other_way, float(np.mean(np.abs(depth[either]) <= limit_inverse_m))
