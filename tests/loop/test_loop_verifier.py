"""Verification on landmarks with exact truth: the pose, its covariance, and what must not pass."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from vislam.config import LoopConfig
from vislam.core.errors import DataError
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.core.messages import Array
from vislam.loop.verification import verifier as verifier_module
from vislam.loop.verification.relative_pose import Matched, errors, refine
from vislam.loop.verification.verifier import Verifier
from vislam.loop.view import View, make_view
from worlds.landmarks import LandmarkWorld, body_pose, make_rig, room

PAIRS = 40
BARE = replace(LoopConfig(), covariance_inflation=1.0, sigma_floor_m=0.0, sigma_floor_deg=0.0)


@pytest.fixture(scope="module")
def world() -> LandmarkWorld:
    return room(1)


def pair_poses(rng: np.random.Generator) -> tuple[Array, Array]:
    """Two poses that see the same wall from up to a metre and 25 degrees apart."""
    yaw = rng.uniform(-180.0, 180.0)
    start = body_pose((rng.uniform(-1, 1), rng.uniform(-1, 1), 0.0), yaw)
    step = np.concatenate([rng.uniform(-0.25, 0.25, 3), rng.uniform(-0.5, 0.5, 3)])
    return start, start @ se3_exp(step)


def views(world: LandmarkWorld, rng: np.random.Generator, **options: float) -> tuple[View, View, Array]:
    T_a, T_b = pair_poses(rng)
    a = make_view(world.see(3, T_a, rng, **options), world.rig)
    return a, make_view(world.see(40, T_b, rng, **options), world.rig), invert(T_a) @ T_b


def error_of(T: Array, truth: Array) -> tuple[float, float]:
    """Return the error of a pose in metres and degrees."""
    xi = se3_log(invert(truth) @ T)
    return float(np.linalg.norm(xi[3:])), float(np.rad2deg(np.linalg.norm(xi[:3])))


def test_poses_are_found_and_good_to_centimetres(world: LandmarkWorld) -> None:
    """The walls are five metres away and pixels are good to 0.7: a centimetre or two is what there is."""
    rng, verifier, all_metres = np.random.default_rng(0), Verifier(LoopConfig(), world.rig, 0), []
    for _ in range(PAIRS // 2):
        a, b, truth = views(world, rng)
        found = verifier.verify(a, b)
        assert found.T_a_b is not None, found.reason
        metres, degrees = error_of(found.T_a_b, truth)
        all_metres.append(metres)
        assert metres < 0.06
        assert degrees < 0.5
        assert found.has_scale
        assert found.supporters >= found.inliers * 0.8
        assert found.reverse_agreement > 0.9
        assert found.depth_agreement > 0.9
    assert np.median(all_metres) < 0.02


def test_points_of_either_side_are_enough(world: LandmarkWorld) -> None:
    rng, verifier = np.random.default_rng(1), Verifier(LoopConfig(), world.rig, 0)
    for _ in range(8):
        a, b, truth = views(world, rng)
        for one, other in ((replace(a, points_cam_m=None), b), (a, replace(b, points_cam_m=None))):
            found = verifier.verify(one, other)
            assert found.T_a_b is not None, found.reason
            assert error_of(found.T_a_b, truth)[0] < 0.04
            assert np.isnan(found.reverse_agreement)


def test_wrong_matches_do_not_move_the_pose(world: LandmarkWorld) -> None:
    """Half of the shared descriptors are given to other places: matches that are as sure as true ones."""
    rng, verifier = np.random.default_rng(2), Verifier(LoopConfig(), world.rig, 0)
    for _ in range(8):
        a, b, truth = views(world, rng)
        descriptors = b.descriptors.copy()
        moved = rng.permutation(len(descriptors))[: len(descriptors) // 2]
        descriptors[moved] = descriptors[np.roll(moved, 1)]
        found = verifier.verify(a, replace(b, descriptors=descriptors))
        assert found.T_a_b is not None, found.reason
        assert error_of(found.T_a_b, truth)[0] < 0.08
        assert found.inliers < found.matches * 0.8


def nees(world: LandmarkWorld, config: LoopConfig, seed: int) -> list[float]:
    rng, verifier, out = np.random.default_rng(seed), Verifier(config, world.rig, 0), []
    for _ in range(PAIRS):
        # pixel noise 1 and inverse depth noise 0.01 / sqrt(2) on both sides are what the config assumes
        a, b, truth = views(world, rng, noise_px=1.0, inverse_depth_noise=0.007)
        found = verifier.verify(a, b)
        assert found.T_a_b is not None, found.reason
        assert found.covariance is not None
        np.testing.assert_allclose(found.covariance, found.covariance.T)
        xi = se3_log(invert(found.T_a_b) @ truth)
        out.append(float(xi @ np.linalg.solve(found.covariance, xi)))
    return out


def test_the_covariance_of_the_fit_is_consistent(world: LandmarkWorld) -> None:
    """Where the noise is as assumed, the fit's own covariance explains the errors (both ways share their noise)."""
    total = sum(nees(world, BARE, 3))
    assert chi2.ppf(0.001, 6 * PAIRS) * 0.6 < total < chi2.ppf(0.999, 6 * PAIRS) * 1.6


