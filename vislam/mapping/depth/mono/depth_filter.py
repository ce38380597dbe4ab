"""The depth filter of one reference image."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from vislam.config import MonoDepthConfig
from vislam.core.angles import angles_of
from vislam.core.errors import DataError
from vislam.core.geometry import are_rigid, invert
from vislam.core.jit import njit
from vislam.core.messages import Array, ImageF32, ImageU8
from vislam.mapping.depth.mono.matching import CODES, LEAST_SCORE, MARGIN, gradient_sums, grey_noise
from vislam.mapping.depth.mono.prior import carried_over, close_gaps, flat_prior
from vislam.mapping.depth.mono.update import CONVERGED, FLAT, SEARCHED, Belief, Rules, Views, update_rows

_SUPPORT = 3  # of eight neighbours
_AGREE = 0.03  # two inverse depths within this share of each other support one another
_STEP = 0.004  # change of inverse depth, as a share, that is usual from a pixel to the next
_JUMP = 0.015  # change from which on the penalty grows only linearly (Huber): surfaces end
_GREY_STEP = 12.0  # grey levels of contrast at which smoothing has fallen by e: surfaces end where images do


_SMOOTHING = 10  # steps of smoothing inside surfaces; 0: none
_MIN_GOOD = 0.6  # share of good measurements (REMODE); half of it, and the pixel has failed
_BAND_ROWS = 8  # of the image, one task each: small enough that two threads end together
_GAP_TOLERANCE = 0.02  # of depth, among the neighbours of a hole that is closed
_RIGID_TOLERANCE = 1e-4
_BETA_START = 10.0  # a and b at first: half of the measurements are good, known as well as from 20 of them


@njit(cache=True, nogil=True)
def supported(rho: ImageF32, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the known pixels [h, w] with which at least three known neighbours agree."""
    rows, columns = rho.shape
    out = np.zeros((rows, columns), np.bool_)
    for y in range(1, rows - 1):
        for x in range(1, columns - 1):
            if not known[y, x]:
                continue
            count = 0
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    near = abs(rho[y + dy, x + dx] - rho[y, x]) <= _AGREE * rho[y, x]
                    count += known[y + dy, x + dx] and near
            out[y, x] = count > _SUPPORT  # the pixel agrees with itself
    return out


@njit(cache=True, nogil=True)
def smoothed(rho: ImageF32, variance: ImageF32, known: NDArray[np.bool_], image: ImageU8, iterations: int) -> ImageF32:
    """Return inverse depth [h, w] smoothed among known pixels, less across contrast and jumps of depth.

    Minimises the squared distance from the measurement over its variance plus a Huber norm of the differences between
    4-neighbours, weighted by contrast as in REMODE (Pizzoli et al. 2014), by reweighted Jacobi steps.
    """
    rows, columns = rho.shape
    now, after = rho.copy(), rho.copy()
    across, down = _contrast_weights(image)
    for _ in range(iterations):
        for y in range(rows):
            for x in range(columns):
                if not known[y, x]:
                    continue
                here = now[y, x]
                weight = 1.0 / variance[y, x]
                total, weights = weight * rho[y, x], weight
                scale = 1.0 / (_STEP * here) ** 2
                for side in range(4):
                    dx, dy = (1, -1, 0, 0)[side], (0, 0, 1, -1)[side]
                    i, j = y + dy, x + dx
                    if i < 0 or j < 0 or i >= rows or j >= columns or not known[i, j]:
                        continue
                    w = scale * (across[y, min(x, j)] if dy == 0 else down[min(y, i), x])
                    off = abs(now[i, j] - here)
                    if off > _JUMP * here:
                        w *= _JUMP * here / off
                    total += w * now[i, j]
                    weights += w
                after[y, x] = total / weights
        now, after = after, now
    return now


