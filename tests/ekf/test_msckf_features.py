"""The model of a track: derivatives, projection onto the nullspace, triangulation, propagation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from vislam.core import Array, FurtherTracks, Observations
from vislam.core.camera import Rig
from vislam.core.geometry import invert, quaternion_wxyz, so3_log, transform
from vislam.core.messages import no_observations
from vislam.ekf.loose.kernels import pose
from vislam.ekf.stretch import Stretch
from vislam.ekf.tight import features, kernels
from vislam.ekf.tight.features import Sensor, Views
from vislam.ekf.tight.kernels import Inertial
from vislam.ekf.tight.state import CLONES, Window, cloned, moved, propagated, with_points, without_clone, without_points
from vislam.ekf.tight.tracks import FrameTracks, prepare, ripe_tracks
from worlds.flight import MONO, REAR, RGBD, STEREO
from worlds.motion import Motion
from worlds.parts import GRAVITY_M_S2

SIGMAS = np.array([0.8, 0.4, 2e-3])
CLONE_TIMES_S = np.array([1.0, 1.3, 1.7, 2.2])
POINT = np.array([5.0, 0.6, 0.3])
BEHIND = np.array([-5.0, 0.6, 0.3])
NO_IDS: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
NOBODY = FrameTracks(0, NO_IDS, np.zeros((0, 2)), np.zeros((0, features.COLUMNS)), np.zeros(0, dtype=np.bool_))


def a_window(motion: Motion, points: int = 0) -> tuple[Window, Array]:
    """Return clones along a motion, and the nominal state at its last one."""
    at = [motion.at(t) for t in CLONE_TIMES_S]
    n = CLONES + 6 * len(at) + 3 * points
    A = np.random.default_rng(3).normal(size=(n, n)) * 1e-3
    NOBODY = FrameTracks(
        0, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, features.COLUMNS)), np.zeros(0, dtype=np.bool_)
    )
    window = Window(
        A @ A.T + 1e-8 * np.eye(n),
        0.0,
        MONO.T_body_cams[0][:3, :3].copy(),
        tuple(NOBODY for _ in at),
        np.array([T[:3, :3] for T, *_ in at]),
        np.array([T[:3, 3] for T, *_ in at]),
        np.array([rate for _, _, rate, _ in at]),
        np.array([v for _, v, _, _ in at]),
        np.arange(points),
        np.tile(POINT, (points, 1)) + np.arange(points)[:, None] * 0.3,
        np.zeros(points, dtype=np.int64),
    )
    T, v, _, _ = at[-1]
    x = np.concatenate((T[:3, 3], v, quaternion_wxyz(T[:3, :3].copy()), [0.05, -0.1, 0.02], [0.01, 0.02, -0.01]))
    return window, x


def seen_from(
    window: Window, rig: Rig, readout_s: float, point: Array, noise: float = 1.0
) -> tuple[NDArray[np.int64], Array]:
    """Return an observation of the point from every clone, somewhat beside where it is."""
    rows = []
    for i in range(len(window.frames)):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = window.R[i], window.p[i]
        y = invert(T @ rig.T_body_cams[0])[:3] @ np.append(point, 1.0)
        pixel = rig.cameras[0].project(y[None]) + np.array([0.7, -0.4])
        right = depth = None
        if rig.is_stereo:
            y1 = invert(T @ rig.T_body_cams[1])[:3] @ np.append(point, 1.0)
            right = rig.cameras[1].project(y1[None]) + np.array([0.2, 0.3])
        if rig.has_depth:
            depth = np.array([y[2] * 1.01])
        seen = Observations(np.array([4]), pixel, right, depth, noise=noise)
        for camera in rig.further:
            y = invert(T @ rig.T_body_cams[camera])[:3] @ np.append(point, 1.0)
            pixel = rig.cameras[camera].project(y[None]) + np.array([0.7, -0.4])
            seen = replace(no_observations(), further=(FurtherTracks(camera, np.array([4]), pixel),))
        rows.append(prepare(0, seen, rig, readout_s).seen)
    return np.arange(len(rows)), np.concatenate(rows)


def sensor(rig: Rig, noise: float = 1.0, focal: float = 1.0, metres: float = 1.0) -> Sensor:
    into = np.array([invert(T) for T in rig.T_cam0_cams])
    R, t = np.ascontiguousarray(into[:, :3, :3]), np.ascontiguousarray(into[:, :3, 3])
    return Sensor(rig.lenses, noise * SIGMAS, R, t, focal, metres)


def poses_of(window: Window, rig: Rig, at: NDArray[np.int64], seen: Array) -> tuple[Array, Array]:
    mount = np.ascontiguousarray(window.R_body_cam), rig.T_body_cams[0][:3, 3].copy()
    return features.camera_poses(at, seen, window.R, window.p, window.rate, window.velocity, mount, sensor(rig))


def residuals(window: Window, rig: Rig, at: NDArray[np.int64], seen: Array, point: Array) -> Array:
    poses = poses_of(window, rig, at, seen)
    A, _, _ = features.linearise(point, Views(at, seen, *poses), sensor(rig, 1.0, *window.scales), len(window.frames))
    return A[:, -1]


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
@pytest.mark.parametrize("rig", [MONO, STEREO, RGBD, REAR], ids=["mono", "stereo", "rgbd", "rear"])
def test_derivatives_of_a_track(rig: Rig, readout_s: float) -> None:
    """By clones, extrinsic rotation and point, against differences of the residual through the filter's own moves."""
    window, x = a_window(Motion.random(5))
    point = BEHIND if rig is REAR else POINT
    at, seen = seen_from(window, rig, readout_s, point)
    poses = poses_of(window, rig, at, seen)
    A, H_f, rows = features.linearise(point, Views(at, seen, *poses), sensor(rig), len(at))
    assert rows == len(at) * (2 + 2 * rig.is_stereo + rig.has_depth)
    h = 1e-6
    for j in range(16, len(window.P)):
        change = np.zeros(len(window.P))
        change[j] = h
        ahead = residuals(moved(window, x.copy(), change), rig, at, seen, point)
        behind = residuals(moved(window, x.copy(), -change), rig, at, seen, point)
        np.testing.assert_allclose(A[:, j - 16], -(ahead - behind) / (2 * h), rtol=2e-5, atol=2e-4)
    for j in range(3):
        step = h * np.eye(3)[j]
        ahead, behind = (residuals(window, rig, at, seen, point + s * step) for s in (1, -1))
        np.testing.assert_allclose(H_f[:, j], -(ahead - behind) / (2 * h), rtol=2e-5, atol=2e-4)


