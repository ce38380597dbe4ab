"""Depth from the second camera: Lucas-Kanade from left to right, held to the epipolar line, then triangulated."""

from __future__ import annotations

import numpy as np
from numba import njit

from vislam.camera import Rig
from vislam.config import FrontEndConfig
from vislam.features import FlowSettings, follow
from vislam.frontend.depth import DepthReading
from vislam.geometry import invert
from vislam.messages import Array, Frame


class StereoDepth:
    """Measures inverse depth by matching corners of the left image in the right one; no rectification needed."""

    def __init__(self, rig: Rig, config: FrontEndConfig) -> None:
        """Take the rig's first two cameras."""
        self._left, self._right = rig.cameras[0], rig.cameras[1]
        self._T_right_left = invert(rig.T_cam0_cam1)
        self._config = config
        self._flow = FlowSettings(
            window_px=config.stereo_window_px, levels=config.stereo_levels, max_back_px=config.max_back_px
        )
        baseline_m = float(np.linalg.norm(self._T_right_left[:3, 3]))
        self._sigma_rho = config.stereo_sigma_px / (self._right.fx * baseline_m)
        self._max_rho = 1.0 / config.min_depth_m

    def available(self, frame: Frame) -> bool:
        """Return whether the right image is there."""
        return len(frame.images) > 1

    def measure(self, frame: Frame, pixels: Array, xy: Array, expected_rho: Array) -> DepthReading:
        """Match raw left pixels [N, 2] in the right image, starting where `expected_rho` [N] puts them."""
        sigma: Array = np.full(len(pixels), self._sigma_rho)
        if not self.available(frame):
            return DepthReading(np.full(len(pixels), np.nan), sigma, np.full((len(pixels), 2), np.nan))
        R, t = self._T_right_left[:3, :3], self._T_right_left[:3, 3]
        rays = np.column_stack([xy, np.ones(len(xy))]) @ R.T
        guess = self._right.project(rays + np.clip(expected_rho, 0.0, self._max_rho)[:, None] * t)
        right_px, ok = follow(frame.images[0], frame.images[1], pixels, guess, self._flow)
        right_xy = self._right.normalise(right_px)
        rho, off_line = _triangulate(rays, t, right_xy)
        # a point at infinity may measure slightly negative; beyond that the match is wrong
        good = ok & (off_line * self._right.fx <= self._config.epipolar_gate_px)
        good &= (rho > -3.0 * self._sigma_rho) & (rho <= self._max_rho)
        right_px[~good] = np.nan
        return DepthReading(np.where(good, np.maximum(rho, 0.0), np.nan), sigma, right_px)


@njit(cache=True, nogil=True)
def _triangulate(rays: Array, t: Array, right_xy: Array) -> tuple[Array, Array]:
    """Return inverse depths [N] and distances [N] from the epipolar line on z = 1 of the right camera.

    The point is `ray + rho * t` up to scale, so the reprojection is a homography of rho; Gauss-Newton from the linear
    solution is exact after two steps.
    """
    rho_out, distance = np.full(len(rays), np.nan), np.full(len(rays), np.nan)
    for i in range(len(rays)):
        u, v = right_xy[i]
        if not (np.isfinite(u) and np.isfinite(v)):
            continue
        a0, a1 = rays[i, 0] - u * rays[i, 2], rays[i, 1] - v * rays[i, 2]
        b0, b1 = t[0] - u * t[2], t[1] - v * t[2]
        rho = -(a0 * b0 + a1 * b1) / (b0 * b0 + b1 * b1)
        ru, rv = 0.0, 0.0
        for _ in range(3):
            z = rays[i, 2] + rho * t[2]
            pu, pv = (rays[i, 0] + rho * t[0]) / z, (rays[i, 1] + rho * t[1]) / z
            ju, jv = (t[0] - pu * t[2]) / z, (t[1] - pv * t[2]) / z
            ru, rv = u - pu, v - pv
            rho += (ju * ru + jv * rv) / (ju * ju + jv * jv)
        rho_out[i] = rho
        distance[i] = np.sqrt(ru * ru + rv * rv)
    return rho_out, distance
