"""What keyframes saw, as flat arrays: rays with inverse depths, their points by triangulation, their residuals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vislam.config import FrontEndConfig
from vislam.core.camera import Camera, Rig
from vislam.core.geometry import invert
from vislam.core.messages import Array, Observations
from vislam.factors.factor_log import FactorLog

Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

_PASSES = 3  # of triangulation: weights need distances, which it gives
_MIN_Z_M = 0.05  # a point nearer to a camera that saw it is no point
_FOCAL_STEP = 1e-3  # relative, of the finite difference
_UNKNOWN_INFORMATION = 1e-9  # 1/m^2, keeps the system of a track without parallax solvable


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Observations [N] of points [P] in keyframes, sorted by keyframe; coordinates are undistorted, on z = 1.

    Depth is kept as inverse depth, whose noise does not grow with distance: of a depth image as it is, of a stereo pair
    from the disparity. A right pixel is found from the left one, so its own noise is that of the disparity, and what
    the track has drifted is common to both; two independent projections would say the opposite.
    """

    keyframe: Ints  # [N]
    image: Ints  # [N] among those [I] whose poses are given; of a run's, keyframe * cameras + camera
    point: Ints  # [N]
    xy: Array  # [N, 2]
    sigma_per_px: Array  # [N] sigma of xy for a noise of one pixel
    rho: Array  # [N] 1/m, NaN where depth was not measured
    sigma_rho: Array  # [N] 1/m
    row: Array  # [N] image row from -0.5 (first) to 0.5 (last)
    by_focal: Array  # [N, 3] derivatives of xy and rho by the true focal lengths over those given
    points: int  # P
    focal: float = 1.0  # the true one over that given: what was measured, with known noise, over xy
    disparity: float = 1.0  # the same of what gave rho, a disparity or an inverse depth

    def __len__(self) -> int:
        return len(self.keyframe)

    def counts(self, keep: Mask | None = None) -> Ints:
        """Return how many observations each point has [P]."""
        return np.bincount(self.point if keep is None else self.point[keep], minlength=self.points)