def test_noise_of_pixels_does_not_move_the_focal_length() -> None:
    """With known poses, what tracks of a distorted camera say of it has no mean: their noise stays out of J."""
    window, _ = a_window(Motion.random(5))
    rng, camera, clones = np.random.default_rng(1), MONO.cameras[0], len(window.frames)
    T_cams = [transform(R, p) @ MONO.T_body_cams[0] for R, p in zip(window.R, window.p, strict=True)]
    rays = camera.unproject(rng.uniform((40.0, 40.0), (710.0, 440.0), (6000, 2)))
    points = (rays * rng.uniform(2.0, 6.0, (6000, 1))) @ T_cams[1][:3, :3].T + T_cams[1][:3, 3]
    pixels = np.array([camera.project((points - T[:3, 3]) @ T[:3, :3]) for T in T_cams])
    whole = np.flatnonzero(np.all([camera.contains(np.nan_to_num(seen, nan=-1.0), 5.0) for seen in pixels], axis=0))
    noisy = pixels[:, whole] + SIGMAS[0] * rng.normal(size=(clones, len(whole), 2))
    rows = np.stack([prepare(0, Observations(whole, seen), MONO, 0.0).seen for seen in noisy])
    at, gradient, information = np.arange(clones), 0.0, 0.0
    poses = poses_of(window, MONO, at, rows[:, 0])
    for k in range(len(whole)):
        views, given = Views(at, np.ascontiguousarray(rows[:, k]), *poses), sensor(MONO)
        point, _, _ = features.triangulate(views, given)
        A, H_f, _ = features.linearise(point, views, given, clones)
        features.project_out(A, H_f)
        gradient += float(A[3:, 3] @ A[3:, -1])
        information += float(A[3:, 3] @ A[3:, 3])
    print(f"{len(whole)} tracks, {gradient / np.sqrt(information):.2f} sigmas, {100 / np.sqrt(information):.3f} %")
    assert len(whole) > 1000
    assert abs(gradient) < 3.0 * np.sqrt(information)


