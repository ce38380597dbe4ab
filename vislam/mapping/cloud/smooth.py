"""Moving least squares: every point of a cloud onto the smooth surface that its neighbours lie on.

Alexa et al., "Computing and rendering point set surfaces" (2003): a plane fitted with Gaussian weights, a quadric over
it, and the point moves along the plane's normal onto the quadric. Neighbours whose own surface looks another way count
less, as in robust implicit moving least squares (Oztireli et al. 2009), so that edges are not rounded.
Open3D's `smooth_mls` (0.20 and newer) ends with the plane: curved surfaces shrink, and edges are rounded by half as
much again (experiments/cloud_smoothing.py).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vislam.core.messages import Array
from vislam.mapping.cloud.cloud import Cloud

_CHUNK = 8192  # points at a time: 75 MB
_MOST_NEIGHBOURS = 48
_LEAST_NEIGHBOURS = 9  # a quadric has six coefficients; with fewer, the point stays
_SIGMAS = 2.0  # the radius in standard deviations of the Gaussian weight
_FACING = 0.35  # difference of unit normals at which a neighbour counts exp(-1/2): 20 degrees
_MOST_SHARE = 0.5  # of the radius; a point that would move by more is no noise of this surface
_RIDGE = 1e-6  # of the quadric's normal equations, in units of the radius: where neighbours lie on a line


def smoothed(cloud: Cloud, radius_m: float) -> Cloud:
    """Return the cloud with every point moved onto the surface through its neighbours within `radius_m`.

    Count, order and colours stay. Points with fewer than 9 neighbours there, and those that would move by more than
    half the radius, stay too. At most the 48 nearest neighbours count. The same cloud gives the same bytes.
    """
    if radius_m <= 0.0 or len(cloud) <= _LEAST_NEIGHBOURS:
        return cloud
    points = cloud.points_m.astype(np.float64)
    tree = cKDTree(points)
    normals = np.zeros_like(points)
    for chunk in _chunks(len(points)):
        offsets, weights, _ = _neighbourhood(tree, points, chunk, radius_m)
        normals[chunk] = _plane_normals(offsets, weights)
    out = cloud.points_m.copy()
    for chunk in _chunks(len(points)):
        offsets, weights, index = _neighbourhood(tree, points, chunk, radius_m)
        cosine = np.einsum("nkj,nj->nk", normals[index], normals[chunk])
        # normals have no side: the difference of unit vectors at this angle, squared, is 2 - 2 |cos|
        weights = weights * np.exp(-(1.0 - np.abs(cosine)) / _FACING**2)
        enough = (weights > np.exp(-0.5 * _SIGMAS**2) * 0.5).sum(axis=1) >= _LEAST_NEIGHBOURS
        axes = _frames(_plane_normals(offsets, weights))
        height_m = _quadric_height_m(offsets, weights, axes, radius_m)
        moves = enough & (np.abs(height_m) <= _MOST_SHARE * radius_m)
        out[chunk] = (points[chunk] + np.where(moves, height_m, 0.0)[:, None] * axes[:, 2]).astype(np.float32)
    return Cloud(out, cloud.colors)


def _chunks(count: int) -> list[slice]:
    return [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]


def _neighbourhood(
    tree: cKDTree, points: Array, chunk: slice, radius_m: float
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return offsets [n, k, 3] to the neighbours, their weights [n, k], 0 where there is none, and indices [n, k]."""
    here = points[chunk]
    distances_m, index = tree.query(here, k=min(_MOST_NEIGHBOURS, len(points)), distance_upper_bound=radius_m)
    there = np.isfinite(distances_m)
    index = np.where(there, index, 0).astype(np.int64)
    weights = np.where(there, np.exp(-0.5 * (np.where(there, distances_m, 0.0) * _SIGMAS / radius_m) ** 2), 0.0)
    return points[index] - here[:, None], weights, index


def _plane_normals(offsets: Array, weights: Array) -> Array:
    """Return the normals [n, 3] of the planes that fit weighted offsets [n, k, 3] best."""
    share = weights / weights.sum(axis=1, keepdims=True)  # a point is its own neighbour: never zero
    centred = offsets - np.einsum("nk,nkj->nj", share, offsets)[:, None]
    scatter = np.einsum("nk,nki,nkj->nij", share, centred, centred, optimize=True)
    return np.asarray(np.linalg.eigh(scatter)[1][:, :, 0])


def _frames(normals: Array) -> Array:
    """Return rows [n, 3, 3]: two directions in the plane, and its normal [n, 3]."""
    least = np.eye(3)[np.abs(normals).argmin(axis=1)]
    u = np.cross(normals, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.stack([u, np.cross(normals, u), normals], axis=1)


def _quadric_height_m(offsets: Array, weights: Array, axes: Array, radius_m: float) -> Array:
    """Return the height [n] over the point, along the third axis, of the quadric through its neighbours."""
    u, v, height = np.moveaxis(np.einsum("nij,nkj->nki", axes, offsets, optimize=True) / radius_m, 2, 0)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=2)
    weighted = terms * weights[..., None]
    A = np.matmul(weighted.transpose(0, 2, 1), terms) + _RIDGE * np.eye(6)
    b = np.einsum("nki,nk->ni", weighted, height)
    return np.asarray(np.linalg.solve(A, b[..., None])[:, 0, 0] * radius_m)
