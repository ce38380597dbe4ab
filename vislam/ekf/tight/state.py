"""What the tight filter estimates beside its inertial state, and the moves on it: clone, forget, correct.

Error state [21 + 6 C + 3 S + K]: the 15 inertial ones (`kernels`), time offset 15, extrinsic rotation 16:19 (camera
side), focal length 19 and metres 20, clones (rotation, position), points kept in the state, own variables of sensors.
Clones and points are right-invariant too: a point is `Exp(e) f^ + e_f` with the rotation error e of the body now.
Everything here is replaced, never changed in place, so that a checkpoint is a reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from vislam.core.geometry import skew, so3_exp, so3_left_jacobian
from vislam.core.jit import njit
from vislam.core.messages import AS_MODELLED, Array, NoiseScale
from vislam.ekf.loose.kernels import turn
from vislam.ekf.regain import Watch
from vislam.ekf.tight.tracks import FrameTracks

TIME = 15
MOUNT = slice(16, 19)
FOCAL, METRES = 19, 20
CLONES = 21


def _none(*shape: int) -> Array:
    return np.zeros(shape)


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Where a rest began, and the first estimate of attitude there.

    At rest, tilt and the accelerometer's bias are one: whatever turns the body by e and changes the bias by
    R^T (g x e) leaves no trace. That direction depends on R. Linearised at each new estimate it is a little different
    each time, and what lies between passes for information (Huang, Mourikis and Roumeliotis, IJRR 2010): tilt follows
    noise. One R for all of a rest keeps it free.
    """

    t_ns: int  # stamp of the frame at which it began
    R: Array  # [3, 3] R_odom_body as estimated then
    to_first: Array  # [3, 3] takes the attitude estimated now to that


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Covariance of everything, calibration, clones with the tracks seen there, points in the state, own variables."""

    P: Array  # [n, n]
    time_offset_s: float  # to add to a frame's stamp to get the IMU's time
    R_body_cam: Array  # [3, 3] of cam0
    frames: tuple[FrameTracks, ...] = ()  # one per clone, oldest first
    R: Array = field(default_factory=lambda: _none(0, 3, 3))  # [C, 3, 3] R_odom_body
    p: Array = field(default_factory=lambda: _none(0, 3))  # [C, 3]
    rate: Array = field(default_factory=lambda: _none(0, 3))  # [C, 3] rad/s, body
    velocity: Array = field(default_factory=lambda: _none(0, 3))  # [C, 3] m/s, odom
    point_ids: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [S] track ids
    points: Array = field(default_factory=lambda: _none(0, 3))  # [S, 3] m, odom
    misses: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # [S] frames in a row
    rest: Rest | None = None  # None: the body moves
    rested_t_ns: int = 0  # stamp of the newest frame at which it still rested
    # [2] of tracks and of points, by how much whitened rows scatter as they turn out, at most 1
    spread: Array = field(default_factory=lambda: np.ones(2))
    scales: Array = field(default_factory=lambda: np.ones(2))  # true focal length and metres over those given
    rejects: int = 0  # frames in a row whose tracks contradict the state
    rejects_since_ns: int = 0
    last_vision_t_ns: int = 0
    noise: NoiseScale = AS_MODELLED  # white noise of the IMU from here on
    own: Array = field(default_factory=lambda: _none(0))  # [K] of sensors, as `Suite` orders them
    own_since_ns: Mapping[str, int] = field(default_factory=dict)  # see `OwnVariables`
    watch: Watch = field(default_factory=Watch)  # which sensors it believes

    @property
    def to_first(self) -> Array:
        """Return what takes the estimated attitude to that at which the accelerometer's bias is linearised [3, 3]."""
        return np.eye(3) if self.rest is None else self.rest.to_first

    @property
    def first_point(self) -> int:
        """Where the points begin in the error state."""
        return CLONES + 6 * len(self.frames)

    @property
    def first_own(self) -> int:
        """Where the points end in the error state, and the sensors' own variables begin."""
        return len(self.P) - len(self.own)