@njit(cache=True, nogil=True)
def _contrast_weights(image: ImageU8) -> tuple[ImageF32, ImageF32]:
    """Return weights [h, w] between each pixel and its right and its lower neighbour."""
    rows, columns = image.shape
    across, down = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    for y in range(rows):
        for x in range(columns):
            here = float(image[y, x])
            if x + 1 < columns:
                across[y, x] = np.exp(-abs(float(image[y, x + 1]) - here) / _GREY_STEP)
            if y + 1 < rows:
                down[y, x] = np.exp(-abs(float(image[y + 1, x]) - here) / _GREY_STEP)
    return across, down


class DepthFilter:
    """Estimates the depth of every textured pixel of a reference image from images with known motion.

    Inverse z-depth is normal (`config.fusion` "gaussian", as in the slambook), or normal with a share of outliers
    ("beta": Vogiatzis and Hernandez 2011). All images are those of one pinhole camera without distortion.
    """

    def __init__(
        self, image: ImageU8, K: Array, config: MonoDepthConfig, prior: tuple[ImageF32, ImageF32] | None = None
    ) -> None:
        """Begin at a reference image [h, w]; `prior` is inverse depth and its sigma [h, w], None: nothing is known.

        Raises DataError when the image is not grey and 8 bit, too small, or the prior has another size.
        """
        _check_image(image, image.shape)
        if min(image.shape) <= 2 * MARGIN:
            raise DataError(f"image is {image.shape[1]}x{image.shape[0]}, smaller than {2 * MARGIN + 1} px; use larger")
        if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 1] != 0.0:
            raise DataError(f"K must be a finite 3x3 pinhole matrix without skew, got {np.asarray(K).tolist()}")
        rho, sigma = flat_prior(image.shape, config) if prior is None else prior
        if rho.shape != image.shape or sigma.shape != image.shape:
            raise DataError(f"prior is {rho.shape} and {sigma.shape} but the image {image.shape}; make them alike")
        self._config = config
        self._K = K
        self._image = image
        self._reference = image.astype(np.float32)
        self._gradients = gradient_sums(image)
        start = np.full(image.shape, _BETA_START, np.float32)
        state = np.full(image.shape, FLAT, np.uint8)
        textured = self._gradients[..., 0] + self._gradients[..., 2] >= config.min_gradient**2
        textured[:MARGIN] = textured[-MARGIN:] = textured[:, :MARGIN] = textured[:, -MARGIN:] = False
        state[textured & (rho > 0.0) & np.isfinite(rho) & (sigma > 0.0) & np.isfinite(sigma)] = SEARCHED
        count = np.zeros(image.shape, np.uint8)
        self.belief = Belief(
            np.array(rho, np.float32), np.square(sigma, dtype=np.float32), start, start.copy(), state, count,
            count.copy(),
        )  # fmt: skip
        self._rules = rules(config, grey_noise(image))

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which pixels [h, w] have converged."""
        return np.asarray(self.belief.state == CONVERGED)

    @property
    def typical_rho(self) -> float:
        """Median inverse depth in 1/m of the pixels that are searched or known."""
        live = (self.belief.state == SEARCHED) | (self.belief.state == CONVERGED)
        return float(np.median(self.belief.rho[live])) if live.any() else 1.0 / self._config.max_depth_m

    def update(self, image: ImageU8, T_ref_cur: Array) -> int:
        """Take in an image taken at `T_ref_cur` [4, 4]; return how many pixels were found in it.

        Raises DataError when the image has another size or type, or the pose is not rigid; nothing is changed then.
        """
        _check_image(image, self._image.shape)
        T = np.asarray(T_ref_cur, dtype=np.float64)
        _check_rigid(T)
        T_cur_ref = invert(np.ascontiguousarray(T))
        R, t = T_cur_ref[:3, :3], T_cur_ref[:3, 3]
        turn_deg = np.rad2deg(angles_of(R))
        current = image.astype(np.float32)
        if turn_deg > self._config.derotate_deg:
            current = self._derotated(current, R)
            R, t = np.eye(3), -T[:3, 3]
        K = np.array([self._K[0, 0], self._K[1, 1], self._K[0, 2], self._K[1, 2]])
        views = Views(
            self._reference, self._gradients, current, K, np.ascontiguousarray(R), np.ascontiguousarray(t)
        )  # fmt: skip
        bands = range(0, image.shape[0], _BAND_ROWS)

        def update_band(row: int) -> int:
            return int(update_rows(row, row + _BAND_ROWS, self.belief, self._rules, views))

        if self._config.threads <= 1:
            return sum(map(update_band, bands))
        # a pixel depends on no other, so the result does not depend on the number of threads
        with ThreadPoolExecutor(self._config.threads, thread_name_prefix="vislam-depth") as pool:
            return sum(pool.map(update_band, bands))

    def depth_m(self) -> ImageF32:
        """Return z-depth [h, w] in metres, smoothed inside surfaces, 0 where it is not known."""
        rho = self._smooth()
        with np.errstate(divide="ignore"):
            return np.where(rho > 0.0, np.float32(1.0) / rho, np.float32(0.0)).astype(np.float32)

    def hand_over(self, T_ref_next: Array, prior: tuple[ImageF32, ImageF32]) -> tuple[ImageF32, ImageF32]:
        """Return a prior for the next reference image, at `T_ref_next`: what is known here, and `prior` elsewhere.

        Its sigma is `handover_sigma` of inverse depth at least, so that every image measures again.
        """
        _check_rigid(np.asarray(T_ref_next, dtype=np.float64))
        T = invert(np.ascontiguousarray(T_ref_next, dtype=np.float64))
        K = np.array([self._K[0, 0], self._K[1, 1], self._K[0, 2], self._K[1, 2]])
        rho = self._smooth()
        carried = carried_over(rho, rho > 0.0, K, np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]))
        sigma = np.float32(self._config.handover_sigma) * carried
        return np.where(carried > 0.0, carried, prior[0]), np.where(carried > 0.0, sigma, prior[1])

    def _smooth(self) -> ImageF32:
        known = supported(self.belief.rho, self.known)
        rho = np.where(known, self.belief.rho, np.float32(0.0))
        if _SMOOTHING > 0:
            rho = smoothed(rho, self.belief.variance, known, self._image, _SMOOTHING)
        return np.asarray(close_gaps(rho, _GAP_TOLERANCE))

    def _derotated(self, image: ImageF32, R_cur_ref: Array) -> ImageF32:
        """Return the image as a camera in its place would see it that is turned like the reference, NaN beyond it.

        Patches then differ by no rotation; the epipolar geometry is that of a pure translation.
        """
        H = self._K @ R_cur_ref @ np.linalg.inv(self._K)  # pixels of the turned camera -> pixels of the image
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(image, H, image.shape[::-1], flags=flags, borderValue=np.nan), np.float32)


def rules(config: MonoDepthConfig, noise: float) -> Rules:
    """Return the settings as compiled code takes them; `noise` is that of a pixel in grey levels."""
    return Rules(
        CODES[config.measure], config.fusion == "beta", config.step_px, config.reach_px, config.search_sigmas,
        LEAST_SCORE[config.measure],
        config.uniqueness, config.sigma_px, config.min_gradient, config.max_sigma_ratio, config.converged,
        config.min_matches, config.max_misses, _MIN_GOOD, 1.0 / config.max_depth_m, 1.0 / config.min_depth_m,
        -1.0 if config.model_sigma_px is None else config.model_sigma_px, noise,
        np.inf if config.warp_px is None else config.warp_px,
    )  # fmt: skip


def _check_image(image: NDArray[np.generic], shape: tuple[int, ...]) -> None:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise DataError(f"image must be grey, 8 bit [h, w], got {image.dtype} of shape {image.shape}; convert it first")
    if image.shape != shape:
        raise DataError(
            f"image is {image.shape[1]}x{image.shape[0]} but the reference is {shape[1]}x{shape[0]}; they must be alike"
        )


def _check_rigid(T: Array) -> None:
    if T.shape != (4, 4) or not are_rigid(T, _RIGID_TOLERANCE):
        raise DataError(f"the motion between two images is not a rigid transform: {T.tolist()}")
