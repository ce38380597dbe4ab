"""How OpenCV's universal RANSAC (USAC; Raguram, PAMI 2013) searches: MSAC scores, local optimisation, a seed."""

from __future__ import annotations

from typing import Any

import cv2

_CONFIDENCE = 0.999


def usac(threshold: float, tries: int, seed: int, local_tries: int | None = None) -> Any:
    """Return OpenCV's settings for an inlier's `threshold` on z = 1 and a largest number of tries.

    `local_tries` refine each new best one; None leaves OpenCV's number.
    """
    settings = cv2.UsacParams()
    settings.randomGeneratorState = seed % 2**31
    settings.threshold = threshold
    settings.confidence = _CONFIDENCE
    settings.maxIterations = tries
    settings.sampler = cv2.SAMPLING_UNIFORM
    settings.score = cv2.SCORE_METHOD_MSAC
    settings.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    if local_tries is not None:
        settings.loIterations = local_tries
    settings.isParallel = False
    return settings