def test_the_default_covariance_is_cautious_here(world: LandmarkWorld) -> None:
    """On ideal features the inflation that real images need (a factor 16) shows."""
    assert sum(nees(world, LoopConfig(), 3)) < 6 * PAIRS / 8


def test_refinement_has_the_right_derivatives(world: LandmarkWorld) -> None:
    """The information is that of finite differences of the errors, and the truth is a fixed point without noise."""
    rng = np.random.default_rng(4)
    T_a_b = se3_exp(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))
    points_b = rng.uniform((-1.0, -1.0, 2.0), (1.0, 1.0, 5.0), (30, 3))
    points_a = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    xy_a, xy_b = points_a[:, :2] / points_a[:, 2:], points_b[:, :2] / points_b[:, 2:]
    points_a[:10] = np.nan
    points_b[25:] = np.nan
    matched = Matched(points_a, points_b, xy_a, xy_b)
    found = refine(T_a_b @ se3_exp(np.array([0.02, 0.01, -0.02, 0.03, 0.02, -0.04])), matched, 0.002, 0.01)
    assert found is not None
    np.testing.assert_allclose(found.T_a_b, T_a_b, atol=1e-8)

    def cost(xi: Array) -> float:
        forward, reverse, depth = errors(T_a_b @ se3_exp(xi), matched)
        share = np.where(np.isfinite(forward) & np.isfinite(reverse), 0.5, 1.0)
        pixels = np.nansum(share * forward**2) + np.nansum(share * reverse**2)
        return float(pixels / 0.002**2 + np.nansum(depth**2) / 0.01**2)

    h = 1e-4
    for i in range(6):
        for j in range(6):
            di, dj = np.eye(6)[i] * h, np.eye(6)[j] * h
            second = (cost(di + dj) - cost(di - dj) - cost(dj - di) + cost(-di - dj)) / (4.0 * h * h)
            scale = np.sqrt(found.information[i, i] * found.information[j, j])
            assert 0.5 * second == pytest.approx(found.information[i, j], abs=2e-3 * scale)


def test_matches_that_determine_nothing_give_no_pose() -> None:
    ray = np.tile([[0.1, 0.1, 2.0]], (20, 1))
    same = Matched(ray, ray, ray[:, :2] / 2.0, ray[:, :2] / 2.0)
    found = refine(np.eye(4), same, 0.002, 0.01)
    assert found is None or np.linalg.cond(found.information) > 1e8


def test_different_places_give_nothing(world: LandmarkWorld) -> None:
    rng, verifier, elsewhere = np.random.default_rng(5), Verifier(LoopConfig(), world.rig, 0), room(2)
    for _ in range(PAIRS):
        a = make_view(world.see(0, pair_poses(rng)[0], rng), world.rig)
        b = make_view(elsewhere.see(50, pair_poses(rng)[0], rng), world.rig)
        found = verifier.verify(a, b)
        assert found.T_a_b is None
        assert "needs 12" in found.reason


