"""Rendered scenes: surfaces, paint, furniture, and the ray caster that sees them.

Compiled by hand: 510 lines. No peer has been measured. To be dropped for a renderer that installs as a wheel, needs
no display, and gives exact depth and a pose per image row.
"""

from vislam.sim.scene.bake import painted
from vislam.sim.scene.names import NAMES, Hung
from vislam.sim.scene.render import Renderer
from vislam.sim.scene.scene import Painter, Scene, SceneBuilder

__all__ = [
    "NAMES",
    "Hung",
    "Painter",
    "Renderer",
    "Scene",
    "SceneBuilder",
    "painted",
]
