"""Meshes after fusion: small holes closed and marked, openings left, flat surfaces flat, relief kept."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas import wall

from needs import missing
from vislam.mapping import _open3d
from vislam.mapping.mesh.mended import filled, flattened


@pytest.fixture(scope="module")
def open3d():
    module, reason = _open3d.load_open3d()
    if module is None:
        missing(reason)
    return module


def without(mesh, half_m):
    """The wall without what is within a square around the origin."""
    middles = mesh.points_m[mesh.triangles].mean(axis=1)
    return mesh.select((np.abs(middles[:, :2]) > half_m).any(axis=1))


def area_m2(mesh):
    a, b, c = mesh.points_m[mesh.triangles].transpose(1, 0, 2).astype(float)
    return 0.5 * np.cross(b - a, c - a)[:, 2].sum()


@pytest.mark.parametrize(
    ("half_m", "is_open", "closes"), [(0.03, False, True), (0.03, True, False), (0.2, False, False)]
)
def test_a_hole_is_closed_where_it_is_small_and_no_ray_passed(half_m, is_open, closes):
    mesh = without(wall(half=0.6), half_m)
    whole, again = (filled(mesh, lambda places: np.full(len(places), is_open)) for _ in range(2))
    assert whole.triangles.tobytes() == again.triangles.tobytes()
    assert (whole.filled > 0) == closes
    assert len(whole.triangles) == len(mesh.triangles) + whole.filled
    # all wind the same way, so the areas add up
    assert area_m2(whole) == pytest.approx(area_m2(wall(half=0.6) if closes else mesh), rel=1e-4)
    assert whole.select(np.arange(len(whole.triangles)) >= 10).filled == whole.filled


def test_a_flat_surface_is_flat_and_relief_stays(open3d):
    rng = np.random.default_rng(1)
    mesh, points = wall(), wall().points_m.copy()
    on_plate = (np.abs(points[:, :2]) < 0.15).all(axis=1)
    points[:, 2] = rng.normal(0.0, 0.002, len(points)) + np.where(on_plate, 0.025, 0.0)
    result = flattened(open3d, replace(mesh, points_m=points)).points_m[:, 2]
    away = ~(np.abs(points[:, :2]) < 0.2).all(axis=1)
    assert result[away].std() < 0.25 * points[away, 2].std()
    assert np.abs(result[on_plate] - 0.025).mean() < 0.003
