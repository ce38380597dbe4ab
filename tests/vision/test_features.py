"""Corners, tracks, descriptors and matches."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vislam.vision.features import FlowSettings, describe, detect_corners, follow, match


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    rng = np.random.default_rng(5)
    fine = cv2.GaussianBlur(rng.standard_normal((240, 320)), (0, 0), 1.5)
    coarse = cv2.GaussianBlur(rng.standard_normal((240, 320)), (0, 0), 5.0)
    mixed = fine / fine.std() + coarse / coarse.std()
    return np.clip(128 + 35 * mixed, 0, 255).astype(np.uint8)


def test_corners_keep_their_distance_and_cover_the_image(image: np.ndarray) -> None:
    corners = detect_corners(image, 200, 40, 10.0, np.empty((0, 2)), 1.0)
    assert 120 < len(corners) <= 200
    gaps = np.linalg.norm(corners[:, None] - corners[None], axis=2) + np.eye(len(corners)) * 1e9
    assert gaps.min() >= 10.0
    cells = {(int(x // 80), int(y // 80)) for x, y in corners}
    assert len(cells) == 12  # 4 x 3 cells of 80 px
    assert corners[:, 0].min() >= 12 and corners[:, 0].max() <= 307


def test_new_corners_avoid_the_live_ones(image: np.ndarray) -> None:
    live = detect_corners(image, 60, 40, 10.0, np.empty((0, 2)), 1.0)
    fresh = detect_corners(image, 200, 40, 10.0, np.vstack([live, [[np.nan, np.nan]]]), 1.0)
    assert len(fresh) > 40
    assert np.linalg.norm(fresh[:, None] - live[None], axis=2).min() >= 10.0


def test_few_corners_are_shared_among_the_cells(image: np.ndarray) -> None:
    half = image.copy()
    half[:, 160:] = np.clip((half[:, 160:].astype(int) - 128) // 4 + 128, 0, 255)  # low contrast on the right
    corners = detect_corners(half, 24, 80, 10.0, np.empty((0, 2)), 1.0)
    right = (corners[:, 0] >= 160).sum()
    assert 8 <= right <= 16


def test_noise_and_flat_images_have_no_corners() -> None:
    rng = np.random.default_rng(1)
    assert len(detect_corners(np.full((120, 160), 90, np.uint8), 50, 40, 10.0, np.empty((0, 2)), 1.0)) == 0
    noisy = np.clip(rng.normal(20, 0.7, (120, 160)), 0, 255).astype(np.uint8)
    assert len(detect_corners(noisy, 50, 40, 10.0, np.empty((0, 2)), 1.0)) == 0
    assert len(detect_corners(noisy, 0, 40, 10.0, np.empty((0, 2)), 0.0)) == 0


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.4, -2.7), (17.25, 9.5)])
def test_following_finds_a_subpixel_shift(image: np.ndarray, shift: tuple[float, float]) -> None:
    warp = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    moved = cv2.warpAffine(image, warp, (320, 240), flags=cv2.INTER_CUBIC)
    corners = detect_corners(image, 100, 40, 10.0, np.empty((0, 2)), 1.0)
    inner = corners[(corners[:, 0] < 270) & (corners[:, 1] < 200) & (corners[:, 1] > 30)]
    found, difference = follow(image, moved, inner, inner, FlowSettings())
    seen = np.isfinite(found[:, 0])
    assert seen.mean() > 0.85 and np.array_equal(seen, np.isfinite(difference))
    errors = np.linalg.norm(found[seen] - inner[seen] - shift, axis=1)
    assert np.median(errors) < 0.05 and np.quantile(errors, 0.95) < 0.3


def test_what_is_not_there_is_not_found(image: np.ndarray) -> None:
    corners = detect_corners(image, 100, 40, 10.0, np.empty((0, 2)), 1.0)
    guess = corners.copy()
    guess[0], guess[1], guess[2] = np.nan, [1e9, -1e9], [-5000.0, 20.0]
    other = np.ascontiguousarray(image[::-1, ::-1])
    found, _ = follow(image, other, corners, guess, FlowSettings())
    assert np.isfinite(found[:, 0]).mean() < 0.2 and not np.isfinite(found[:3]).any()
    black, _ = follow(image, np.zeros_like(image), corners, guess, FlowSettings())
    assert not np.isfinite(black).any()
    nothing, _ = follow(image, other, np.empty((0, 2)), np.empty((0, 2)), FlowSettings())
    assert nothing.shape == (0, 2)


def test_descriptions_are_spread_and_repeat(image: np.ndarray) -> None:
    pixels, descriptors = describe(image, 200)
    assert pixels.shape == (len(descriptors), 2) and descriptors.shape[1] == 32 and descriptors.dtype == np.uint8
    assert 100 < len(pixels) <= 200
    again = describe(image, 200)
    assert np.array_equal(pixels, again[0]) and np.array_equal(descriptors, again[1])
    counts, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=(2, 2), range=((0, 320), (0, 240)))
    assert counts.min() > 0.1 * len(pixels)
    empty_pixels, empty = describe(np.zeros((100, 100), np.uint8), 50)
    assert empty_pixels.shape == (0, 2) and empty.shape == (0, 32)


def test_a_turned_image_matches_itself(image: np.ndarray) -> None:
    warp = cv2.getRotationMatrix2D((160.0, 120.0), 25.0, 1.0)
    turned = cv2.warpAffine(image, warp, (320, 240))
    a, da = describe(image, 300)
    b, db = describe(turned, 300)
    pairs = match(da, db, 0.8, 64)
    errors = np.linalg.norm(a[pairs[:, 0]] @ warp[:, :2].T + warp[:, 2] - b[pairs[:, 1]], axis=1)
    assert len(pairs) > 30 and (errors < 4.0).mean() > 0.9


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12), st.floats(0.5, 1.0), st.integers(1, 256))
def test_matches_are_what_brute_force_says(seed: int, n: int, m: int, ratio: float, most: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    b = rng.integers(0, 256, (m, 32), dtype=np.uint8)
    shared = min(n, m) // 2
    b[:shared] = a[:shared] ^ (rng.random((shared, 32)) < 0.1)
    distance = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)
    expected = []
    for i in range(n):
        j = int(np.argmin(distance[i]))
        others = np.delete(distance[i], j)
        second = others.min() if len(others) else 257
        if distance[i, j] <= most and distance[i, j] < ratio * second and int(np.argmin(distance[:, j])) == i:
            expected.append((i, j))
    assert match(a, b, ratio, most).tolist() == [list(pair) for pair in expected]


def test_nothing_matches_nothing() -> None:
    some, none = np.zeros((3, 32), np.uint8), np.zeros((0, 32), np.uint8)
    assert match(some, none).shape == (0, 2) and match(none, some).shape == (0, 2)
