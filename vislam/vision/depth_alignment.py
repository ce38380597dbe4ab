"""Where a camera is by its depth alone: point-to-plane alignment with surfaces that were seen before.

Points are associated by projection and drawn to the planes they fall on, coarse to fine (KinectFusion: Newcombe et
al., ISMAR 2011; point to plane: Chen and Medioni 1992), under robust weights and noise that grows with z^2. A start has
to be known: this does not search.

What depth does not show is kept as the prior has it. A bare wall slides in two directions and turns in one; normals
that are noisy look as if they held it (Gelfand et al., 3DIM 2003: unstable directions; Zhang et al., ICRA 2016: to be
left alone). How much information noise alone would make up is summed up beside the information itself, so directions
count as determined only where they hold several times as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from vislam.core.geometry import invert, se3_exp, se3_log, transform_points
from vislam.core.jit import njit
from vislam.core.messages import Array, Bools
from vislam.vision.depth_surface import DepthSurface, Surface

# stride in the frame's pixels, farthest distance to a plane in metres, and iterations: coarse to fine
_LEVELS = ((4, 0.3, 12), (2, 0.12, 8), (2, 0.06, 8))
_FAR_M = 3.0  # to surfaces that a turn moves
_LOOK = 4  # stride in pixels of the points by which the result is judged
_ALIKE_NORMALS = 0.8  # cosine of the angle between normals that may be of the same surface
_CAUCHY = 3.0  # scale of the robust kernel in standard deviations
_FLOOR_M = 0.001  # of a distance's standard deviation: what calibration leaves near the camera
_NOISE_TIMES = 8.0  # the information that noise would make up: so much is needed for a direction to count
_GROUPS = 4  # the image is cut into 4 x 4 regions whose residuals may err together
_SETTLED = 2e-4  # norm of a step in rad and m, far below the noise of depth
_SETTLED_CHI2 = 0.01  # and the same over how sure the pose is: a tenth of its standard deviation
_MARGIN_M, _MARGIN = 0.05, 0.03  # a surface is seen through by more than this and this share of its depth
_LEAST_POINTS = 50  # on surfaces, or nothing is said


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrom:
    """A surface and where it was seen from."""

    seen: DepthSurface
    T_model_cam: Array  # [4, 4]


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Where the camera is thought to be before its depth is looked at."""

    T_model_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of its right perturbation, rotation first


@dataclass(frozen=True, slots=True, eq=False)
class DepthAlignment:
    """Where depth and prior together put the camera, and what that rests on."""

    T_model_cam: Array  # [4, 4]
    covariance: Array  # [6, 6] of its right perturbation, rotation first: the prior's where nothing was determined
    determined: int  # directions, of six, that depth determines
    undetermined: Array  # [6, 6 - determined] orthonormal tangents along which only the prior holds the camera
    overlap: float  # of the frame's surface: the share that falls on surfaces of the model
    agreement: float  # of what falls on them or in front of them: the share within the gate
    seen_through: float  # of the same, from both sides: the share that the other one looks through
    residual: float  # root mean square of the distances over what noise explains
    converged: bool


class _Rows(NamedTuple):
    """Points of the frame, a row each."""

    points: Array  # [N, 3]
    normals: Array  # [N, 3]
    tilt: Array  # [N]
    group: Array  # [N] region of the image, as float


class _Sums(NamedTuple):
    """Sums over associated points, filled by `_accumulate`."""

    information: Array  # [6, 6]
    made_up: Array  # [6, 6] that noise of normals alone would give
    gradient: Array  # [6]
    scores: Array  # [groups, 6]
    totals: Array  # [3] weighted squares, weights, points


def align_depth(
    frame: DepthSurface, model: Sequence[SeenFrom], prior: Prior, sigma_rho: float, T_start: Array | None = None
) -> DepthAlignment:
    """Align a depth image with surfaces that were seen from known places.

    Args:
        frame: what the camera sees.
        model: surfaces in one frame, the one to be asked first in front.
        prior: where the camera is thought to be; the covariance must be positive definite.
        sigma_rho: standard deviation of an inverse depth in 1/m.
        T_start: where to begin [4, 4]; None: where the prior is.

    Returns:
        The alignment. Where the surfaces say nothing (no depth, no overlap) it is the prior, not converged.
    """
    information_0 = np.linalg.inv(prior.covariance)
    T, converged = (prior.T_model_cam if T_start is None else T_start).copy(), False
    sums = _no_sums()
    for stride, gate_m, most in _LEVELS[_begin(prior) :]:
        rows = _rows(frame, stride)
        converged = False
        for _ in range(most):
            sums = _summed(rows, model, T, gate_m, sigma_rho)
            if sums.totals[2] * stride * stride < _LEAST_POINTS:
                return _nothing(prior)
            H, b, _ = _determined(sums)
            xi = se3_log(invert(prior.T_model_cam) @ T)
            step = -np.linalg.solve(H + information_0, b + information_0 @ xi)
            size = float(np.linalg.norm(step))
            if not size < 1.0:
                return _nothing(prior)
            T = T @ se3_exp(step)
            if size < _SETTLED or float(step @ (H + information_0) @ step) < _SETTLED_CHI2:
                converged = True
                break
    H, _, basis = _determined(sums)
    covariance = np.linalg.inv(H + information_0)
    overlap, agreement, through = _judged(frame, model, T)
    return DepthAlignment(
        T, 0.5 * (covariance + covariance.T), 6 - basis.shape[1], basis, overlap, agreement, through,
        float(np.sqrt(sums.totals[0] / sums.totals[1])), converged,
    )  # fmt: skip


