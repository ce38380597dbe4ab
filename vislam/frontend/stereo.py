"""Depth from the second camera: Lucas-Kanade from left to right, held to the epipolar line, then triangulated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Rig
from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, Frame
from vislam.frontend.depth import DepthReading
from vislam.frontend.tracker import given_rows
from vislam.vision.brightness import matched
from vislam.vision.features import FlowSettings, follow

_START_DISPARITIES = (8.0, 25.0, 60.0)  # px; with the reach of Lucas-Kanade they cover 0 to about 90


class StereoDepth:
    """Measures inverse depth by matching corners of the left image in the right one; no rectification needed."""

    every_frame = False

    def __init__(self, rig: Rig, config: FrontEndConfig) -> None:
        """Take the rig's first two cameras."""
        self._right = rig.cameras[1]
        self._T_right_left = invert(rig.T_cam0_cam1)
        self._config = config
        self._flow = FlowSettings(
            window_px=config.stereo_window_px, levels=config.stereo_levels, max_back_px=config.max_back_px
        )
        baseline_m = float(np.linalg.norm(self._T_right_left[:3, 3]))
        self._sigma_rho = config.stereo_sigma_px / (self._right.fx * baseline_m)
        self._max_rho = 1.0 / config.min_depth_m

    def available(self, frame: Frame) -> bool:
        """Return whether the right image is there, or points given with their places in it."""
        return len(frame.images) > 1 or (frame.tracks is not None and frame.tracks.right_px is not None)

    def measure(
        self, frame: Frame, pixels: Array, xy: Array, expected_rho: Array, ids: NDArray[np.int64] | None = None
    ) -> DepthReading:
        """Match raw left pixels [N, 2] in the right image, starting where `expected_rho` [N] puts them.

        Where nothing is expected (NaN), several disparities are tried and the most similar match is taken.
        """
        right_px: Array = np.full((len(pixels), 2), np.nan)
        rho: Array = np.full(len(pixels), np.nan)
        rays = np.column_stack([xy, np.ones(len(xy))]) @ self._T_right_left[:3, :3].T
        if frame.tracks is not None and frame.tracks.right_px is not None and ids is not None:
            right_px = given_rows(frame.tracks, frame.tracks.right_px, ids)
            rho = self._accepted(rays, right_px)
            right_px[np.isnan(rho)] = np.nan
        elif len(frame.images) > 1 and len(pixels) > 0:
            left, right = frame.images[:2]
            best = np.full(len(pixels), np.inf)
            for start_rho in self._starts(expected_rho):
                guess = self._right.project(rays + start_rho[:, None] * self._T_right_left[:3, 3])
                source = matched(left, right, pixels, guess, self._flow.window_px)
                found, difference = follow(source, right, pixels, guess, self._flow)
                candidate_rho = self._accepted(rays, found)
                better = np.isfinite(candidate_rho) & (difference < best)
                right_px[better], rho[better], best[better] = found[better], candidate_rho[better], difference[better]
        return DepthReading(rho, np.full(len(pixels), self._sigma_rho), right_px)

    def _starts(self, expected_rho: Array) -> list[Array]:
        known = np.isfinite(expected_rho)
        if known.all():
            return [np.clip(expected_rho, 0.0, self._max_rho)]
        pixel_rho = self._sigma_rho / self._config.stereo_sigma_px
        return [np.where(known, np.clip(expected_rho, 0.0, self._max_rho), px * pixel_rho) for px in _START_DISPARITIES]

    def _accepted(self, rays: Array, right_px: Array) -> Array:
        """Triangulate; NaN where the match is off the epipolar line, behind the cameras or too near."""
        rho, off_line = _triangulate(rays, self._T_right_left[:3, 3].copy(), self._right.normalise(right_px))
        with np.errstate(invalid="ignore"):
            # a point at infinity may measure slightly negative; beyond that the match is wrong
            good = (off_line * self._right.fx <= self._config.epipolar_gate_px) & (rho <= self._max_rho)
            good &= rho > -3.0 * self._sigma_rho
        return np.where(good, np.maximum(rho, 0.0), np.nan)


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
