"""Colours of charts levelled, so that none of their borders can be seen.

The global adjustment of Waechter, Moehrle and Goesele, "Let there be color! Large-scale texturing of 3D
reconstructions", ECCV 2014: each vertex of each chart gets an offset; both sides of a border are to have one colour,
offsets within a chart are to be smooth, and small.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

from vislam.core.messages import Array

_SMALL = 1e-3  # weight of an offset being none: it fades over thirty vertices
_ASTRAY = 30.0  # grey levels; sides that differ by more count less: something else is seen there
_TOLERANCE = 1e-2
_MOST_STEPS = 500


def offsets(colors: Array, vertex: NDArray[np.integer], triangles: NDArray[np.integer]) -> Array:
    """Return what to add to colours [P, 3] of the corners of charts.

    Args:
        colors: of the corners of charts, 0 to 255; NaN where cut off.
        vertex: of the mesh that each corner is [P]; those of several charts are borders.
        triangles: of corners [M, 3], each within one chart.
    """
    order = np.argsort(vertex, kind="stable")
    same = vertex[order][1:] == vertex[order][:-1]
    a, b = order[:-1][same], order[1:][same]
    known = np.isfinite(colors[a]).all(axis=1) & np.isfinite(colors[b]).all(axis=1)
    a, b = a[known], b[known]
    apart = colors[b] - colors[a]
    weight = 1.0 / (1.0 + (np.abs(apart).max(axis=1) / _ASTRAY) ** 2)
    c, d = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).T
    rows, columns = np.concatenate([a, c]), np.concatenate([b, d])
    weights = np.concatenate([weight, np.full(len(c), 0.5)])  # an edge belongs to two triangles
    size = len(colors)
    links = coo_matrix((weights, (rows, columns)), shape=(size, size)).tocsr()
    links = links + links.T
    diagonal = np.asarray(links.sum(axis=1)).ravel() + _SMALL
    H = diags(diagonal) - links
    out = np.zeros((size, 3))
    for k in range(3):
        g = np.bincount(a, weight * apart[:, k], size) - np.bincount(b, weight * apart[:, k], size)
        out[:, k], _ = cg(H, g, rtol=_TOLERANCE, maxiter=_MOST_STEPS, M=diags(1.0 / diagonal))
    return out