@pytest.mark.parametrize("rig", [MONO, STEREO, RGBD], ids=["mono", "stereo", "rgbd"])
def test_tracks_that_scatter_twice_as_much_count_as_if_told_so(rig: Rig) -> None:
    window, _ = a_window(Motion.random(5))
    at, seen = seen_from(window, rig, 0.0, POINT)
    _, noisy = seen_from(window, rig, 0.0, POINT, noise=2.0)
    poses = poses_of(window, rig, at, seen)
    told = features.linearise(POINT, Views(at, seen, *poses), sensor(rig, 2.0), len(at))
    shown = features.linearise(POINT, Views(at, noisy, *poses), sensor(rig), len(at))
    for one, other in zip(told, shown, strict=True):
        np.testing.assert_allclose(one, other)


def test_a_clone_depends_on_the_time_offset() -> None:
    """Its derivative against clones made a little later on the true motion; then what pixels make of it."""
    motion = Motion.random(6)
    t_s, h = 1.234, 1e-5

    def clone_at(t: float) -> tuple[Array, Array]:
        T = motion.pose(t)
        return T[:3, :3], T[:3, 3]

    T, v, rate, _ = motion.at(t_s)
    x = np.concatenate((T[:3, 3], v, quaternion_wxyz(T[:3, :3].copy()), np.zeros(6)))
    P = np.zeros((CLONES, CLONES))
    P[15, 15] = 4.0  # only the time offset is unknown: its column of the clone shows in the covariance
    NOBODY = FrameTracks(
        0, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, features.COLUMNS)), np.zeros(0, dtype=np.bool_)
    )
    R = np.ascontiguousarray(T[:3, :3])
    after = cloned(Window(P, 0.0, np.eye(3)), x, R, rate, 0.0, GRAVITY_M_S2, NOBODY)
    column = after.P[CLONES:, 15] / 4.0
    (R1, p1), (R0, p0) = clone_at(t_s + h), clone_at(t_s - h)
    turned = so3_log(R1 @ R0.T) / (2 * h)
    np.testing.assert_allclose(column[:3], turned, atol=1e-5)
    np.testing.assert_allclose(column[3:], (p1 - p0) / (2 * h) - np.cross(turned, T[:3, 3]), atol=1e-5)


def test_a_clone_of_the_near_past() -> None:
    motion = Motion.random(7)
    T, v, rate, _ = motion.at(2.0)
    x = np.concatenate((T[:3, 3], v, quaternion_wxyz(T[:3, :3].copy()), np.zeros(6)))
    R = np.ascontiguousarray(T[:3, :3])
    NOBODY = FrameTracks(
        0, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, features.COLUMNS)), np.zeros(0, dtype=np.bool_)
    )
    after = cloned(Window(np.eye(CLONES), 0.0, np.eye(3)), x, R, rate, 0.004, GRAVITY_M_S2, NOBODY)
    then = motion.pose(1.996)
    np.testing.assert_allclose(after.p[0], then[:3, 3], atol=5e-5)
    np.testing.assert_allclose(so3_log(then[:3, :3].T @ after.R[0]), 0.0, atol=5e-5)


def test_projection_removes_the_point_and_keeps_the_rest() -> None:
    rng = np.random.default_rng(1)
    A, H_f = rng.normal(size=(14, 9)), rng.normal(size=(14, 3))
    A_before, H_before = A.copy(), H_f.copy()
    features.project_out(A, H_f)
    np.testing.assert_allclose(H_f[3:], 0.0, atol=1e-12)
    np.testing.assert_allclose(A.T @ A, A_before.T @ A_before, atol=1e-10)  # only rotated: the noise stays white
    Q = np.linalg.qr(H_before, mode="complete")[0][:, 3:]
    np.testing.assert_allclose(A[3:].T @ A[3:], A_before.T @ Q @ Q.T @ A_before, atol=1e-10)


