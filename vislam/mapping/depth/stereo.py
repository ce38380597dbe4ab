"""Dense depth of a stereo keyframe: semi-global matching on the rectified, reduced pair.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, as in OpenCV, with its
uniqueness and left-right checks.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MapConfig
from vislam.core.camera import Rig, rectify
from vislam.core.messages import ImageU8
from vislam.mapping.depth.image import DepthView, stereo_view
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
