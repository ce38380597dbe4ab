"""Triangulation, one-pixel uncertainty and fusion of the depth filter, against independent ways to the same numbers."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vislam.core.geometry import so3_exp
from vislam.mapping.depth.mono.stage import triangulated
from vislam.mapping.depth.mono.update import fuse_beta, fuse_gaussian, inverse_depth, inverse_depth_sigma

PIXEL = 1.0 / 480.0
small = st.floats(-0.4, 0.4)


@st.composite
def sightings(draw):
    """A pixel, its depth, and another camera that is turned and moved and sees the point in front of it."""
    h, k = draw(st.floats(-0.6, 0.6)), draw(st.floats(-0.5, 0.5))
    z = draw(st.floats(0.5, 10.0))
    R = so3_exp(np.array([draw(small), draw(small), draw(st.floats(-3.0, 3.0))]))
    t = np.array([draw(small), draw(small), draw(small)])
    q = R @ np.array([h, k, 1.0])
    there = q + t / z
    assume(there[2] > 0.3)
    point = there[:2] / there[2]
    # the epipolar line: where the point goes as inverse depth grows
    slope = (t[:2] - point * t[2]) / there[2]
    assume(np.linalg.norm(slope) > 0.02)
    return np.array([h, k]), z, R, t, q, point, slope / np.linalg.norm(slope) * PIXEL


def _call(function, q, t, point, direction, *more):
    return function(tuple(q), tuple(t), point[0], point[1], direction[0], direction[1], *more)


@given(sightings())
def test_triangulation_gives_back_the_inverse_depth(case):
    _, z, _, t, q, point, direction = case
    assert _call(inverse_depth, q, t, point, direction) == pytest.approx(1.0 / z, rel=1e-9)


@given(sightings())
def test_a_small_error_of_the_match_costs_what_the_derivative_says(case):
    _, z, _, t, q, point, direction = case
    rho, sigma = _call(inverse_depth_sigma, q, t, point, direction, 1e-4)
    step = 1e-6  # numerical derivative of where the point is seen, in inverse depth
    low, high = q + t * (1.0 / z - step), q + t * (1.0 / z + step)
    moved = np.linalg.norm(high[:2] / high[2] - low[:2] / low[2]) / (2.0 * step)
    assert rho == pytest.approx(1.0 / z, rel=1e-9)
    assert sigma == pytest.approx(1e-4 * PIXEL / moved, rel=1e-2)


@given(sightings())
def test_one_pixel_is_the_triangle_of_the_slambook_with_all_rays_in_one_frame(case):
    seen, z, R, t, q, point, direction = case
    _, sigma = _call(inverse_depth_sigma, q, t, point, direction, 1.0)
    centre = -R.T @ t  # of the other camera, in the reference frame
    baseline = np.linalg.norm(centre)
    ray = np.append(seen, 1.0) / np.linalg.norm(np.append(seen, 1.0))
    shifted = R.T @ np.append(point + direction, 1.0)  # turned into the reference frame, which the book forgets
    shifted /= np.linalg.norm(shifted)
    alpha = np.arccos(np.clip(ray @ centre / baseline, -1.0, 1.0))
    beta = np.arccos(np.clip(-shifted @ centre / baseline, -1.0, 1.0))
    gamma = np.pi - alpha - beta
    assume(min(alpha, beta, gamma) > 1e-2)  # the law of sines loses its digits in flat triangles; gamma <= 0: no point
    moved_z = baseline * np.sin(beta) / np.sin(gamma) * ray[2]
    assert sigma == pytest.approx(abs(1.0 / moved_z - 1.0 / z), rel=1e-6, abs=1e-9)


def test_no_baseline_is_no_depth_and_no_number_that_looks_like_one():
    rho, sigma = inverse_depth_sigma((0.1, 0.2, 1.0), (0.0, 0.0, 0.0), 0.1, 0.2, PIXEL, 0.0, 1.0)
    assert not (rho > 0.0 and np.isfinite(sigma))


@given(st.lists(sightings(), min_size=1, max_size=5))
def test_tracks_are_triangulated_alike(cases):
    for seen, z, R, t, _, point, along in cases:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t
        rho, _ = triangulated(seen[None], point[None], T, PIXEL)
        assert rho[0] == pytest.approx(1.0 / z, rel=1e-7)
        off_line = point[None] + 10.0 * np.array([[-along[1], along[0]]])
        assert not triangulated(seen[None], off_line, T, PIXEL)[1].any()


@given(st.floats(0.1, 2.0), st.floats(0.01, 0.5), st.floats(0.1, 2.0), st.floats(0.01, 0.5))
def test_gaussian_fusion_is_the_weighted_mean(a, sigma_a, b, sigma_b):
    mean, variance = fuse_gaussian(a, sigma_a**2, b, sigma_b**2)
    weights = np.array([sigma_a**-2, sigma_b**-2])
    assert mean == pytest.approx(np.average([a, b], weights=weights), rel=1e-9)
    assert variance == pytest.approx(1.0 / weights.sum(), rel=1e-9)


@given(
    st.floats(0.3, 2.0), st.floats(0.02, 0.3), st.floats(2.0, 30.0), st.floats(2.0, 30.0), st.floats(0.2, 2.2),
    st.floats(0.02, 0.3),
)  # fmt: skip
def test_beta_fusion_has_the_moments_of_the_exact_posterior(rho, sigma, a, b, measured, sigma_measured):
    spread = 3.0
    new, variance, new_a, new_b = fuse_beta(rho, sigma**2, a, b, measured, sigma_measured**2, spread)
    x = np.linspace(rho - 9 * sigma, rho + 9 * sigma, 1001)[:, None]
    share = np.linspace(0.0, 1.0, 201)[None, 1:-1]
    prior = np.exp(-0.5 * ((x - rho) / sigma) ** 2) * share ** (a - 1.0) * (1.0 - share) ** (b - 1.0)
    seen = np.exp(-0.5 * ((measured - x) / sigma_measured) ** 2) / (np.sqrt(2 * np.pi) * sigma_measured)
    posterior = prior * (share * seen + (1.0 - share) / spread)
    posterior /= posterior.sum()

    def moment(value):
        return float((posterior * value).sum())

    assert new == pytest.approx(moment(x), abs=2e-4)
    assert variance == pytest.approx(moment((x - moment(x)) ** 2), rel=2e-2, abs=1e-6)
    assert new_a / (new_a + new_b) == pytest.approx(moment(share), abs=2e-3)
    second = new_a * (new_a + 1.0) / ((new_a + new_b) * (new_a + new_b + 1.0))
    assert second == pytest.approx(moment(share * share), abs=2e-3)


def test_an_outlier_hardly_moves_the_mean_and_lowers_the_share_of_good_ones():
    rho, variance, a, b = fuse_beta(0.5, 0.01**2, 10.0, 10.0, 1.5, 0.01**2, 3.0)
    assert rho == pytest.approx(0.5, abs=1e-6)
    assert variance == pytest.approx(0.01**2, rel=1e-3)
    assert a / (a + b) < 0.5