def propagated(window: Window, Phi: Array, Q: Array) -> Window:
    """Return the window after the inertial part went through the transition Phi with noise Q [15, 15].

    Points stand still, but their error is given relative to the body's rotation error, and that changed. Own variables
    of sensors stand still.
    """
    first, end = window.first_point, window.first_own
    turned = _skews(window.points)
    P = window.P.copy()
    moves, spread = np.empty((15 + end - first, 15)), np.zeros((15 + end - first, 15))
    moves[:15] = Phi
    moves[15:] = turned @ (Phi[:3] - np.eye(3, 15))
    spread[:15], spread[15:, :3] = np.eye(15), turned
    change = moves @ window.P[:15]
    P[:15] = change[:15]
    P[first:end] += change[15:]
    change = P[:, :15] @ moves.T
    P[:, :15] = change[:, :15]
    P[:, first:end] += change[:, 15:]
    noise = spread @ Q @ spread.T
    P[:15, :15] += noise[:15, :15]
    P[:15, first:end] += noise[:15, 15:]
    P[first:end, :15] += noise[15:, :15]
    P[first:end, first:end] += noise[15:, 15:]
    return replace(window, P=0.5 * (P + P.T))


def _skews(points: Array) -> Array:
    """Return `skew` of points [S, 3], one below the other [3 S, 3]."""
    out = np.zeros((len(points), 3, 3))
    x, y, z = points.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out.reshape(-1, 3)


def _opened(P: Array, at: int, by: int) -> Array:
    """Return P with room for `by` more rows and columns from `at` on, which hold anything."""
    out = np.empty((len(P) + by, len(P) + by))
    out[:at, :at], out[:at, at + by :] = P[:at, :at], P[:at, at:]
    out[at + by :, :at], out[at + by :, at + by :] = P[at:, :at], P[at:, at:]
    return out


def _closed(P: Array, at: int, by: int) -> Array:
    """Return P without `by` rows and columns from `at` on."""
    out = np.empty((len(P) - by, len(P) - by))
    out[:at, :at], out[:at, at:] = P[:at, :at], P[:at, at + by :]
    out[at:, :at], out[at:, at:] = P[at + by :, :at], P[at + by :, at + by :]
    return out


def cloned(
    window: Window, x: Array, R: Array, gyro_rad_s: Array, ago_s: float, gravity: float, frame: FrameTracks
) -> Window:
    """Return the window with a clone of the pose `ago_s` before that of x [16], whose rotation is R.

    `ago_s` is 0 unless the estimate of the time offset jumped back over another measurement. The clone depends on the
    time offset by its velocity (Li and Mourikis, IJRR 2014).
    """
    rate, v = gyro_rad_s - x[13:16], x[3:6].copy()
    R_then = R @ so3_exp(-rate * ago_s)
    p_then = x[0:3] - v * ago_s
    C, n = len(window.frames), len(window.P)
    J = np.zeros((6, n))
    J[:3, :3] = J[3:, 3:6] = np.eye(3)
    J[3:, 6:9] = -ago_s * np.eye(3)
    J[3:, :3] = 0.5 * ago_s * ago_s * skew(np.array([0.0, 0.0, -gravity]))
    turning = R_then @ rate
    J[:3, TIME] = turning
    J[3:, TIME] = v + np.cross(p_then, turning)
    at = CLONES + 6 * C
    P, here, after = _opened(window.P, at, 6), slice(at, at + 6), slice(at + 6, n + 6)
    JP = J @ window.P
    P[here, :at], P[here, after], P[:at, here], P[after, here] = JP[:, :at], JP[:, at:], JP[:, :at].T, JP[:, at:].T
    P[here, here] = JP @ J.T
    return replace(
        window,
        P=P,
        frames=(*window.frames, frame),
        R=np.concatenate((window.R, R_then[None])),
        p=np.concatenate((window.p, p_then[None])),
        rate=np.concatenate((window.rate, rate[None])),
        velocity=np.concatenate((window.velocity, v[None])),
    )


