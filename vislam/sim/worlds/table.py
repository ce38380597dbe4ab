"""The table of simulated worlds and the sensors that each carries by default."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from vislam.core.camera import EXACT, Camera, Rig
from vislam.core.messages import Array
from vislam.imu import ImuNoise
from vislam.sim.motion.spline import BodySpline
from vislam.sim.scene import SceneBuilder
from vislam.sim.sensing import CONSUMER_IMU, CONSUMER_TURN_ON, GY85_IMU, GY85_TURN_ON, TurnOn
from vislam.sim.worlds import corridor, hall, halls, room

RigKind = Literal["rgbd", "stereo", "mono"]

_BASELINE_M = 0.11
# Columns: x right, y down, z forward of a camera that looks along the body's x.
_R_BODY_CAM_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Sensors:
    """What a world's sensors do to the truth, where an option does not say otherwise."""

    imu: ImuNoise = CONSUMER_IMU
    turn_on: TurnOn = CONSUMER_TURN_ON
    exposure_s: float = 0.0
    camera_delay_s: float = 0.0  # stamps come so late
    camera_jitter_s: float = 0.0  # standard deviation of that


_CART = Sensors(GY85_IMU, GY85_TURN_ON, exposure_s=0.008, camera_delay_s=0.03, camera_jitter_s=0.002)


@dataclass(frozen=True, slots=True)
class World:
    """A world of the table: its place, its motion and how the camera is mounted."""

    description: str
    build: Callable[[np.random.Generator], SceneBuilder]
    motion: Callable[[np.random.Generator], BodySpline]
    rig: RigKind
    camera_hz: float
    camera_offset_m: tuple[float, float, float]  # of cam0 in the body frame
    camera_tilt_deg: float  # downwards
    sensors: Sensors = Sensors()


WORLDS: Mapping[str, World] = MappingProxyType({
    "workshop-cart": World(
        "a cart drives two laps through a furnished workshop of 13 x 9 m: 73 s, RGB-D, many loops",
        hall.build, hall.motion, "rgbd", 15.0, (0.14, 0.03, 0.22), 4.0,
    ),
    "handheld-room": World(
        "a camera carried by hand around a furnished room of 6 x 4.6 m, six degrees of freedom: 34 s, RGB-D",
        room.build, room.motion, "rgbd", 20.0, (0.05, 0.02, 0.03), 0.0,
    ),
    "corridor-loop": World(
        "a walk of 70 m through four corridors, closed once at the end: 64 s, stereo",
        corridor.build, corridor.motion, "stereo", 20.0, (0.06, 0.055, 0.04), 0.0,
    ),
    "aliased-halls": World(
        "a walk of 67 m through four halls that look alike, 1.6 rounds: 62 s, RGB-D, made to fool appearance",
        halls.build, halls.motion, "rgbd", 10.0, (0.06, 0.02, 0.04), 0.0,
    ),
    "cart-drive": World(
        "a cart drives 105 m through the same workshop, with stops: one webcam 0.6 m above the floor, a GY-85",
        hall.build, hall.cart_drive, "mono", 15.0, (0.2, 0.02, 0.3), 18.0, _CART,
    ),
})  # fmt: skip

WORLD_NAMES: tuple[str, ...] = tuple(WORLDS)


def camera(width_px: int) -> Camera:
    """Return the simulated camera at a width: 4:3, 70 degrees wide, mild radial-tangential distortion."""
    full = Camera(
        width=640, height=480, fx=456.4, fy=455.7, cx=322.1, cy=237.6, distortion="radtan",
        coefficients=(-0.081, 0.042, 0.0006, -0.0004), sigmas=EXACT,
    )  # fmt: skip
    return full.scaled(width_px / full.width)


def make_rig(world: World, kind: RigKind, width_px: int) -> Rig:
    """Return the cameras of a world: mounted with a lever arm and, as in real life, never quite straight."""
    tilt = Rotation.from_euler("y", world.camera_tilt_deg, degrees=True).as_matrix()
    skewed = Rotation.from_rotvec([0.008, -0.006, 0.011]).as_matrix()
    cam0 = _pose(tilt @ _R_BODY_CAM_LEVEL @ skewed, np.array(world.camera_offset_m))
    if kind != "stereo":
        return Rig((camera(width_px),), (cam0,), has_depth=kind == "rgbd")
    beside = _pose(Rotation.from_rotvec([-0.004, 0.005, 0.003]).as_matrix(), np.array([_BASELINE_M, 0.0006, -0.0004]))
    return Rig((camera(width_px), camera(width_px)), (cam0, cam0 @ beside))


def surrounded(rig: Rig, count: int) -> Rig:
    """Return a rig with its first camera `count` times more, evenly around the body's vertical."""
    angles = 2.0 * np.pi * np.arange(1, count + 1) / (count + 1)
    turns = Rotation.from_rotvec(angles[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    poses = [_pose(turn, np.zeros(3)) @ rig.T_body_cam0 for turn in turns]
    return replace(rig, cameras=(*rig.cameras, *rig.cameras[:1] * count), T_body_cams=(*rig.T_body_cams, *poses))


def _pose(R: Array, t: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