@pytest.mark.parametrize("rig", [MONO, STEREO, RGBD], ids=["mono", "stereo", "rgbd"])
def test_triangulation_in_spite_of_an_outlier(rig: Rig) -> None:
    rng, motion = np.random.default_rng(2), Motion.random(8)
    window, _ = a_window(motion)
    at, seen = seen_from(window, rig, 0.0, POINT)
    seen[:, 2:4] += rng.normal(size=(4, 2)) * 0.46
    poses = poses_of(window, rig, at, seen)
    point, rho, sigma = features.triangulate(Views(at, seen, *poses), sensor(rig))
    assert np.linalg.norm(point - POINT) < 0.15
    assert 0.0 < sigma < 0.3 * rho
    spoilt = seen.copy()
    spoilt[2, 2:4] += 37.0
    robust, _, _ = features.triangulate(Views(at, spoilt, *poses), sensor(rig))
    assert np.linalg.norm(robust - point) < 0.3


def test_transition_is_the_derivative_of_the_motion() -> None:
    """Phi over 25 steps against differences, in the invariant error and in that of NavState."""
    samples, _ = Motion.random(9).samples(0.2)
    values = np.array([np.concatenate((s.gyro_rad_s, s.accel_m_s2)) for s in samples])[:26]
    stamps = np.array([s.t_ns for s in samples])[:26]
    piece = Stretch(stamps, values, np.zeros(26), 0, 26)
    sigmas = np.array([1e-3, 1e-2, 1e-4, 1e-3, 0.0, 0.0])
    _, start = a_window(Motion.random(9))

    def end_of(change: Array) -> Array:
        x = start.copy()
        moved(Window(np.zeros((CLONES, CLONES)), 0.0, np.eye(3)), x, np.append(change, np.zeros(CLONES - 15)))
        moving = Inertial(x, Phi.copy(), Q.copy())
        kernels.run(moving, piece, np.empty((26, 10)), sigmas, GRAVITY_M_S2, np.eye(3))
        return x

    Phi, Q = np.eye(15), np.zeros((15, 15))
    x = start.copy()
    kernels.run(Inertial(x, Phi, Q), piece, np.empty((26, 10)), sigmas, GRAVITY_M_S2, np.eye(3))
    Phi_run, Phi, Q_run, Q = Phi, np.eye(15), Q, np.zeros((15, 15))
    M = kernels.to_nav_error(x)
    np.testing.assert_allclose(M @ kernels.from_nav_error(x), np.eye(15), atol=1e-12)
    h = 1e-6
    for j in range(15):
        step = np.zeros(15)
        step[j] = h
        a, b = end_of(step), end_of(-step)
        turned = so3_log(pose(b, 0, 6)[:3, :3].T @ pose(a, 0, 6)[:3, :3])
        parts = (turned, a[0:3] - b[0:3], a[3:6] - b[3:6], a[13:16] - b[13:16], a[10:13] - b[10:13])
        np.testing.assert_allclose(M @ Phi_run[:, j], np.concatenate(parts) / (2 * h), atol=1e-6)
    assert np.linalg.eigvalsh(Q_run)[0] > -1e-18


