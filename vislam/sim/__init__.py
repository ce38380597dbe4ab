"""The simulated world: smooth motion, sensor models and rendered images, with exact truth for everything."""

from vislam.sim.motion.motions import POINT_WORLDS
from vislam.sim.points import MeasuredInertial, PointOptions, PointRecording, open_points
from vislam.sim.worlds.simulation import SimOptions, Simulation, TrueStates, open_world
from vislam.sim.worlds.table import WORLD_NAMES, WORLDS

POINT_WORLD_NAMES: tuple[str, ...] = (*POINT_WORLDS, *WORLDS)

__all__ = [
    "POINT_WORLD_NAMES",
    "WORLD_NAMES",
    "MeasuredInertial",
    "PointOptions",
    "PointRecording",
    "SimOptions",
    "Simulation",
    "TrueStates",
    "open_points",
    "open_world",
]