def test_alike_descriptors_in_another_arrangement_give_nothing(world: LandmarkWorld) -> None:
    """The hardest single pair: every descriptor matches, but the geometry is that of another place."""
    rng, verifier = np.random.default_rng(6), Verifier(LoopConfig(), world.rig, 0)
    for _ in range(PAIRS):
        a, b, _ = views(world, rng)
        shuffled = replace(b, descriptors=b.descriptors[rng.permutation(len(b.descriptors))])
        found = verifier.verify(a, shuffled)
        assert found.matches > 100
        assert found.T_a_b is None
        assert "fit one pose" in found.reason


def test_without_depth_rotation_and_direction_come_out(world: LandmarkWorld) -> None:
    rng, verifier, found_any = np.random.default_rng(7), Verifier(LoopConfig(), world.rig, 0), 0
    T_body_cam = world.rig.T_body_cams[0]
    for _ in range(PAIRS // 2):
        T_a, T_b = pair_poses(rng)
        truth = invert(T_a) @ T_b
        a = make_view(world.see(3, T_a, rng, depth=False), world.rig)
        b = make_view(world.see(40, T_b, rng, depth=False), world.rig)
        found = verifier.verify(a, b)
        if found.T_a_b is None:
            assert "parallax" in found.reason or "plane" in found.reason
            continue
        found_any += 1
        assert not found.has_scale
        assert found.covariance is not None
        assert np.linalg.norm(found.T_a_b[:3, 3]) == pytest.approx(1.0)
        assert error_of(np.block([[found.T_a_b[:3, :3], truth[:3, 3:]], [np.zeros((1, 3)), 1.0]]), truth)[1] < 1.0
        between = invert(T_a @ T_body_cam) @ (T_b @ T_body_cam)
        centres = T_body_cam[:3, :3] @ between[:3, 3] / np.linalg.norm(between[:3, 3])
        assert np.rad2deg(np.arccos(np.clip(centres @ found.T_a_b[:3, 3], -1.0, 1.0))) < 8.0
        ahead = found.T_a_b[:3, :3].T @ found.T_a_b[:3, 3]
        assert ahead @ found.covariance[3:, 3:] @ ahead < 1e-9  # nothing is said along the direction
    assert found_any >= PAIRS // 3


def test_turning_on_the_spot_has_no_direction(world: LandmarkWorld) -> None:
    rng, verifier = np.random.default_rng(8), Verifier(LoopConfig(), world.rig, 0)
    T_a = body_pose((0.0, 0.0, 0.0), 20.0)
    T_cam = T_a @ world.rig.T_body_cams[0]
    T_b = T_cam @ se3_exp(np.array([0.02, 0.2, 0.0, 0.0, 0.0, 0.0])) @ invert(world.rig.T_body_cams[0])
    a = make_view(world.see(0, T_a, rng, depth=False, noise_px=0.4), world.rig)
    found = verifier.verify(a, make_view(world.see(9, T_b, rng, depth=False, noise_px=0.4), world.rig))
    assert found.matches > 100
    assert found.T_a_b is None
    assert found.reason


def test_verification_repeats_to_the_bit(world: LandmarkWorld) -> None:
    for depth in (True, False):
        rng = np.random.default_rng(9)
        T_a, T_b = pair_poses(rng)
        a = make_view(world.see(3, T_a, rng, depth=depth), world.rig)
        b = make_view(world.see(40, T_b, rng, depth=depth), world.rig)
        one, two = (Verifier(LoopConfig(), world.rig, 5).verify(a, b) for _ in range(2))
        assert one.T_a_b is not None
        assert two.T_a_b is not None
        assert one.T_a_b.tobytes() == two.T_a_b.tobytes()
        assert one.inliers == two.inliers


def test_a_view_copies_only_what_it_needs(world: LandmarkWorld) -> None:
    rng = np.random.default_rng(10)
    keyframe = world.see(3, body_pose((0.0, 0.0, 0.0), 0.0), rng)
    assert keyframe.points_body_m is not None
    keyframe.points_body_m[0] = [np.inf, 0.0, 1.0]
    keyframe.points_body_m[1] = [-5.0, 0.0, 0.0]  # behind the camera
    keyframe.keypoints_px[2] = np.nan
    view = make_view(keyframe, world.rig)
    assert len(view.descriptors) == len(keyframe.descriptors) - 1
    assert not view.known[0]
    assert not view.known[1]
    assert not np.shares_memory(view.descriptors, keyframe.descriptors)
    with pytest.raises(DataError, match="keyframe 3"):
        make_view(replace(keyframe, keypoints_px=keyframe.keypoints_px[:-1]), world.rig)


def test_a_pair_without_depth_and_with_too_few_matches_is_not_searched(world: LandmarkWorld, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """It could not pass, however many of its matches agreed."""
    monkeypatch.setattr(verifier_module, "relative_direction", lambda *_: pytest.fail("searched"))
    a, b, _ = views(world, np.random.default_rng(4))
    a, b = (replace(view, points_cam_m=None) for view in (a, b))
    config = replace(LoopConfig(), min_inliers_direction=10_000)
    found = Verifier(config, world.rig, 0).verify(a, b)
    assert found.T_a_b is None and found.matches >= config.min_inliers
    assert found.reason == f"too few matches: {found.matches}, needs 10000 without depth"


def two_panels() -> tuple[View, View, Array, Verifier]:
    """Views a of two equal panels and b of the second, whose descriptors are nearer to the first; the truth."""
    rng, rig = np.random.default_rng(6), make_rig()
    panel, bits = (
        rng.uniform([-0.6, -0.8, 3.0], [0.6, 0.8, 3.6], (60, 3)),
        rng.integers(0, 256, (60, 32)).astype(np.uint8),
    )
    second, step = bits.copy(), np.array([1.5, 0.0, 0.0])
    second[:, 0] ^= 0b1111
    T_cams = invert(rig.T_body_cams[0]) @ se3_exp(np.array([0.0, 0.0, 0.0, 0.0, -0.4, 0.0])) @ rig.T_body_cams[0]

    def view(number: int, points: Array, descriptors: NDArray[np.uint8]) -> View:
        xy = (points[:, :2] / points[:, 2:]).astype(np.float32)
        return View(number, number, descriptors, xy, points.astype(np.float32))

    a = view(0, np.vstack([panel, panel + step]), np.vstack([bits, second]))
    b = view(1, panel + step - T_cams[:3, 3], bits)
    return a, b, rig.T_body_cams[0] @ T_cams @ invert(rig.T_body_cams[0]), Verifier(LoopConfig(), rig, 0)


def test_of_equal_panels_the_one_where_the_map_has_it_is_found() -> None:
    a, b, T_true, verifier = two_panels()
    alone, guided = verifier.verify(a, b), verifier.verify(a, b, None, T_true)
    assert np.linalg.norm(alone.T_a_b[:3, 3] - T_true[:3, 3]) > 1.0
    np.testing.assert_allclose(guided.T_a_b, T_true, atol=0.02)


def test_a_place_that_looks_like_itself_a_step_further_has_a_rival_there(world: LandmarkWorld) -> None:
    a, b, T_true, verifier = two_panels()
    (rival,) = verifier.rivals(a, b, verifier.verify(a, b))
    np.testing.assert_allclose(rival.T_a_b, T_true, atol=0.02)
    (back,) = verifier.rivals(a, b, verifier.verify(a, b, None, T_true))
    assert np.linalg.norm(back.T_a_b[:3, 3] - T_true[:3, 3]) == pytest.approx(1.5, abs=0.05)
    (c, d, _), plain = views(world, np.random.default_rng(4)), Verifier(LoopConfig(), world.rig, 0)
    assert plain.rivals(c, d, plain.verify(c, d)) == []
