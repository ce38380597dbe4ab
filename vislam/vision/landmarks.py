"""Landmarks of the current keyframe as inverse-depth points with covariances, and the compiled kernels on them.

A landmark is `(x, y, rho)`: its direction on the plane z = 1 of the keyframe's cam0 and its inverse z-depth in 1/m
(Civera, TRO 2008). Depth noise of stereo and structured light is nearly constant in rho, points far away are ordinary
numbers, and a point of unknown depth is one with a wide sigma of rho: it constrains only what its epipolar line sees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vislam.core.jit import njit
from vislam.core.messages import Array

UNKNOWN_RHO = 0.25  # 1/m: of a point of unknown depth beside few known ones (`refine.py`), four metres away ...
UNKNOWN_RHO_SIGMA = 0.75  # 1/m: ... or anywhere between a metre and infinity
_KNOWN_FRACTION = 0.25  # sigma of rho relative to rho
_KNOWN_FAR = 0.02  # 1/m: sigma below which a point is known to be far, whatever its rho
_MIN_Z = 0.05  # of a landmark moved into another camera, relative to its old z-depth: nearer is behind or beside
_FUSE_GATE = 3.0  # standard deviations; depth at an edge is off by more


@njit(cache=True, nogil=True)
def predict(landmark: Array, R: Array, t: Array, h: Array, J_landmark: Array, J_pose: Array) -> bool:
    """Predict how a camera at T_key_cam = (R, t) sees a landmark; write into the last three arguments.

    Args:
        landmark: `(x, y, rho)` [3] in the keyframe's camera.
        R: rotation [3, 3] of T_key_cam.
        t: translation [3] of T_key_cam in metres.
        h: receives `(x, y, rho)` [3] in the camera.
        J_landmark: receives dh/dlandmark [3, 3].
        J_pose: receives dh/dxi [3, 6] for T_key_cam @ se3_exp(xi).

    Returns:
        False when the landmark is not in front of the camera; the outputs are then undefined.
    """
    rho = landmark[2]
    dx, dy, dz = landmark[0] - rho * t[0], landmark[1] - rho * t[1], 1.0 - rho * t[2]
    # Y = rho * (point in the camera): finite for points at infinity
    Y0 = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    Y1 = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    Y2 = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    if not Y2 > _MIN_Z:
        return False
    s = 1.0 / Y2
    h[0], h[1], h[2] = Y0 * s, Y1 * s, rho * s
    for column in range(3):
        if column < 2:
            y0, y1, y2 = R[column, 0], R[column, 1], R[column, 2]
        else:
            y0 = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
            y1 = -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])
            y2 = -(R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2])
        J_landmark[0, column] = s * (y0 - h[0] * y2)
        J_landmark[1, column] = s * (y1 - h[1] * y2)
        J_landmark[2, column] = -s * h[2] * y2
    J_landmark[2, 2] += s
    # dY = skew(Y) w - rho v
    for column in range(3):
        if column == 0:
            y0, y1, y2 = 0.0, Y2, -Y1
        elif column == 1:
            y0, y1, y2 = -Y2, 0.0, Y0
        else:
            y0, y1, y2 = Y1, -Y0, 0.0
        J_pose[0, column] = s * (y0 - h[0] * y2)
        J_pose[1, column] = s * (y1 - h[1] * y2)
        J_pose[2, column] = -s * h[2] * y2
        v2 = -rho if column == 2 else 0.0
        J_pose[0, 3 + column] = s * ((-rho if column == 0 else 0.0) - h[0] * v2)
        J_pose[1, 3 + column] = s * ((-rho if column == 1 else 0.0) - h[1] * v2)
        J_pose[2, 3 + column] = -s * h[2] * v2
    return True


@njit(cache=True, nogil=True)
def sandwich(J: Array, P: Array, out: Array) -> None:
    """Write J P J^T [3, 3] into `out`; by hand, because small matrix products allocate."""
    for a in range(3):
        for b in range(3):
            total = 0.0
            for c in range(3):
                row = P[c, 0] * J[b, 0] + P[c, 1] * J[b, 1] + P[c, 2] * J[b, 2]
                total += J[a, c] * row
            out[a, b] = total


@njit(cache=True, nogil=True)
def move(landmarks: Array, covariances: Array, T_key_cam: Array) -> tuple[Array, Array]:
    """Return landmarks [N, 3] and covariances [N, 3, 3] seen from T_key_cam [4, 4]; NaN where not in front of it."""
    R, t = T_key_cam[:3, :3].copy(), T_key_cam[:3, 3].copy()
    moved = np.full_like(landmarks, np.nan)
    moved_covariances = np.full_like(covariances, np.nan)
    h, J, J_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    for i in range(len(landmarks)):
        if predict(landmarks[i], R, t, h, J, J_pose):
            moved[i] = h
            sandwich(J, covariances[i], moved_covariances[i])
    return moved, moved_covariances


@njit(cache=True, nogil=True)
def fuse(
    landmarks: Array, covariances: Array, xy: Array, rho: Array, sigma_xy: float, sigma_rho: Array, gate: float
) -> tuple[Array, Array]:
    """Update landmarks with a measurement of themselves in their own camera (Kalman, one component after the other).

    Args:
        landmarks: [N, 3].
        covariances: [N, 3, 3].
        xy: measured directions [N, 2] on z = 1; NaN: not seen.
        rho: measured inverse depths [N] in 1/m; NaN: unknown.
        sigma_xy: standard deviation of `xy`.
        sigma_rho: standard deviations [N] of `rho` in 1/m.
        gate: a component further off than this many standard deviations is left out.

    Returns:
        Updated landmarks and covariances.
    """
    out, P = landmarks.copy(), covariances.copy()
    for i in range(len(landmarks)):
        for k in range(3):
            value = xy[i, k] if k < 2 else rho[i]
            sigma = sigma_xy if k < 2 else sigma_rho[i]
            variance = P[i, k, k] + sigma * sigma
            innovation = value - out[i, k]
            if not innovation * innovation <= gate * gate * variance:  # also leaves out NaN
                continue
            column = P[i, :, k].copy()
            for a in range(3):
                out[i, a] += column[a] / variance * innovation
                for b in range(3):
                    P[i, a, b] -= column[a] * column[b] / variance
    return out, P


def metric_points(inverse_depth: Array) -> Array:
    """Return points [N, 3] in metres of inverse-depth points [N, 3] with rho > 0."""
    return np.column_stack([inverse_depth[:, :2], np.ones(len(inverse_depth))]) / inverse_depth[:, 2:]


def known_depth(landmarks: Array, covariances: Array) -> NDArray[np.bool_]:
    """Return which landmarks [N, 3] with covariances [N, 3, 3] have a depth that is good enough to stand on."""
    sigma = np.sqrt(covariances[:, 2, 2])
    return np.asarray(sigma < np.maximum(_KNOWN_FRACTION * landmarks[:, 2], _KNOWN_FAR), dtype=np.bool_)


class Landmarks:
    """The landmarks of the tracks, row by row: means [N, 3] and covariances [N, 3, 3]."""

    def __init__(self) -> None:
        """Start empty."""
        self.mean: Array = np.empty((0, 3))
        self.covariance: Array = np.empty((0, 3, 3))
        self.by_delay: Array = np.empty(0)  # [N] of rho by a delay of the depth it was made of, 1/m/s; NaN: unknown

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which landmarks [N] have a depth that is good enough to stand on."""
        return known_depth(self.mean, self.covariance)

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Drop the rows that are not in `which` [N]."""
        self.mean, self.covariance = self.mean[which], self.covariance[which]
        self.by_delay = self.by_delay[which]

    def append(self, xy: Array, rho: Array, sigma_xy: float, sigma_rho: Array, by_delay: Array | None = None) -> None:
        """Add landmarks seen at `xy` [M, 2] with inverse depths `rho` [M], NaN where unknown, and `by_delay` [M]."""
        known = np.isfinite(rho)
        covariance: Array = np.zeros((len(xy), 3, 3))
        covariance[:, 0, 0] = covariance[:, 1, 1] = sigma_xy**2
        covariance[:, 2, 2] = np.where(known, sigma_rho, UNKNOWN_RHO_SIGMA) ** 2
        self.mean = np.vstack([self.mean, np.column_stack([xy, np.where(known, rho, UNKNOWN_RHO)])])
        self.covariance = np.concatenate([self.covariance, covariance])
        self.by_delay = np.concatenate([self.by_delay, np.zeros(len(xy)) if by_delay is None else by_delay])

    def pin(self, sigma_xy: float) -> None:
        """Let each landmark be the patch where it is believed to be: its direction is known to `sigma_xy`."""
        rho_variance = self.covariance[:, 2, 2].copy()
        self.covariance = np.zeros_like(self.covariance)
        self.covariance[:, 0, 0] = self.covariance[:, 1, 1] = sigma_xy**2
        self.covariance[:, 2, 2] = rho_variance

    def carried(
        self, kept: NDArray[np.bool_], T_key_cam: Array, xy: Array, sigma_xy: float, rho: Array, sigma_rho: Array,
        by_delay: Array,
    ) -> Landmarks:  # fmt: skip
        """Return the landmarks of `kept` [N] as a camera at `T_key_cam` [4, 4] sees them, improved by what it measures.

        Args:
            kept: M of them.
            T_key_cam: pose in the keyframe.
            xy: their directions [M, 2] on z = 1, with standard deviation `sigma_xy`.
            sigma_xy: see `xy`.
            rho: inverse depths [M] in 1/m, NaN where not measured, with standard deviations `sigma_rho` [M].
            sigma_rho: see `rho`.
            by_delay: derivative [M] of `rho` by the delay of depth.
        """
        out = Landmarks()
        mean, covariance = move(self.mean[kept], self.covariance[kept], T_key_cam)
        # depth that is measured again counts by what was not known before
        weight = covariance[:, 2, 2] / (covariance[:, 2, 2] + sigma_rho**2)
        before = self.by_delay[kept]
        out.by_delay = np.where(np.isfinite(rho), before + weight * (by_delay - before), before)
        out.mean, out.covariance = fuse(mean, covariance, xy, rho, sigma_xy, sigma_rho, _FUSE_GATE)
        return out

    def expected_rho(self, xy: Array) -> Array:
        """Return the inverse depth [M] of the nearest known landmark to each direction [M, 2]; NaN without any."""
        known = self.known
        if not known.any() or len(xy) == 0:
            return np.full(len(xy), np.nan)
        return np.asarray(_nearest_rho(self.mean[known], np.ascontiguousarray(xy)))


@njit(cache=True, nogil=True)
def _nearest_rho(landmarks: Array, xy: Array) -> Array:
    out = np.empty(len(xy))
    for i in range(len(xy)):
        best = np.inf
        for j in range(len(landmarks)):
            dx, dy = landmarks[j, 0] - xy[i, 0], landmarks[j, 1] - xy[i, 1]
            distance = dx * dx + dy * dy
            if j == 0 or distance < best:
                best, out[i] = distance, landmarks[j, 2]
    return out
