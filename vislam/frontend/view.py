"""What is looked through: a camera of the rig, and what measures depth in its image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array, Frame, ImageF32, Observations
from vislam.frontend.tracker import CELL_PX, MAX_BACK_PX, MIN_CORNER_RESPONSE, MIN_START_CORNERS, given_rows
from vislam.vision.brightness import matched
from vislam.vision.features import FlowSettings, detect_corners, follow
from vislam.vision.landmarks import move

# of the spread of 1/z within 8x8 px: what a wrong registration by some pixels costs
_DEPTH_SPREAD = 0.5
_DEPTH_EDGE_RHO = 0.06  # 1/m: a larger spread is an edge, where depth belongs to neither side
_STEREO_WINDOW_PX = 15  # smaller than in time: depth edges hurt, blur is the same in both images
_STEREO_LEVELS = 3  # pyramid levels above the image
EPIPOLAR_GATE_PX = 1.5  # distance from the epipolar line that calibration and noise explain
_REACH_PX = 4  # half the side of the neighbourhood in which the effect of a wrong registration is measured
_START_DISPARITIES = (8.0, 25.0, 60.0)  # px; with the reach of Lucas-Kanade they cover 0 to about 90


@dataclass(frozen=True, slots=True, eq=False)
class DepthReading:
    """Inverse z-depths of pixels in cam0."""

    rho: Array  # [N] in 1/m, NaN where unknown
    sigma_rho: Array  # [N] in 1/m
    right_px: Array | None = None  # [N, 2] in cam1 for stereo, NaN where not matched
    by_delay: Array | None = None  # [N] derivative of `rho` by how much later depth was taken, 1/m/s; None: zero

    @property
    def depth_m(self) -> Array:
        """Return z-depths [N], NaN where unknown or at infinity."""
        depth: Array = np.full(len(self.rho), np.nan)
        near = np.isfinite(self.rho) & (self.rho > 1e-3)
        depth[near] = 1.0 / self.rho[near]
        return depth

    def joined(self, other: DepthReading) -> DepthReading:
        """Return this reading followed by another of the same sensor."""
        right = None
        if self.right_px is not None and other.right_px is not None:
            right = np.vstack([self.right_px, other.right_px])
        rho, sigma = np.concatenate([self.rho, other.rho]), np.concatenate([self.sigma_rho, other.sigma_rho])
        return DepthReading(rho, sigma, right)

    @property
    def slope(self) -> Array:
        """Return `by_delay` [N]; NaN where it could not be measured, as at the edge of what has depth."""
        return np.zeros(len(self.rho)) if self.by_delay is None else self.by_delay


class DepthSensor(Protocol):
    """A source of inverse depth for pixels of cam0."""

    every_frame: bool  # whether measuring is cheap enough to do in every frame, not only in keyframes

    def available(self, frame: Frame) -> bool:
        """Return whether this frame carries depth at all."""
        ...

    def measure(
        self, frame: Frame, pixels: Array, xy: Array, expected_rho: Array, ids: NDArray[np.int64] | None = None
    ) -> DepthReading:
        """Measure the depth of raw pixels [N, 2] with directions `xy` [N, 2], where about `expected_rho` [N] is likely.

        NaN in `expected_rho` means that nothing is expected. `ids` [N] are the tracks that the pixels belong to: where
        a frame brings its tracks with it, only their depth is known.
        """
        ...


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
        rho, spread = _sample(frame.depth_m, pixels, config.min_depth_m, config.max_depth_m, _DEPTH_EDGE_RHO)
        return DepthReading(rho, np.hypot(config.depth_sigma_rho, _DEPTH_SPREAD * spread))


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


class StereoDepth:
    """Measures inverse depth by matching corners of the left image in the right one; no rectification needed."""

    every_frame = False

    def __init__(self, rig: Rig, config: FrontEndConfig) -> None:
        """Take the rig's first two cameras."""
        self._right = rig.cameras[1]
        self._T_right_left = invert(rig.T_cam0_cam1)
        self._config = config
        self._flow = FlowSettings(window_px=_STEREO_WINDOW_PX, levels=_STEREO_LEVELS, max_back_px=MAX_BACK_PX)
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
                found, difference = follow(source, right, pixels, guess, self._flow, frame.mask(1))
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
            good = (off_line * self._right.fx <= EPIPOLAR_GATE_PX) & (rho <= self._max_rho)
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


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera, its place on the body, and what measures depth in its image."""

    camera: Camera
    T_body_cam: Array  # [4, 4]
    depth: DepthSensor
    is_swapped: bool = False  # whether it looks through cam1; cam0 then plays its part

    def of(self, frame: Frame) -> Frame:
        """Return the frame with this camera's image first; done twice, it is the frame again."""
        if not self.is_swapped or len(frame.images) < 2:
            return frame
        masks = (frame.mask(1), frame.mask(0)) if frame.masks else ()
        return replace(frame, images=(frame.images[1], frame.images[0], *frame.images[2:]), masks=masks)

    def carry(self, points: Array, covariances: Array, other: View) -> tuple[Array, Array]:
        """Return inverse-depth points [N, 3] of this camera as another sees them, and their covariances [N, 3, 3]."""
        return move(points, covariances, np.asarray(invert(self.T_body_cam) @ other.T_body_cam))

    def as_other_would(
        self, other: View, ids: NDArray[np.int64], xy: Array, means: Array, covariances: Array, gate_px: float
    ) -> Observations:
        """Return what another camera would see of tracks [N] that this one sees at `xy` [N, 2], to `gate_px`.

        The depth is that of landmarks `means` [N, 3] of the same instant, with covariances [N, 3, 3]; tracks whose
        pixel it predicts with a larger sigma are left out.
        """
        covariance = np.zeros_like(covariances)
        covariance[:, 2, 2] = covariances[:, 2, 2]
        points, covariance = self.carry(np.column_stack([xy, means[:, 2]]), covariance, other)
        pixels = other.camera.project(np.column_stack([points[:, :2], np.ones(len(points))]))
        known = other.camera.contains(pixels) & (other.camera.fx * spread(covariance) < gate_px)
        return Observations(ids[known], pixels[known], instant_px=pixels[known])


def stereo_views(rig: Rig, config: FrontEndConfig) -> tuple[View, View]:
    """Return the first two cameras of a rig, each with the other for depth."""
    swapped = Rig((rig.cameras[1], rig.cameras[0]), (rig.T_body_cams[1], rig.T_body_cams[0]))
    return (
        View(rig.cameras[0], rig.T_body_cams[0], StereoDepth(rig, config)),
        View(rig.cameras[1], rig.T_body_cams[1], StereoDepth(swapped, config), is_swapped=True),
    )


def spread(covariances: Array) -> Array:
    """Return how far directions [N] scatter, of landmarks with covariances [N, 3, 3]."""
    return np.asarray(np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]))


def sees(frame: Frame, camera: int, config: FrontEndConfig) -> bool:
    """Return whether a camera's image shows enough to start from: a covered one's does not."""
    wanted, none = MIN_START_CORNERS, np.empty((0, 2))
    image, mask = frame.images[camera], frame.mask(camera)
    corners = detect_corners(image, wanted, CELL_PX, config.min_distance_px, none, MIN_CORNER_RESPONSE, mask)
    return len(corners) >= wanted
