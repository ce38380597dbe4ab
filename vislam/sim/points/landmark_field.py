"""Landmarks without images: points scattered around a path, so that a camera on it sees some wherever it looks."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.messages import Array

Indices = NDArray[np.int64]

_ANCHOR_M = 2.0  # the path is thinned to one anchor per cube of this side
_PER_ANCHOR = 600  # points around each: with their neighbours', some 500 in a view of 80 x 60 degrees
_LEAST = 6000  # points in all
_NEAR_M, _MIDDLE_M, _FAR_M = 1.5, 8.0, 30.0  # walls and furniture between the first two, the rest of the hall beyond
_FAR_SHARE = 0.12
_CLEARANCE_M = 0.9  # from the path: the body does not drive through things
_REACH_M = 16.0  # anchors further away do not count
_STRIDE_M = 1.0  # the camera may move so far before the points around it are chosen again


class LandmarkField:
    """Points [N, 3] in the world, kept by the anchor they were scattered around."""

    def __init__(self, path_m: Array, rng: np.random.Generator) -> None:
        """Scatter points around a path [M, 3]: evenly in all directions, their distances evenly in the logarithm."""
        cubes = np.floor(path_m / _ANCHOR_M).astype(np.int64)
        first = np.sort(np.unique(cubes, axis=0, return_index=True)[1])
        self._anchors: Array = path_m[first]
        each = max(_PER_ANCHOR, -(-_LEAST // len(first)))
        count = each * len(first)
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        far = rng.random(count) < _FAR_SHARE
        low, high = np.where(far, _MIDDLE_M, _NEAR_M), np.where(far, _FAR_M, _MIDDLE_M)
        distance = low * (high / low) ** rng.random(count)
        points = np.repeat(self._anchors, each, axis=0) + distance[:, None] * direction
        thinned = path_m[np.sort(np.unique(np.floor(path_m / 0.3).astype(np.int64), axis=0, return_index=True)[1])]
        clear = cKDTree(thinned).query(points, distance_upper_bound=_CLEARANCE_M)[0] > _CLEARANCE_M
        self.points_m: Array = np.ascontiguousarray(points[clear])
        self.strength: Array = rng.random(len(self.points_m))  # [N] of the corners that the points are, 0 to 1
        self._anchor_of = np.repeat(np.arange(len(first)), each)[clear]
        self._starts = np.searchsorted(self._anchor_of, np.arange(len(first) + 1))
        self._tree = cKDTree(self._anchors)

    def around(self, position_m: Array) -> Indices:
        """Return the indices of the points whose anchor is within reach of a position [3], ascending."""
        anchors = np.sort(np.asarray(self._tree.query_ball_point(position_m, _REACH_M), dtype=np.int64))
        parts = [np.arange(self._starts[a], self._starts[a + 1]) for a in anchors]
        return np.concatenate(parts).astype(np.int64) if parts else np.empty(0, dtype=np.int64)


class Surroundings:
    """The points around a moving camera; chosen again only when it has moved far enough to matter."""

    def __init__(self, field: LandmarkField) -> None:
        """Start nowhere."""
        self._field = field
        self._centre: Array | None = None
        self._near = np.empty(0, dtype=np.int64)

    def at(self, position_m: Array) -> Indices:
        """Return the indices of the points around a position [3]."""
        if self._centre is None or np.linalg.norm(position_m - self._centre) > _STRIDE_M:
            self._centre = position_m.copy()
            self._near = self._field.around(position_m)
        return self._near
