"""The simulated world: smooth motion, sensor models and rendered images, with exact truth for everything."""

from vislam.sim.simulation import SimOptions, Simulation, TrueStates, open_world
from vislam.sim.worlds import WORLD_NAMES, WORLDS

WORLD_DESCRIPTIONS: dict[str, str] = {name: world.description for name, world in WORLDS.items()}

__all__ = ["WORLD_DESCRIPTIONS", "WORLD_NAMES", "SimOptions", "Simulation", "TrueStates", "open_world"]
