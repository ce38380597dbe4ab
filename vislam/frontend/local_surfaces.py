"""The surfaces of the last keyframes, and new ones fitted to them: odometry against a small map instead of one frame.

Motions that tracks give since the last keyframe have a new error with each keyframe. Surfaces that several of the last
keyframes saw are fitted again (Newcombe et al., "KinectFusion", ISMAR 2011), so errors do not add up while these are in
view, and bare walls count as well as textured ones. See docs/decisions/013-surfaces-of-the-last-keyframes.md.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera
from vislam.core.geometry import invert, se3_adjoint, se3_exp, se3_log
from vislam.core.messages import Array, Frame, ImageF32, Keyframe, VoMeasurement
from vislam.frontend.exposures import DepthLag
from vislam.frontend.result import body_motion
from vislam.vision.depth_alignment import DepthAlignment, Prior, SeenFrom, align_depth
from vislam.vision.depth_surface import DepthSurface, SurfaceMaker

WIDER = 3.0  # times the standard deviations of depth: errors of its calibration, the same in all images, stay
_AGREEMENT, _SEEN_THROUGH = 0.8, 0.1  # shares of what overlaps: more contradicts, and it is another place
_ROOM = 3.0  # times the standard deviations of tracks, within which surfaces are met: few tracks may be far off
_DOUBTED = 12.6  # chi-square of six, exceeded once in 20: tracks and surfaces contradict each other, ...
_REFUSED = 9.0 * _DOUBTED  # ... and here even if tracks are three times as unsure as they say
_LEAST_SHARE = 0.15  # of the pixels have a surface, or there is nothing to align
_LEAST_OVERLAP = 0.3  # of its surface that falls on those of the last keyframes
# times what surfaces are apart by: the noise of independent samples that would move a pose as much. Depth errs in
# patches, and lens, registration and readout err in common, which leaves no residual. Chosen on fr1_desk, hololens_000
# and a rendered room; 20 to 30 differ little
_ALIKE = 30.0
_LEAST_APART = 0.25  # of what noise explains: so little may be chance
_APART_S = 0.01  # by which the exposure of depth is not known: readout, and velocity that changes


class LocalSurfaces:
    """Owns the surfaces of the last keyframes with depth, each where its depth was taken in the newest keyframe."""

    def __init__(self, config: FrontEndConfig, camera: Camera, T_body_cam: Array) -> None:
        """Take the camera that depth images are registered to, and where it is on the body [4, 4]."""
        self._T_body_cam = T_body_cam
        self._fitted_to = config.local_surfaces
        self._maker = SurfaceMaker(camera, config.min_depth_m, config.max_depth_m, config.depth_sigma_rho)
        self._sigma_rho = config.depth_sigma_rho
        self._newest: tuple[int, _DepthImage | None] = (-1, None)  # by its frame's time
        self._last: tuple[tuple[_DepthImage, Array], ...] = ()  # the newest keyframe's first, in its camera [4, 4]

    @property
    def kept(self) -> tuple[SeenFrom, ...]:
        """The surfaces, the newest keyframe's first, in its camera."""
        return tuple(SeenFrom(depth.surface, T) for depth, T in self._last if depth.surface is not None)

    def of(self, frame: Frame) -> DepthSurface | None:
        """Return the surface that a frame sees; None where it has no depth, or too little."""
        depth = self._depth_of(frame)
        return None if depth is None else depth.surface

    def add(self, keyframe: Keyframe, T_key_new: Array | None) -> None:
        """Take a new keyframe, at T_key_new [4, 4] in the last one; None: nothing ties it to that."""
        T_new_key = None if T_key_new is None else np.asarray(invert(T_key_new))
        last = [] if T_new_key is None else [(depth, np.asarray(T_new_key @ T)) for depth, T in self._last]
        own, T_image_depth = self._depth_of(keyframe.frame), keyframe.T_image_depth
        if own is not None:
            own.take_sweep(keyframe.depth_sweep)
            last.insert(0, (own, np.eye(4) if T_image_depth is None else T_image_depth))
        self._last = tuple([one for one in last if not one[0].is_bare][: max(self._fitted_to, 1)])

    def fitted(
        self, frame: Frame, vo: VoMeasurement, T_key_cam: Array, lag: DepthLag, twist_per_s: Array
    ) -> tuple[VoMeasurement, Array]:
        """Return where tracks and surfaces together put a new keyframe: its body's motion, and its camera [4, 4].

        It is where tracks alone put it where surfaces say nothing, or contradict.

        Args:
            frame: that is to be a keyframe.
            vo: its motion since the last keyframe by tracks.
            T_key_cam: the same [4, 4] of the camera.
            lag: of depth after its image.
            twist_per_s: velocity [6] of the camera in its own frame, rotation first.
        """
        if (depth := self._depth_of(frame)) is None or self._fitted_to == 0:
            return vo, T_key_cam
        depth.take_sweep(lag.sweep(frame, twist_per_s))
        surface, kept = depth.surface, self.kept
        if surface is None or not kept:
            return vo, T_key_cam
        T_image_depth = lag.motion(frame, twist_per_s)
        T_cam_depth = np.eye(4) if T_image_depth is None else T_image_depth
        T_depth_body = np.asarray(invert(self._T_body_cam @ T_cam_depth))
        to_depth, to_body = se3_adjoint(T_depth_body), se3_adjoint(np.asarray(invert(T_depth_body)))
        prior = Prior(np.asarray(T_key_cam @ T_cam_depth), to_depth @ vo.covariance @ to_depth.T + 1e-12 * np.eye(6))
        room = Prior(prior.T_model_cam, _ROOM**2 * prior.covariance)
        found = align_depth(surface, kept, room, WIDER * self._sigma_rho)
        if not found.converged or found.overlap < _LEAST_OVERLAP or not is_alike(found):
            return vo, T_key_cam
        twist = se3_adjoint(np.asarray(invert(T_cam_depth))) @ (_APART_S * twist_per_s)
        change, known, chi2 = _weighed(found, prior, 2.0 * np.outer(twist, twist))
        if chi2 > _REFUSED:
            return vo, T_key_cam
        T_key_cam = np.asarray(prior.T_model_cam @ se3_exp(change) @ invert(T_cam_depth))
        covariance = to_body @ known @ to_body.T
        together = replace(
            vo, T_keyframe_body=body_motion(T_key_cam, self._T_body_cam),
            covariance=0.5 * (covariance + covariance.T), by_surfaces=True,
        )  # fmt: skip
        return together, T_key_cam

    def _depth_of(self, frame: Frame) -> _DepthImage | None:
        if self._newest[0] != frame.t_ns:
            self._newest = frame.t_ns, None if frame.depth_m is None else _DepthImage(frame.depth_m, self._maker)
        return self._newest[1]


