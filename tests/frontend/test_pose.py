"""The compiled kernels: Jacobians, pose refinement, two views, landmark updates, rolling shutter."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config import FrontEndConfig
from vislam.core import ImuSpan
from vislam.core.camera import Camera
from vislam.core.geometry import invert, se3_exp, se3_log, so3_exp, so3_log
from vislam.core.messages import Array
from vislam.frontend.turning_rows import TurningRows
from vislam.vision.landmarks import UNKNOWN_RHO, UNKNOWN_RHO_SIGMA, Landmarks, fuse, move, predict
from vislam.vision.locate import pnp_ransac
from vislam.vision.refine import extra_parameter, pose_covariance, refine_pose
from vislam.vision.shutter import Shutter
from vislam.vision.two_view import essential_ransac, refine_two_view

SIGMA = 0.5 / 500.0
twists = st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6).map(np.array)


def scene(rng: np.random.Generator, count: int) -> Array:
    """Inverse-depth points in front of a camera, 1 m to infinity."""
    return np.column_stack(
        [rng.uniform(-0.6, 0.6, count), rng.uniform(-0.45, 0.45, count), rng.uniform(0.0, 1.0, count)]
    )


def seen_from(landmarks: Array, T: Array) -> Array:
    return move(landmarks, np.zeros((len(landmarks), 3, 3)), T)[0]


@given(twists, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.0, 1.5))
def test_prediction_and_its_jacobians(xi: Array, x: float, y: float, rho: float) -> None:
    T, landmark = se3_exp(xi), np.array([x, y, rho])

    def h(landmark: Array, T: Array) -> Array:
        out = np.empty(3)
        assert predict(landmark, T[:3, :3].copy(), T[:3, 3].copy(), out, np.empty((3, 3)), np.empty((3, 6)))
        return out

    J, J_pose, value = np.empty((3, 3)), np.empty((3, 6)), np.empty(3)
    predict(landmark, T[:3, :3].copy(), T[:3, 3].copy(), value, J, J_pose)
    if rho > 0.01:
        point = (invert(T) @ np.array([x, y, 1.0, rho]))[:3] / rho
        assert np.allclose(value, [point[0] / point[2], point[1] / point[2], 1.0 / point[2]], atol=1e-9)
    step = 1e-6
    for k in range(3):
        d = np.eye(3)[k] * step
        assert np.allclose((h(landmark + d, T) - h(landmark - d, T)) / (2 * step), J[:, k], atol=1e-6)
    for k in range(6):
        d = np.eye(6)[k] * step
        numeric = (h(landmark, T @ se3_exp(d)) - h(landmark, T @ se3_exp(-d))) / (2 * step)
        assert np.allclose(numeric, J_pose[:, k], atol=1e-6)


def test_behind_the_camera_is_not_predicted() -> None:
    T = np.eye(4)
    T[2, 3] = 2.0
    moved, covariances = move(np.array([[0.1, 0.1, 1.0]]), np.eye(3)[None], T)
    assert np.isnan(moved).all() and np.isnan(covariances).all()


@given(st.integers(0, 2**32 - 1), twists)
def test_landmarks_move_there_and_back(seed: int, xi: Array) -> None:
    landmarks = scene(np.random.default_rng(seed), 10)
    P = np.tile(np.diag([1e-6, 2e-6, 1e-4]), (10, 1, 1))
    there, P_there = move(landmarks, P, se3_exp(xi))
    back, P_back = move(there, P_there, invert(se3_exp(xi)))
    known = np.isfinite(back[:, 0])
    assert np.allclose(back[known], landmarks[known], atol=1e-9) and np.allclose(P_back[known], P[known], atol=1e-9)


@given(st.integers(0, 2**32 - 1), twists)
def test_refinement_finds_the_pose_through_outliers(seed: int, xi: Array) -> None:
    rng = np.random.default_rng(seed)
    landmarks, T = scene(rng, 120), se3_exp(0.5 * xi)
    xy = seen_from(landmarks, T)[:, :2] + rng.normal(0.0, SIGMA, (120, 2))
    wrong = rng.random(120) < 0.2
    xy[wrong] += rng.uniform(-0.2, 0.2, (int(wrong.sum()), 2))
    P = np.tile(np.diag([1e-10, 1e-10, 1e-6]), (120, 1, 1))
    estimate = refine_pose(np.eye(4), landmarks, P, xy, SIGMA, 3.0)
    assert estimate.converged
    error = se3_log(invert(T) @ estimate.T_key_cam)
    assert np.linalg.norm(error[:3]) < 2e-3 and np.linalg.norm(error[3:]) < 6e-3
    assert estimate.inliers[~wrong].mean() > 0.95
    assert estimate.inliers[wrong & (np.linalg.norm(xy - seen_from(landmarks, T)[:, :2], axis=1) > 0.02)].sum() == 0


@pytest.mark.parametrize("sigma_rho", [1e-4, 0.02])
def test_pose_covariance_is_honest(sigma_rho: float) -> None:
    """NEES over many trials: normalised error near one per degree of freedom, whatever noise dominates."""
    rng, nees = np.random.default_rng(11), []
    for _ in range(150):
        landmarks, T = scene(rng, 100), se3_exp(rng.normal(0.0, 0.08, 6))
        xy = seen_from(landmarks, T)[:, :2] + rng.normal(0.0, SIGMA, (100, 2))
        P = np.tile(np.diag([1e-10, 1e-10, sigma_rho**2]), (100, 1, 1))
        noisy = landmarks + np.column_stack([rng.normal(0, 1e-5, (100, 2)), rng.normal(0, sigma_rho, 100)])
        estimate = refine_pose(np.eye(4), noisy, P, xy, SIGMA, 3.0)
        error = se3_log(invert(T) @ estimate.T_key_cam)
        nees.append(error @ np.linalg.solve(estimate.covariance, error) / 6.0)
    assert 0.5 < np.mean(nees) < 1.5
    assert 0.5 < np.median(nees) < 1.5


def test_covariance_grows_with_errors_that_a_region_shares() -> None:
    """Independent residuals must not look shared; shared ones must widen the covariance."""
    rng = np.random.default_rng(4)
    landmarks = scene(rng, 300)
    clean = landmarks[:, :2] + rng.normal(0.0, SIGMA, (300, 2))
    shared = landmarks[:, :2] + 1.0 * SIGMA * np.sin(8.0 * landmarks[:, 1::-1]) + rng.normal(0.0, SIGMA, (300, 2))
    P = np.zeros((300, 3, 3))
    alone = refine_pose(np.eye(4), landmarks, P, clean, SIGMA, 3.0)
    together = refine_pose(np.eye(4), landmarks, P, shared, SIGMA, 3.0)
    growth = np.trace(together.covariance[:3, :3]) / np.trace(alone.covariance[:3, :3])
    assert growth > 2.0 > 1.5 * together.variance / alone.variance


def test_covariance_by_measured_noise_and_an_unsure_parameter() -> None:
    rng = np.random.default_rng(11)
    landmarks, T = scene(rng, 80), se3_exp(np.array([0.02, -0.01, 0.03, 0.1, 0.05, -0.02]))
    covariances = np.zeros((80, 3, 3))
    xy = seen_from(landmarks, T)[:, :2] + rng.normal(0.0, SIGMA, (80, 2))
    estimate = refine_pose(T, landmarks, covariances, xy, SIGMA, 3.0)
    slope = np.column_stack([landmarks[:, 1], np.zeros(80)])  # a shear

    def covariance(scale: float, slope_sigma: float) -> Array:
        found = pose_covariance(
            estimate.T_key_cam, landmarks, covariances, xy, SIGMA, 3.0, None, None, scale, slope, slope_sigma
        )
        assert found is not None
        return found

    assert np.allclose(covariance(1.0, 0.0), estimate.covariance, rtol=1e-6, atol=0.0)
    assert np.allclose(covariance(3.0, 0.0), 9.0 * estimate.covariance, rtol=1e-6, atol=0.0)
    # what the parameter does to the pose: once more with directions that it has changed by its sigma
    change = 0.003
    other = refine_pose(estimate.T_key_cam, landmarks, covariances, xy - change * slope, SIGMA, 3.0)
    moved = se3_log(invert(estimate.T_key_cam) @ other.T_key_cam)
    added = covariance(1.0, change) - covariance(1.0, 0.0)
    assert np.linalg.norm(added - np.outer(moved, moved)) < 0.2 * np.linalg.norm(added)
    assert (
        pose_covariance(T, landmarks[:2], covariances[:2], xy[:2], SIGMA, 3.0, None, None, 1.0, slope[:2], 0.0) is None
    )


def test_points_of_unknown_depth_constrain_across_their_epipolar_line() -> None:
    """With all depths unknown, direction and rotation are seen, but hardly the distance."""
    rng = np.random.default_rng(2)
    landmarks, T = scene(rng, 200), se3_exp(np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]))
    xy = seen_from(landmarks, T)[:, :2]
    P = np.tile(np.diag([1e-10, 1e-10, UNKNOWN_RHO_SIGMA**2]), (200, 1, 1))
    estimate = refine_pose(T, landmarks, P, xy, SIGMA, 3.0)
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert estimate.converged and sigma[3] > 10.0 * sigma[4]


def test_points_of_unknown_depth_help_those_of_known_depth() -> None:
    """Points a metre away, more than half of unknown depth, as beyond a depth camera's edges: NEES and error."""
    rng, nees, errors_m = np.random.default_rng(5), [], []
    for _ in range(60):
        landmarks = np.column_stack([scene(rng, 200)[:, :2], rng.uniform(0.6, 1.1, 200)])
        T = se3_exp(np.concatenate([rng.normal(0.0, 0.02, 3), rng.normal(0.0, 0.06, 3)]))
        xy = seen_from(landmarks, T)[:, :2] + rng.normal(0.0, 4.0 * SIGMA, (200, 2))
        is_known = np.arange(200) < 80
        P = np.tile(np.diag([1e-10, 1e-10, 1.0]), (200, 1, 1))
        P[:, 2, 2] = np.where(is_known, 0.01, UNKNOWN_RHO_SIGMA) ** 2
        landmarks[:, 2] = np.where(is_known, landmarks[:, 2] + rng.normal(0.0, 0.01, 200), UNKNOWN_RHO)
        start = T @ se3_exp(rng.normal(0.0, 0.005, 6))
        both = [refine_pose(start, landmarks[:n], P[:n], xy[:n], 4.0 * SIGMA, 3.0) for n in (80, 200)]
        errors = [se3_log(invert(T) @ found.T_key_cam) for found in both]
        assert all(found.converged for found in both)
        nees.append(errors[1] @ np.linalg.solve(both[1].covariance, errors[1]) / 6.0)
        errors_m.append([np.linalg.norm(error[3:]) for error in errors])
    of_known, of_all = np.sqrt(np.mean(np.square(errors_m), axis=0))
    assert of_all < 0.95 * of_known
    assert 0.5 < np.mean(nees) < 1.5


