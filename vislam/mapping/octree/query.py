"""What a robot asks of an occupancy map, for many places at once: rays, collisions of shapes, what is nearest.

All coordinates are in the map frame. Where nothing was seen is neither free nor occupied, and each answer keeps that
apart; places beyond the key range are unknown. A map that is being written to must be asked from the same thread, or
as the copy that `CorrectedOccupancy` swapped out.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vislam.core.errors import DataError
from vislam.core.geometry import are_rotations
from vislam.core.messages import Array
from vislam.mapping.octree import query_kernels as kernels
from vislam.mapping.octree.occupancy import Octree

Numbers = NDArray[np.floating] | list[float] | list[list[float]] | tuple[float, ...]
_MAX_SHAPE_VOXELS = 1 << 26  # a shape of 20 x 20 x 20 m at 5 cm


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """How rays ended."""

    outcome: NDArray[np.int8]  # [N] `Occupancy`: OCCUPIED hit; UNKNOWN stopped there; FREE nothing within the range
    range_m: Array  # [N] from the origin to where the ray enters the voxel that ended it, at most the range
    voxel_m: Array  # [N, 3] centre of that voxel; NaN where there is none


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The nearest voxels of a kind."""

    distance_m: Array  # [N] to the nearest point of the voxel, 0 inside it; infinite where there is none
    voxel_m: Array  # [N, 3] its centre; NaN where there is none


def ray_cast(
    grid: Octree,
    origins_m: Numbers,
    directions: Numbers,
    max_range_m: float,
    unknown: Literal["pass", "stop"] = "pass",
) -> RayHits:
    """Follow rays from origins [N, 3] or [3] along directions [N, 3] to the first occupied voxel.

    "pass" looks through unknown voxels as if they were free, "stop" ends there. The origin's own voxel counts.
    Cells are those of Amanatides and Woo's traversal (1987), from the origin as float32. Raises DataError on input that
    is not finite, a direction of length zero or a range that is not positive.
    """
    ways = _rows(directions, 3, "directions")
    origins = _rows(origins_m, 3, "ray origins").astype(np.float32).astype(np.float64)
    starts = np.array(np.broadcast_to(origins, ways.shape), order="C")  # a view may be read-only: another kernel
    lengths = np.linalg.norm(ways, axis=1)
    if not (lengths > 0.0).all():
        raise DataError(f"the direction of ray {int(np.flatnonzero(~(lengths > 0.0))[0])} has length zero")
    _check_positive(max_range_m, "a ray's range")
    outcome, range_m, voxel = kernels.cast(
        starts, ways / lengths[:, None], max_range_m, unknown == "stop", grid.resolution_m,
        *grid.pool.arrays,
    )  # fmt: skip
    return RayHits(outcome, range_m, voxel)


def sphere_state(grid: Octree, centres_m: Numbers, radius_m: float) -> NDArray[np.int8]:
    """Return the `Occupancy` [N] of the voxels that spheres around centres [N, 3] reach into.

    OCCUPIED when any of them is, else UNKNOWN when any is, else FREE. Raises DataError on input that is not finite or
    a sphere of more voxels than anyone can mean.
    """
    centres = _rows(centres_m, 3, "sphere centres")
    _check_positive(radius_m, "a sphere's radius")
    _check_size(grid, np.full(3, 2.0 * radius_m))
    return np.asarray(kernels.spheres(centres, radius_m, grid.resolution_m, *grid.pool.arrays))


def box_state(grid: Octree, centres_m: Numbers, size_m: Numbers, R_map_box: Numbers | None = None) -> NDArray[np.int8]:
    """Return the `Occupancy` [N], as of `sphere_state`, of boxes of size [3] around centres [N, 3].

    `R_map_box` [N, 3, 3] or [3, 3] turns them; without it they stand along the map's axes. The test is exact
    (separating axes; Gottschalk et al. 1996); to touch is not to collide. Raises DataError like `sphere_state`, and
    for a matrix that is no rotation.
    """
    centres = _rows(centres_m, 3, "box centres")
    size = _rows(size_m, 3, "a box's size")[0]
    if not (size > 0.0).all():
        raise DataError(f"a box's size must be positive, got {size.tolist()} m")
    turn = np.eye(3) if R_map_box is None else np.asarray(R_map_box, dtype=np.float64)
    if turn.shape not in ((3, 3), (len(centres), 3, 3)):
        raise DataError(f"boxes are turned by one or {len(centres)} rotations, got shape {turn.shape}")
    R = np.array(np.broadcast_to(turn, (len(centres), 3, 3)), order="C")
    if not are_rotations(R, 1e-6).all():
        raise DataError("a box is turned by a matrix that is no rotation")
    _check_size(grid, np.full(3, float(np.linalg.norm(size))))
    return np.asarray(kernels.boxes(centres, 0.5 * size, R, grid.resolution_m, *grid.pool.arrays))


