"""A focal length from depth images, where a recording has them: images alone are misled by more than they show.

Depth and pixels of rigid points show the focal length another way than tracks do (`vision/depth_focal.py`): it joins in
as one measurement, against which the images weigh as much as their widened sigmas allow.
"""

from dataclasses import replace

import numpy as np

from vislam.calibration.self_calibration.certainty import Certainty
from vislam.calibration.self_calibration.lens_search import Solution, refined
from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.recording import Problems
from vislam.datasets import survey
from vislam.datasets.rgbd import rgbd_facts
from vislam.datasets.stream import frame_table
from vislam.vision.depth_focal import FocalFit

_WORST = 0.02  # relative sigma: worse is no help
_LEAST_SIGMA = 0.004  # of what depth shows, too: a sensor's own registration is no better


def focal_by_depth(source: str, camera: Camera) -> FocalFit | str:
    """Return what depth shows of a camera's focal length, or why it does not; empty: the recording has no depth."""
    try:
        found = survey(source)
        if found.rig is None or found.depth is None:
            return ""
        if found.errors:
            return str(found.errors[0])
        frames = frame_table(found, Problems())
        if not np.any(frames.depth_rows >= 0):
            return ""
        rig = replace(found.rig, cameras=(camera, *found.rig.cameras[1:]))
        fit = rgbd_facts(found, rig, frames).focal
    except DataError as error:
        return str(error)
    if fit is None:
        return "too little moves past edges of depth"
    return fit if fit.sigma < _WORST else f"they show it to {fit.sigma:.1%} only"


def with_focal(solution: Solution, known: Certainty, fit: FocalFit) -> Solution:
    """Return the solution with a focal length as measured, weighed against how sure the images are [see `known`]."""
    fx = solution.shared.camera.fx
    sigma_px = fx * max(fit.sigma, _LEAST_SIGMA) / float(known.wider[0])
    mean, information = solution.prior.mean.copy(), solution.prior.information.copy()
    mean[0], information[0] = fx * fit.factor, sigma_px**-2.0
    return refined(replace(solution, prior=replace(solution.prior, mean=mean, information=information)))