def test_depth_constrains_where_directions_do_not() -> None:
    """Features in a narrow strip: a turn and a shift look alike, until depth tells them apart; wrong depth does not."""
    rng, errors = np.random.default_rng(6), {"without": [], "with": [], "wrong": []}
    for _ in range(30):
        landmarks, T = scene(rng, 80), se3_exp(rng.normal(0.0, 0.05, 6))
        landmarks[:, :2] *= [0.15, 0.05]
        there = seen_from(landmarks, T)
        xy = there[:, :2] + rng.normal(0.0, SIGMA, (80, 2))
        P = np.tile(np.diag([1e-10, 1e-10, 4e-6]), (80, 1, 1))
        rho = there[:, 2] + rng.normal(0.0, 2e-3, 80)
        wrong = np.where(rng.random(80) < 0.3, rho + 0.3, rho)
        sigma = np.full(80, 2e-3)
        for name, given_rho in (("without", None), ("with", rho), ("wrong", wrong)):
            found = refine_pose(np.eye(4), landmarks, P, xy, SIGMA, 3.0, given_rho, sigma)
            assert found.converged
            errors[name].append(np.linalg.norm(se3_log(invert(T) @ found.T_key_cam)))
    medians = {name: float(np.median(values)) for name, values in errors.items()}
    assert medians["with"] < 0.7 * medians["without"] and medians["wrong"] < 1.2 * medians["with"]