def collect(log: FactorLog, config: FrontEndConfig) -> Tracks:
    """Return all tracks that at least two keyframes saw; pixels that no ray of the camera gives are left out."""
    seen = [(i, k.packet.observations) for i, k in enumerate(log.keyframes)]
    longer = replace(log.rig, cameras=tuple(c.with_focal(1.0 + _FOCAL_STEP) for c in log.rig.cameras))
    parts = [part for i, one in seen for part in _observed(i, one, (log.rig, longer), config)]
    keyframe, image = (np.concatenate([getattr(part, name) for part in parts]) for name in ("keyframe", "image"))
    ids = np.concatenate([part.ids for part in parts])
    xy, sigma = np.concatenate([part.xy for part in parts]), np.concatenate([part.sigma_per_px for part in parts])
    rho, sigma_rho = np.concatenate([part.rho for part in parts]), np.concatenate([part.sigma_rho for part in parts])
    row, by_focal = np.concatenate([part.row for part in parts]), np.concatenate([part.by_focal for part in parts])
    _, first = np.unique(np.stack([keyframe, ids]), axis=1, return_index=True)  # a track has one place in a keyframe
    usable = np.zeros(len(ids), dtype=bool)
    usable[first] = True
    usable &= np.isfinite(xy).all(axis=1) & np.isfinite(sigma)
    unique, point = np.unique(ids, return_inverse=True)
    usable &= np.bincount(point[usable], minlength=len(unique))[point] >= 2
    _, point = np.unique(ids[usable], return_inverse=True)
    count = int(point.max()) + 1 if len(point) else 0
    return Tracks(
        keyframe[usable], image[usable], point.astype(np.int64), xy[usable], sigma[usable], rho[usable],
        sigma_rho[usable], row[usable], by_focal[usable], count,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Observed:
    """What a camera saw in one keyframe, one entry per track."""

    keyframe: Ints
    image: Ints
    ids: Ints
    xy: Array
    sigma_per_px: Array
    rho: Array
    sigma_rho: Array
    row: Array
    by_focal: Array


def _observed(index: int, seen: Observations, rigs: tuple[Rig, Rig], config: FrontEndConfig) -> Iterator[_Observed]:
    """Yield what cameras but a right one saw, by `rigs` as given and with longer focal lengths; others at once."""
    rig = rigs[0]
    if rig.is_blind:
        nothing, none = np.zeros(0), np.zeros(0, np.int64)
        yield _Observed(none, none, none, np.zeros((0, 2)), nothing, nothing, nothing, nothing, np.zeros((0, 3)))
        return
    row = np.clip(seen.pixels_px[:, 1] / max(rig.cameras[0].height - 1.0, 1.0), 0.0, 1.0) - 0.5
    yield _seen_by(0, index, seen, rigs, config, row)
    for further in seen.further:
        alone = Observations(further.track_ids, further.pixels_px)
        yield _seen_by(further.camera, index, alone, rigs, config, np.zeros(len(further.track_ids)))


def _seen_by(
    number: int, index: int, seen: Observations, rigs: tuple[Rig, Rig], config: FrontEndConfig, row: Array
) -> _Observed:
    """Return what a camera saw in a keyframe; `row` [N] is where in the image, as in `Tracks`."""
    rig, longer = rigs
    camera, n = rig.cameras[number], len(seen.track_ids)
    xy, rho, sigma_rho = _calibrated(camera, seen, rig, config)
    xy_longer, rho_longer, _ = _calibrated(longer.cameras[number], seen, longer, config)
    by_focal = np.nan_to_num(np.column_stack([xy_longer - xy, rho_longer - rho])) / _FOCAL_STEP
    keyframe = np.full(n, index, dtype=np.int64)
    image, ids = keyframe * len(rig.cameras) + number, seen.track_ids.astype(np.int64)
    return _Observed(keyframe, image, ids, xy, angle_per_px(camera, xy), rho, sigma_rho, row, by_focal)


def _calibrated(camera: Camera, seen: Observations, rig: Rig, config: FrontEndConfig) -> tuple[Array, Array, Array]:
    """Return coordinates [N, 2], inverse depths [N] and their sigmas [N] as a camera of a rig gives them."""
    xy = camera.normalise(seen.pixels_px)
    if seen.right_px is not None and rig.is_stereo:
        return xy, *stereo_inverse_depth(rig, xy, seen.right_px, config.stereo_sigma_px)
    if seen.depth_m is None:
        return xy, np.full(len(xy), np.nan), np.full(len(xy), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.where(seen.depth_m > 0.0, 1.0 / seen.depth_m, np.nan)
    return xy, rho, np.where(np.isfinite(rho), config.depth_sigma_rho, np.nan)


def angle_per_px(camera: Camera, xy: Array) -> Array:
    """Return the sigma [N] of normalised coordinates for one pixel of noise, the geometric mean of both directions."""
    rays = np.column_stack([np.nan_to_num(xy), np.ones(len(xy))])
    J = camera.project_jacobian(rays)[:, :, :2]
    determinant = np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0])
    return np.asarray(1.0 / np.sqrt(np.maximum(determinant, 1e-6)))


