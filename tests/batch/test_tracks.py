"""The geometry under the bundle adjustment, against exact worlds and numerical derivatives."""

import gtsam
import numpy as np
import pytest

from vislam.batch.bundle.adjust import L, VisualNoise, visual_factors
from vislam.batch.bundle.rays import Tracks, collect, residuals, stereo_inverse_depth, triangulate
from vislam.batch.bundle.shutter import ReadoutSearch, camera_twists, flow_basis
from vislam.config import FrontEndConfig
from vislam.core.geometry import invert, se3_exp, transform_points
from vislam.factors.keys import X
from vislam.trajectory import Trajectory
from worlds.session import BASELINE_M, CAMERA, rig_for, simulate

SEED = 5


@pytest.fixture
def rng():
    print("seed", SEED)
    return np.random.default_rng(SEED)


def seen_from(cameras, points, rng, sigma_px=0.0, with_depth=False):
    """Every point in every camera [K, 4, 4] of an ideal lens with 400 px focal length."""
    k, p = np.repeat(np.arange(len(cameras)), len(points)), np.tile(np.arange(len(points)), len(cameras))
    c = np.concatenate([transform_points(invert(T), points) for T in cameras])
    xy = c[:, :2] / c[:, 2:] + rng.normal(size=(len(c), 2)) * sigma_px / 400.0
    rho = 1.0 / c[:, 2] if with_depth else np.full(len(c), np.nan)
    n = len(c)
    return Tracks(k, k, p, xy, np.full(n, 1 / 400.0), rho, np.full(n, 2e-3), np.zeros(n), np.zeros((n, 3)), len(points))


def some_cameras(rng, count=6, step_m=0.2):
    cameras = [se3_exp(np.concatenate([rng.normal(size=3) * 0.05, rng.normal(size=3) * step_m])) for _ in range(count)]
    return np.array(cameras)


def test_stereo_pairs_give_the_inverse_depth(rng):
    rig = rig_for("stereo")
    points = np.column_stack([rng.uniform(-1, 1, 200), rng.uniform(-0.8, 0.8, 200), rng.uniform(1, 8, 200)])
    left = rig.cameras[0].project(points)
    right = rig.cameras[1].project(transform_points(invert(rig.T_cam0_cam1), points))
    xy = rig.cameras[0].normalise(left)
    rho, sigma = stereo_inverse_depth(rig, xy, right, 0.3)
    good = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    assert good.sum() > 100
    assert np.allclose(rho[good], 1.0 / points[good, 2], atol=1e-9)
    noisy = stereo_inverse_depth(rig, xy, right + rng.normal(size=right.shape) * 0.3, 0.3)[0]
    ratio = np.std((noisy - rho)[good] / sigma[good])
    assert 0.85 < ratio < 1.15
    assert np.median(sigma[good]) == pytest.approx(0.3 / 400.0 / BASELINE_M, rel=0.3)
    lost = stereo_inverse_depth(rig, xy, np.full_like(right, np.nan), 0.3)[0]
    assert np.isnan(lost).all()


def test_exact_rays_triangulate_to_exact_points(rng):
    points = rng.uniform([-2, -2, 3], [2, 2, 9], (50, 3))
    cameras = some_cameras(rng)
    tracks = seen_from(cameras, points, rng)
    placed = triangulate(tracks, np.ones(len(tracks), bool), cameras, 1.0)
    assert np.allclose(placed.points_m, points, atol=1e-5)
    error = residuals(tracks, placed.points_m, cameras)
    assert error.px.max() < 1e-2
    assert np.isnan(error.rho).all()


def test_uncertainty_of_points_is_what_noise_shows(rng):
    """The predicted sigma of distance against the spread over 200 noisy tracks of one point."""
    point = np.array([0.3, -0.2, 5.0])
    cameras = np.array([se3_exp(np.array([0, 0, 0, 0.1 * i, 0, 0])) for i in range(5)])
    tracks = seen_from(cameras, np.repeat(point[None], 200, axis=0), rng, sigma_px=0.5)
    placed = triangulate(tracks, np.ones(len(tracks), bool), cameras, 0.5)
    spread = np.std(np.linalg.norm(placed.points_m, axis=1)) / 5.0
    assert 0.7 < np.median(placed.relative_sigma) / spread < 1.3


def test_points_without_parallax_have_no_place_and_depth_gives_them_one(rng):
    points = rng.uniform([-2, -2, 3], [2, 2, 9], (20, 3))
    still = np.repeat(np.eye(4)[None], 4, axis=0)
    blind = seen_from(still, points, rng)
    assert (triangulate(blind, np.ones(len(blind), bool), still, 1.0).relative_sigma > 1.0).all()
    deep = seen_from(still, points, rng, with_depth=True)
    placed = triangulate(deep, np.ones(len(deep), bool), still, 1.0)
    assert (placed.relative_sigma < 0.05).all()
    assert np.allclose(placed.points_m, points, atol=1e-6)


