"""Depth images of made rooms, aligned: what they tell is right, and what they do not tell is not claimed."""

import numpy as np
import pytest

from vislam.core.camera import Camera
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import invert, se3_exp, se3_log
from vislam.mapping.depth.localise import DepthLocaliser, Guess
from vislam.vision.depth_alignment import Prior, SeenFrom, align_depth
from vislam.vision.depth_surface import SurfaceMaker

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
SIGMA_RHO = 2e-3
CORNER = (((0.0, 0.0, 1.0), 2.5), ((1.0, 0.0, 0.0), 1.0), ((0.0, 1.0, 0.0), 0.8))
WALL = (((0.0, 0.0, 1.0), 2.0),)
CORRIDOR = (((1.0, 0.0, 0.0), 1.0), ((1.0, 0.0, 0.0), -1.0), ((0.0, 1.0, 0.0), 1.0), ((0.0, 1.0, 0.0), -1.2))
MOVED = se3_exp(np.array([0.03, -0.05, 0.04, 0.08, -0.05, 0.06]))
UNSURE = np.diag(np.repeat([0.1**2, 0.2**2], 3))
INTO_CORNER = se3_exp(np.array([-0.5, 0.6, 0.0, 0.0, 0.0, 0.0]))


def depth(T_world_cam, planes, noise=0.0, seed=0):
    """Depth [H, W] of planes (normal, distance) of the world."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float)).reshape(*u.shape, 3)
    z = np.full(u.shape, np.inf)
    for normal, distance in planes:
        along = rays @ T_world_cam[:3, :3].T @ np.array(normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = (distance - np.array(normal) @ T_world_cam[:3, 3]) / along
        z = np.where((hit > 0.1) & (hit < z), hit, z)
    if noise:
        z = 1.0 / (1.0 / z + np.random.default_rng(seed).normal(0.0, noise, z.shape))
    return z.astype(np.float32)


def surface(depth_m):
    return SurfaceMaker(CAMERA, 0.3, 8.0, SIGMA_RHO).make(depth_m)


def aligned(planes, T_world_cam, noise=0.0, seed=0):
    model = surface(depth(T_world_cam, planes, noise, seed))
    frame = surface(depth(T_world_cam @ MOVED, planes, noise, seed + 1000))
    found = align_depth(frame, [SeenFrom(model, np.eye(4))], Prior(np.eye(4), UNSURE), SIGMA_RHO)
    return found, se3_log(invert(found.T_model_cam) @ MOVED)


def test_a_corner_of_a_room_is_aligned_within_a_millimetre():
    found, error = aligned(CORNER, INTO_CORNER)
    assert found.converged
    assert found.determined == 6
    assert np.linalg.norm(error[3:]) < 0.001
    assert np.linalg.norm(error[:3]) < np.deg2rad(0.05)
    assert found.agreement > 0.99
    assert found.seen_through == 0.0


@pytest.mark.parametrize(("planes", "free"), [(WALL, 3), (CORRIDOR, 1)], ids=["wall", "corridor"])
@pytest.mark.parametrize("noise", [0.0, 1.4e-3])
def test_what_a_surface_does_not_tell_stays_as_unsure_as_it_was(planes, free, noise):
    found, error = aligned(planes, np.eye(4), noise)
    assert found.determined == 6 - free
    along = found.undetermined.T @ np.linalg.inv(found.covariance) @ found.undetermined
    sigmas = np.sqrt(1.0 / np.linalg.eigvalsh(along))
    assert (sigmas > 0.08).all()  # 0.1 rad and 0.2 m before
    assert error @ np.linalg.solve(found.covariance, error) < 16.8  # chi2 of six, 99 %
    assert np.linalg.norm(error[3:]) < np.linalg.norm(MOVED[:3, 3])  # the rest is better known


def test_a_wall_does_not_slide():
    found, _ = aligned(WALL, np.eye(4), 1.4e-3)
    across = se3_log(found.T_model_cam)[3:5]
    assert np.linalg.norm(across) < 0.01


def test_the_covariance_covers_the_errors():
    errors = []
    for seed in range(20):
        found, error = aligned(CORNER, INTO_CORNER, 1.4e-3, seed)
        errors.append(float(error @ np.linalg.solve(found.covariance, error)))
    assert np.mean(errors) < 6.0


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 50.0])
def test_depth_that_says_nothing_leaves_the_prior(value):
    model = surface(depth(INTO_CORNER, CORNER))
    nothing = surface(np.full((CAMERA.height, CAMERA.width), value, np.float32))
    assert nothing.share == 0.0
    for frame, other in ((nothing, model), (model, nothing)):
        found = align_depth(frame, [SeenFrom(other, np.eye(4))], Prior(MOVED, UNSURE), SIGMA_RHO)
        assert not found.converged
        assert found.determined == 0
        np.testing.assert_array_equal(found.T_model_cam, MOVED)
        np.testing.assert_array_equal(found.covariance, UNSURE)


def test_a_depth_image_of_another_size_is_refused():
    with pytest.raises(DataError):
        surface(np.ones((10, 10), np.float32))


def in_corner():
    localiser = DepthLocaliser(CAMERA, np.eye(4))
    localiser.add(INTO_CORNER, depth(INTO_CORNER, CORNER, 1.4e-3, 1))
    return localiser, depth(INTO_CORNER @ MOVED, CORNER, 1.4e-3, 2)


def test_a_place_is_found_from_a_guess():
    localiser, seen = in_corner()
    answer = localiser.localise(seen, Guess(INTO_CORNER, 0.1, 5.0))
    assert answer.accepted, answer.reason
    error = se3_log(invert(answer.T_map_body) @ INTO_CORNER @ MOVED)
    assert np.linalg.norm(error[3:]) < 0.01
    assert np.linalg.norm(error[:3]) < np.deg2rad(0.3)


def test_a_thing_that_was_not_there_is_refused():
    localiser, seen = in_corner()
    blocked = seen.copy()
    blocked[:, 100:220] = 0.7  # somebody stands in the middle of the view
    answer = localiser.localise(blocked, Guess(INTO_CORNER, 0.1, 5.0))
    assert not answer.accepted
    assert answer.reason


def test_a_guess_far_from_the_map_and_an_empty_image_are_refused_with_a_reason():
    localiser, seen = in_corner()
    far = INTO_CORNER.copy()
    far[0, 3] -= 5.0
    assert "no keyframe of the map is near" in localiser.localise(seen, Guess(far)).reason
    assert "of the image has depth" in localiser.localise(np.zeros_like(seen), Guess(INTO_CORNER)).reason


def test_a_guess_that_is_no_pose_is_refused():
    localiser, seen = in_corner()
    with pytest.raises(DataError, match="rigid transform"):
        localiser.localise(seen, Guess(np.full((4, 4), np.nan)))
    with pytest.raises(UsageError, match="more than 0"):
        localiser.localise(seen, Guess(INTO_CORNER, 0.0))


def test_the_same_question_has_the_same_answer():
    answers = []
    for _ in range(2):
        localiser, seen = in_corner()
        answers.append(localiser.localise(seen, Guess(INTO_CORNER, 0.1, 5.0)))
    assert answers[0].T_map_body.tobytes() == answers[1].T_map_body.tobytes()
    assert answers[0].covariance.tobytes() == answers[1].covariance.tobytes()
