"""Matching where a pose is known: the point of one view is looked for near its place in the other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.geometry import invert
from vislam.core.jit import njit
from vislam.core.messages import Array
from vislam.loop.view import View
from vislam.vision.hamming import distance, packed

Pairs = NDArray[np.int64]


class _Other(NamedTuple):
    """Features of the other view."""

    order: NDArray[np.int64]  # [M] by x
    x: Array  # [M] in that order
    xy: NDArray[np.float32]  # [M, 2]
    descriptors: NDArray[np.uint64]  # [M, 4]


@njit(cache=True, nogil=True)
def _search(
    points: Array, descriptors: NDArray[np.uint64], T_other_this: Array, other: _Other, radius: float,
    max_distance: int,
) -> Pairs:  # fmt: skip
    """Return mutual best pairs [K, 2] (this, other) of points [N, 3] and the other's features within `radius`."""
    order, x_sorted, xy_other, descriptors_other = other
    nearest = np.full(len(points), -1, np.int64)
    owner = np.full(len(xy_other), -1, np.int64)
    owner_distance = np.full(len(xy_other), 257, np.int64)
    T = T_other_this
    for i in range(len(points)):
        px, py, pz = points[i]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if not z > 0.0:  # behind the other view, or NaN: no point
            continue
        x = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) / z
        y = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) / z
        best = max_distance + 1
        for s in range(np.searchsorted(x_sorted, x - radius), len(order)):
            if x_sorted[s] > x + radius:
                break
            j = order[s]
            dx, dy = xy_other[j, 0] - x, xy_other[j, 1] - y
            if dx * dx + dy * dy <= radius * radius:
                d = distance(descriptors, i, descriptors_other, j)
                if d < best:
                    best, nearest[i] = d, j
        j = nearest[i]
        if j >= 0 and best < owner_distance[j]:
            owner[j], owner_distance[j] = i, best
    pairs = np.empty((len(points), 2), np.int64)
    count = 0
    for i in range(len(points)):
        if nearest[i] >= 0 and owner[nearest[i]] == i:
            pairs[count, 0], pairs[count, 1] = i, nearest[i]
            count += 1
    return pairs[:count]


def _one_way(this: View, other: View, T_other_this: Array, radius: float, max_distance: int) -> Pairs:
    order, x_sorted = other.by_x
    return np.asarray(
        _search(
            this.points_or_nan(), packed(this.descriptors), T_other_this,
            _Other(order, x_sorted, other.xy, packed(other.descriptors)), radius, max_distance,
        ),
        dtype=np.int64,
    )  # fmt: skip


def match_guided(a: View, b: View, T_a_b: Array, radius: float, max_distance: int) -> Pairs:
    """Return feature pairs [K, 2] (a, b) that a relative pose of the cameras [4, 4] brings within `radius` on z = 1.

    Points of a are looked for in b; what remains of b's points is looked for in a. No feature occurs twice.
    """
    forward = _one_way(a, b, invert(T_a_b), radius, max_distance)
    reverse = _one_way(b, a, T_a_b, radius, max_distance)[:, ::-1]
    free_a, free_b = np.ones(len(a.xy), np.bool_), np.ones(len(b.xy), np.bool_)
    free_a[forward[:, 0]], free_b[forward[:, 1]] = False, False
    return np.concatenate([forward, reverse[free_a[reverse[:, 0]] & free_b[reverse[:, 1]]]])
