"""Point-to-plane equations between two depth images that see the same surfaces.

Projective association as in Newcombe et al., "KinectFusion", ISMAR 2011; errors as in Chen and Medioni, "Object
modelling by registration of multiple range images", 1992.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array

Planes = NDArray[np.float32]  # [h, w, 4]: unit normal of the surface in the view's frame, z-depth; 0 where none

WINDOW_PX = 3  # of the depth image, to all sides, that a plane is fitted to
_LEAST_SHARE = 0.6  # of the window that has depth on the same surface
_SAME_SURFACE = 0.05  # of depth; what differs by more is another one
_FLAT_SIGMAS = 2.0  # rms from the plane; clutter is none
_LEAST_FACING = 0.2  # cosine between ray and normal
_SIGMA_1M = 0.0025  # of depth from structured light at one metre; it grows with the square of depth
_SIGMA_M = 0.002  # that it never falls below: calibration
_SAME_FACING = 0.85  # cosine between two normals of one surface
_FAR_SIGMAS = 3.0  # farther off is not worse
# samples that err alike: depth images are wrong in patches, not in pixels; chosen on fr1_desk, hololens_000 and a
# rendered room in fast turns, where 500 to 1500 differ little
_CORRELATED = 500.0
_LEAST_APART, _MOST_APART = 0.05, 1.0  # of the variance that noise has; less may be chance, more is a wrong pose


class Seen(NamedTuple):
    """A depth image as planes on a coarser grid."""

    planes: Planes
    K: Array  # [3, 3] of that grid


class Equations(NamedTuple):
    """Normal equations of the motion of view a against view b, in a's frame, rotation first."""

    H: Array  # [6, 6]
    g: Array  # [6], J^T W r
    cost: float  # mean robust error in sigmas, squared, of a's samples; those that met no surface count as far off


@njit(cache=True, nogil=True)
def _fit(depth_m: NDArray[np.float32], v: int, u: int, K: Array, out: Planes) -> None:
    """Fit a plane to the window around a pixel: inverse depth is linear in it. `out` [4] stays 0 where it is none."""
    rows, columns = depth_m.shape
    z0 = depth_m[v, u]
    sums = np.zeros((3, 3))
    right = np.zeros(3)
    squares, count = 0.0, 0
    for i in range(max(v - WINDOW_PX, 0), min(v + WINDOW_PX + 1, rows)):
        for j in range(max(u - WINDOW_PX, 0), min(u + WINDOW_PX + 1, columns)):
            z = depth_m[i, j]
            if not (z > 0.0 and abs(z - z0) < _SAME_SURFACE * z0):  # also for NaN
                continue
            row = ((j - u) / K[0, 0], (i - v) / K[1, 1], 1.0)
            for a in range(3):
                for b in range(3):
                    sums[a, b] += row[a] * row[b]
                right[a] += row[a] / z
            squares += 1.0 / (z * z)
            count += 1
    if count < _LEAST_SHARE * (2 * WINDOW_PX + 1) ** 2 or np.linalg.det(sums) <= 0.0:
        return
    x = np.linalg.solve(sums, right)
    if x[2] <= 0.0:
        return
    # rms of 1 / z from the plane, as depth
    off_m = np.sqrt(max(float(squares - x @ right), 0.0) / count) / (x[2] * x[2])
    if off_m > _FLAT_SIGMAS * (_SIGMA_M + _SIGMA_1M * z0 * z0):
        return
    ray_x, ray_y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    nz = x[2] - x[0] * ray_x - x[1] * ray_y
    length = np.sqrt(x[0] * x[0] + x[1] * x[1] + nz * nz)
    if x[2] < _LEAST_FACING * length * np.sqrt(ray_x * ray_x + ray_y * ray_y + 1.0):
        return
    out[0], out[1], out[2], out[3] = -x[0] / length, -x[1] / length, -nz / length, 1.0 / x[2]