def test_rotation_alone_leaves_the_translation() -> None:
    landmarks = scene(np.random.default_rng(1), 60)
    landmarks[:, 2] = 0.0
    R = so3_exp(np.array([0.05, -0.1, 0.02]))
    T = np.eye(4)
    T[:3, :3] = R
    estimate = refine_pose(
        np.eye(4), landmarks, np.zeros((60, 3, 3)), seen_from(landmarks, T)[:, :2], SIGMA, 3.0, rotation_only=True
    )
    assert estimate.converged and np.allclose(estimate.T_key_cam, T, atol=1e-9)


def test_nothing_to_see_does_not_converge() -> None:
    landmarks, P = scene(np.random.default_rng(0), 20), np.zeros((20, 3, 3))
    blind = refine_pose(np.eye(4), landmarks, P, np.full((20, 2), np.nan), SIGMA, 3.0)
    assert not blind.converged and not blind.inliers.any() and np.isnan(blind.covariance).all()
    two = np.full((20, 2), np.nan)
    two[:2] = landmarks[:2, :2]
    assert not refine_pose(np.eye(4), landmarks, P, two, SIGMA, 3.0).converged
    none = np.empty((0, 3))
    assert not refine_pose(np.eye(4), none, np.empty((0, 3, 3)), np.empty((0, 2)), SIGMA, 3.0).converged