def stereo_inverse_depth(rig: Rig, xy: Array, right_px: Array, sigma_px: float) -> tuple[Array, Array]:
    """Return inverse depths [N] in cam0 and their sigmas, in 1/m, from pixels in cam1; NaN where there is none.

    The ray (x, y, 1) at inverse depth rho projects to R r + rho t in cam1, two equations linear in rho.
    """
    T = invert(rig.T_cam0_cam1)
    turned = np.column_stack([xy, np.ones(len(xy))]) @ T[:3, :3].T
    seen = rig.cameras[1].normalise(right_px)
    a = turned[:, :2] - seen * turned[:, 2:]
    b = T[:2, 3] - seen * T[2, 3]
    length2 = np.einsum("ni,ni->n", b, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = -np.einsum("ni,ni->n", a, b) / length2
        noise = sigma_px * angle_per_px(rig.cameras[1], seen) * np.abs(turned[:, 2])
        sigma = noise / np.sqrt(length2)
    good = np.isfinite(rho) & np.isfinite(sigma)
    return np.where(good, rho, np.nan), np.where(good, sigma, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Points [P, 3] in map and how uncertain each is, relative to its mean distance; infinite: it has no place."""

    points_m: Array
    relative_sigma: Array


def triangulate(tracks: Tracks, keep: Mask, T_map_cam: Array, sigma_px: float) -> Triangulation:
    """Return points by weighted least squares of the kept observations [N], given the images' poses [I, 4, 4]."""
    k, p = tracks.image[keep], tracks.point[keep]
    R, centre = T_map_cam[k, :3, :3], T_map_cam[k, :3, 3]
    rays = np.column_stack([tracks.xy[keep], np.ones(len(k))])
    norm = np.linalg.norm(rays, axis=1)
    ray = np.einsum("nij,nj->ni", R, rays / norm[:, None])
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    along = ray[:, :, None] * ray[:, None, :]
    rho, sigma_rho = tracks.rho[keep], tracks.sigma_rho[keep]
    deep = rho > 2.0 * sigma_rho  # farther, the measured range has no mean
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = np.where(deep, norm / rho, 0.0)
        weight_along = np.where(deep, (rho**2 / (norm * sigma_rho)) ** 2, 0.0)
    mean = np.bincount(p[deep], measured[deep], tracks.points) / np.maximum(
        np.bincount(p[deep], None, tracks.points), 1
    )
    distance: Array = np.where(mean[p] > 0.0, mean[p], 3.0)
    target = centre + ray * measured[:, None]
    sigma = sigma_px * tracks.sigma_per_px[keep] / norm  # of the ray's angle, nearly
    points: Array = np.zeros((tracks.points, 3))
    information: Array = np.zeros((tracks.points, 3, 3))
    for _ in range(_PASSES):
        A = across / (sigma * distance)[:, None, None] ** 2 + along * weight_along[:, None, None]
        information = summed(A.reshape(-1, 9), p, tracks.points).reshape(-1, 3, 3)
        right = summed(np.einsum("nij,nj->ni", A, target), p, tracks.points)
        floor = _UNKNOWN_INFORMATION + 1e-12 * np.trace(information, axis1=1, axis2=2)
        regular = information + floor[:, None, None] * np.eye(3)
        points = np.asarray(np.linalg.solve(regular, right[:, :, None])[:, :, 0])
        distance = np.asarray(np.maximum(np.linalg.norm(points[p] - centre, axis=1), _MIN_Z_M))
    seen = np.maximum(np.bincount(p, None, tracks.points), 1)
    mean_distance = np.bincount(p, distance, tracks.points) / seen
    weakest = np.maximum(np.linalg.eigvalsh(information)[:, 0], _UNKNOWN_INFORMATION)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = 1.0 / (np.sqrt(weakest) * mean_distance)
    return Triangulation(points, np.where(mean_distance > 0.0, relative, np.inf))


def summed(rows: Array, index: Ints, count: int) -> Array:
    """Return the sums [count, C] of rows [N, C] with the same index."""
    return np.stack([np.bincount(index, column, count) for column in rows.T], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """How far observations [N] are from where their points should be seen."""

    xy: Array  # [N, 2] predicted minus observed, on z = 1
    px: Array  # [N] its length in units of one pixel; infinite behind the camera
    rho: Array  # [N] inverse depth, predicted minus observed by its sigma; NaN where none was measured
    predicted_rho: Array  # [N] 1/m


def residuals(tracks: Tracks, points_m: Array, T_map_cam: Array) -> Residuals:
    """Return the residuals of all observations at given points [P, 3] and poses of images [I, 4, 4]."""
    T = T_map_cam[tracks.image]
    seen = np.einsum("nji,nj->ni", T[:, :3, :3], points_m[tracks.point] - T[:, :3, 3])
    ahead = seen[:, 2] > _MIN_Z_M
    z = np.where(ahead, seen[:, 2], 1.0)
    xy = seen[:, :2] / z[:, None] - tracks.xy
    px = np.where(ahead, np.linalg.norm(xy, axis=1) / tracks.sigma_per_px, np.inf)
    return Residuals(xy, px, (1.0 / z - tracks.rho) / tracks.sigma_rho, 1.0 / z)
