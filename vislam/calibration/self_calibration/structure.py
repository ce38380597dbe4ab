"""Poses and points of one stretch, and how what was seen depends on them, on the lens and on the readout.

A point is a direction and an inverse distance from the stretch's origin, so that far ones and pure turns need no care
(Civera, Davison, Montiel, TRO 2008, with one anchor for all). A row that is read `row * readout` after the middle one
sees a point `row * readout * velocity` further on, with the velocity that tracks themselves show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vislam.calibration.self_calibration.segments import Segment
from vislam.core.camera import Camera
from vislam.core.messages import Array, Bools
from vislam.imu.gyro_turns import GyroTurns, SeenTurns, turn_errors

UNKNOWNS = 8  # turn of R_cam_body on the camera's side, time offset, bias, scale error
OFFSET, SCALE = 3, 7
BIAS = slice(4, 7)
_SHARE = 0.003  # of an angle, by which axes that are not square and a flexing mount are off
_FLOOR_RAD = 1e-4
LENS = 9  # fx, fy, cx, cy and five coefficients, of which a lens may have four
READOUT = LENS  # place of the readout, in s, among the shared unknowns
GYRO = READOUT + 1  # place of the first of the gyroscope's
SHARED = GYRO + UNKNOWNS


@dataclass(frozen=True, slots=True, eq=False)
class Gyro:
    """Samples of a gyroscope and how good they are."""

    zero_ns: int
    t_s: Array  # [N] since then
    rate_rad_s: Array  # [N, 3]
    density: float  # rad/s/sqrt(Hz)
    scale_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class TurnRows:
    """Differences [n - 1, 3] between successive keyframes' turns and the gyroscope's, with what takes them off."""

    errors: Array
    by_second: Array  # [n - 1, 3, 3] by the later keyframe's turn; by the earlier one's it is the identity
    by_gyro: Array  # [n - 1, 3, UNKNOWNS]
    information: Array  # [n - 1], zero where samples are missing


def turn_rows(
    R: Array, t_ns: NDArray[np.int64], gyro: Gyro, turns: GyroTurns, R_cam_body: Array, offset_s: float
) -> TurnRows:
    """Return the rows of attitudes [n, 3, 3] at stamps [n] of the camera: the rotation part of Kalibr (IROS 2013).

    The gyroscope's scale is unknown as far as its calibration leaves it: an exact one would give the focal length
    better than most cameras can.
    """
    t_s = np.asarray((t_ns - gyro.zero_ns) * 1e-9, dtype=np.float64)
    between = R[:-1].transpose(0, 2, 1) @ R[1:]
    seen = SeenTurns(t_s[:-1].copy(), t_s[1:].copy(), np.ascontiguousarray(between))
    errors, J = turn_errors(turns, seen, np.ascontiguousarray(R_cam_body), offset_s, 0.0)
    vectors = Rotation.from_matrix(between).as_rotvec()
    variance = gyro.density**2 * np.diff(t_s) + _SHARE**2 * np.sum(vectors**2, axis=1) + _FLOOR_RAD**2
    known = np.isfinite(errors).all(axis=1)
    by_gyro = np.concatenate([J[:, :, 4:7], J[:, :, :4], vectors[:, :, None]], axis=2)
    return TurnRows(np.where(known[:, None], errors, 0.0), -between, by_gyro * known[:, None, None], known / variance)


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Where n keyframes and m points are, in the frame of the stretch, with any scale."""

    R: Array  # [n, 3, 3] from the camera's axes
    centre: Array  # [n, 3]
    ray: Array  # [m, 3] unit vectors from the origin
    rho: Array  # [m] over the distance from the origin
    origin: int  # keyframe that stays in the origin

    def moved(self, by_pose: Array, by_point: Array) -> Structure:
        """Return the structure after steps of the poses [n, 6] (turn on the camera's side, shift) and points [m, 3]."""
        ray = self.ray + np.einsum("mij,mj->mi", _tangents(self.ray), by_point[:, :2])
        return Structure(
            self.R @ Rotation.from_rotvec(by_pose[:, :3]).as_matrix(),
            self.centre + by_pose[:, 3:],
            ray / np.linalg.norm(ray, axis=1, keepdims=True),
            self.rho + by_point[:, 2],
            self.origin,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Observations [N] linearised: residuals in px, measured minus predicted, and derivatives of the prediction."""

    keyframe: NDArray[np.int64]  # [N]
    point: NDArray[np.int64]  # [N]
    r: Array  # [N, 2]
    by_pose: Array  # [N, 2, 6]
    by_point: Array  # [N, 2, 3]
    by_shared: Array  # [N, 2, SHARED]


def residuals(segment: Segment, at: Structure, camera: Camera, readout_s: float) -> Array:
    """Return measured minus predicted pixels [n, m, 2]; NaN where not seen, or where no ray of the lens leads."""
    seen = np.einsum("nji,nmj->nmi", at.R, at.ray[None] - at.rho[None, :, None] * at.centre[:, None])
    predicted = camera.project(seen.reshape(-1, 3)).reshape(segment.pixels.shape)
    return segment.pixels - predicted - readout_s * _lag(segment, camera, readout_s)


def linearise(segment: Segment, at: Structure, camera: Camera, readout_s: float, kept: Bools) -> Linear:
    """Return the kept observations [n, m], sorted by keyframe, with their derivatives."""
    r = residuals(segment, at, camera, readout_s)
    k, p = np.nonzero(kept & np.isfinite(r).all(axis=2))
    Rt = at.R[k].transpose(0, 2, 1)
    ray, rho, centre = at.ray[p], at.rho[p], at.centre[k]
    seen = np.einsum("nij,nj->ni", Rt, ray - rho[:, None] * centre)
    A = camera.project_jacobian(seen)
    by_turn = np.zeros((len(k), 3, 3))  # of exp(-w) seen, which is seen x w
    x, y, z = seen.T
    by_turn[:, 0, 1], by_turn[:, 0, 2], by_turn[:, 1, 0] = -z, y, z
    by_turn[:, 1, 2], by_turn[:, 2, 0], by_turn[:, 2, 1] = -x, -y, x
    by_pose = A @ np.concatenate([by_turn, -rho[:, None, None] * Rt], axis=2)
    by_ray = Rt @ _tangents(at.ray)[p]
    by_rho = -np.einsum("nij,nj->ni", Rt, centre)[:, :, None]
    by_point = A @ np.concatenate([by_ray, by_rho], axis=2)
    lag = _lag(segment, camera, readout_s)[k, p]
    by_shared = np.concatenate([by_lens(camera, seen), lag[:, :, None], np.zeros((len(k), 2, UNKNOWNS))], axis=2)
    return Linear(k, p, r[k, p], by_pose, by_point, by_shared)


def by_lens(camera: Camera, points: Array) -> Array:
    """Return derivatives [N, 2, LENS] of pixels by fx, fy, cx, cy and coefficients (radtan or equidistant)."""
    x, y = (points[:, :2] / points[:, 2:]).T
    r2 = x * x + y * y
    zero = np.zeros(len(x))
    if camera.distortion == "equidistant":
        r = np.sqrt(np.maximum(r2, 1e-18))
        powers = np.arctan(r)[:, None] ** [3, 5, 7, 9] / r[:, None]
        u_k, v_k = np.column_stack([x[:, None] * powers, zero]), np.column_stack([y[:, None] * powers, zero])
    else:
        u_k = np.column_stack([x * r2, x * r2 * r2, 2.0 * x * y, r2 + 2.0 * x * x, x * r2**3])
        v_k = np.column_stack([y * r2, y * r2 * r2, r2 + 2.0 * y * y, 2.0 * x * y, y * r2**3])
    pixels = camera.project(points)
    u, v = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    one = zero + 1.0
    along_u = np.column_stack([u, zero, one, zero, camera.fx * u_k])
    along_v = np.column_stack([zero, v, zero, one, camera.fy * v_k])
    return np.stack([along_u, along_v], axis=1)


def _lag(segment: Segment, camera: Camera, readout_s: float) -> Array:
    """Return by how much pixels [n, m, 2] lag for a second of readout.

    A point that moves down is read later from frame to frame: more time has passed than between the stamps.
    """
    velocity, height = segment.velocity_px_s, camera.height - 1.0
    rows = segment.pixels[:, :, 1] / height - 0.5
    later = np.maximum(1.0 + velocity[:, :, 1] * readout_s / height, 0.5)
    return np.asarray((rows / later)[:, :, None] * velocity)


def _tangents(rays: Array) -> Array:
    """Return two unit vectors [m, 3, 2] across each of unit vectors [m, 3]."""
    pole = np.where(np.abs(rays[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(pole, rays)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=2)
