"""One view of a landmark: its whitened error and the derivative of that, by carrying the landmark through the frames.

A landmark is a bearing [a, b, 1] and an inverse depth rho in the camera of its host that saw it first, at the time its
row was read; on its way it is scaled by rho. A right camera hosts none: camera 0 does in its place. A camera at time
`dt` after its keyframe's stamp sits at `R @ exp(rate * dt), p + v * dt`.

Vectors and rotations are tuples here, which the compiler keeps in registers. Predictions go through the lens: with the
derivative at the pixel that was measured, whose noise the residual has, too, focal lengths would drift by it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vislam.core.geometry import so3_exp
from vislam.core.jit import njit
from vislam.core.lens import Lens, Lenses, imaged, lens_at
from vislam.core.messages import Array
from vislam.core.small import Mat, Vec, back, by, cross, dot, in_a_row, minus, plus, product, times, turned
from vislam.window.equations.layout import FOCAL, METRES, RIGHT, Camera

# Columns of a row of the derivative: by the host's pose, calibration and landmark, the error itself, by the pose that
# sees. What belongs to a landmark comes first and together; the rest of the width is empty.
VIEWED = 10  # entries of the calibration that a view depends on, the first ones
CALIBRATED, POINT, ERROR, SEEN, COLUMNS = 6, 16, 19, 20, 26
_MIN_Z = 0.02  # relative to the host's depth: nearer is beside or behind the camera


class Measured(NamedTuple):
    """A view as the front end measured it; see `layout.Views`."""

    x: float  # on z = 1, for a first guess
    y: float
    u: float  # px from the principal point
    v: float
    weight: float  # 1 / sigma of a pixel
    row: float
    inverse_depth: float
    depth_weight: float


class Mount(NamedTuple):
    """Camera 0 on the body."""

    R: Mat
    p: Vec


class Cameras(NamedTuple):
    """All cameras in camera 0, as the calibration has them."""

    R: Array  # [C, 3, 3]
    p: Array  # [C, 3] m, as calibrated
    lenses: Lenses
    metres: float
    focal: float
    right: int


class Optics(NamedTuple):
    """A camera in camera 0, and how it images."""

    R: Mat
    p: Vec  # as calibrated
    metres: float  # by which p and measured depths are as calibrated
    focal: float
    is_first: bool
    is_right: bool
    lens: Lens


class Place(NamedTuple):
    """A body when a row was read, and how it moved."""

    R: Mat
    p: Vec
    turn: Mat  # since the keyframe's stamp
    rate: Vec
    velocity: Vec


class Hosted(NamedTuple):
    """A landmark as its host has it."""

    place: Place
    cam: Optics  # that saw it first
    row: float  # at which it did
    rho: float
    bearing: Vec
    in_cam0: Vec
    in_host: Vec  # body axes
    in_world: Vec  # world axes, from the host on


class Sight(NamedTuple):
    """A landmark as a camera sees it, and its way there."""

    place: Place
    mount: Mount
    gap: Vec  # from this body to the host, world axes
    in_seen: Vec  # body axes
    in_cam0: Vec
    cam: Optics
    in_cam: Vec


@njit(cache=True, nogil=True, error_model="numpy")
def measured(values: Array, n: int) -> Measured:
    """Return view n."""
    return Measured(
        values[n, 0], values[n, 1], values[n, 2], values[n, 3], values[n, 4], values[n, 5], values[n, 6], values[n, 7]
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def mounted(camera: Camera, calibration: Array) -> Mount:
    """Return camera 0 on the body, turned by the calibration."""
    R, T = product(camera.T_body_cam, so3_exp(calibration[1:4])), camera.T_body_cam
    return Mount(in_a_row(R), (T[0, 3], T[1, 3], T[2, 3]))


@njit(cache=True, nogil=True, error_model="numpy")
def optics(camera: Camera, calibration: Array) -> Cameras:
    """Return all cameras as the calibration has them; the right one is turned by it."""
    T, right = camera.T_cam0_cams, camera.right
    R = T[:, :3, :3].copy()
    if right >= 0:
        R[right] = product(T[right], so3_exp(calibration[RIGHT : RIGHT + 3]))
    metres, focal = 1.0 + calibration[METRES], 1.0 + calibration[FOCAL]
    return Cameras(R, T[:, :3, 3].copy(), camera.lenses, metres, focal, right)


@njit(cache=True, nogil=True, error_model="numpy")
def through(cams: Cameras, c: int) -> Optics:
    """Return camera c."""
    is_first, is_right = c == 0, c == cams.right
    metres = cams.metres if is_first or is_right else 1.0
    p = (cams.p[c, 0], cams.p[c, 1], cams.p[c, 2])
    return Optics(in_a_row(cams.R[c]), p, metres, cams.focal, is_first, is_right, lens_at(cams.lenses, c))


@njit(cache=True, nogil=True, error_model="numpy")
def hosting(cams: Cameras, c: int) -> Optics:
    """Return the camera that hosts landmarks which camera c saw first: of a pair, always the first."""
    return through(cams, 0 if c == cams.right else c)


@njit(cache=True, nogil=True, error_model="numpy")
def place(X: Array, k: int, rates: Array, dt: float) -> Place:
    """Return where keyframe k's body is `dt` after its stamp; Rodrigues' series is good to 1e-8 rad at 0.1 rad."""
    R = (X[k, 0], X[k, 1], X[k, 2], X[k, 3], X[k, 4], X[k, 5], X[k, 6], X[k, 7], X[k, 8])
    velocity, rate = (X[k, 12], X[k, 13], X[k, 14]), (rates[k, 0], rates[k, 1], rates[k, 2])
    a, b, c = times(dt, rate)
    square = a * a + b * b + c * c
    first, second = 1.0 - square / 6.0 * (1.0 - square / 20.0), 0.5 - square / 24.0
    turn = (
        1.0 - second * (b * b + c * c), second * a * b - first * c, second * a * c + first * b,
        second * a * b + first * c, 1.0 - second * (a * a + c * c), second * b * c - first * a,
        second * a * c - first * b, second * b * c + first * a, 1.0 - second * (a * a + b * b),
    )  # fmt: skip
    return Place(turned(R, turn), plus((X[k, 9], X[k, 10], X[k, 11]), times(dt, velocity)), turn, rate, velocity)


@njit(cache=True, nogil=True, error_model="numpy")
def hosted(at: Place, mount: Mount, cam: Optics, row: float, a: float, b: float, rho: float) -> Hosted:
    """Return a landmark of a host at a place, that a camera saw first."""
    bearing = (a, b, 1.0)
    in_cam0 = bearing
    if not cam.is_first:
        in_cam0 = plus(by(cam.R, bearing), times(rho, cam.p))
    in_host = plus(by(mount.R, in_cam0), times(rho, mount.p))
    return Hosted(at, cam, row, rho, bearing, in_cam0, in_host, by(at.R, in_host))


@njit(cache=True, nogil=True, error_model="numpy")
def sight(landmark: Hosted, at: Place, mount: Mount, cam: Optics) -> Sight:
    """Carry a landmark into a camera of a body at a place."""
    rho, gap = landmark.rho, minus(landmark.place.p, at.p)
    in_seen = back(at.R, plus(landmark.in_world, times(rho, gap)))
    in_cam0 = back(mount.R, minus(in_seen, times(rho, mount.p)))
    return Sight(at, mount, gap, in_seen, in_cam0, cam, back(cam.R, minus(in_cam0, times(rho * cam.metres, cam.p))))


@njit(cache=True, nogil=True, error_model="numpy")
def residual(in_cam: Vec, rho: float, view: Measured, cam: Optics) -> tuple[bool, Vec]:
    """Return whether a camera can see a landmark, and the view's whitened error: pixel and inverse depth."""
    x, y, z = in_cam
    if not z > _MIN_Z:
        return False, (0.0, 0.0, 0.0)
    u, v, _, _, _, _ = imaged(x / z, y / z, cam.lens)
    if not np.isfinite(u):
        return False, (0.0, 0.0, 0.0)
    depth = view.depth_weight * (cam.metres * rho / z - view.inverse_depth)
    return True, (view.weight * (cam.focal * u - view.u), view.weight * (cam.focal * v - view.v), depth)


