"""Visual odometry: mono, stereo, RGB-D and planar front ends behind one protocol."""

from vislam.config import FrontEndConfig
from vislam.config.frontend import Mode
from vislam.core.camera import Rig
from vislam.core.errors import UsageError
from vislam.core.kinds import Kinds, lacking
from vislam.frontend.further_cameras import WithFurtherCameras
from vislam.frontend.metric import RgbdFrontEnd, StereoFrontEnd
from vislam.frontend.mono import MonoFrontEnd
from vislam.frontend.no_camera import NoFrontEnd
from vislam.frontend.planar import PlanarFrontEnd
from vislam.frontend.result import CommonErrors, FrontEnd, FrontEndKind, TrackResult
from vislam.imu import ImuNoise

__all__ = [
    "FRONT_ENDS",
    "FrontEnd",
    "FrontEndKind",
    "TrackResult",
    "common_errors",
    "knows_scale",
    "make_frontend",
    "mode_for",
]


FRONT_ENDS = Kinds[type[FrontEndKind]](
    "vislam.front_ends",
    {
        "rgbd": RgbdFrontEnd,
        "stereo": StereoFrontEnd,
        "mono": MonoFrontEnd,
        "planar": PlanarFrontEnd,
        "none": NoFrontEnd,
    },
    lacking("knows_scale", "errors", "track", "begin_at"),
)


def knows_scale(mode: str) -> bool:
    """Return whether motions of a front end are in metres; of one that is not known here they are taken to be."""
    return mode not in FRONT_ENDS or FRONT_ENDS[mode].knows_scale


def mode_for(config: FrontEndConfig, rig: Rig) -> Mode:
    """Return the name of the front end that a configuration means.

    `auto` takes the richest that the rig allows; one camera whose height above a floor is known is `planar`. Raises
    UsageError where one is to look through a camera that there is not, DataError for a pair of cameras at one place.
    """
    if rig.is_blind:
        if config.mode not in ("auto", "none"):
            raise UsageError(f"--frontend.mode {config.mode} needs a camera, and the recording has none; leave it away")
        return "none"
    one_camera: Mode = "mono" if config.planar.height_m is None else "planar"
    richest: Mode = "rgbd" if rig.has_depth else "stereo" if rig.is_stereo else one_camera
    mode = richest if config.mode == "auto" else config.mode
    if mode == "stereo":
        rig.check_baseline()
    return mode


def common_errors(config: FrontEndConfig, rig: Rig, noise: ImuNoise | None) -> CommonErrors:
    """Return what motions of the front end of `mode_for` have in common; `noise` is the IMU's, None without one."""
    return FRONT_ENDS[mode_for(config, rig)].errors(config, rig, noise)


def make_frontend(config: FrontEndConfig, rig: Rig, seed: int) -> FrontEnd:
    """Return the front end of `mode_for`; raises UsageError when the rig lacks what the mode needs."""
    front = FRONT_ENDS[mode_for(config, rig)](config, rig, seed)
    return WithFurtherCameras(front, config, rig) if rig.further else front
