"""Depth of keyframes from the frames that follow them, each used at its pose between two optimised keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MonoDepthConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import Array, Frame, ImageF32, ImageU8, KeyframePacket, Observations
from vislam.mapping.depth.image import mono_camera
from vislam.mapping.depth.mono.depth_filter import DepthFilter
from vislam.mapping.depth.mono.prior import flat_prior, points_prior
from vislam.trajectory.odometry_keyframe import OdometryKeyframe
from vislam.vision.features import LEAST_USED

_FRAMES_PER_KEYFRAME = 6  # used between two keyframes, the newer one included; bounds the time
_MIN_OVERLAP = 0.5  # of the image that later ones must still see; less, and the next is begun at once
_GRID = 5  # points across and down that show how much of the reference image a camera still sees
_POINT_ERROR_PX = 3.0  # of a track against its epipolar line, in a full image
_POINT_RATIO = 0.3  # sigma of a point's inverse depth over it, if a track is a pixel off


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrame:
    """A frame between two keyframes, at its pose by odometry."""

    t_ns: int
    image: ImageU8  # [H, W] of cam0, as it came
    keyframe_id: int  # the keyframe before it
    T_keyframe_body: Array  # [4, 4] relative to that


@dataclass(frozen=True, slots=True, eq=False)
class LateDepth:
    """What became known of a keyframe after it had been added."""

    keyframe_id: int
    t_ns: int
    T_map_body: Array  # [4, 4], its newest pose
    depth_m: ImageF32  # [h, w] z-depth on the rays of `mono_view`, 0 where unknown
    image: ImageU8  # [h, w] or [h, w, 3] BGR on the same rays


@dataclass(frozen=True, slots=True, eq=False)
class _Reference:
    """A keyframe whose depth is being filtered."""

    keyframe_id: int
    t_ns: int
    image: ImageU8
    filter: DepthFilter
    steps: int  # keyframes since, not counting those at rest


class MonoDepth:
    """Filters the depth of one keyframe after the other; each takes over what the one before it has found."""

    def __init__(self, config: MonoDepthConfig, rig: Rig) -> None:
        """Raises DataError when the camera's image at `config.scale` is too small."""
        self._config = config
        self._camera = rig.cameras[0]
        self._T_body_cam = np.array(rig.T_body_cams[0], dtype=np.float64)
        ideal = mono_camera(rig, config)
        self._K, self._size = ideal.K, (ideal.width, ideal.height)
        small = self._camera.scaled(config.scale)
        self._maps = small.resampling_maps(np.linalg.inv(ideal.K).astype(np.float64), np.eye(3), self._size)
        self._reference: _Reference | None = None
        self._last: OdometryKeyframe | None = None
        self._T_map_last: Array = np.eye(4)
        self._T_map_reference: Array = np.eye(4)
        self.counters = {"depth_references": 0, "depth_frames": 0, "depth_pixels": 0}

    @property
    def reference_id(self) -> int | None:
        """The keyframe that is being filtered."""
        return None if self._reference is None else self._reference.keyframe_id

    def move(self, ids: NDArray[np.int64], T_map_body: Array) -> None:
        """Take over corrected poses [M, 4, 4] of keyframes."""
        for keyframe_id, T in zip(ids.tolist(), T_map_body, strict=True):
            if keyframe_id == self.reference_id:
                self._T_map_reference = np.array(T)
            if self._last is not None and keyframe_id == self._last.packet.keyframe.id:
                self._T_map_last = np.array(T)

    def add(self, keyframe: OdometryKeyframe, T_map_body: Array, seen: list[SeenFrame]) -> LateDepth | None:
        """Take a keyframe and the frames since the one before; return the depth of an earlier one, once it is done.

        Call `move` before, with what the graph made of the keyframe. Raises DataError when an image has not the size
        of its camera.
        """
        done = None
        last, self._last = self._last, keyframe
        T_map_last, self._T_map_last = self._T_map_last, np.array(T_map_body, dtype=np.float64)
        if not keyframe.packet.keyframe.frame.images:
            return None
        if keyframe.packet.begins_submap or last is None:
            done = self._finished()
            self._begin(keyframe.packet, None)
            return done
        motion = _Motion(last, T_map_last, keyframe, self._T_map_last)
        if self._reference is None:
            return None
        self._feed(motion, seen, keyframe.packet.keyframe.frame)
        if self._is_done():
            prior = self._prior(last.packet.observations, keyframe.packet.observations, motion)
            old = self._reference.filter
            T_ref_next = self._in_camera(invert(self._T_map_reference) @ self._T_map_last)
            done = self._finished()
            self._begin(keyframe.packet, old.hand_over(T_ref_next, prior))
        return done

    def _begin(self, packet: KeyframePacket, prior: tuple[ImageF32, ImageF32] | None) -> None:
        frame = packet.keyframe.frame
        grey = self._seen_ideally(frame.images[0])
        image = grey if frame.color is None else self._seen_ideally(frame.color)
        if (mask := frame.mask(0)) is not None:
            rho, sigma = prior or flat_prior(grey.shape, self._config)
            prior = np.where(self._seen_ideally(mask) >= LEAST_USED, rho, np.float32(0.0)), sigma
        self._reference = _Reference(
            packet.keyframe.id, packet.keyframe.t_ns, image, DepthFilter(grey, self._K, self._config, prior), 0
        )
        self._T_map_reference = self._T_map_last
        self.counters["depth_references"] += 1

    def _feed(self, motion: _Motion, seen: list[SeenFrame], newest: Frame) -> None:
        """Give the filter some of the frames between two keyframes, and the newer keyframe itself."""
        reference = self._reference
        assert reference is not None
        T_ref_last = invert(self._T_map_reference) @ motion.T_map_from
        usable = [frame for frame in seen if frame.keyframe_id == motion.from_id and frame.t_ns < motion.to_t_ns]
        wanted = min(_FRAMES_PER_KEYFRAME - 1, len(usable))
        chosen = [usable[(i + 1) * len(usable) // (wanted + 1)] for i in range(wanted)]
        images = [(frame.image, motion.at(frame.t_ns, frame.T_keyframe_body)) for frame in chosen]
        for image, T_last_body in [*images, (newest.images[0], motion.T_from_to)]:
            T_ref_cam = self._in_camera(T_ref_last @ T_last_body)
            reference.filter.update(self._seen_ideally(image), T_ref_cam)
            self.counters["depth_frames"] += 1
        self._reference = replace(reference, steps=reference.steps + (not motion.at_rest))

    def _is_done(self) -> bool:
        """Return whether the reference has been followed for long enough, or is hardly in view any more."""
        reference = self._reference
        assert reference is not None
        if reference.steps >= self._config.keyframes:
            return True
        T_cur_ref = invert(self._in_camera(invert(self._T_map_reference) @ self._T_map_last))
        width, height = self._size
        u, v = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
        rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ np.linalg.inv(self._K).T
        points = rays @ T_cur_ref[:3, :3].T + T_cur_ref[:3, 3] * reference.filter.typical_rho
        pixels = points @ self._K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = pixels[:, :2] / pixels[:, 2:]
            inside = (points[:, 2] > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels < self._size).all(axis=1)
        return bool(inside.mean() < _MIN_OVERLAP)

    def _finished(self) -> LateDepth | None:
        reference, self._reference = self._reference, None
        if reference is None:
            return None
        depth_m = reference.filter.depth_m()
        known = int(np.count_nonzero(depth_m))
        self.counters["depth_pixels"] += known
        if known == 0:
            return None
        return LateDepth(reference.keyframe_id, reference.t_ns, self._T_map_reference, depth_m, reference.image)

    def _prior(self, before: Observations, now: Observations, motion: _Motion) -> tuple[ImageF32, ImageF32]:
        """Return the depth around points that were tracked from the keyframe before to this one."""
        shape = self._size[::-1]
        _, i, j = np.intersect1d(before.track_ids, now.track_ids, return_indices=True)
        if len(i) == 0:
            return flat_prior(shape, self._config)
        here, there = self._camera.normalise(now.pixels_px[j]), self._camera.normalise(before.pixels_px[i])
        rho, good = triangulated(here, there, self._in_camera(motion.T_from_to), 1.0 / self._camera.fx)
        pixels = np.column_stack([here, np.ones(len(here))]) @ self._K.T
        return points_prior(shape, pixels[good, :2], rho[good], self._config)

    def _in_camera(self, T_body: Array) -> Array:
        """Return a motion of the body as one of the camera."""
        return np.asarray(invert(self._T_body_cam) @ T_body @ self._T_body_cam)

    def _seen_ideally(self, image: ImageU8) -> ImageU8:
        """Return an image as the ideal, smaller camera would see it."""
        self._camera.check_image(image)
        small = image
        if self._config.scale != 1.0:
            small = np.asarray(cv2.resize(image, self._size, interpolation=cv2.INTER_AREA), np.uint8)
        return np.asarray(cv2.remap(small, *self._maps, cv2.INTER_LINEAR), np.uint8)


class _Motion:
    """The way from a keyframe to the next: by odometry in between, corrected so that it ends where the graph has it."""

    def __init__(self, start: OdometryKeyframe, T_map_start: Array, end: OdometryKeyframe, T_map_end: Array) -> None:
        self.from_id, self.to_t_ns = start.packet.keyframe.id, end.packet.keyframe.t_ns
        self.T_map_from = T_map_start
        self.T_from_to = np.asarray(invert(T_map_start) @ T_map_end)
        self.at_rest = end.packet.at_rest
        self._from_t_ns = start.packet.keyframe.t_ns
        by_odometry = invert(start.T_odom_body) @ end.T_odom_body
        self._correction = se3_log(np.ascontiguousarray(invert(by_odometry) @ self.T_from_to))

    def at(self, t_ns: int, T_from_body: Array) -> Array:
        """Return the corrected pose [4, 4], relative to the first keyframe, of a frame in between."""
        share = (t_ns - self._from_t_ns) / max(self.to_t_ns - self._from_t_ns, 1)
        return np.asarray(T_from_body @ se3_exp(share * self._correction))


def triangulated(here: Array, there: Array, T_there_here: Array, pixel: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return inverse z-depth [N] of points seen at `here` and `there` [N, 2], normalised, and which of them are good.

    Least squares of the error in the second image; good are those that lie in front, near their epipolar lines, with
    enough parallax. `pixel` is the size of one in normalised coordinates.
    """
    q = np.column_stack([here, np.ones(len(here))]) @ T_there_here[:3, :3].T
    t = T_there_here[:3, 3]
    c, d = t[:2] - there * t[2], there * q[:, 2:] - q[:, :2]
    square = np.sum(c * c, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.sum(c * d, axis=1) / square
        z = q[:, 2] + t[2] * rho
        error = np.linalg.norm(d - c * rho[:, None], axis=1) / np.abs(z)
        sigma = pixel / np.sqrt(square)
        good = (rho > 0.0) & (z > 0.0) & (error < _POINT_ERROR_PX * pixel) & (sigma < _POINT_RATIO * rho)
    return rho, good
