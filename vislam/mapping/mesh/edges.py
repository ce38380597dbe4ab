"""Edges of triangles, and which triangles share one."""

import numpy as np
from numpy.typing import NDArray


def edges_of(triangles: NDArray[np.integer], directed: bool = False) -> NDArray[np.int64]:
    """Return one number per edge [3 M] of triangles [M, 3]: all first edges, then all second and third ones."""
    a, b = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64).T
    return (a << 32) + b if directed else (np.minimum(a, b) << 32) + np.maximum(a, b)


def neighbours(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the pairs [E, 2] of triangles that share an edge."""
    edges, owner = edges_of(triangles), np.tile(np.arange(len(triangles)), 3)
    order = np.argsort(edges, kind="stable")
    same = edges[order][1:] == edges[order][:-1]
    return np.column_stack([owner[order][:-1][same], owner[order][1:][same]])
