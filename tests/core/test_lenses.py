"""Lenses over spheres, over their whole field of view: one ray a pixel, and none where there is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.core.camera import Camera
from vislam.core.errors import DataError
from vislam.core.lens import imaged
from vislam.core.messages import Array

PINHOLE = (640, 480, 190.0, 191.0, 318.0, 243.0, 0.7)
small = st.floats(-0.1, 0.1)
lenses = st.one_of(
    st.tuples(st.just("ucm"), st.tuples(st.floats(0.0, 1.0))),
    st.tuples(st.just("eucm"), st.tuples(st.floats(0.0, 1.0), st.floats(0.3, 3.0))),
    st.tuples(st.just("ds"), st.tuples(st.floats(-0.6, 0.9), st.floats(0.0, 1.0))),
    st.tuples(st.just("omni"), st.tuples(st.floats(0.0, 3.0), small, small, st.just(1e-3), st.just(-1e-3))),
).map(lambda lens: Camera(*PINHOLE, *lens))
seeds = st.integers(0, 2**32 - 1)


def directions(seed: int, count: int = 300) -> Array:
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def by_formula(camera: Camera, rays: Array) -> Array:
    """Pixels by the papers' formulas, focal lengths as in files of Kalibr."""
    x, y, z = rays.T
    d = np.sqrt(x * x + y * y + z * z)
    xi, alpha = 0.0, camera.coefficients[0]
    if camera.distortion == "eucm":
        alpha, beta = camera.coefficients
        under = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1.0 - alpha) * z
    elif camera.distortion == "ds":
        xi, alpha = camera.coefficients
        under = alpha * np.sqrt(x * x + y * y + (xi * d + z) ** 2) + (1.0 - alpha) * (xi * d + z)
    elif camera.distortion == "ucm":
        under = alpha * d + (1.0 - alpha) * z
    else:
        xi = camera.coefficients[0]
        under = z + xi * d
    u, v = x / under, y / under
    if camera.distortion == "omni":
        _, k1, k2, p1, p2 = camera.coefficients
        r2 = u * u + v * v
        radial = 1.0 + k1 * r2 + k2 * r2 * r2
        u, v = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    K = camera.K.copy()
    K[:, :2] *= 1.0 + xi
    return np.column_stack([u, v, np.ones(len(u))]) @ K[:2].T


@given(camera=lenses, seed=seeds)
@settings(max_examples=80, deadline=None)
def test_a_ray_within_the_cone_comes_back_and_one_beyond_has_no_pixel(camera: Camera, seed: int) -> None:
    rays = directions(seed)
    pixels = camera.project(rays * 2.5)
    seen = np.isfinite(pixels).all(axis=1)
    ordinary = seen & (np.linalg.norm(np.nan_to_num(pixels), axis=1) < 1e4)  # where the image plane is not infinite
    assert ordinary.sum() > 20 and np.array_equal(np.isfinite(pixels[:, 0]), seen)
    assert np.allclose(pixels[ordinary], by_formula(camera, rays[ordinary]), rtol=1e-9, atol=1e-7)
    back = camera.bearings(pixels[ordinary])
    found = np.isfinite(back).all(axis=1)
    # at the very edge of a cone, where pixels hardly move with the ray, rounding shows
    edge = np.linalg.svd(camera.project_jacobian(rays[ordinary][found]), compute_uv=False)[:, 1] < 1.0
    assert np.linalg.norm(back[found] - rays[ordinary][found], axis=1)[~edge].max(initial=0.0) < 1e-6
    assert found.all() or camera.distortion == "omni"  # radtan may be beyond what Newton's method can undo
    others = directions(seed + 1)
    within = others[others[:, 2] > rays[seen, 2].min()]
    # radtan's cone is not quite round, with that of its images
    assert np.isfinite(camera.project(within)).all() or camera.distortion == "omni"