def _begin(prior: Prior) -> int:
    """Return the level to begin with: gates need not be wider than the prior is unsure."""
    turn, way = (float(np.linalg.eigvalsh(prior.covariance[k : k + 3, k : k + 3])[-1]) for k in (0, 3))
    off_m = 3.0 * np.sqrt(turn * _FAR_M**2 + way)
    return next((k for k in reversed(range(len(_LEVELS) - 1)) if off_m < _LEVELS[k][1]), 0)


def _nothing(prior: Prior) -> DepthAlignment:
    return DepthAlignment(prior.T_model_cam.copy(), prior.covariance, 0, np.eye(6), 0.0, 0.0, 0.0, np.inf, False)


def _rows(frame: DepthSurface, stride: int) -> _Rows:
    points, planes, tilt = frame.surface
    height, width = tilt.shape
    v, u = np.mgrid[0:height:stride, 0:width:stride]
    group = (v * _GROUPS // height) * _GROUPS + u * _GROUPS // width
    there = np.isfinite(tilt[::stride, ::stride])
    m = planes[::stride, ::stride][there]
    return _Rows(
        points[::stride, ::stride][there],
        m / np.linalg.norm(m, axis=1, keepdims=True),
        tilt[::stride, ::stride][there],
        group[there].astype(np.float64),
    )


def _no_sums() -> _Sums:
    return _Sums(np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros((_GROUPS * _GROUPS, 6)), np.zeros(3))


def _summed(rows: _Rows, model: Sequence[SeenFrom], T: Array, gate_m: float, sigma_rho: float) -> _Sums:
    """Return the sums over all points, each on the first surface that it falls on."""
    sums, free = _no_sums(), np.ones(len(rows.points), dtype=np.bool_)
    for part in model:
        T_part_cam = np.ascontiguousarray(invert(part.T_model_cam) @ T)
        pixels = part.seen.camera.project(transform_points(T_part_cam, rows.points))
        _accumulate(rows, part.seen.surface, T_part_cam, pixels, free, np.array([gate_m, sigma_rho]), sums)
    return sums


@njit(cache=True, nogil=True)
def _accumulate(
    rows: _Rows, surface: Surface, T: Array, pixels: Array, free: Bools, limits: Array, sums: _Sums
) -> None:
    """Add what points [N] that are still `free` [N] say, seen at `pixels` [N, 2] of the surface's camera."""
    gate_m, sigma_rho = limits
    height, width = surface.tilt.shape
    J, G = np.empty(6), np.zeros((6, 3))
    for k in range(3):
        G[3 + k, k] = 1.0
    for n in range(len(rows.points)):
        u, v = pixels[n]
        if not free[n] or not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        i, j = int(v + 0.5), int(u + 0.5)
        if not np.isfinite(surface.tilt[i, j]):
            continue
        p, m, s = rows.points[n], surface.planes[i, j], rows.normals[n]
        size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        r, alike = -1.0, 0.0
        for a in range(3):
            q, turned, J[3 + a] = T[a, 3], 0.0, 0.0
            for c in range(3):
                q += T[a, c] * p[c]
                turned += T[a, c] * s[c]
                J[3 + a] += T[c, a] * m[c] / size  # the plane's normal in the camera
            r += m[a] * q
            alike += m[a] / size * turned
        r /= size
        if not (abs(r) <= gate_m and alike >= _ALIKE_NORMALS):
            continue
        free[n] = False
        J[0] = p[1] * J[5] - p[2] * J[4]
        J[1] = p[2] * J[3] - p[0] * J[5]
        J[2] = p[0] * J[4] - p[1] * J[3]
        # both depths err along their rays: sigma_z times the cosine to the normal is c z d, d the plane's distance
        sigma2 = 2.0 * (sigma_rho * p[2] / size) ** 2 + _FLOOR_M**2
        sigma2 = max(sigma2, (gate_m / 6.0) ** 2) if gate_m > 0.1 else sigma2
        x = r * r / sigma2
        w = 1.0 / (1.0 + x / (_CAUCHY * _CAUCHY)) / sigma2
        tilt2 = surface.tilt[i, j] ** 2
        G[0, 1], G[0, 2], G[1, 0] = -p[2], p[1], p[2]
        G[1, 2], G[2, 0], G[2, 1] = -p[0], -p[1], p[0]
        region = int(rows.group[n])
        for a in range(6):
            sums.gradient[a] += w * r * J[a]
            sums.scores[region, a] += w * r * J[a]
            for c in range(6):
                turned = G[a, 0] * G[c, 0] + G[a, 1] * G[c, 1] + G[a, 2] * G[c, 2]
                sums.information[a, c] += w * J[a] * J[c]
                sums.made_up[a, c] += w * tilt2 * (turned - J[a] * J[c])
        sums.totals[0] += w * r * r
        sums.totals[1] += w * sigma2
        sums.totals[2] += 1.0


def _determined(sums: _Sums) -> tuple[Array, Array, Array]:
    """Return information [6, 6] and gradient [6] of the directions that depth determines, and a basis of the others.

    Information is what is more than noise makes up, over how much the residuals exceed their sigmas, alone or together
    in a region of the image (see `refine.pose_covariance`).
    """
    scale = np.sqrt(np.trace(sums.made_up[:3, :3]) / max(np.trace(sums.made_up[3:, 3:]), 1e-12))
    regular = np.diag(np.repeat([scale * scale, 1.0], 3)) * 1e-6 * max(np.trace(sums.made_up[3:, 3:]), 1e-9)
    ratios, V = eigh(sums.information, sums.made_up + regular)  # V.T @ information @ V = diag(ratios)
    holds = ratios > _NOISE_TIMES
    variance = sums.totals[0] / max(sums.totals[1], 1e-12)
    used = int((np.abs(sums.scores).sum(axis=1) > 0.0).sum())
    together = 1.0
    if used > 6 and holds.any():
        by_region = sums.scores @ V[:, holds]
        together = float(np.mean((by_region**2).sum(axis=0) / ratios[holds])) * used / (used - 3.0)
    factor = max(1.0, variance, together)
    W = np.linalg.inv(V)  # rows: dual directions
    H = W[holds].T @ ((ratios[holds] - 1.0)[:, None] * W[holds]) / factor
    b = W[holds].T @ (V[:, holds].T @ sums.gradient) / factor
    basis = np.linalg.qr(V[:, ~holds])[0] if (~holds).any() else np.empty((6, 0))
    return H, b, basis


def _judged(frame: DepthSurface, model: Sequence[SeenFrom], T: Array) -> tuple[float, float, float]:
    """Return overlap, agreement and the share seen through, of the frame at T [4, 4] and the model."""
    rows = _rows(frame, _LOOK)
    best, through, judged = np.zeros(len(rows.points)), 0, 0
    for part in model:
        T_part_cam = np.ascontiguousarray(invert(part.T_model_cam) @ T)
        codes = _compared(rows.points, part.seen, T_part_cam)
        best = np.maximum(best, codes)
        back = _rows(part.seen, _LOOK).points
        codes_back = _compared(back, frame, np.ascontiguousarray(invert(T_part_cam)))
        through += int((codes_back == 1.0).sum())
        judged += int((codes_back > 0.0).sum())
    on, in_front = int((best == 2.0).sum()), int((best == 1.0).sum())
    through, judged = through + in_front, judged + on + in_front
    return on / max(len(best), 1), on / max(on + in_front, 1), through / max(judged, 1)


def _compared(points: Array, seen: DepthSurface, T_seen_cam: Array) -> Array:
    """Return of points [N, 3]: 2 on the surface, 1 in front of it (it is seen through there), 0 nothing is known."""
    moved = transform_points(T_seen_cam, points)
    return np.asarray(_compare(moved, seen.camera.project(moved), seen.surface.points, seen.surface.planes))


@njit(cache=True, nogil=True)
def _compare(points: Array, pixels: Array, surface: Array, planes: Array) -> Array:
    height, width = surface.shape[:2]
    out = np.zeros(len(points))
    for n in range(len(points)):
        u, v = pixels[n]
        if not (u > 0.5 and v > 0.5 and u < width - 1.5 and v < height - 1.5):
            continue
        i, j, z = int(v + 0.5), int(u + 0.5), points[n, 2]
        margin = _MARGIN_M + _MARGIN * z
        nearest, holes = np.inf, 0
        for r in range(i - 1, i + 2):
            for c in range(j - 1, j + 2):
                if np.isfinite(surface[r, c, 2]):
                    nearest = min(nearest, surface[r, c, 2])
                else:
                    holes += 1
        if holes == 0 and z < nearest - margin:
            out[n] = 1.0
        elif np.isfinite(surface[i, j, 2]):
            m = planes[i, j]
            size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
            r = (m[0] * points[n, 0] + m[1] * points[n, 1] + m[2] * points[n, 2] - 1.0) / size
            if abs(r) <= 0.4 * margin:
                out[n] = 2.0
    return out
