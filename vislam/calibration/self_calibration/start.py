"""A first structure of a stretch for a lens that is roughly right: two views, then one after the other."""

from __future__ import annotations

import cv2
import numpy as np

from vislam.calibration.self_calibration.segments import Segment
from vislam.calibration.self_calibration.structure import Structure
from vislam.core.camera import Camera
from vislam.core.geometry import so3_exp
from vislam.core.messages import Array, Bools
from vislam.vision.two_view import essential_ransac

_SHARED = 60  # tracks that the first two views should share
_LEAST = 20
_GATE_PX = 4.0  # of a wrong lens: half a per cent of the image
_TRIES = 200


def start_structure(segment: Segment, camera: Camera) -> tuple[Structure, Bools] | None:
    """Return poses and points as a lens sees them, and which [m] are placed; None where views do not fit together."""
    n, m = segment.pixels.shape[:2]
    xy = camera.normalise(segment.pixels.reshape(-1, 2)).reshape(n, m, 2)
    gate = _GATE_PX * camera.width / 640.0 / camera.fx
    pair = _first_pair(xy)
    if pair is None:
        return None
    first, second = pair
    found = essential_ransac(None, xy[first], xy[second], gate, _LEAST)
    if found is None:
        return None
    T = np.full((n, 3, 4), np.nan)  # from the stretch to each camera
    T[first] = np.eye(3, 4)
    T[second] = np.column_stack([found[0].T, -found[0].T @ found[1]])
    middle = (first + second) // 2
    for k in sorted(range(n), key=lambda k: (abs(k - middle), k)):
        if k in pair:
            continue
        points, known = _triangulated(xy, T)
        T[k] = _resected(points, known, xy[k], gate)
    if np.isnan(T[:, 0, 0]).any():
        return None
    R = T[:, :, :3].transpose(0, 2, 1)
    return placed_points(segment, camera, R, -np.einsum("nij,nj->ni", R, T[:, :, 3]), first)


def placed_points(segment: Segment, camera: Camera, R: Array, centre: Array, origin: int) -> tuple[Structure, Bools] | None:
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


def _first_pair(xy: Array) -> tuple[int, int] | None:
    """Return the two keyframes about the middle that are furthest apart and still share enough tracks."""
    n = len(xy)
    seen = np.isfinite(xy[:, :, 0])
    for half in range(n // 2 - 1, 0, -1):
        first, second = n // 2 - half, n // 2 + half
        if int((seen[first] & seen[second]).sum()) >= _SHARED:
            return first, second
    return None


def _triangulated(xy: Array, T: Array) -> tuple[Array, Array]:
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


def _resected(points: Array, known: Array, xy: Array, gate: float) -> Array:
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
