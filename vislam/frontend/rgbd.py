"""Depth from a registered depth image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.jit import njit
from vislam.core.messages import Array, Frame, ImageF32
from vislam.frontend.depth import DepthReading
from vislam.frontend.tracker import given_rows

_REACH_PX = 4  # half the side of the neighbourhood that says how much a wrong registration would matter


class ImageDepth:
    """Reads inverse depth at sub-pixel positions of a depth image.

    Structured light and stereo measure disparity, so the noise is constant in inverse depth: sigma_z = c z^2
    (Khoshelham and Oude Elberink, Sensors 2012: c = 1.4e-3 /m for the first Kinect). Depth and colour are exposed at
    different times, up to 15 px apart when the camera turns; so where the neighbourhood is not flat, sigma grows with
    its spread.
    """

    every_frame = True

    def __init__(self, config: FrontEndConfig) -> None:
        """Take range limits and the noise model from the configuration."""
        self._config = config

    def available(self, frame: Frame) -> bool:
        """Return whether this frame has a depth image, or points given with their depth."""
        return frame.depth_m is not None or (frame.tracks is not None and frame.tracks.depth_m is not None)

    def measure(
        self, frame: Frame, pixels: Array, xy: Array, expected_rho: Array, ids: NDArray[np.int64] | None = None
    ) -> DepthReading:
        """Read inverse depth at raw pixels [N, 2]: bilinear, NaN at holes, beyond range and across depth edges."""
        config = self._config
        if frame.tracks is not None and frame.tracks.depth_m is not None and ids is not None:
            depth = given_rows(frame.tracks, frame.tracks.depth_m, ids)
            with np.errstate(invalid="ignore"):
                good = (depth >= config.min_depth_m) & (depth <= config.max_depth_m)
            given: Array = np.full(len(depth), np.nan)
            given[good] = 1.0 / depth[good]
            return DepthReading(given, np.full(len(depth), config.depth_sigma_rho))
        if frame.depth_m is None:
            unknown: Array = np.full(len(pixels), np.nan)
            return DepthReading(unknown, np.full(len(pixels), config.depth_sigma_rho))
        rho, spread = _sample(frame.depth_m, pixels, config.min_depth_m, config.max_depth_m, config.depth_edge_rho)
        return DepthReading(rho, np.hypot(config.depth_sigma_rho, config.depth_spread * spread))


@njit(cache=True, nogil=True)
def _sample(depth: ImageF32, pixels: Array, nearest: float, farthest: float, edge_rho: float) -> tuple[Array, Array]:
    """Return inverse depths [N], interpolated bilinearly (planes are linear in 1/z), and their spread nearby [N].

    NaN where less than a quarter of the interpolation is valid, or the neighbourhood spreads more than `edge_rho`.
    """
    height, width = depth.shape
    out, spread = np.full(len(pixels), np.nan), np.zeros(len(pixels))
    for i in range(len(pixels)):
        x, y = pixels[i]
        if not (x >= _REACH_PX and y >= _REACH_PX and x < width - _REACH_PX and y < height - _REACH_PX):
            continue
        column, row = int(x), int(y)
        lowest, highest = np.inf, -np.inf
        value, weight = 0.0, 0.0
        for r in range(row - _REACH_PX + 1, row + _REACH_PX + 1):
            for c in range(column - _REACH_PX + 1, column + _REACH_PX + 1):
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
            spread[i] = highest - lowest
    return out, spread