@given(st.integers(0, 2**32 - 1))
def test_fusing_is_the_weighted_mean(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior, A = rng.normal(size=3), rng.normal(size=(3, 3))
    P = A @ A.T + 0.1 * np.eye(3)
    z, sigma_xy, sigma_rho = prior + 0.3 * rng.normal(size=3), 0.5, 0.7
    fused, P_fused = fuse(prior[None], P[None], z[None, :2], z[2:], sigma_xy, np.array([sigma_rho]), 100.0)
    W = np.diag([sigma_xy**-2, sigma_xy**-2, sigma_rho**-2])
    expected = np.linalg.inv(np.linalg.inv(P) + W)
    assert np.allclose(P_fused[0], expected, atol=1e-9)
    assert np.allclose(fused[0], expected @ (np.linalg.solve(P, prior) + W @ z), atol=1e-9)


def test_fusing_leaves_out_what_is_missing_or_absurd() -> None:
    landmarks, P = np.array([[0.1, 0.2, 0.5]]), np.diag([1e-6, 1e-6, 1e-4])[None]
    for rho in (np.nan, 0.9):
        fused, P_fused = fuse(landmarks, P, np.full((1, 2), np.nan), np.array([rho]), 1e-3, np.array([1e-2]), 3.0)
        assert np.array_equal(fused, landmarks) and np.array_equal(P_fused, P)


def test_landmarks_know_which_depths_they_know() -> None:
    landmarks = Landmarks()
    landmarks.append(
        np.array([[0.0, 0.0], [0.1, 0.0], [0.3, 0.0]]), np.array([0.5, np.nan, 0.0]), 1e-4, np.full(3, 5e-3)
    )
    assert landmarks.known.tolist() == [True, False, True]
    assert landmarks.expected_rho(np.array([[0.02, 0.0], [0.29, 0.1]])).tolist() == [0.5, 0.0]
    landmarks.keep(np.array([False, True, False]))
    assert len(landmarks) == 1 and np.isnan(landmarks.expected_rho(np.zeros((2, 2)))).all()


@given(st.integers(0, 2**32 - 1), twists)
def test_ransac_places_a_camera_among_wrong_matches(seed: int, xi: Array) -> None:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1, 1, (60, 2)), rng.uniform(2.0, 5.0, 60)])
    T = se3_exp(xi)
    in_cam = points @ T[:3, :3] - T[:3, 3] @ T[:3, :3]
    xy = in_cam[:, :2] / in_cam[:, 2:] + rng.normal(0, 1e-4, (60, 2))
    xy[:15] = rng.uniform(-0.5, 0.5, (15, 2))
    points[20] = np.nan
    found = pnp_ransac(points, xy, 3e-3, 15)
    assert found is not None and np.linalg.norm(se3_log(invert(T) @ found)) < 0.02
    assert pnp_ransac(points[:10], xy[:10], 3e-3, 15) is None


def two_views(rng: np.random.Generator, count: int, sigma: float) -> tuple[Array, Array, Array, Array]:
    landmarks = scene(rng, count)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    R = so3_exp(rng.normal(0.0, 0.08, 3))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, 0.3 * direction
    xy = seen_from(landmarks, T)[:, :2] + rng.normal(0.0, sigma, (count, 2))
    return R, direction, landmarks[:, :2].copy(), xy


def test_two_views_give_rotation_and_direction_with_an_honest_covariance() -> None:
    rng, nees = np.random.default_rng(21), []
    for _ in range(100):
        R, direction, key_xy, xy = two_views(rng, 150, SIGMA)
        xy[:15] += rng.uniform(0.02, 0.1, (15, 2))
        start = essential_ransac(np.eye(3), key_xy, xy, 3.0 * SIGMA, 15)
        assert start is not None
        view = refine_two_view(*start[:2], key_xy, xy, SIGMA, 3.0)
        assert view.converged and direction @ view.direction_key > 0.99
        assert view.inliers[15:].mean() > 0.95
        error = np.concatenate([so3_log(np.ascontiguousarray(R.T @ view.R_key_cam)), view.direction_key - direction])
        nees.append(error @ np.linalg.pinv(view.covariance, rcond=1e-9, hermitian=True) @ error / 5.0)
        assert np.linalg.matrix_rank(view.covariance, tol=1e-9 * np.trace(view.covariance)) == 5
    assert 0.5 < np.median(nees) < 2.0


