"""Visual odometry: mono, stereo, RGB-D and planar front ends behind one protocol."""

from __future__ import annotations

from collections.abc import Callable

from vislam.config import FrontEndConfig
from vislam.config.frontend import Mode
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.frontend.metric import MetricFrontEnd
from vislam.frontend.mono import MonoFrontEnd
from vislam.frontend.planar import PlanarFrontEnd
from vislam.frontend.result import FrontEnd, TrackResult
from vislam.frontend.rgbd import ImageDepth
from vislam.frontend.view import View, stereo_views
from vislam.imu import ImuNoise

__all__ = ["FrontEnd", "TrackResult", "lasting_scale_sigma", "make_frontend", "mode_for"]


def _rgbd(config: FrontEndConfig, rig: Rig, seed: int) -> FrontEnd:
    if not rig.has_depth:
        raise UsageError("front end 'rgbd' needs depth images, this recording has none; use --frontend.mode auto")
    return MetricFrontEnd("rgbd", config, rig, (View(rig.cameras[0], rig.T_body_cams[0], ImageDepth(config)),), seed)


def _stereo(config: FrontEndConfig, rig: Rig, seed: int) -> FrontEnd:
    if not rig.is_stereo:
        raise UsageError("front end 'stereo' needs two cameras, this recording has one; use --frontend.mode auto")
    return MetricFrontEnd("stereo", config, rig, stereo_views(rig, config), seed)


FRONT_ENDS: dict[str, Callable[[FrontEndConfig, Rig, int], FrontEnd]] = {
    "rgbd": _rgbd,
    "stereo": _stereo,
    "mono": MonoFrontEnd,
    "planar": PlanarFrontEnd,
}


def mode_for(config: FrontEndConfig, rig: Rig) -> Mode:
    """Return the name of the front end that a configuration means.

    `auto` takes the richest that the rig allows; one camera whose height above a floor is known is `planar`.
    """
    if config.mode != "auto":
        return config.mode
    one_camera: Mode = "mono" if config.planar.height_m is None else "planar"
    return "rgbd" if rig.has_depth else "stereo" if rig.is_stereo else one_camera


def lasting_scale_sigma(config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> float:
    """Return the relative sigma of all metres together that motions do not tell of.

    Over a floor it is that of the camera's height; for one camera with an IMU that of the accelerometer's scale.
    """
    mode, planar = mode_for(config, rig), config.planar
    if mode == "mono":
        return 0.0 if noise is None else noise.accelerometer_scale_sigma or 0.0
    if mode != "planar" or planar.height_m is None:
        return 0.0
    return planar.height_sigma_m / planar.height_m


def make_frontend(config: FrontEndConfig, rig: Rig, seed: int) -> FrontEnd:
    """Return the front end of `mode_for`; raises UsageError when the rig lacks what the mode needs."""
    return FRONT_ENDS[mode_for(config, rig)](config, rig, seed)
