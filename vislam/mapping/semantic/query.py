"""Questions to the labels of a map: what is here, and where is the nearest thing of a kind?"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.errors import DataError, UsageError
from vislam.core.messages import Array
from vislam.mapping.semantic.layer import LabelLayer, Thing, thing_data


@dataclass(frozen=True, slots=True, eq=False)
class NearestLabel:
    """The nearest labelled voxels of a class."""

    distance_m: Array  # [N] to the voxel's middle; infinite where there is none
    voxel_m: Array  # [N, 3] its middle; NaN where there is none
    thing: NDArray[np.int32]  # [N] the thing that it belongs to; -1 where there is none
    votes: NDArray[np.int32]  # [N] keyframes that saw the class in that voxel
    share: Array  # [N] of the keyframes that said anything of it; NaN where there is none


def class_id(layer: LabelLayer, name: str) -> int:
    """Return the id of a class; raises UsageError that lists what there is when no voxel has it."""
    there = {layer.classes[i].name: i for i in np.unique(layer.labels).tolist()}
    if name not in there:
        raise UsageError(f"no voxel of the map is labelled '{name}'; there are: {', '.join(sorted(there)) or 'none'}")
    return there[name]


def nearest(layer: LabelLayer, points_m: Array, name: str, window_m: float = np.inf) -> NearestLabel:
    """Return the nearest voxel of a class within `window_m` of each point [N, 3]; stray voxels do not count.

    Raises UsageError for a class that is not in the map, DataError for points that are not finite.
    """
    wanted = class_id(layer, name)
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise DataError(f"a place must be three finite numbers of metres, got {points.tolist()}")
    if not window_m > 0.0:
        raise DataError(f"the window must be a positive number of metres, got {window_m}")
    rows = np.flatnonzero((layer.labels == wanted) & (layer.thing_of >= 0))
    distance, found = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    if len(rows):
        answer = cKDTree(layer.points_m[rows].astype(np.float64)).query(points, distance_upper_bound=window_m)
        distance, found = np.asarray(answer[0], np.float64), np.asarray(answer[1], np.int64)
    is_there = np.isfinite(distance)
    row = rows[found[is_there]]
    voxel, share = np.full((len(points), 3), np.nan), np.full(len(points), np.nan)
    thing, votes = np.full(len(points), -1, np.int32), np.zeros(len(points), np.int32)
    voxel[is_there], thing[is_there], votes[is_there] = layer.points_m[row], layer.thing_of[row], layer.votes[row]
    share[is_there] = layer.votes[row] / layer.total[row]
    return NearestLabel(distance, voxel, thing, votes, share)


def things_of(layer: LabelLayer, name: str) -> list[Thing]:
    """Return all things of a class, the largest first; raises UsageError as `class_id`."""
    wanted = class_id(layer, name)
    return [thing for thing in layer.things if thing.label == wanted]


def describe_nearest(layer: LabelLayer, place_m: tuple[float, float, float], name: str) -> dict[str, Any]:
    """Return what is known of the nearest thing of a class as plain data; raises as `nearest`.

    `nearest_m` is None where all voxels of the class are stray ones.
    """
    found = nearest(layer, np.array([place_m]), name)
    answer: dict[str, Any] = {"label": name, "from_m": list(place_m), "nearest_m": None}
    answer["things"] = len(things_of(layer, name))
    if not np.isfinite(found.distance_m[0]):
        return answer
    thing = layer.things[int(found.thing[0])]
    return {
        **answer,
        "nearest_m": round(float(found.distance_m[0]), 3),
        "nearest_at_m": found.voxel_m[0].round(3).tolist(),
        "keyframes": int(found.votes[0]),
        "keyframes_share": round(float(found.share[0]), 4),
        "thing": thing_data(thing),
    }


def label_at(layer: LabelLayer, points_m: Array) -> list[str]:
    """Return the names [N] of the classes at points [N, 3]; empty where no voxel is labelled."""
    labels = layer.label_at(np.asarray(points_m, dtype=np.float64)).tolist()
    return [layer.classes[i].name if i else "" for i in labels]