def footprint_state(grid: Octree, poses: Numbers, polygon_m: Numbers, low_m: float, high_m: float) -> NDArray[np.int8]:
    """Return the `Occupancy` [N], as of `sphere_state`, of a robot's body at planar poses [N, 3]: x, y (m), yaw (rad).

    The body is the convex polygon [K, 2] in the robot's frame between two heights of the map; begin it a voxel above
    the floor. Raises DataError on input that is not finite, a polygon that is not convex or no height.
    """
    places = _rows(poses, 3, "poses")
    polygon = _rows(polygon_m, 2, "a footprint")
    edges = np.roll(polygon, -1, axis=0) - polygon
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    whole_turn = np.abs(np.arctan2(turns, (edges * following).sum(axis=1)).sum())
    if len(polygon) < 3 or not ((turns > 0.0).all() or (turns < 0.0).all()) or whole_turn > 2.5 * np.pi:
        raise DataError("a footprint must be a convex polygon of at least 3 corners; ask for convex parts one by one")
    if not -np.inf < low_m < high_m < np.inf:
        raise DataError(f"a footprint reaches from a lower to a higher height, got {low_m} to {high_m} m")
    reach = 2.0 * float(np.linalg.norm(polygon, axis=1).max())
    _check_size(grid, np.array([reach, reach, high_m - low_m]))
    return np.asarray(kernels.footprints(places, polygon, low_m, high_m, grid.resolution_m, *grid.pool.arrays))


def nearest_obstacle(grid: Octree, points_m: Numbers, window_m: float) -> Nearest:
    """Return the nearest occupied voxel within `window_m` of each point [N, 3].

    Raises DataError on points that are not finite or a window that is not positive.
    """
    return _nearest(grid, points_m, window_m, False)


def nearest_frontier(grid: Octree, points_m: Numbers, window_m: float) -> Nearest:
    """Return the nearest free voxel with an unknown voxel beside it (Yamauchi 1997), as the crow flies.

    Raises DataError like `nearest_obstacle`.
    """
    return _nearest(grid, points_m, window_m, True)


def _nearest(grid: Octree, points_m: Numbers, window_m: float, frontier: bool) -> Nearest:
    points = _rows(points_m, 3, "points")
    _check_positive(window_m, "the window")
    distance, voxel = kernels.nearest(points, window_m, frontier, grid.resolution_m, *grid.pool.arrays)
    return Nearest(distance, voxel)


def _rows(values: Numbers, width: int, what: str) -> Array:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape[-1:] != (width,) or array.ndim > 2:
        raise DataError(f"{what} must be [N, {width}] numbers, got shape {array.shape}")
    array = array.reshape(-1, width)
    if not np.isfinite(array).all():
        first = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise DataError(f"{what} must be finite, got {array[first].tolist()} in row {first}")
    return array


def _check_positive(value_m: float, what: str) -> None:
    if not 0.0 < value_m < np.inf:
        raise DataError(f"{what} must be a positive number of metres, got {value_m}")


def _check_size(grid: Octree, extent_m: Array) -> None:
    voxels = float((extent_m / grid.resolution_m + 2.0).prod())
    if voxels > _MAX_SHAPE_VOXELS:
        raise DataError(
            f"a shape of {extent_m.round(2).tolist()} m covers {voxels:.3g} voxels of {grid.resolution_m} m, at most "
            f"{_MAX_SHAPE_VOXELS} are looked at; ask for parts of it"
        )