def test_two_views_without_points_say_so() -> None:
    nothing = np.full((30, 2), np.nan)
    assert essential_ransac(np.eye(3), np.zeros((30, 2)), nothing, 1e-3, 15) is None
    view = refine_two_view(np.eye(3), np.array([1.0, 0.0, 0.0]), np.zeros((30, 2)), nothing, SIGMA, 3.0)
    assert not view.converged and not view.inliers.any()


CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


def rolling(landmarks: Array, twist_per_s: Array, readout_s: float) -> tuple[Array, Array]:
    """Raw pixels and directions of landmarks as a rolling shutter sees them, by fixed-point iteration on the row."""
    pixels = CAMERA.project(np.column_stack([landmarks[:, :2], np.ones(len(landmarks))]))
    for _ in range(30):
        for i in range(len(landmarks)):
            delay = (pixels[i, 1] / 479.0 - 0.5) * readout_s
            h = seen_from(landmarks[i : i + 1], se3_exp(twist_per_s * delay))[0]
            pixels[i] = CAMERA.project(np.array([[h[0], h[1], 1.0]]))[0]
    return pixels, CAMERA.normalise(pixels)


def test_a_rolling_shutter_is_undone_and_projected() -> None:
    landmarks = scene(np.random.default_rng(3), 40)
    twist = np.array([0.5, -0.8, 0.3, 0.3, -0.2, 0.4])
    pixels, xy = rolling(landmarks, twist, 0.03)
    inside = CAMERA.contains(pixels)
    shutter = Shutter(CAMERA, 0.03)
    undone = shutter.to_instant(pixels, xy, landmarks[:, 2], twist)
    assert np.abs(undone - landmarks[:, :2])[inside].max() * 500.0 < 0.1
    assert np.abs(xy - landmarks[:, :2])[inside].max() * 500.0 > 3.0  # it mattered
    assert np.abs(shutter.project(landmarks, twist) - pixels)[inside].max() < 0.1
    assert Shutter(CAMERA, 0.0).to_instant(pixels, xy, landmarks[:, 2], twist) is xy


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_the_readout_time_is_learned_from_the_shear_it_leaves(readout_s: float) -> None:
    rng = np.random.default_rng(8)
    shutter = Shutter(CAMERA, None)
    landmarks, P = scene(rng, 150), np.zeros((150, 3, 3))
    for _ in range(15):
        twist = rng.normal(0.0, 0.5, 6)
        pixels, seen = rolling(landmarks, twist, readout_s)
        seen = seen + rng.normal(0.0, SIGMA, seen.shape)
        xy = shutter.to_instant(pixels, seen, landmarks[:, 2], twist)
        estimate = refine_pose(np.eye(4), landmarks, P, xy, SIGMA, 3.0)
        slope = -shutter.slope(pixels, xy, landmarks[:, 2], twist)
        shutter.learn(*extra_parameter(estimate.T_key_cam, landmarks, P, xy, SIGMA, 3.0, slope))
    assert shutter.readout_s == pytest.approx(readout_s, abs=0.003)


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_one_camera_learns_the_readout_beside_a_gyroscope(readout_s: float) -> None:
    rng = np.random.default_rng(9)
    rows = TurningRows(CAMERA, np.eye(3), FrontEndConfig())
    for _ in range(25):
        landmarks, T = scene(rng, 150), se3_exp(rng.normal(0.0, [0.05, 0.05, 0.05, 0.2, 0.2, 0.2]))
        twists = np.column_stack([rng.normal(0.0, 0.8, (2, 3)), [5.0 * T[:3, 3], 5.0 * T[:3, :3].T @ T[:3, 3]]])
        ends = [
            rolling(seen_from(landmarks, at), twist, readout_s)[0]
            for at, twist in zip((np.eye(4), T), twists, strict=True)
        ]
        noisy = [px + rng.normal(0.0, 0.3, px.shape) for px in ends]
        for twist in twists:
            rows.begin()
            rows.take(ImuSpan(np.array([0]), twist[None, :3], np.zeros((1, 3))))
        rows.look(noisy[0])
        xy = rows.now_xy(noisy[1])
        view = refine_two_view(T[:3, :3], T[:3, 3], rows.key_xy, xy, SIGMA, 3.0)
        rows.learn(view, noisy[1], SIGMA, None)
    print(f"{rows.learned_s} of {readout_s} s")
    assert rows.learned_s == (pytest.approx(readout_s, abs=0.003) if readout_s else None)
