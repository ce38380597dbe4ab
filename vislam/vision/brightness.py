"""Exposure that changed between two images: gain and offset of grey, seen where the same patches are expected.

Lucas-Kanade compares grey levels as they are, so a step of exposure takes every track from it. The middle one of many
patches shows the step even where each is expected some pixels off; what is clipped shows nothing and is left out. A
gamma curve turns a factor of exposure into another factor of grey, so the same line serves cameras that apply one.
"""

from __future__ import annotations

import cv2
import numpy as np

from vislam.core.jit import njit
from vislam.core.messages import Array, ImageU8
from vislam.core.quantiles import quantile

_NEGLIGIBLE = 1.3  # ratio of brightness; less, and Lucas-Kanade stands it better than a gain known to some percent
_MIN_PATCHES = 10  # that agree; fewer are no evidence
_MAX_PATCHES = 120  # looked at; the middle one of this many is known to a few percent
_SAMPLES = 7  # a patch is seen through 7 x 7 pixels spread over it
_CLIPPED = (3, 252)  # grey levels beyond which a camera no longer distinguishes light, noise allowed for
_MAX_CLIPPED = 5  # of the 49 samples
_FLAT_GREY = 2.0  # standard deviation below which a patch has no contrast to compare


def matched(source: ImageU8, target: ImageU8, pixels: Array, guess: Array, window_px: int) -> ImageU8:
    """Return `source` as bright as `target`; the same object, untouched, where they are alike or it cannot be found.

    Args:
        source: grey image whose patches are looked for.
        target: grey image in which they are looked for.
        pixels: places [N, 2] of patches in `source`.
        guess: where they are about in `target` [N, 2]; NaN: nowhere.
        window_px: side of a patch.
    """
    stride = max(len(pixels) // _MAX_PATCHES, 1)
    some, guessed = np.ascontiguousarray(pixels[::stride]), np.ascontiguousarray(guess[::stride])  # one layout
    patches = _compare(source, target, some, guessed, max(window_px // _SAMPLES, 1))
    if len(patches) < _MIN_PATCHES:
        return source
    mean_source, sigma_source, mean_target, sigma_target = patches.T
    ratios = np.sort((mean_target + 1.0) / (mean_source + 1.0))
    darker, brighter = quantile(ratios, 0.25), quantile(ratios, 0.75)
    if darker <= _NEGLIGIBLE and brighter >= 1.0 / _NEGLIGIBLE:  # three in four patches have to agree on a step
        return source
    gain = float(np.median(sigma_target / sigma_source))
    offset = float(np.median(mean_target - gain * mean_source))
    table = np.clip(np.rint(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(source, table), dtype=np.uint8)


@njit(cache=True, nogil=True)
def _compare(source: ImageU8, target: ImageU8, pixels: Array, guess: Array, step_px: int) -> Array:
    """Return mean and sigma of grey in both images [M, 4] of the patches that lie inside, unclipped and with contrast.

    Patches are sampled at whole pixels, every `step_px`.
    """
    out = np.empty((len(pixels), 4))
    count = 0
    for i in range(len(pixels)):
        good = True
        for side in range(2):
            image = source if side == 0 else target
            x, y = (pixels[i, 0], pixels[i, 1]) if side == 0 else (guess[i, 0], guess[i, 1])
            reach = _SAMPLES // 2 * step_px
            if not (x >= reach and y >= reach and x < image.shape[1] - reach - 1 and y < image.shape[0] - reach - 1):
                good = False  # also where the guess is NaN
                break
            left, top = int(x + 0.5) - reach, int(y + 0.5) - reach
            total, squares, clipped = 0.0, 0.0, 0
            for row in range(_SAMPLES):
                for column in range(_SAMPLES):
                    grey = float(image[top + row * step_px, left + column * step_px])
                    total += grey
                    squares += grey * grey
                    clipped += grey < _CLIPPED[0] or grey > _CLIPPED[1]
            samples = float(_SAMPLES * _SAMPLES)
            mean = total / samples
            sigma = np.sqrt(max(squares / samples - mean * mean, 0.0))
            if clipped > _MAX_CLIPPED or sigma < _FLAT_GREY:
                good = False
                break
            out[count, 2 * side], out[count, 2 * side + 1] = mean, sigma
        count += good
    return out[:count]