def test_yaw_and_position_stay_unobservable() -> None:
    """Turning and moving everything together is invisible to tracks and points, whatever the estimates are."""
    window, x = a_window(Motion.random(10), points=2)
    at, seen = seen_from(window, MONO, 0.0, POINT)
    poses = poses_of(window, MONO, at, seen)
    A, H_f, _ = features.linearise(POINT, Views(at, seen, *poses), sensor(MONO), len(at))
    features.project_out(A, H_f)
    blind = np.zeros((len(window.P) - 3 * 2 - 16, 4))
    for i in range(len(at)):
        blind[features.CALIBRATION + 6 * i + 2, 0] = 1.0  # about the vertical
        blind[features.CALIBRATION + 6 * i + 3 : features.CALIBRATION + 6 * i + 6, 1:] = np.eye(3)
    np.testing.assert_allclose(A[3:, :-1] @ blind, 0.0, atol=1e-8)
    Phi, Q = np.eye(15), np.zeros((15, 15))
    values = np.tile([0.3, -0.2, 0.4, 1.0, 2.0, 9.0], (20, 1))
    stamps = np.arange(20) * 5_000_000
    track, sigmas = np.empty((20, 10)), np.full(6, 1e-3)
    piece = Stretch(stamps, values, np.zeros(20), 0, 20)
    kernels.run(Inertial(x, Phi, Q), piece, track, sigmas, GRAVITY_M_S2, np.eye(3))
    still = np.zeros((15, 4))
    still[2, 0] = 1.0
    still[3:6, 1:] = np.eye(3)
    np.testing.assert_allclose(Phi @ still, still, atol=1e-12)


def test_bookkeeping_of_the_covariance() -> None:
    """Propagation with points is J P J^T + G Q G^T; clones and points come and go without touching the rest."""
    window, _ = a_window(Motion.random(11), points=2)
    rng = np.random.default_rng(4)
    Phi, B = np.eye(15) + 0.1 * rng.normal(size=(15, 15)), rng.normal(size=(15, 15))
    J, G = np.eye(len(window.P)), np.eye(len(window.P), 15)
    J[:15, :15] = Phi
    for s in range(2):
        rows = slice(window.first_point + 3 * s, window.first_point + 3 * s + 3)
        by_turn = np.array([np.cross(window.points[s], e) for e in np.eye(3)]).T
        J[rows, :15] += by_turn @ (Phi[:3] - np.eye(3, 15))
        G[rows, :3] = by_turn
    np.testing.assert_allclose(propagated(window, Phi, B @ B.T).P, J @ window.P @ J.T + G @ B @ B.T @ G.T, atol=1e-9)
    gone = without_points(without_clone(window, 1), np.array([True, False]))
    kept = np.r_[0:27, 33:45, 48:51]
    np.testing.assert_array_equal(gone.P, window.P[np.ix_(kept, kept)])
    A, H_f = rng.normal(size=(3, 30)), rng.normal(size=(3, 3))
    more = with_points(window, np.array([9]), np.array([[1.0, 2.0, 3.0]]), A[None], H_f[None])
    assert np.linalg.eigvalsh(more.P)[0] > -1e-12
    np.testing.assert_allclose(more.points[-1], np.array([1.0, 2.0, 3.0]) + np.linalg.solve(H_f, A[:, -1]))


def test_which_tracks_are_ripe() -> None:
    def frame(*ids: int) -> FrameTracks:
        n = len(ids)
        return FrameTracks(0, np.array(ids), np.zeros((n, 2)), np.zeros((n, 14)), np.ones(n, dtype=np.bool_))

    frames = (frame(1, 2, 3), frame(1, 2, 3, 4), frame(1, 3, 4), frame(1, 4, 5))
    ended = ripe_tracks(frames, None, 2, 10)
    assert ended.ids.tolist() == [3, 2] and not ended.alive.any()
    assert ended.at.tolist() == [0, 1, 2, 0, 1]
    leaving = ripe_tracks(frames, 0, 3, 1)
    assert leaving.ids.tolist() == [1] and leaving.alive.tolist() == [True]
    assert ripe_tracks((frame(),), None, 2, 10).ids.size == 0


def test_bad_observations_are_left_out() -> None:
    pixels = np.array([[300.0, 200.0], [np.nan, 1.0], [300.0, np.inf], [310.0, 210.0], [1e9, 0.0]])
    frame = prepare(0, Observations(np.array([5, 6, 7, 5, 8]), pixels), MONO, 0.0)
    assert frame.ids.tolist() == [5]
    assert np.isnan(frame.seen[0, 4:9]).all()
    depth = prepare(0, Observations(np.array([1, 2]), pixels[[0, 3]], None, np.array([-1.0, 2.0])), RGBD, 0.0)
    assert np.isnan(depth.seen[0, 8]) and depth.seen[1, 8] == 0.5