def test_a_point_behind_its_camera_never_fits(rng):
    cameras = some_cameras(rng)
    tracks = seen_from(cameras, np.array([[0.0, 0.0, 4.0]]), rng)
    assert np.isinf(residuals(tracks, np.array([[0.0, 0.0, -4.0]]), cameras).px).all()


def test_collect_takes_each_track_once_per_keyframe_and_drops_what_no_ray_explains():
    log = simulate("rgbd", duration_s=3.0, true_loops=0).log
    before = collect(log, FrontEndConfig())
    seen = log.keyframes[1].packet.observations
    seen.track_ids[1] = seen.track_ids[0]  # twice the same
    seen.pixels_px[2] = np.nan
    after = collect(log, FrontEndConfig())
    assert len(before) - 6 < len(after) < len(before)
    pairs = np.stack([after.keyframe, after.point])
    assert len(np.unique(pairs, axis=1).T) == len(after)
    assert np.isfinite(after.xy).all()
    assert (after.counts() >= 2).all()


def test_the_factors_are_the_residuals_with_their_noise(rng):
    """Half the squared sigmas of pixel and inverse depth, at random errors, under a kernel that does not bend."""
    cameras, points = some_cameras(rng), rng.uniform([-2, -2, 3], [2, 2, 9], (20, 3))
    tracks = seen_from(cameras, points, rng, sigma_px=0.7, with_depth=True)
    moved = points + rng.normal(size=points.shape) * 0.02
    with_depth = rng.uniform(size=len(tracks)) < 0.5
    T_body_cam = se3_exp(rng.normal(size=6) * 0.3)
    noise = VisualNoise(0.8, 1.5, gtsam.noiseModel.mEstimator.Huber.Create(1e6))
    keep = rng.uniform(size=len(tracks)) < 0.9
    factors = visual_factors(tracks, keep, with_depth, (T_body_cam,), noise)
    values = gtsam.Values()
    for k, T in enumerate(cameras):
        values.insert(X(k), gtsam.Pose3(T @ invert(T_body_cam)))
    for j, point in enumerate(moved):
        values.insert(L(j), point)
    error = residuals(tracks, moved, cameras)
    expected = (error.px / 0.8) ** 2 + np.where(with_depth, (error.rho / 1.5) ** 2, 0.0)
    got = np.array([2.0 * f.error(values) for f in factors])
    assert np.allclose(got, expected[keep], rtol=0.06)  # sigmas are shared in steps of 2 %
    assert np.isclose(got.sum(), expected[keep].sum(), rtol=0.03)


def test_flow_is_the_derivative_of_the_image(rng):
    points = rng.uniform([-2, -2, 2], [2, 2, 6], (30, 3))
    twist, h = rng.normal(size=6), 1e-6

    def image(t):
        c = transform_points(se3_exp(-t * twist), points)
        return c[:, :2] / c[:, 2:]

    numeric = (image(h) - image(-h)) / (2 * h)
    assert np.allclose(flow_basis(image(0), 1.0 / points[:, 2]) @ twist, numeric, atol=1e-7)


def test_twists_are_those_of_the_camera(rng):
    twist, T_body_cam = rng.normal(size=6) * 0.5, se3_exp(rng.normal(size=6))
    t_ns = (np.arange(40) * 33_000_000).astype(np.int64)
    cameras = np.array([se3_exp(twist * t * 1e-9) for t in t_ns])
    frames = Trajectory(t_ns, cameras @ invert(T_body_cam))
    found = camera_twists(frames, np.array([500_000_000, 0, 10**12]), T_body_cam)
    assert np.allclose(found[0], twist, atol=2e-3)
    assert np.allclose(found[1], twist, atol=0.05)
    assert not found[2].any()  # long after the last frame nothing is known


def test_the_search_for_the_readout_needs_few_rounds():
    """Residuals that show only a third of the error, as on fr1_desk: plain steps would still be 20 % off."""
    search, readout = ReadoutSearch(), 0.0
    for _ in range(4):
        readout = search.next_s(readout, 0.33 * (0.02 - readout))
    assert readout == pytest.approx(0.02, abs=2e-4)
    assert ReadoutSearch().next_s(0.0, -1.0) == 0.0


def test_pixels_at_the_border_are_less_certain_in_angle():
    log = simulate("rgbd", duration_s=2.0, true_loops=0).log
    tracks = collect(log, FrontEndConfig())
    off = np.linalg.norm(tracks.xy, axis=1)
    assert tracks.sigma_per_px[off < 0.2].mean() == pytest.approx(1.0 / CAMERA.fx, rel=0.05)
    assert tracks.sigma_per_px[off > 0.7].mean() > 1.05 / CAMERA.fx  # this lens compresses its border
