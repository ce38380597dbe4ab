"""Colour of an OAK with depth aligned to it on the device, both without distortion."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import numpy as np

from vislam.config import OakConfig
from vislam.core.camera import Camera
from vislam.hw.cameras.factory import factory_camera

_STEREO_SIZE = (640, 400)  # of the grey images that depth is found in; as depthai's own examples have it


def colour_and_depth(dai: Any, pipeline: Any, calibration: Any, config: OakConfig, is_newer: bool) -> Any:
    """Return the queue of groups of `color` and `depth` of one time.

    Depth is found in the grey pair and warped into the colour image, which is freed of its distortion for that: by the
    node of stereo depth itself, or (`is_newer`: RVC4) by one of its own.
    """
    node, rate = dai.node, config.rate_hz
    sockets = calibration.getStereoLeftCameraId(), calibration.getStereoRightCameraId()
    colour = pipeline.create(node.Camera).build(dai.CameraBoardSocket.CAM_A)
    set_exposure(colour, config)
    stereo, sync = pipeline.create(node.StereoDepth), pipeline.create(node.Sync)
    for socket, entrance in zip(sockets, (stereo.left, stereo.right), strict=True):
        pipeline.create(node.Camera).build(socket).requestOutput(_STEREO_SIZE, fps=rate).link(entrance)
    size, bgr = (config.width_px, config.height_px), dai.ImgFrame.Type.BGR888i
    images = colour.requestOutput(size, type=bgr, fps=rate, enableUndistortion=True)
    sync.setSyncThreshold(timedelta(seconds=0.5 / rate))
    images.link(sync.inputs["color"])
    if is_newer:
        align = pipeline.create(node.ImageAlign)
        stereo.depth.link(align.input)
        images.link(align.inputAlignTo)
        align.outputAligned.link(sync.inputs["depth"])
    else:
        images.link(stereo.inputAlignTo)
        stereo.depth.link(sync.inputs["depth"])
    return sync.out.createOutputQueue(maxSize=2, blocking=False)


def colour_camera(calibration: Any, socket: Any, config: OakConfig) -> Camera:
    """Return the colour camera as its undistorted images have it: a pinhole, cut to the shape that is asked for."""
    size = (config.width_px, config.height_px)
    K = np.array(calibration.getCameraIntrinsics(socket, *size))
    return factory_camera(size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), "none", ())


def set_exposure(camera: Any, config: OakConfig) -> None:
    """Fix exposure and gain, where that is asked for."""
    if config.exposure_s is not None:
        iso = 400 if config.gain is None else round(config.gain)
        camera.initialControl.setManualExposure(round(config.exposure_s * 1e6), iso)
