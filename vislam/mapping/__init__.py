"""Dense maps from keyframe poses: clouds, an occupancy octree, a navigation grid, a mesh and pictures of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vislam.core.late import late

if TYPE_CHECKING:
    from vislam.mapping.depth.localise import Guess
    from vislam.mapping.drive.drive_grid import Drive, DriveMap
    from vislam.mapping.mapper import Mapper
    from vislam.mapping.products import write_products
    from vislam.mapping.semantic.classes import LabelClasses
    from vislam.mapping.semantic.layer_files import read_layer
    from vislam.mapping.semantic.query import label_at, nearest, things_of

__all__ = [
    "Drive",
    "DriveMap",
    "Guess",
    "LabelClasses",
    "Mapper",
    "label_at",
    "nearest",
    "read_layer",
    "things_of",
    "write_products",
]

__getattr__ = late(
    __name__,
    {
        "Drive DriveMap": "vislam.mapping.drive.drive_grid",
        "Guess": "vislam.mapping.depth.localise",
        "LabelClasses": "vislam.mapping.semantic.classes",
        "Mapper": "vislam.mapping.mapper",
        "label_at nearest things_of": "vislam.mapping.semantic.query",
        "read_layer": "vislam.mapping.semantic.layer_files",
        "write_products": "vislam.mapping.products",
    },
)
