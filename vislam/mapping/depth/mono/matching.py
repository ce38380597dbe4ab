"""Block matching: how alike a patch of the reference image and one at a sub-pixel place of another image are.

Six measures (slambook 2, section 12.2): sums of absolute and of squared differences, normalised cross-correlation, and
each with the patches' means taken off. Sums run column by column with the rows inside: the compiler then puts the
eight columns into one vector register, which is seven times as fast as row by row.
"""

from __future__ import annotations

import math

import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import ImageF32, ImageU8

HALF = 3  # a patch is 7x7 px
SIDE = 2 * HALF + 1
_LANES = SIDE + 1  # rows of a patch are padded with a zero, so that they fill a vector register
PIXELS = np.float32(SIDE * SIDE)

SAD, SSD, NCC, ZSAD, ZSSD, ZNCC = range(6)
CODES = {"sad": SAD, "ssd": SSD, "ncc": NCC, "zsad": ZSAD, "zssd": ZSSD, "zncc": ZNCC}
# least score of a match: grey levels on average (sad), their mean square (ssd), or a correlation
LEAST_SCORE = {"sad": -14.0, "ssd": -350.0, "ncc": 0.99, "zsad": -14.0, "zssd": -350.0, "zncc": 0.85}
_SMALLEST = np.float32(1e-3)  # grey levels^2, of a patch: keeps correlations of flat ones finite
MARGIN = HALF + 3  # px from the border within which no patch with its padding fits
_MEDIAN_OF_NORMAL = 0.6745  # of the absolute value, in standard deviations
_ROUNDING = math.sqrt(1.0 / 12.0)
_FAST = {"reassoc", "contract", "nsz"}  # NaN and infinity keep their meaning


def grey_noise(image: ImageU8) -> float:
    """Return the standard deviation of an image's noise in grey levels (Immerkaer 1996), of rounding at least.

    The median takes the place of the mean, so edges do not count. Texture that is everywhere and fine as the pixels
    does, and passes for noise.
    """
    grey = image.astype(np.float32)
    across = grey[:, :-2] - 2.0 * grey[:, 1:-1] + grey[:, 2:]
    response = np.abs(across[:-2] - 2.0 * across[1:-1] + across[2:])  # noise of sigma 1 gives it 6
    return max(float(np.median(response)) / (6.0 * _MEDIAN_OF_NORMAL), _ROUNDING)


@njit(cache=True, nogil=True)
def gradient_sums(image: ImageU8) -> ImageF32:
    """Return gx^2, gx gy and gy^2 [h, w, 3] (grey levels per px)^2, averaged over the patch around each pixel."""
    rows, columns = image.shape
    products = np.zeros((rows, columns, 3), np.float32)
    for y in range(1, rows - 1):
        for x in range(1, columns - 1):
            gx = np.float32(0.5) * (np.float32(image[y, x + 1]) - np.float32(image[y, x - 1]))
            gy = np.float32(0.5) * (np.float32(image[y + 1, x]) - np.float32(image[y - 1, x]))
            products[y, x, 0], products[y, x, 1], products[y, x, 2] = gx * gx, gx * gy, gy * gy
    out = np.zeros((rows, columns, 3), np.float32)
    line = np.zeros((columns, 3), np.float32)
    for y in range(HALF, rows - HALF):
        line[:] = 0.0
        for dy in range(-HALF, HALF + 1):
            line += products[y + dy]
        for x in range(HALF, columns - HALF):
            for k in range(3):
                total = np.float32(0.0)
                for dx in range(-HALF, HALF + 1):
                    total += line[x + dx, k]
                out[y, x, k] = total / PIXELS
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def load_patch(patch: ImageF32, image: ImageF32, y: int, x: int) -> tuple[np.float32, np.float32]:
    """Fill `patch` [7, 8] with the pixels around (x, y) less their mean; return mean and sum of squares about it."""
    row, column = np.uint64(y - HALF), np.uint64(x - HALF)
    total = np.float32(0.0)
    for dx in range(_LANES):
        weight = np.float32(dx < SIDE)
        for dy in range(SIDE):
            total += weight * image[row + np.uint64(dy), column + np.uint64(dx)]
    mean = total / PIXELS
    squares = np.float32(0.0)
    for dx in range(_LANES):
        weight = np.float32(dx < SIDE)
        for dy in range(SIDE):
            off = weight * (image[row + np.uint64(dy), column + np.uint64(dx)] - mean)
            patch[dy, dx] = off
            squares += off * off
    return mean, squares


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def load_warped(
    patch: ImageF32, image: ImageF32, y: int, x: int, warp: tuple[float, float, float, float]
) -> tuple[np.float32, np.float32]:
    """Fill `patch` as `load_patch` does, from where `warp` takes the steps between its pixels in the image.

    `warp` is a 2x2 matrix by rows, from steps in the other image to steps in this one. The sum of squares is negative
    where the patch leaves the image, and it is not to be used then.
    """
    a, b, c, d = np.float32(warp[0]), np.float32(warp[1]), np.float32(warp[2]), np.float32(warp[3])
    half, one = np.float32(HALF), np.float32(1.0)
    wide, high = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    rows, columns = image.shape
    if not (x - wide >= 0 and y - high >= 0 and x + wide < columns - 1 and y + high < rows - 1):
        return np.float32(0.0), np.float32(-1.0)
    total = np.float32(0.0)
    for dy in range(SIDE):
        for dx in range(SIDE):
            right, down = np.float32(dx) - half, np.float32(dy) - half
            u, v = np.float32(x) + a * right + b * down, np.float32(y) + c * right + d * down
            column, row = np.uint64(u), np.uint64(v)
            s, t = u - np.float32(column), v - np.float32(row)
            upper = (one - s) * image[row, column] + s * image[row, column + np.uint64(1)]
            lower = (one - s) * image[row + np.uint64(1), column] + s * image[row + np.uint64(1), column + np.uint64(1)]
            patch[dy, dx] = (one - t) * upper + t * lower
            total += patch[dy, dx]
        patch[dy, SIDE] = 0.0
    mean = total / PIXELS
    squares = np.float32(0.0)
    for dy in range(SIDE):
        for dx in range(SIDE):
            patch[dy, dx] -= mean
            squares += patch[dy, dx] * patch[dy, dx]
    return mean, squares


