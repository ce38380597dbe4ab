"""Where a camera is in a finished map by its depth alone, from a guess: "near the charging station".

This does not search the map: rooms are full of corners that look alike to a depth camera. It aligns with the keyframes
around the guess from several starts (`vision.depth_alignment`), and answers where nothing speaks against the pose: what
overlaps fits, nothing is seen through, and no other start ends in another place that fits as well.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import are_rigid, invert, invert_many, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array, ImageF32
from vislam.vision.depth_alignment import DepthAlignment, Prior, SeenFrom, align_depth
from vislam.vision.depth_surface import DepthSurface, SurfaceMaker

_NEAREST_M, _FARTHEST_M, _SIGMA_RHO = 0.3, 8.0, 2e-3  # as in a run (`FrontEndConfig`)
_WIDER = 3.0  # times the standard deviations of depth, as frames are placed by it in a run
# beside the noise of depth: what the poses of keyframes, stamps and registration leave, as fr1_desk shows it
_MAP_SIGMA_M, _MAP_SIGMA_RAD = 0.01, np.deg2rad(0.6)
_PARTS = 4  # keyframes around a guess: more see the same
_NEAR_M, _NEAR_RAD = 1.0, np.deg2rad(40.0)  # how far off a keyframe is as far as another is turned away
_FAR = 2.0  # of those distances together: such a keyframe sees something else
_KEPT = 64  # surfaces of keyframes at once, 1 MB each: those of a room
_LEAST_SHARE = 0.3  # of the pixels have depth
_OVERLAP, _AGREEMENT, _SEEN_THROUGH, _RESIDUAL = 0.5, 0.9, 0.04, 1.5
_SAME_M, _SAME_RAD = 0.03, np.deg2rad(1.5)  # two starts that end within this are at one place
_RIVAL = 0.9  # of the best one's score: another place that fits as well as that
_LEAST_STARTS = 3  # that end at the same place


@dataclass(frozen=True, slots=True)
class Guess:
    """Where the camera's body is thought to be in the map, and how far off that may be (standard deviations)."""

    T_map_body: Array  # [4, 4]
    sigma_m: float = 0.3
    sigma_deg: float = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class DepthAnswer:
    """What depth shows of a guess."""

    accepted: bool
    reason: str  # why it was refused; empty otherwise
    T_map_body: Array  # [4, 4]; the guess where nothing could be aligned
    covariance: Array  # [6, 6] of its right perturbation, rotation first: the guess's in undetermined directions
    determined: int  # directions, of six, that depth determines
    undetermined: Array  # [6, 6 - determined] tangents of the body along which only the guess holds it
    overlap: float  # share of the frame's surface that falls on the map's
    agreement: float  # share of what could be compared that fits
    seen_through: float  # share of what was compared that one side looks through
    nearest: int = -1  # of the keyframes as they were added, that whose view is most like the guess's; -1: none is near


