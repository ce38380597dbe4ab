"""Depth from a registered depth image."""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.config import FrontEndConfig
from vislam.frontend.depth import DepthReading
from vislam.messages import Array, Frame, ImageF32


class ImageDepth:
    """Reads inverse depth at sub-pixel positions of a depth image.

    Structured light and stereo measure disparity, so the noise is constant in inverse depth: sigma_z = c z^2 (Khoshelham
    and Oude Elberink, Sensors 2012: c = 1.4e-3 /m for the first Kinect).
    """

    def __init__(self, config: FrontEndConfig) -> None:
        """Take range limits and the noise constant from the configuration."""
        self._config = config

    def available(self, frame: Frame) -> bool:
        """Return whether this frame has a depth image."""
        return frame.depth_m is not None

    def measure(self, frame: Frame, pixels: Array, xy: Array, expected_rho: Array) -> DepthReading:
        """Read inverse depth at raw pixels [N, 2]: bilinear, NaN at holes, beyond range and across depth edges."""
        config = self._config
        if frame.depth_m is None:
            rho: Array = np.full(len(pixels), np.nan)
        else:
            rho = _sample(frame.depth_m, pixels, config.min_depth_m, config.max_depth_m, config.depth_edge_rho)
        return DepthReading(rho, np.full(len(pixels), config.depth_sigma_rho))


@njit(cache=True, nogil=True)
def _sample(depth: ImageF32, pixels: Array, nearest: float, farthest: float, edge_rho: float) -> Array:
    """Interpolate 1/depth bilinearly: planes are linear in inverse depth. A neighbourhood with a step gives NaN."""
    height, width = depth.shape
    out = np.full(len(pixels), np.nan)
    for i in range(len(pixels)):
        x, y = pixels[i]
        if not (x >= 1.0 and y >= 1.0 and x < width - 2 and y < height - 2):
            continue
        column, row = int(x), int(y)
        lowest, highest = np.inf, -np.inf
        value, weight = 0.0, 0.0
        for r in range(row - 1, row + 3):
            for c in range(column - 1, column + 3):
                z = float(depth[r, c])
                if not (z >= nearest and z <= farthest):
                    continue
                rho = 1.0 / z
                lowest, highest = min(lowest, rho), max(highest, rho)
                w = max(0.0, 1.0 - abs(c - x)) * max(0.0, 1.0 - abs(r - y))
                value += w * rho
                weight += w
        if weight > 0.25 and highest - lowest <= edge_rho:
            out[i] = value / weight
    return out