def without_clone(window: Window, index: int) -> Window:
    """Return the window without one clone and what was seen there."""
    stay = np.concatenate((np.arange(index), np.arange(index + 1, len(window.frames))))
    return replace(
        window,
        P=_closed(window.P, CLONES + 6 * index, 6),
        frames=window.frames[:index] + window.frames[index + 1 :],
        R=window.R[stay],
        p=window.p[stay],
        rate=window.rate[stay],
        velocity=window.velocity[stay],
    )


def without_points(window: Window, drop: NDArray[np.bool_]) -> Window:
    """Return the window without the points [S] marked."""
    if not drop.any():
        return window
    stay = np.flatnonzero(~drop)
    rows = window.first_point + (3 * stay[:, None] + np.arange(3)).ravel()
    keep = np.concatenate((np.arange(window.first_point), rows, np.arange(window.first_own, len(window.P))))
    return replace(
        window,
        P=window.P[np.ix_(keep, keep)],
        point_ids=window.point_ids[stay],
        points=window.points[stay],
        misses=window.misses[stay],
    )


def with_points(window: Window, ids: NDArray[np.int64], points: Array, fixing: Array, H_points: Array) -> Window:
    """Return the window with new points in the state.

    Args:
        window: as it was when the tracks were linearised.
        ids: [K] track ids.
        points: [K, 3] where they were linearised.
        fixing: [K, 3, 5 + 6 C + 1] rows that fix each point, by what observations share and clones, then the residual.
        H_points: [K, 3, 3] the same rows by the point.
    """
    n, C = len(window.P), len(window.frames)
    G = np.zeros((3 * len(ids), n))
    moved = points.copy()
    noise = np.zeros((3 * len(ids), 3 * len(ids)))
    for k in range(len(ids)):
        inverse = np.linalg.inv(H_points[k])
        rows = slice(3 * k, 3 * k + 3)
        G[rows, 16 : CLONES + 6 * C] = -inverse @ fixing[k, :, :-1]
        G[rows, :3] = skew(points[k])
        noise[rows, rows] = inverse @ inverse.T
        moved[k] += inverse @ fixing[k, :, -1]
    GP, at = G @ window.P, window.first_own
    P, here, after = _opened(window.P, at, len(G)), slice(at, at + len(G)), slice(at + len(G), n + len(G))
    P[here, :at], P[here, after], P[:at, here], P[after, here] = GP[:, :at], GP[:, at:], GP[:, :at].T, GP[:, at:].T
    P[here, here] = GP @ G.T + noise
    return replace(
        window,
        P=0.5 * (P + P.T),
        point_ids=np.concatenate((window.point_ids, ids)),
        points=np.concatenate((window.points, moved)),
        misses=np.concatenate((window.misses, np.zeros(len(ids), dtype=np.int64))),
    )


def depth_ratios(window: Window, points: Array, fixing: Array, H_points: Array) -> Array:
    """Return the relative sigma [K] of the distance of points [K, 3] from the newest clone, poses included.

    Arguments as in `with_points`.
    """
    newest = len(window.frames) - 1
    visible = slice(16, window.first_point)
    P = window.P[visible, visible]
    at = CLONES - MOUNT.start + 6 * newest
    out = np.empty(len(points))
    for k in range(len(points)):
        ray = points[k] - window.p[newest]
        distance = float(np.linalg.norm(ray))
        across = np.linalg.solve(H_points[k].T, ray / distance)
        row = -across @ fixing[k, :, :-1]
        row[at : at + 3] += ray / distance @ skew(window.p[newest])
        row[at + 3 : at + 6] -= ray / distance
        out[k] = np.sqrt(max(float(row @ P @ row + across @ across), 0.0)) / distance
    return out


def compressed(H: Array, r: Array) -> tuple[Array, Array]:
    """Return at most as many rows as columns that say the same: QR of whitened rows [m, n]."""
    if len(r) <= H.shape[1]:
        return H, r
    R = np.asarray(np.linalg.qr(np.column_stack((H, r)), mode="r"))
    return R[: H.shape[1], :-1], R[: H.shape[1], -1]