@njit(cache=True, nogil=True)
def _planes(depth_m: NDArray[np.float32], K: Array, step: int, max_depth_m: float) -> Planes:
    out = np.zeros(((depth_m.shape[0] + step - 1) // step, (depth_m.shape[1] + step - 1) // step, 4), np.float32)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            z = depth_m[i * step, j * step]
            if 0.0 < z < max_depth_m:
                _fit(depth_m, i * step, j * step, K, out[i, j])
    return out


def seen_in(depth_m: NDArray[np.float32], K: Array, step: int, max_depth_m: float) -> Seen:
    """Return the planes of every n-th row and column of a depth image [h, w], 0 or NaN where it has none."""
    coarse = K.copy()
    coarse[:2] /= step
    depth_m = np.ascontiguousarray(depth_m, np.float32)
    return Seen(_planes(depth_m, np.ascontiguousarray(K), step, max_depth_m), coarse)


@njit(cache=True, nogil=True)
def _pair(a: Planes, b: Planes, K: Array, T_b_a: Array, gate_m: float, step: int) -> tuple[Array, Array, Array]:
    """Return H [6, 6], g [6] and (samples, those that met a surface, sum of their costs)."""
    H, g, sums, J = np.zeros((6, 6)), np.zeros(6), np.zeros(3), np.zeros(6)
    R = np.ascontiguousarray(T_b_a[:3, :3])
    for i in range(0, a.shape[0], step):
        for j in range(0, a.shape[1], step):
            z = a[i, j, 3]
            if z <= 0.0:
                continue
            sums[0] += 1.0
            p = np.array([(j - K[0, 2]) / K[0, 0] * z, (i - K[1, 2]) / K[1, 1] * z, z])
            at = R @ p + T_b_a[:3, 3]
            if at[2] <= 0.0:
                continue
            u = int(np.floor(K[0, 0] * at[0] / at[2] + K[0, 2] + 0.5))
            v = int(np.floor(K[1, 1] * at[1] / at[2] + K[1, 2] + 0.5))
            if u < 0 or v < 0 or v >= b.shape[0] or u >= b.shape[1]:
                continue
            z_b = b[v, u, 3]
            if z_b <= 0.0 or abs(z_b - at[2]) > 2.0 * gate_m:
                continue
            n_b = b[v, u, :3].astype(np.float64)
            n = R.T @ n_b
            if n @ a[i, j, :3].astype(np.float64) < _SAME_FACING:
                continue
            q = np.array([(u - K[0, 2]) / K[0, 0] * z_b, (v - K[1, 2]) / K[1, 1] * z_b, z_b])
            r = n_b @ (at - q)
            if abs(r) > gate_m:
                continue
            variance = _SIGMA_M**2 + _SIGMA_1M**2 * (z**4 + z_b**4)
            scale2 = max(4.0 * variance, gate_m * gate_m / 9.0)
            w = 1.0 / (variance * (1.0 + r * r / scale2) * _CORRELATED)
            sums[1] += 1.0
            sums[2] += min(r * r / variance, _FAR_SIGMAS**2)
            J[0], J[1], J[2] = p[1] * n[2] - p[2] * n[1], p[2] * n[0] - p[0] * n[2], p[0] * n[1] - p[1] * n[0]
            J[3:] = n
            for x in range(6):
                g[x] += w * J[x] * r
                for y in range(6):
                    H[x, y] += w * J[x] * J[y]
    return H, g, sums


def equations(a: Seen, b: Seen, T_b_a: Array, gate_m: float, step: int) -> Equations:
    """Return what view a's surfaces say of its pose against view b's, the less the farther apart they are.

    Those farther apart than the gate say nothing.
    """
    H, g, (samples, met, cost) = _pair(a.planes, b.planes, a.K, np.ascontiguousarray(T_b_a), gate_m, step)
    # in variances: what turned fast or is badly registered counts less
    apart = min(max(cost / max(met, 1.0), _LEAST_APART), _MOST_APART)
    return Equations(H / apart, g / apart, (cost + _FAR_SIGMAS**2 * (samples - met)) / max(samples, 1.0))


def overlap(a: Seen, b: Seen, T_b_a: Array, gate_m: float, step: int) -> float:
    """Return the share of view a's surfaces that meet those of view b within the gate."""
    samples, met, _ = _pair(a.planes, b.planes, a.K, np.ascontiguousarray(T_b_a), gate_m, step)[2]
    return float(met / max(samples, 1.0))
