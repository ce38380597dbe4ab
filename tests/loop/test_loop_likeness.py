"""Whether two views are alike, before a pose is asked for."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.config import LoopConfig
from vislam.core.geometry import se3_exp, transform_points
from vislam.core.messages import Array
from vislam.loop.verification.likeness import compare, rigid_count
from vislam.loop.verification.verifier import Verifier
from vislam.loop.view import View
from worlds.landmarks import make_rig

CONFIG = LoopConfig()
PX = 1.0 / 500.0
COUNT = 200


def _points(rng: np.random.Generator, count: int) -> Array:
    """Return points [count, 3] that a camera of 60 degrees sees, 1 to 5 m away."""
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)]) * rng.uniform(1.0, 5.0, (count, 1))


def _view(number: int, points: Array, descriptors: Array, known: float = 1.0) -> View:
    """Return a view that knows the points of the first so many of its features."""
    xy = (points[:, :2] / points[:, 2:]).astype(np.float32)
    kept = points.astype(np.float32)
    kept[round(known * len(points)) :] = np.nan
    return View(number, number * 10**9, descriptors, xy, kept if known else None)


def _pair(rng: np.random.Generator, same: int, known: float = 1.0) -> tuple[View, View]:
    """Return two views of which the first `same` features are one scene; 18 others look alike but are not."""
    descriptors = [rng.integers(0, 256, (COUNT, 32), np.uint8) for _ in range(2)]
    descriptors[1][: same + 18] = descriptors[0][: same + 18]
    points = [_points(rng, COUNT) for _ in range(2)]
    points[1][:same] = transform_points(se3_exp(np.array([0.1, 0.4, 0.2, 0.2, -0.1, 0.3])), points[0][:same])
    return _view(0, points[0], descriptors[0], known), _view(1, points[1], descriptors[1], known)


@given(st.integers(0, 1000), st.integers(0, 40))
def test_a_rigid_scene_keeps_its_distances_among_wrong_matches(seed: int, same: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = _points(rng, same + 15), _points(rng, same + 15)
    b[:same] = transform_points(se3_exp(rng.normal(size=6) * 0.1), a[:same])
    order = rng.permutation(len(a))
    a, b = a[order], b[order]
    found = rigid_count(a, b, 0.0, 0.006)
    assert found == rigid_count(b, a, 0.0, 0.006)
    assert 0.6 * same <= found <= len(a)


@pytest.mark.parametrize("same", [12, 20, 60])
def test_views_of_one_place_are_alike_and_others_are_not(same: int) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        found = compare(*_pair(rng, same), CONFIG, PX)
        assert found.is_alike and found.rigid >= 0.4 * same
        other = compare(*_pair(rng, 0), CONFIG, PX)
        assert not other.is_alike and other.rigid < CONFIG.min_rigid
        assert found.rank > other.rank
        assert len(other.pairs) >= 18  # their number alone would have been enough


@pytest.mark.parametrize("known", [0.0, 0.1])
def test_without_enough_depth_the_number_of_matches_tells(known: float) -> None:
    rng = np.random.default_rng(0)
    few = replace(CONFIG, min_inliers=5)
    many, none = compare(*_pair(rng, 30, known), few, PX), compare(*_pair(rng, 0, known), few, PX)
    assert many.is_alike and many.rigid == 0
    strict = replace(few, chance_matched_share=0.1)  # 20 by chance, 34 are three sigmas above
    assert none.is_alike and not compare(*_pair(rng, 0, known), strict, PX).is_alike
    assert compare(*_pair(rng, 30, known), strict, PX).is_alike


def test_so_many_matches_are_no_chance_even_where_distances_tell_nothing() -> None:
    """A picture on a wall far away: all points are nearer to each other than depth is good to."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.02, 0.02, (COUNT, 2)), np.ones(COUNT)]) * 7.0
    descriptors = rng.integers(0, 256, (COUNT, 32), np.uint8)
    moved = transform_points(se3_exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.2])), points)
    for matched, is_alike in ((20, False), (60, True)):
        other = rng.integers(0, 256, (COUNT, 32), np.uint8)
        other[:matched] = descriptors[:matched]
        found = compare(_view(0, points, descriptors), _view(1, moved, other), CONFIG, PX)
        assert found.rigid < CONFIG.min_rigid
        assert found.is_alike == is_alike


def test_views_without_features_are_not_alike() -> None:
    rng = np.random.default_rng(0)
    empty = _view(0, np.empty((0, 3)), np.empty((0, 32), np.uint8))
    full = _pair(rng, 30)[1]
    assert not compare(empty, full, CONFIG, PX).is_alike
    assert not compare(full, empty, CONFIG, PX).is_alike


def test_what_is_known_already_changes_no_verification() -> None:
    a, b = _pair(np.random.default_rng(1), 60)
    verifier = Verifier(CONFIG, make_rig(), 0)
    fresh, known = verifier.verify(a, b), verifier.verify(a, b, verifier.compare(a, b))
    assert fresh.T_a_b is not None and known.T_a_b is not None
    assert fresh.T_a_b.tobytes() == known.T_a_b.tobytes()
    assert fresh.matches == known.matches
