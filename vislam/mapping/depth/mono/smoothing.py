"""What neighbours know of one another: pixels without support leave, the rest are smoothed inside surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import ImageF32, ImageU8

_SUPPORT = 3  # of eight neighbours
_AGREE = 0.03  # two inverse depths within this share of each other support one another
_STEP = 0.004  # change of inverse depth, as a share, that is usual from a pixel to the next
_JUMP = 0.015  # change from which on the penalty grows only linearly (Huber): surfaces end
_GREY_STEP = 12.0  # grey levels of contrast at which smoothing has fallen by e: surfaces end where images do


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