@given(camera=lenses, seed=seeds)
@settings(max_examples=80, deadline=None)
def test_a_pixel_has_the_ray_that_gives_it_back_or_none(camera: Camera, seed: int) -> None:
    pixels = np.random.default_rng(seed).uniform([-2000.0, -2000.0], [2600.0, 2500.0], (300, 2))
    rays = camera.bearings(pixels)
    there = np.isfinite(rays).all(axis=1)
    assert np.allclose(np.linalg.norm(rays[there], axis=1), 1.0)
    again = camera.project(rays[there])
    same = np.isfinite(again).all(axis=1)
    assert np.allclose(again[same], pixels[there][same], atol=1e-4)
    assert same.mean() > 0.99 if there.any() else True  # but for rounding at the edge of the cone
    xy = camera.normalise(pixels)
    ahead = np.isfinite(xy[:, 0])
    assert not (ahead & ~there).any() and (rays[ahead, 2] > np.cos(1.5) - 1e-9).all()
    assert np.allclose(xy[ahead], rays[ahead, :2] / rays[ahead, 2:], rtol=1e-12)


@given(camera=lenses, seed=seeds)
@settings(max_examples=40, deadline=None)
def test_derivatives_are_those_of_differences_behind_the_camera_too(camera: Camera, seed: int) -> None:
    points = 1.7 * directions(seed, 100)
    analytic = camera.project_jacobian(points)
    numeric = np.stack([camera.project(points + e) - camera.project(points - e) for e in 1e-6 * np.eye(3)], -1) / 2e-6
    assert np.array_equal(np.isfinite(camera.project(points)).all(axis=1), np.isfinite(analytic).all(axis=(1, 2)))
    tame = np.isfinite(numeric).all(axis=(1, 2)) & (np.abs(np.nan_to_num(analytic)).max(axis=(1, 2)) < 1e4)
    assert tame.sum() > 5  # radtan may see no farther than 45 degrees from its axis: 15 of them
    assert np.allclose(analytic[tame], numeric[tame], rtol=1e-4, atol=1e-2)
    ahead = points[tame & (points[:, 2] > 0.3)]
    for (x, y, z), pixel, J in zip(ahead, camera.project(ahead), camera.project_jacobian(ahead), strict=True):
        u, v, ux, uy, vx, vy = imaged(x / z, y / z, camera.lens)
        assert (u + camera.cx, v + camera.cy) == pytest.approx(pixel)
        assert np.array([[ux, uy], [vx, vy]]) / z == pytest.approx(J[:, :2], abs=1e-6)


@pytest.mark.parametrize(
    ("lens", "half_deg"),
    [
        (("ucm", (0.75,)), 109.471), (("eucm", (0.62, 1.1)), 129.129), (("ds", (-0.2, 0.58)), 128.469),
        (("omni", (2.0, 0.0, 0.0, 0.0, 0.0)), 120.0),
    ],
)  # fmt: skip
def test_the_cone_ends_where_two_rays_would_share_a_pixel(lens: tuple[str, tuple[float, ...]], half_deg: float) -> None:
    camera = Camera(*PINHOLE, *lens)
    for off_deg, is_seen in ((-0.02, True), (0.02, False)):
        angle = np.deg2rad(half_deg + off_deg)
        ray = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
        assert np.isfinite(camera.project(ray)).all() == is_seen
        assert np.isfinite(camera.project_jacobian(ray)).all() == np.isfinite(camera.project(ray)).all()
    radii = camera.project(np.array([[np.sin(a), 0.0, np.cos(a)] for a in np.deg2rad(np.arange(0.0, half_deg))]))[:, 0]
    assert np.all(np.diff(radii) > 0.0)


def test_coefficients_that_no_lens_has_are_refused() -> None:
    with pytest.raises(DataError, match=r"ds distortion takes \(2,\) coefficients, got 1"):
        Camera(*PINHOLE, "ds", (0.5,))
    with pytest.raises(DataError, match=r"ucm distortion has alpha from 0 to 1, got 1.5"):
        Camera(*PINHOLE, "ucm", (1.5,))
    with pytest.raises(DataError, match=r"eucm distortion has beta from 0.001 to 1000, got -1"):
        Camera(*PINHOLE, "eucm", (0.5, -1.0))
    with pytest.raises(DataError, match="omni distortion has xi from 0 to 1000"):
        Camera(*PINHOLE, "omni", (-0.5, 0.0, 0.0, 0.0, 0.0))
