"""A first structure of a stretch for a lens that is roughly right: two views, then one after the other."""

import cv2
import numpy as np

from vislam.calibration.self_calibration.segments import LEAST_KEYFRAMES, Segment
from vislam.calibration.self_calibration.structure import Structure
from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, Bools
from vislam.vision.two_view import essential_ransac

_SHARED = 60  # tracks that the first two views should share
_LEAST = 20
_GATE_PX = 4.0  # of a wrong lens: half a per cent of the image
_TRIES = 200


def start_structure(segment: Segment, camera: Camera) -> tuple[Segment, Structure, Bools] | None:
    """Return poses and points as a lens sees them; None where the views do not fit together.

    Returns:
        The stretch with those of its keyframes that found a place, the structure, and which points [m] are placed.
    """
    n, m = segment.pixels.shape[:2]
    xy = camera.normalise(segment.pixels.reshape(-1, 2)).reshape(n, m, 2)
    gate = _GATE_PX * camera.width / 640.0 / camera.fx
    best: Array = np.full((n, 3, 4), np.nan)
    origin = 0
    for first, second in _first_pairs(xy):
        T = _chained(xy, first, second, gate)
        if np.isfinite(T[:, 0, 0]).sum() > np.isfinite(best[:, 0, 0]).sum():
            best, origin = T, first
        if np.isfinite(best[:, 0, 0]).all():
            break
    good = np.isfinite(best[:, 0, 0])
    if good.sum() < LEAST_KEYFRAMES:
        return None
    R = best[good, :, :3].transpose(0, 2, 1)
    centre = -np.einsum("nij,nj->ni", R, best[good, :, 3])
    rest = segment.of(good)
    found = placed_points(rest, camera, R, centre, int(good[:origin].sum()))
    return None if found is None else (rest, *found)


def _chained(xy: Array, first: int, second: int, gate: float) -> Array:
    """Return poses [n, 3, 4] from the stretch to each camera, begun with two of them; NaN where one has no place."""
    T = np.full((len(xy), 3, 4), np.nan)
    found = essential_ransac(None, xy[first], xy[second], gate, _LEAST)
    if found is None:
        return T
    T[first] = np.eye(3, 4)
    T[second] = np.column_stack([found[0].T, -found[0].T @ found[1]])
    middle = (first + second) // 2
    for _ in range(2):  # who did not see enough may do so once others have placed more
        for k in sorted(range(len(xy)), key=lambda k: (abs(k - middle), k)):
            if np.isnan(T[k, 0, 0]):
                T[k] = _resected(*_triangulated(xy, T), xy[k], gate)
    return T


def placed_points(
    segment: Segment, camera: Camera, R: Array, centre: Array, origin: int
) -> tuple[Structure, Bools] | None:
    """Return the structure of known poses, its usual distance 1, and which points [m] have a place; None: too few."""
    xy = camera.normalise(segment.pixels.reshape(-1, 2)).reshape(segment.pixels.shape)
    Rt = R.transpose(0, 2, 1)
    points, known = _triangulated(xy, np.concatenate([Rt, -(Rt @ centre[:, :, None])], axis=2))
    if known.sum() < _LEAST:
        return None
    length = np.maximum(np.linalg.norm(points[:, :3], axis=1), 1e-12)
    rho = np.where(known, points[:, 3] / length, 1.0)
    scale = float(np.median(1.0 / rho[known]))
    ray = np.where(known[:, None], points[:, :3] / length[:, None], [0.0, 0.0, 1.0])
    return Structure(R, centre / scale, ray, np.where(known, rho * scale, 1.0), origin), known


def _first_pairs(xy: Array) -> list[tuple[int, int]]:
    """Return pairs of keyframes about the middle to begin with: far apart, but sharing enough tracks; then nearer."""
    n = len(xy)
    seen = np.isfinite(xy[:, :, 0])
    enough = min(_SHARED, 0.5 * float(np.median(seen.sum(axis=1))))
    halves = [h for h in range(n // 2 - 1, 0, -1) if (seen[n // 2 - h] & seen[n // 2 + h]).sum() >= enough]
    return [
        (n // 2 - h, n // 2 + h) for h in dict.fromkeys([*halves[:1], *halves[len(halves) // 2 :][:1], *halves[-1:]])
    ]


def _triangulated(xy: Array, T: Array) -> tuple[Array, Bools]:
    """Return homogeneous points [m, 4] in the stretch and which [m] two views or more place in front of themselves."""
    placed = np.isfinite(T[:, 0, 0])
    P = T[placed]
    at = np.nan_to_num(xy[placed])
    seen = np.isfinite(xy[placed, :, 0])
    rows = at[..., None] * P[:, None, None, 2] - P[:, None, :2]  # [n, m, 2, 4]
    rows *= seen[..., None, None]
    points = np.linalg.eigh(np.einsum("nmij,nmik->mjk", rows, rows))[1][:, :, 0]
    depth = np.einsum("nj,mj->nm", P[:, 2], points)
    front = np.sum(np.where(seen, np.sign(depth), 0.0), axis=0)
    points = points * np.where(front < 0.0, -1.0, 1.0)[:, None]
    known = (np.abs(front) == seen.sum(axis=0)) & (seen.sum(axis=0) >= 2) & (points[:, 3] > 1e-9)
    return points, known


def _resected(points: Array, known: Bools, xy: Array, gate: float) -> Array:
    """Return the pose [3, 4] from which known points are seen at `xy` [m, 2]; NaN where too few agree."""
    used = known & np.isfinite(xy[:, 0])
    nothing = np.full((3, 4), np.nan)
    if used.sum() < _LEAST:
        return nothing
    places = np.ascontiguousarray(points[used, :3] / points[used, 3:])
    at = np.ascontiguousarray(xy[used])
    try:
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            places, at, np.eye(3), np.zeros(4), iterationsCount=_TRIES, reprojectionError=gate, confidence=0.999,
            flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
        if not ok or inliers is None or len(inliers) < _LEAST // 2:
            return nothing
        good = inliers[:, 0]
        turn, shift = cv2.solvePnPRefineLM(places[good], at[good], np.eye(3), np.zeros(4), turn, shift)
    except cv2.error:  # degenerate samples
        return nothing
    return np.column_stack([so3_exp(np.ravel(turn).astype(np.float64)), np.ravel(shift)])
