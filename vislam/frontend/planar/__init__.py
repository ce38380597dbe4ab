"""Visual odometry of a cart by the floor: one camera at a known height."""

from vislam.frontend.planar.floor import up_in_camera
from vislam.frontend.planar.odometry import PlanarFrontEnd

__all__ = [
    "PlanarFrontEnd",
    "up_in_camera",
]
