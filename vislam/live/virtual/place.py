"""Where the virtual cart drives: its world, its camera, and the way through it."""

from dataclasses import dataclass
from functools import lru_cache
from math import radians
from typing import Annotated, Literal

from pydantic import Field

from vislam.core.camera import Rig
from vislam.core.messages import Array
from vislam.sim.motion.path import rounded_path
from vislam.sim.scene import Scene, painted
from vislam.sim.worlds import corridor, hall, room
from vislam.sim.worlds.table import WORLDS, make_rig

BODY_HEIGHT_M = 0.3
WORLDS_BUILT = {"workshop": hall.build, "room": room.build, "corridor": corridor.build}
_LAPS = {
    "workshop": ((-1.2, -2.6), (4.55, -2.65), (4.6, 2.6), (-0.4, 2.75), (-4.6, 2.55), (-4.55, -2.6), (0.2, -2.65)),
    "room": ((-0.6, -0.6), (0.9, -0.6), (0.9, 0.9), (-1.3, 0.9), (-1.3, -0.6), (0.0, -0.6)),
    "corridor": ((-4.0, -6.5), (10.5, -6.5), (10.5, 6.5), (-10.5, 6.5), (-10.5, -6.5), (0.0, -6.5)),
}  # where it begins, a lap, and where it ends
_BEND_M = {"workshop": 0.9, "room": 0.5, "corridor": 0.9}


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """What can be chosen about the virtual cart."""

    world: Literal["workshop", "room", "corridor"] = "workshop"
    start_x_m: float | None = None  # None: where the world's lap begins, heading along x
    start_y_m: float | None = None
    start_yaw_deg: float = 0.0
    rig: Literal["mono", "rgbd", "none"] = "mono"  # none: no camera
    camera_hz: Annotated[float, Field(gt=0.5, le=60.0)] = 10.0  # less where the machine cannot render as many
    image_width_px: Annotated[int, Field(ge=64, le=1280, multiple_of=4)] = 320
    camera_delay_s: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.0  # that stamps are late by
    laps: Annotated[int, Field(ge=0, le=1000)] = 2  # of 26 m in the workshop; 0: it stands
    steered: bool = False  # by commands; without a new one for 0.3 s it stops
    seed: int = 0
    bridge: bool = False  # its IMU is a board on a serial port, else on I2C
    # what happens in `imu_out`, one after the other; all but the first with `bridge` alone
    imu_fault: tuple[Literal["unplugged", "silent", "garbage", "no_gyro", "no_accel", "frozen"], ...] = ("unplugged",)
    imu_out: tuple[tuple[float, float], ...] = ()  # s since the beginning: from, to
    camera_out: tuple[tuple[float, float], ...] = ()

    @property
    def start(self) -> tuple[float, float, float]:
        """Where it begins in the world: x, y and heading, in m and rad."""
        x, y = _LAPS[self.world][0]
        return (
            x if self.start_x_m is None else self.start_x_m, y if self.start_y_m is None else self.start_y_m,
            radians(self.start_yaw_deg),
        )  # fmt: skip


def virtual_rig(options: PlaceOptions) -> Rig:
    """Return its camera, if any: that of the world `cart-drive`, 0.6 m above the floor."""
    if options.rig == "none":
        return Rig((), ())
    return make_rig(WORLDS["cart-drive"], options.rig, options.image_width_px)


@lru_cache(maxsize=1)
def make_scene(world: str, seed: int) -> Scene:
    """Return a painted world; takes seconds the first time."""
    return painted(WORLDS_BUILT[world], seed)


def course(world: str, laps: int) -> Array:
    """Return the way [N, 2] of a number of laps, dense; it begins where the cart stands, heading along x."""
    first, *lap, last = _LAPS[world]
    return rounded_path([first, *(lap * max(laps, 1)), last], _BEND_M[world]).xy_m