class DepthLocaliser:
    """Answers guesses by the depth of a map's keyframes."""

    def __init__(self, camera: Camera, T_body_cam: Array, map_camera: Camera | None = None) -> None:
        """Take the camera that depth is registered to, its place on the body, and that of the map's depth if other."""
        self._T_body_cam = np.asarray(T_body_cam, dtype=np.float64)
        self._maker = SurfaceMaker(camera, _NEAREST_M, _FARTHEST_M, _SIGMA_RHO)
        other = camera if map_camera is None else map_camera
        self._map_maker = SurfaceMaker(other, _NEAREST_M, _FARTHEST_M, _SIGMA_RHO)
        self._T_map_cams: list[Array] = []
        self._depths: list[Callable[[], ImageF32]] = []
        self._surfaces: OrderedDict[int, DepthSurface] = OrderedDict()  # that were asked for last

    def __len__(self) -> int:
        return len(self._depths)

    def add(self, T_map_body: Array, depth_m: ImageF32 | Callable[[], ImageF32]) -> None:
        """Add a keyframe of the map by its pose [4, 4] and depth image [H, W], or what makes it when it is needed.

        One without depth is never asked. Raises DataError for a pose that is not finite, or an image that has not the
        size of the map's camera; for one that is made later, `localise` does.
        """
        T_map_cam = _checked(T_map_body) @ self._T_body_cam
        if callable(depth_m):
            self._depths.append(depth_m)
        else:
            seen = self._map_maker.make(depth_m)
            if seen.share == 0.0:
                return
            image = depth_m
            self._depths.append(lambda: image)
        self._T_map_cams.append(T_map_cam)

    def move(self, index: int, T_map_body: Array) -> None:
        """Put the keyframe that was added as number `index` to another pose [4, 4]."""
        self._T_map_cams[index] = _checked(T_map_body) @ self._T_body_cam

    def localise(self, depth_m: ImageF32, guess: Guess) -> DepthAnswer:
        """Return the pose of a depth image [H, W] near a guess, accepted or refused with the reason.

        Raises DataError when the guess is not a finite pose or the image has not the size of the camera, UsageError
        when the guess is not of positive uncertainty.
        """
        if not (0.0 < guess.sigma_m < np.inf and 0.0 < guess.sigma_deg < np.inf):
            raise UsageError(
                f"a guess may be off by {guess.sigma_m} m and {guess.sigma_deg} deg; both must be more than 0"
            )
        T_map_cam = _checked(guess.T_map_body) @ self._T_body_cam
        sigmas = np.repeat([np.deg2rad(guess.sigma_deg), guess.sigma_m], 3)
        prior = Prior(T_map_cam, np.diag(sigmas**2))
        frame = self._maker.make(depth_m)
        if frame.share < _LEAST_SHARE:
            return self._refused(prior, None, f"only {frame.share:.0%} of the image has depth on surfaces")
        around = self._around(T_map_cam)
        if not around:
            return self._refused(prior, None, "no keyframe of the map is near the guess")
        parts = [SeenFrom(self._surface(k), self._T_map_cams[k]) for k in around]
        found = [
            align_depth(frame, parts, prior, _WIDER * _SIGMA_RHO, T_map_cam @ se3_exp(start))
            for start in _starts(sigmas)
        ]
        best = max(found, key=_score)
        reason = _why_not(best, found)
        return replace(self._answer(best, reason), nearest=around[0])

    def nearest(self, T_map_body: Array) -> int:
        """Return the number of the keyframe whose view is most like that of a body at T_map_body [4, 4]; -1: none is.

        Raises DataError for a pose that is not finite.
        """
        return next(iter(self._around(_checked(T_map_body) @ self._T_body_cam)), -1)

    def _around(self, T_map_cam: Array) -> Sequence[int]:
        """Return the keyframes whose views are most like that of a camera at T_map_cam [4, 4], the most alike first."""
        if not self._T_map_cams:
            return []
        T = invert_many(np.array(self._T_map_cams)) @ T_map_cam
        turned = np.arccos(np.clip(T[:, 2, 2], -1.0, 1.0))
        apart = np.linalg.norm(T[:, :3, 3], axis=1) / _NEAR_M + turned / _NEAR_RAD
        return [int(k) for k in np.argsort(apart, kind="stable")[:_PARTS] if apart[k] <= _FAR]

    def _surface(self, k: int) -> DepthSurface:
        seen = self._surfaces.pop(k, None)
        self._surfaces[k] = self._map_maker.make(self._depths[k]()) if seen is None else seen
        if len(self._surfaces) > _KEPT:
            self._surfaces.popitem(last=False)
        return self._surfaces[k]

    def _refused(self, prior: Prior, found: DepthAlignment | None, reason: str) -> DepthAnswer:
        if found is None:
            found = DepthAlignment(prior.T_model_cam, prior.covariance, 0, np.eye(6), 0.0, 0.0, 0.0, np.inf, False)
        return self._answer(found, reason)

    def _answer(self, found: DepthAlignment, reason: str) -> DepthAnswer:
        adjoint = se3_adjoint(self._T_body_cam)
        of_map = np.diag(np.repeat([_MAP_SIGMA_RAD**2, _MAP_SIGMA_M**2], 3))
        covariance = adjoint @ (found.covariance + of_map) @ adjoint.T
        basis = np.linalg.qr(adjoint @ found.undetermined)[0] if found.undetermined.size else np.empty((6, 0))
        return DepthAnswer(
            not reason, reason, found.T_model_cam @ invert(self._T_body_cam), covariance,
            found.determined, basis, found.overlap, found.agreement, found.seen_through,
        )  # fmt: skip


def _checked(T_map_body: Array) -> Array:
    T = np.asarray(T_map_body, dtype=np.float64)
    if T.shape != (4, 4) or not are_rigid(T, 1e-3):
        raise DataError(f"a pose is a finite rigid transform [4, 4], got {T.shape}; see vislam.core.geometry.transform")
    return T


def _starts(sigmas: Array) -> Array:
    """Return tangents [13, 6] to start from: the guess, and one standard deviation off it along each axis."""
    return np.vstack([np.zeros(6), np.diag(sigmas), -np.diag(sigmas)])


def _score(found: DepthAlignment) -> float:
    return found.overlap * found.agreement * (1.0 - found.seen_through) if found.converged else 0.0


def _why_not(best: DepthAlignment, found: Sequence[DepthAlignment]) -> str:
    """Return why the best of several alignments is not to be trusted, or an empty string."""
    if not best.converged:
        return "the depth does not settle at any pose"
    checks = (
        (best.overlap < _OVERLAP, f"only {best.overlap:.0%} of the depth falls on the map"),
        (best.agreement < _AGREEMENT, f"only {best.agreement:.0%} of what overlaps fits"),
        (best.seen_through > _SEEN_THROUGH, f"{best.seen_through:.0%} of the surfaces are looked through"),
        (best.residual > _RESIDUAL, f"surfaces lie apart by {best.residual:.1f} times what noise explains"),
    )
    reason = next((words for failed, words in checks if failed), "")
    if reason:
        return reason
    same = [_is_same(best, other) for other in found]
    if sum(same) < _LEAST_STARTS:
        return f"only {sum(same)} of {len(found)} starts end there"
    rivals = [o for o, is_same in zip(found, same, strict=True) if not is_same and _score(o) > _RIVAL * _score(best)]
    return f"{len(rivals)} of {len(found)} starts end elsewhere and fit as well" if rivals else ""


def _is_same(best: DepthAlignment, other: DepthAlignment) -> bool:
    """Return whether two alignments are at one place, but for what depth does not determine."""
    if not other.converged:
        return False
    change = se3_log(invert(best.T_model_cam) @ other.T_model_cam)
    change = change - best.undetermined @ (best.undetermined.T @ change)
    return bool(np.linalg.norm(change[:3]) <= _SAME_RAD and np.linalg.norm(change[3:]) <= _SAME_M)
