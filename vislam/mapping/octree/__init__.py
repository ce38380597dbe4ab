"""The occupancy octree: insertion, correction, queries and OctoMap's files.

Compiled by hand: 710 lines. Peer: OctoMap 1.9.7 in C++, -O3, which takes 4.9 to 36 times the CPU time per frame; its
files are the same byte for byte (benchmarks/RESULTS.md). To be dropped if OctoMap or a successor comes as a wheel,
takes scans at less than twice these times, and lets a keyframe be taken back.
"""

from vislam.mapping.octree.blocks import find_slot, keys_at
from vislam.mapping.octree.columns import NEVER, Columns, ColumnStore
from vislam.mapping.octree.correct import CorrectedOccupancy
from vislam.mapping.octree.describe import describe_octree, describe_place
from vislam.mapping.octree.occupancy import Occupancy, Octree
from vislam.mapping.octree.octomap_io import encode_bt, encode_ot, read_octree
from vislam.mapping.octree.query import (
    Nearest,
    RayHits,
    box_state,
    footprint_state,
    nearest_frontier,
    nearest_obstacle,
    ray_cast,
    sphere_state,
)
from vislam.mapping.octree.tree import OctreeLeaves

__all__ = [
    "NEVER",
    "ColumnStore",
    "Columns",
    "CorrectedOccupancy",
    "Nearest",
    "Occupancy",
    "Octree",
    "OctreeLeaves",
    "RayHits",
    "box_state",
    "describe_octree",
    "describe_place",
    "encode_bt",
    "encode_ot",
    "find_slot",
    "footprint_state",
    "keys_at",
    "nearest_frontier",
    "nearest_obstacle",
    "ray_cast",
    "read_octree",
    "sphere_state",
]
