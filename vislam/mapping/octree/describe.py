"""What an octree holds, and what is at a place of it, in plain values for people and JSON."""

from typing import Any

import numpy as np

from vislam.core.errors import DataError
from vislam.mapping.octree.occupancy import Occupancy, Octree
from vislam.mapping.octree.query import nearest_frontier, nearest_obstacle
from vislam.mapping.octree.tree import OctreeLeaves


def describe_octree(octree: OctreeLeaves) -> dict[str, Any]:
    """Return resolution, extent [m], number of leaves, and volumes [m^3] of what is occupied and free."""
    centres, size = octree.centres_m()
    occupied = octree.log_odds >= 0.0
    answer: dict[str, Any] = {"resolution_m": octree.resolution_m, "leaves": len(octree)}
    if len(octree):
        answer["from_m"] = (centres - 0.5 * size[:, None]).min(axis=0).round(3).tolist()
        answer["to_m"] = (centres + 0.5 * size[:, None]).max(axis=0).round(3).tolist()
    answer["occupied_m3"] = round(float((size[occupied] ** 3).sum()), 3)
    answer["free_m3"] = round(float((size[~occupied] ** 3).sum()), 3)
    answer["colour"] = octree.colors is not None
    return answer


def describe_place(
    octree: OctreeLeaves, place_m: tuple[float, float, float], level: int, window_m: float
) -> dict[str, Any]:
    """Return state and probability at a place, and distance and centre of the nearest obstacle and frontier.

    Raises DataError on a place that is not finite, a level that does not exist or an octree too large to take apart.
    """
    point = np.array([place_m])
    if not np.isfinite(point).all():
        raise DataError(f"a place must be three finite numbers of metres, got {list(place_m)}")
    grid = Octree.from_leaves(octree)
    value = float(grid.log_odds_at(point, level)[0])
    answer: dict[str, Any] = {"place_m": list(place_m), "level": level}
    answer["state"] = Occupancy(int(grid.state_at(point, level)[0])).name.lower()
    answer["probability"] = None if np.isnan(value) else round(1.0 / (1.0 + float(np.exp(-value))), 4)
    for name, found in (
        ("obstacle", nearest_obstacle(grid, point, window_m)),
        ("frontier", nearest_frontier(grid, point, window_m)),
    ):
        is_there = bool(np.isfinite(found.distance_m[0]))
        answer[f"nearest_{name}_m"] = round(float(found.distance_m[0]), 3) if is_there else None
        answer[f"nearest_{name}_at_m"] = found.voxel_m[0].round(3).tolist() if is_there else None
    return answer