class _DepthImage:
    """A depth image whose surface is made once, when it is asked for: with an IMU that is in the dark only."""

    def __init__(self, depth_m: ImageF32, maker: SurfaceMaker) -> None:
        self._depth_m, self._maker = depth_m, maker
        self._sweep: Array | None = None

    def take_sweep(self, sweep: Array | None) -> None:
        """Take the camera's twist [6] from the first to the last row, once it is known."""
        if sweep is not None and self._sweep is None:
            self._sweep = sweep
            vars(self).pop("surface", None)

    @cached_property
    def surface(self) -> DepthSurface | None:
        """What was seen, as of the middle row's time; None where there is too little."""
        made = self._maker.make(self._depth_m)
        if made.share < _LEAST_SHARE:
            return None
        return made if self._sweep is None else made.at_once(self._sweep)

    @property
    def is_bare(self) -> bool:
        """Whether it is known that there is too little."""
        return "surface" in vars(self) and self.surface is None


def is_alike(found: DepthAlignment) -> bool:
    """Return whether what was aligned can be one place: surfaces fall on surfaces, and none is seen through."""
    return found.agreement >= _AGREEMENT and found.seen_through <= _SEEN_THROUGH


def _weighed(found: DepthAlignment, prior: Prior, off: Array) -> tuple[Array, Array, float]:
    """Return what surfaces change [6] of the prior's pose, the covariance [6, 6] then, and by how much both contradict.

    Surfaces were found with _ROOM times the prior's sigmas. Their information, by residuals, is lowered for what errs
    in common, and by `off` [6, 6], the covariance of where depth was taken.
    """
    of_prior, whole = _inverse(prior.covariance), _inverse(found.covariance)
    apart = (_ALIKE * max(found.residual, _LEAST_APART / WIDER)) ** 2
    information = (whole - of_prior / _ROOM**2) / apart
    pull = whole @ se3_log(invert(prior.T_model_cam) @ found.T_model_cam) / apart
    less = np.linalg.inv(np.eye(6) + information @ off)
    information = less @ information
    information = 0.5 * (information + information.T)
    known, change, chi2 = _joined(information, less @ pull, of_prior)
    if chi2 > _DOUBTED:  # surfaces were judged by how they fit; tracks are doubted where both contradict
        known, change, _ = _joined(information, less @ pull, of_prior * _DOUBTED / chi2)
    return change, 0.5 * (known + known.T), chi2


def _inverse(symmetric: Array) -> Array:
    return np.asarray(np.linalg.inv(symmetric), dtype=np.float64)


def _joined(information: Array, pull: Array, of_prior: Array) -> tuple[Array, Array, float]:
    known = _inverse(information + of_prior)
    change: Array = known @ pull
    kept = of_prior @ change  # both pull as much
    chi2 = change @ kept + kept @ np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ kept
    return known, change, float(chi2)
