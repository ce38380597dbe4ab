"""Which way is up by what a camera with depth saw: floors, table tops and walls, and how people hold cameras."""

from vislam.mapping.upright.normals import View, view_of
from vislam.mapping.upright.planes import surest_up, up_of_planes

__all__ = [
    "View",
    "surest_up",
    "up_of_planes",
    "view_of",
]