@njit(cache=True, nogil=True, error_model="numpy")
def robust(s: float, k: float) -> tuple[float, float]:
    """Return Huber's weight and twice its cost for a squared error."""
    if s <= k * k:
        return 1.0, s
    root = np.sqrt(s)
    return k / root, 2.0 * k * root - k * k


@njit(cache=True, nogil=True, error_model="numpy")
def shift(applied_offset_s: Array, calibration: Array, k: int, row: float) -> float:
    """Return the time from keyframe k's stamp to when a row was read."""
    return calibration[0] - applied_offset_s[k] + row * calibration[4]


@njit(cache=True, nogil=True, error_model="numpy")
def linearised(
    landmark: Hosted,
    seen: Sight,
    view: Measured,
    same: bool,
    error: Vec,
    huber_k: tuple[float, float],
    J: Array,
) -> None:
    """Fill J [3, 26] with a view's whitened error and its derivative at a sight, robustly weighted.

    `same`: the host itself sees it. From `huber_k` on, of pixels and of depth, errors count less. The third
    row is filled where a depth is measured.
    """
    z = seen.in_cam[2]
    x, y = seen.in_cam[0] / z, seen.in_cam[1] / z
    weight = np.sqrt(robust(error[0] * error[0] + error[1] * error[1], huber_k[0])[0])
    cam, weighted = seen.cam, weight * view.weight
    u, v, ux, uy, vx, vy = imaged(x, y, cam.lens)
    at, a, b = weighted * u, weighted * cam.focal * ux, weighted * cam.focal * uy
    for k in range(3):  # in a loop, for numba would compile the row again for each constant
        if k == 1:
            at, a, b = weighted * v, weighted * cam.focal * vx, weighted * cam.focal * vy
        by_cam = (a / z, b / z, -(a * x + b * y) / z)
        by_lens, slope = (at, 0.0), 0.0
        if k == 2:
            if not view.depth_weight > 0.0:
                break
            weight = np.sqrt(robust(error[2] * error[2], huber_k[1])[0])
            slope = weight * view.depth_weight * cam.metres / z
            by_cam = (0.0, 0.0, -slope * landmark.rho / z)
            by_lens = (0.0, slope * landmark.rho / cam.metres)
        _row(landmark, seen, view.row, same, by_cam, by_lens, J, k)
        if k == 2:
            J[k, POINT + 2] += slope
        J[k, ERROR] = weight * error[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _row(
    landmark: Hosted, seen: Sight, row: float, same: bool, by_cam: Vec, by_lens: tuple[float, float], J: Array, k: int
) -> None:
    """Carry the derivative by the camera's coordinates back through the frames into row k of J [3, 26].

    The whole way depends on rho, for the landmark is scaled by it.
    """
    host, at, mount, rho = landmark.place, seen.place, seen.mount, landmark.rho
    by_cam0 = by(seen.cam.R, by_cam)
    by_seen = by(mount.R, by_cam0)
    by_world = by(at.R, by_seen)
    by_host = back(host.R, by_world)
    by_first = by_bearing = back(mount.R, by_host)
    J[k, POINT + 2] = (
        dot(minus(by_host, by_seen), mount.p) + dot(by_world, seen.gap) - seen.cam.metres * dot(by_cam0, seen.cam.p)
    )  # fmt: skip
    if not landmark.cam.is_first:
        by_bearing = back(landmark.cam.R, by_first)
        J[k, POINT + 2] += dot(by_first, landmark.cam.p)
    J[k, POINT], J[k, POINT + 1] = by_bearing[0], by_bearing[1]
    J[k, CALIBRATED + FOCAL] = by_lens[0]
    J[k, CALIBRATED + METRES] = by_lens[1] - (rho * dot(by_cam0, seen.cam.p) if seen.cam.is_right else 0.0)
    by_right = cross(by_cam, seen.in_cam) if seen.cam.is_right else (0.0, 0.0, 0.0)
    J[k, CALIBRATED + RIGHT], J[k, CALIBRATED + RIGHT + 1], J[k, CALIBRATED + RIGHT + 2] = by_right
    if same:  # moving the body moves landmark and camera alike
        J[k, : CALIBRATED + FOCAL] = 0.0
        J[k, SEEN:] = 0.0
        return
    by_turn_host, by_turn = cross(landmark.in_host, by_host), cross(by_seen, seen.in_seen)  # when the rows were read
    by_pose_host, by_pose, moved = by(host.turn, by_turn_host), by(at.turn, by_turn), times(rho, by_world)
    by_mount = plus(cross(landmark.in_cam0, by_first), cross(by_cam0, seen.in_cam0))
    by_time_host = dot(by_turn_host, host.rate) + dot(moved, host.velocity)
    by_time = dot(by_turn, at.rate) - dot(moved, at.velocity)
    J[k, 0], J[k, 1], J[k, 2] = by_pose_host
    J[k, 3], J[k, 4], J[k, 5] = moved
    J[k, SEEN], J[k, SEEN + 1], J[k, SEEN + 2] = by_pose
    J[k, SEEN + 3], J[k, SEEN + 4], J[k, SEEN + 5] = -moved[0], -moved[1], -moved[2]
    J[k, CALIBRATED] = by_time_host + by_time
    J[k, CALIBRATED + 1], J[k, CALIBRATED + 2], J[k, CALIBRATED + 3] = by_mount
    J[k, CALIBRATED + 4] = by_time_host * landmark.row + by_time * row
