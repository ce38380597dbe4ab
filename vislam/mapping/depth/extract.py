"""What a keyframe can give the map: depth from its sensor, from its second camera, or a few triangulated points.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, as in OpenCV, with its
uniqueness and left-right checks.
"""

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.camera import Camera, Rig, rectify
from vislam.core.errors import DataError
from vislam.core.messages import ImageF32, ImageU8, Keyframe
from vislam.mapping.cloud.store import Scan
from vislam.mapping.depth.image import DepthView, filter_depth, mono_view, rgbd_view, stereo_view
from vislam.mapping.depth.moment import DepthAtImage
from vislam.mapping.semantic.images import LabelRays, checked
from vislam.vision.features import LEAST_USED

_BLOCK_PX = 5
_SUBPIXELS = 16  # OpenCV's fixed-point disparity


class DenseStereo:
    """Matches the two images of a rig into a depth image of the rectified left view."""

    def __init__(self, rig: Rig, config: MapConfig) -> None:
        """Raises DataError when the rig cannot be rectified."""
        self._rectification = rectify(rig, config.stereo_scale)
        self.view: DepthView = stereo_view(self._rectification, rig, config)
        self._focal_baseline = float(self._rectification.K[0, 0] * self._rectification.baseline_m)
        nearest_px = self._focal_baseline / config.min_range_m
        disparities = int(min(np.ceil(nearest_px / 16) * 16, 16 * (self._rectification.size[0] // 48)))
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=max(16, disparities),
            blockSize=_BLOCK_PX,
            P1=8 * _BLOCK_PX**2,
            P2=32 * _BLOCK_PX**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=0,  # filter_depth does it, for every kind of depth
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def uses(self, mask: ImageU8) -> NDArray[np.bool_]:
        """Return which pixels [h, w] of the rectified left view a mask [H, W] of the left image lets be used."""
        small = cv2.resize(mask, self._rectification.size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.remap(small, *self._rectification.maps0, cv2.INTER_LINEAR)) >= LEAST_USED

    def match(self, left: ImageU8, right: ImageU8) -> tuple[NDArray[np.float32], ImageU8]:
        """Return z-depth [h, w] in metres, 0 where not matched, and the rectified left image [h, w]."""
        size = self._rectification.size
        small = [np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8) for image in (left, right)]
        flat_left, flat_right = self._rectification.apply(small[0], small[1])
        disparity = np.asarray(self._matcher.compute(flat_left, flat_right), dtype=np.float32) / _SUBPIXELS
        with np.errstate(divide="ignore"):
            depth_m = np.where(disparity > 0.5, self._focal_baseline / disparity, 0.0)
        return depth_m.astype(np.float32), flat_left


class ScanExtractor:
    """Makes scans of keyframes, the richest that each offers; what it could not use is counted."""

    def __init__(self, config: MapConfig, rig: Rig, one_camera: bool = False) -> None:
        """Prepare for a rig; with `one_camera`, depth comes late, from `late`, and no other depth is used."""
        self._config = config
        self._rig = rig
        self._cameras = rig.cameras
        self._one_camera = one_camera
        stereo = rig.is_stereo and not rig.has_depth and not one_camera
        self._stereo = DenseStereo(rig, config) if stereo else None
        one_camera_view = mono_view(rig, config.mono_depth) if one_camera else rgbd_view(rig, config)
        self.view: DepthView = self._stereo.view if self._stereo else one_camera_view
        self.counters = {"keyframes_dense": 0, "keyframes_sparse": 0, "keyframes_without_depth": 0}

    @property
    def camera(self) -> Camera:
        """The first camera."""
        return self._cameras[0]

    def on_rays(self, labels: NDArray[np.integer]) -> NDArray[np.uint16]:
        """Return labels [H, W] of a first image on the rays [h, w] of the view; raises DataError as `extract`."""
        return self._label_rays.sample(checked(labels, self._cameras[0]))

    @cached_property
    def _label_rays(self) -> LabelRays:
        return LabelRays(self.view, self._rig)

    @cached_property
    def _depth_at_image(self) -> DepthAtImage:
        return DepthAtImage(self._cameras[0])

    def extract(self, keyframe: Keyframe, labels: NDArray[np.integer] | None = None) -> Scan | None:
        """Return the keyframe's scan, or None when nothing of its geometry is known.

        `labels` [H, W] are those of its first image, or of one that is smaller by a whole factor.

        Raises DataError when an image, depth image or labels do not have the size of its camera.
        """
        scan = self._dense(keyframe)
        if scan is not None and labels is not None:
            scan = replace(scan, labels=self.on_rays(labels))
        scan = scan or self._sparse(keyframe, labels)
        if scan is None:
            self.counters["keyframes_without_depth"] += 1
        else:
            self.counters["keyframes_dense" if scan.depth is not None else "keyframes_sparse"] += 1
        return scan

    def late(self, depth_m: ImageF32, image: ImageU8, labels: NDArray[np.uint16] | None = None) -> Scan:
        """Return the scan of depth [h, w] that was made of several images, and of a grey or BGR image of that size.

        `labels` [h, w] are on the view's rays.

        Raises DataError when they do not have the size of the view.
        """
        if image.shape[:2] != depth_m.shape:
            raise DataError(f"image is {image.shape[:2]} but its depth {depth_m.shape}; they must be alike")
        scan = Scan(filter_depth(depth_m, 1, self.view, self._config), None, _rgb(image), labels)
        self.counters["keyframes_dense"] += 1
        return scan

    def _dense(self, keyframe: Keyframe) -> Scan | None:
        frame = keyframe.frame
        if self._stereo is not None:
            if len(frame.images) < 2:
                return None
            for camera, picture in zip(self._cameras[:2], frame.images, strict=False):
                camera.check_image(picture)
            depth_m, grey = self._stereo.match(frame.images[0], frame.images[1])
            if (mask := frame.mask(0)) is not None:
                depth_m = np.where(self._stereo.uses(mask), depth_m, np.float32(0.0))
            return Scan(filter_depth(depth_m, 1, self.view, self._config), None, _rgb(grey))
        if frame.depth_m is None or self._one_camera:
            return None
        image = frame.images[0] if frame.color is None else frame.color
        self._cameras[0].check_image(image)
        depth_m, T_image_depth, sweep = frame.depth_m, keyframe.T_image_depth, keyframe.depth_sweep
        if T_image_depth is not None or sweep is not None:
            depth_m = self._depth_at_image(depth_m, np.eye(4) if T_image_depth is None else T_image_depth, sweep)
        if keyframe.image_sweep is not None:
            image = self._depth_at_image.colors(image, depth_m, keyframe.image_sweep)
        depth = filter_depth(depth_m, self._config.pixel_step, self.view, self._config)
        return Scan(depth, None, _rgb(cv2.resize(image, self.view.size, interpolation=cv2.INTER_AREA)))

    def _sparse(self, keyframe: Keyframe, labels: NDArray[np.integer] | None) -> Scan | None:
        if keyframe.points_body_m is None:
            return None
        known = np.isfinite(keyframe.points_body_m).all(axis=1)
        if not known.any():
            return None
        frame = keyframe.frame
        if not frame.images:
            return None
        image = frame.images[0] if frame.color is None else frame.color
        pixels = np.nan_to_num(np.round(keyframe.keypoints_px[known])).astype(np.int64)
        rows = np.clip(pixels[:, 1], 0, image.shape[0] - 1)
        colors = _rgb(image)[rows, np.clip(pixels[:, 0], 0, image.shape[1] - 1)]
        seen = None if labels is None else self._label_rays.at(checked(labels, self._cameras[0]), pixels)
        return Scan(None, keyframe.points_body_m[known].astype(np.float32), colors, seen)


def _rgb(image: NDArray[np.generic]) -> ImageU8:
    """Return a grey or BGR image as RGB [H, W, 3]."""
    array = np.asarray(image, dtype=np.uint8)
    if array.ndim == 2:
        return np.repeat(array[..., None], 3, axis=2)
    return np.ascontiguousarray(array[..., ::-1])