def gain_step(P: Array, H: Array, r: Array) -> tuple[Array, Array, float]:
    """Return the change of the state [n] by whitened rows H [m, n], r [m], the covariance after it, and their NIS."""
    HP = H @ P
    S = HP @ H.T
    S.flat[:: len(r) + 1] += 1.0
    L = np.linalg.cholesky(S)
    A = solve_triangular(L, HP, lower=True, check_finite=False)
    b = solve_triangular(L, r, lower=True, check_finite=False)
    after = P - A.T @ A
    return A.T @ b, 0.5 * (after + after.T), float(b @ b)


def corrected(window: Window, x: Array, H: Array, r: Array) -> Window:
    """Apply whitened rows H [m, n], r [m]: x moves in place."""
    change, P, _ = gain_step(window.P, H, r)
    return moved(replace(window, P=P), x, change)


def moved(window: Window, x: Array, change: Array) -> Window:
    """Add an error [n] to the estimates: x in place, the rest returned."""
    R, p, velocity, points = window.R.copy(), window.p.copy(), window.velocity.copy(), window.points.copy()
    _retract(x, R, p, velocity, points, np.ascontiguousarray(change))
    return replace(
        window,
        time_offset_s=window.time_offset_s + float(change[TIME]),
        R_body_cam=window.R_body_cam @ so3_exp(np.ascontiguousarray(change[MOUNT])),
        scales=window.scales + change[FOCAL : METRES + 1],
        R=R,
        p=p,
        velocity=velocity,
        points=points,
        own=window.own + change[window.first_own :],
    )


@njit(cache=True, nogil=True)
def _retract(x: Array, R: Array, p: Array, velocity: Array, points: Array, change: Array) -> None:
    by = change[0:3]
    turned, J, none = so3_exp(by), so3_left_jacobian(by), np.zeros(3)
    w, a, b, c = x[6], x[7], x[8], x[9]
    body = np.empty(3)  # the same turn on the body side
    body[0] = (1 - 2 * (b * b + c * c)) * by[0] + 2 * (a * b + w * c) * by[1] + 2 * (a * c - w * b) * by[2]
    body[1] = 2 * (a * b - w * c) * by[0] + (1 - 2 * (a * a + c * c)) * by[1] + 2 * (b * c + w * a) * by[2]
    body[2] = 2 * (a * c + w * b) * by[0] + 2 * (b * c - w * a) * by[1] + (1 - 2 * (a * a + b * b)) * by[2]
    turn(x, 6, body[0], body[1], body[2])
    _move(turned, x[0:3], J, change[3:6])
    _move(turned, x[3:6], J, change[6:9])
    for i in range(3):
        x[13 + i] += change[9 + i]
        x[10 + i] += change[12 + i]
    C = len(R)
    column = np.empty(3)
    for k in range(C):
        at = CLONES + 6 * k
        by = change[at : at + 3]
        turn_k = so3_exp(by)
        for j in range(3):
            for i in range(3):
                column[i] = R[k, i, j]
            _move(turn_k, column, J, none)
            for i in range(3):
                R[k, i, j] = column[i]
        _move(turn_k, p[k], so3_left_jacobian(by), change[at + 3 : at + 6])
        _move(turn_k, velocity[k], J, none)
    for s in range(len(points)):
        at = CLONES + 6 * C + 3 * s
        _move(turned, points[s], J, change[at : at + 3])


@njit(cache=True, nogil=True)
def _move(turned: Array, v: Array, J: Array, change: Array) -> None:
    """Replace v [3] by turned @ v + J @ change."""
    a, b, c = v[0], v[1], v[2]
    for i in range(3):
        v[i] = turned[i, 0] * a + turned[i, 1] * b + turned[i, 2] * c
        v[i] += J[i, 0] * change[0] + J[i, 1] * change[1] + J[i, 2] * change[2]
