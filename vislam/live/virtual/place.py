"""Where the virtual cart drives: the workshop of the demo, its camera, and the way through it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from vislam.core.camera import Rig
from vislam.core.messages import Array
from vislam.sim.motion.path import rounded_path
from vislam.sim.scene import Scene, painted
from vislam.sim.worlds import hall
from vislam.sim.worlds.table import WORLDS, make_rig

BODY_HEIGHT_M = 0.3
_LAP = [(4.55, -2.65), (4.6, 2.6), (-0.4, 2.75), (-4.6, 2.55), (-4.55, -2.6)]


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """What can be chosen about the virtual cart."""

    rig: Literal["mono", "rgbd", "none"] = "mono"  # none: no camera
    camera_hz: Annotated[float, Field(gt=0.5, le=60.0)] = 10.0  # less where the machine cannot render as many
    image_width_px: Annotated[int, Field(ge=64, le=1280, multiple_of=4)] = 320
    camera_delay_s: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.0  # that stamps are late by
    laps: Annotated[int, Field(ge=0, le=1000)] = 2  # of 26 m; 0: it stands
    steered: bool = False  # by who writes commands, see experiments/follow_path.py
    seed: int = 0
    bridge: bool = False  # its IMU is a board on a serial port, else on I2C
    # what happens in `imu_out`; all but the first with `bridge` alone
    imu_fault: Literal["unplugged", "silent", "garbage", "no_gyro", "no_accel", "frozen"] = "unplugged"
    imu_out: tuple[tuple[float, float], ...] = ()  # s since the beginning: from, to
    camera_out: tuple[tuple[float, float], ...] = ()


def virtual_rig(options: PlaceOptions) -> Rig:
    """Return its camera, if any: that of the world `cart-drive`, 0.6 m above the floor."""
    if options.rig == "none":
        return Rig((), ())
    return make_rig(WORLDS["cart-drive"], options.rig, options.image_width_px)


def make_scene(seed: int) -> Scene:
    """Return the painted workshop; takes seconds."""
    return painted(hall.build, seed)


def course(laps: int) -> Array:
    """Return the way [N, 2] of a number of laps, dense; it begins where the cart stands, heading along x."""
    points = [(-1.2, -2.6), *(_LAP * max(laps, 1)), (0.2, -2.65)]
    return rounded_path(points, 0.9).xy_m
