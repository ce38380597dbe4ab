"""The focal length that makes points with depth in two views move as one rigid body.

Depth is how far points are, the focal length how far apart they are sideways; a turn of the camera exchanges the two.
Over many pairs of views, Gauss-Newton finds the poses, and beside them what all pairs share: the focal length, the
readout of a rolling shutter (a camera that pans would else seem to zoom), and what the edges left open of the place
and the lag of depth, as priors. The errors are in pixels: in units of the focal length they would shrink as it grows,
and it would run away. The unit of depth is no part of it: poses take it up (a similarity).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vislam.core.angles import angles_of
from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp
from vislam.core.jackknife import jackknife_variances
from vislam.core.messages import Array
from vislam.vision.locate import pnp

_PIXEL_SIGMA = 0.5
_RHO_SIGMA = 0.01  # 1/m, with what a neighbourhood of a few pixels hides
_CAUCHY = 2.0
_ITERATIONS = 20
_CONVERGED = 1e-5
_LEAST_POINTS = 25
_LEAST_PAIRS = 8
_LEAST_SHARE = 0.5  # of the pairs: where most do not move as one body, the rest is no sample of them
_PNP_PX = 4.0
_LEAST_AGREEING = 0.5
_STEP = 1e-3  # relative, of the focal length, for its derivative
_FOCAL_SIGMA = 0.2
_READOUT_SIGMA_S = 0.03
_SHARED = 5  # focal length, readout, offset right and down, lag
_FULL = 6 + _SHARED
_MEDIAN_CHI2 = 2.37  # of three degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """The same points in one of two views."""

    pixels: Array  # [N, 2]
    speed_px_s: Array  # [N, 2]
    rho: Array  # [N] inverse depths in 1/m, NaN where unknown
    slope: Array  # [N, 2] change of rho per pixel right and down


@dataclass(frozen=True, slots=True, eq=False)
class FocalFit:
    """What views with depth say of the camera; sigma by leaving out pairs one by one (jackknife)."""

    factor: float  # true focal length over the camera's
    sigma: float
    readout_s: float
    readout_sigma_s: float
    offset_px: Array  # [2] of depth, in addition to that at which it was read
    lag_s: float  # in addition, too
    pairs: int
    points: int
    turn_deg: float  # median of the pairs


class _View(NamedTuple):
    xyr: Array  # [N, 3] direction on z = 1 and inverse depth
    slope: Array  # [N, 3, 5] by the shared parameters


class _Equations(NamedTuple):
    H: Array  # [11, 11] pose, then shared
    g: Array  # [11]
    chi2: Array  # [N]


def fit_focal(
    camera: Camera, pairs: Sequence[tuple[SeenPoints, SeenPoints]], offset_sigma_px: Array, lag_sigma_s: float
) -> FocalFit | None:
    """Return the focal length by pairs of views; None where too few of them agree on a motion.

    Args:
        camera: what pixels mean by now.
        pairs: points of two views each.
        offset_sigma_px: how well [2] the place of depth is known that it was read at.
        lag_sigma_s: the same of its lag.
    """
    views: list[tuple[_View, _View]] = []
    T_b_as: list[Array] = []
    for a, b in pairs:
        ready = _prepared(camera, a, b)
        if ready is not None:
            views.append(ready[0])
            T_b_as.append(ready[1])
    if len(views) < max(_LEAST_PAIRS, _LEAST_SHARE * len(pairs)):
        return None
    sigmas = np.array([_FOCAL_SIGMA, _READOUT_SIGMA_S, *np.maximum(offset_sigma_px, 0.1), max(lag_sigma_s, 1e-3)])
    shared = np.zeros(_SHARED)
    H = g = np.zeros(0)
    for _ in range(_ITERATIONS):
        equations = [_equations(a, b, T, shared, camera.fx) for (a, b), T in zip(views, T_b_as, strict=True)]
        carried = [
            np.linalg.solve(e.H[:6, :6] + 1e-9 * np.eye(6), np.column_stack([e.H[:6, 6:], e.g[:6]])) for e in equations
        ]
        H = np.array([e.H[6:, 6:] - e.H[6:, :6] @ c[:, :-1] for e, c in zip(equations, carried, strict=True)])
        g = np.array([e.g[6:] - e.H[6:, :6] @ c[:, -1] for e, c in zip(equations, carried, strict=True)])
        # tracks of one region err together: the prior counts as if residuals were as large as they are, and fewer
        wider = 4.0 * max(1.0, float(np.median(np.concatenate([e.chi2 for e in equations]))) / _MEDIAN_CHI2)
        prior = np.diag(wider / sigmas**2)
        step = -np.linalg.solve(H.sum(axis=0) + prior, g.sum(axis=0) + prior @ shared)
        T_b_as = [_moved(T, -(c[:, -1] + c[:, :-1] @ step)) for T, c in zip(T_b_as, carried, strict=True)]
        shared = shared + step
        if not np.isfinite(shared).all() or abs(shared[0]) > 0.6:
            return None
        if abs(step[0]) < _CONVERGED:
            break
    left_out = np.array([
        -np.linalg.solve(H.sum(axis=0) - one + prior, g.sum(axis=0) - part + prior @ shared)
        for one, part in zip(H, g, strict=True)
    ])  # fmt: skip
    sigma = np.sqrt(jackknife_variances(left_out))
    factor = 1.0 / (1.0 + float(shared[0]))
    turns = angles_of(np.array(T_b_as)[:, :3, :3])
    return FocalFit(
        factor, float(sigma[0]) * factor**2, float(shared[1]), float(sigma[1]), shared[2:4], -float(shared[4]),
        len(views), sum(len(a.xyr) for a, _ in views), float(np.rad2deg(np.median(turns))),
    )  # fmt: skip


def _prepared(camera: Camera, a: SeenPoints, b: SeenPoints) -> tuple[tuple[_View, _View], Array] | None:
    """Return both views of the points that are known in both, and a first T_b_a; None where they do not agree."""
    known = np.ones(len(a.rho), dtype=np.bool_)
    for one in (a, b):
        known &= np.isfinite(np.column_stack([one.rho, one.slope, one.speed_px_s, one.pixels])).all(axis=1)
    views = []
    for one in (a, b):
        views.append(_view(camera, one.pixels[known], one.speed_px_s[known], one.rho[known], one.slope[known]))
    usable = np.isfinite(views[0].slope).all(axis=(1, 2)) & np.isfinite(views[1].slope).all(axis=(1, 2))
    first, second = (_View(view.xyr[usable], view.slope[usable]) for view in views)
    if len(first.xyr) < _LEAST_POINTS:
        return None
    points = np.column_stack([first.xyr[:, :2], np.ones(len(first.xyr))]) / first.xyr[:, 2:]
    found = pnp(points, second.xyr[:, :2], _PNP_PX / camera.fx)
    if found is None or found[1] < _LEAST_AGREEING * len(points):
        return None
    return (first, second), found[0]


def _view(camera: Camera, pixels: Array, speed_px_s: Array, rho: Array, slope: Array) -> _View:
    longer, shorter = (replace(camera, fx=camera.fx / k, fy=camera.fy / k) for k in (1.0 - _STEP, 1.0 + _STEP))
    J = np.zeros((len(pixels), 3, _SHARED))
    J[:, :2, 0] = (shorter.normalise(pixels) - longer.normalise(pixels)) / (2.0 * _STEP)
    right_px, down_px = np.eye(2)
    right = 0.5 * (camera.normalise(pixels + right_px) - camera.normalise(pixels - right_px))
    down = 0.5 * (camera.normalise(pixels + down_px) - camera.normalise(pixels - down_px))
    late = -speed_px_s * (pixels[:, 1:] / camera.height - 0.5)  # undone: rows below the middle are read later
    J[:, :2, 1] = right * late[:, :1] + down * late[:, 1:]
    J[:, 2, 2:4] = slope
    J[:, 2, 4] = np.sum(slope * speed_px_s, axis=1)
    return _View(np.column_stack([camera.normalise(pixels), rho]), J)


def _equations(a: _View, b: _View, T_b_a: Array, shared: Array, focal_px: float) -> _Equations:
    """Return the weighted normal equations of one pair by pose (left, rotation first) and shared parameters."""
    R, t = T_b_a[:3, :3], T_b_a[:3, 3]
    A, B = a.xyr + a.slope @ shared, b.xyr + b.slope @ shared
    turned = np.column_stack([A[:, :2], np.ones(len(A))]) @ R.T
    q = turned + A[:, 2:] * t
    inverse = 1.0 / q[:, 2]
    h = np.column_stack([q[:, 0], q[:, 1], A[:, 2]]) * inverse[:, None]
    by_q = np.zeros((len(A), 3, 3))
    by_q[:, 0, 0] = by_q[:, 1, 1] = inverse
    by_q[:, :, 2] = -h * inverse[:, None]
    by_a = np.concatenate([by_q @ R[:, :2], (by_q @ t)[:, :, None]], axis=2)
    by_a[:, 2, 2] += inverse
    scale = 1.0 / (1.0 + shared[0])  # directions times this are pixels over the camera's focal length
    r = h - B
    by_shared = by_a @ a.slope - b.slope
    by_shared[:, :2] *= scale
    by_shared[:, :2, 0] -= scale * scale * r[:, :2]
    by_pose = np.concatenate([by_q @ _crossed(turned), by_q * A[:, 2][:, None, None]], axis=2)
    by_pose[:, :2] *= scale
    r[:, :2] *= scale
    by_rho = by_a[:, :, 2] * np.array([scale, scale, 1.0])
    S = by_rho[:, :, None] * by_rho[:, None, :] * _RHO_SIGMA**2
    S += np.diag([2.0 * (_PIXEL_SIGMA / focal_px) ** 2] * 2 + [_RHO_SIGMA**2])
    W = np.linalg.inv(S)
    chi2 = np.einsum("ni,nij,nj->n", r, W, r)
    J = np.concatenate([by_pose, by_shared], axis=2)
    WJ = (W / (1.0 + chi2 / (3.0 * _CAUCHY**2))[:, None, None]) @ J
    return _Equations(np.einsum("nia,nib->ab", J, WJ), np.einsum("nia,ni->a", WJ, r), chi2)


def _crossed(v: Array) -> Array:
    """Return -[v]x of vectors [N, 3]: the derivative of a left turn of each."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = v[:, 2], -v[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -v[:, 2], v[:, 0]
    out[:, 2, 0], out[:, 2, 1] = v[:, 1], -v[:, 0]
    return out


def _moved(T_b_a: Array, step: Array) -> Array:
    """Return a pose after a step: turned from the left, then shifted."""
    out = T_b_a.copy()
    out[:3, :3] = so3_exp(step[:3]) @ T_b_a[:3, :3]
    out[:3, 3] += step[3:]
    return out