@njit(cache=True, nogil=True, error_model="numpy")
def score_at(
    measure: int, patch: ImageF32, mean: np.float32, squares: np.float32, image: ImageF32, u: float, v: float
) -> np.float32:
    """Return how alike a patch (from `load_patch`) and the bilinear patch around (u, v) are; larger is more alike.

    Differences are averaged over the patch and negative; correlations lie in -1..1. NaN where the image is NaN.
    """
    column, row = np.uint64(u) - np.uint64(HALF), np.uint64(v) - np.uint64(HALF)  # unsigned: no negative indices
    a, b = np.float32(u - math.floor(u)), np.float32(v - math.floor(v))
    if measure == SAD:
        return -_absolute(patch, image, row, column, a, b, mean) / PIXELS
    product, total, power = _moments(patch, image, row, column, a, b, mean)
    if measure == ZSAD:
        return -_absolute(patch, image, row, column, a, b, mean + total / PIXELS) / PIXELS
    other = max(power - total * total / PIXELS, np.float32(0.0))
    if measure == ZNCC:
        return product / np.float32(math.sqrt(squares * other + _SMALLEST))
    if measure == NCC:
        base = PIXELS * mean * mean
        full = (squares + base) * (power + np.float32(2.0) * mean * total + base)
        return (product + mean * total + base) / np.float32(math.sqrt(full + _SMALLEST))
    difference = (squares + other - np.float32(2.0) * product) / PIXELS
    if measure == SSD:
        difference += (total / PIXELS) ** 2
    return -difference


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _moments(
    patch: ImageF32,
    image: ImageF32,
    row: np.uint64,
    column: np.uint64,
    a: np.float32,
    b: np.float32,
    offset: np.float32,
) -> tuple[np.float32, np.float32, np.float32]:
    """Return sum of products, sum, and sum of squares of the bilinear patch less `offset`."""
    product, total, power = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    na, nb = np.float32(1.0) - a, np.float32(1.0) - b
    for dx in range(_LANES):
        x = column + np.uint64(dx)
        weight = np.float32(dx < SIDE)
        upper = na * image[row, x] + a * image[row, x + np.uint64(1)] - offset
        for dy in range(SIDE):
            y = row + np.uint64(dy + 1)
            lower = na * image[y, x] + a * image[y, x + np.uint64(1)] - offset
            grey = nb * upper + b * lower
            product += patch[dy, dx] * grey
            total += weight * grey
            power += weight * grey * grey
            upper = lower
    return product, total, power


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _absolute(
    patch: ImageF32,
    image: ImageF32,
    row: np.uint64,
    column: np.uint64,
    a: np.float32,
    b: np.float32,
    offset: np.float32,
) -> np.float32:
    """Return the sum of absolute differences of a patch of mean zero and the bilinear patch less `offset`."""
    total = np.float32(0.0)
    na, nb = np.float32(1.0) - a, np.float32(1.0) - b
    for dx in range(_LANES):
        x = column + np.uint64(dx)
        weight = np.float32(dx < SIDE)
        upper = na * image[row, x] + a * image[row, x + np.uint64(1)] - offset
        for dy in range(SIDE):
            y = row + np.uint64(dy + 1)
            lower = na * image[y, x] + a * image[y, x + np.uint64(1)] - offset
            total += weight * abs(patch[dy, dx] - (nb * upper + b * lower))
            upper = lower
    return total
