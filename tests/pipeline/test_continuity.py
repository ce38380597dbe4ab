"""The published pose: at rest it stays, in motion it follows, and what is corrected is not seen as motion."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vislam.config import PublishConfig, load
from vislam.core.geometry import invert, se3_exp, so3_log
from vislam.core.messages import Array
from vislam.pipeline.steps import Step
from vislam.sim.points.points import open_points
from vislam.slam import Slam
from vislam.trajectory.continuity import Continuity

_NS = 1_000_000_000
_FRAME_NS = 50_000_000
_CONFIG = PublishConfig()


def moved(m: float, rad: float = 0.0) -> Array:
    return se3_exp(np.array([0.0, 0.0, rad, m, 0.0, 0.0]))


def step_m(a: Array, b: Array) -> float:
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3]))


def turn_rad(a: Array, b: Array) -> float:
    return float(np.linalg.norm(so3_log(np.ascontiguousarray(a[:3, :3].T @ b[:3, :3]))))


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-0.15, 0.15), min_size=6, max_size=6),
    st.floats(0.005, 0.1),
)
def test_a_correction_at_rest_is_no_step_and_arrives_in_the_end(parts: list[float], dt_s: float) -> None:
    jump = se3_exp(np.array(parts) * [0.3, 0.3, 0.3, 1.0, 1.0, 1.0])
    publisher = Continuity(_CONFIG)
    shown = [publisher.follow(0, np.eye(4), np.eye(4)), publisher.follow(0, np.eye(4), jump)]
    for k in range(1, 60):
        shown.append(publisher.follow(round(k * dt_s * _NS), jump, jump))
    steps = [step_m(a, b) for a, b in pairwise(shown)]
    assert max(steps) <= _CONFIG.creep_m_s * dt_s + 1e-7
    turns = [turn_rad(a, b) for a, b in pairwise(shown)]
    assert max(turns) <= turn_rad(np.eye(4), jump) * dt_s / _CONFIG.turn_s + 1e-7
    last = publisher.follow(300 * _NS, jump, jump)
    assert step_m(last, jump) < 1e-3
    assert turn_rad(last, jump) < 1e-3


def test_a_correction_comes_with_the_way_that_the_body_makes() -> None:
    publisher, T = Continuity(_CONFIG), np.eye(4)
    publisher.follow(0, T, T)
    publisher.follow(0, T, moved(0.3) @ T)
    T = moved(0.3) @ T
    errors = []
    for k in range(1, 41):
        before, T = T, moved(0.05) @ T  # 1 m/s
        shown = publisher.follow(k * _FRAME_NS, T, T)
        errors.append(step_m(shown, T))
        assert errors[-1] <= 0.3
        assert before is not T
    assert errors[-1] < 0.01
    assert np.max(-np.diff(errors)) < _CONFIG.way_share * 0.05 + 0.001


def test_without_a_gyroscope_a_correction_of_orientation_comes_with_the_turn() -> None:
    """By a tenth of it; who has a gyroscope would see that, and gets it by the gyroscope's own drift."""
    left_rad = {}
    for sigma_rad_s in (0.0, np.inf):
        publisher, T, owed = Continuity(_CONFIG), np.eye(4), moved(0.0, 0.03)
        publisher.follow(0, T, T, sigma_rad_s)
        publisher.follow(0, T, owed @ T, sigma_rad_s)
        T = owed @ T
        for k in range(1, 11):  # half a second at rest
            shown = publisher.follow(k * _FRAME_NS, T, T, sigma_rad_s)
        assert turn_rad(shown, T) > 0.029
        turns = []
        for k in range(11, 31):  # one second at 0.4 rad/s
            T = T @ moved(0.0, 0.02)
            turns.append(turn_rad(publisher.follow(k * _FRAME_NS, T, T, sigma_rad_s), T))
        assert np.max(-np.diff(turns)) <= 0.1 * 0.02 + 0.03 * 0.05 / _CONFIG.turn_s + 1e-9
        left_rad[sigma_rad_s] = turns[-1]
    assert left_rad[0.0] > 0.028 and left_rad[np.inf] < 0.001


def test_a_correction_that_is_another_belief_comes_at_once() -> None:
    publisher, far = Continuity(_CONFIG), moved(1.5)
    publisher.follow(0, np.eye(4), np.eye(4))
    np.testing.assert_array_equal(publisher.follow(0, np.eye(4), far)[:3, 3], far[:3, 3])
    turned = far @ moved(0.0, np.deg2rad(8.0))
    np.testing.assert_allclose(publisher.follow(0, far, turned), turned, atol=1e-12)


def test_switched_off_it_shows_every_estimate_as_it_is() -> None:
    publisher = Continuity(replace(_CONFIG, enabled=False))
    publisher.follow(0, np.eye(4), np.eye(4))
    np.testing.assert_allclose(publisher.follow(0, np.eye(4), moved(0.1, 0.02)), moved(0.1, 0.02), atol=1e-12)


def test_a_turned_map_does_not_swing_the_body_at_a_lever_arm() -> None:
    """Fifty metres from the origin, a map that turns by a degree about the body leaves it where it is."""
    T = moved(50.0)
    about_body = T @ moved(0.0, np.deg2rad(1.0)) @ invert(T)
    publisher = Continuity(_CONFIG)
    publisher.follow(0, T, T)
    for k in range(1, 10):
        shown = publisher.follow(k * _FRAME_NS, T if k == 1 else about_body @ T, about_body @ T)
        assert step_m(shown, T) < 1e-9


@pytest.fixture(scope="module", params=["mono, tight", "mono, loose", "stereo, tight", "stereo, loose"])
def steps(request: pytest.FixtureRequest) -> list[tuple[Step, Array]]:
    """A second of rest, 8 s by hand, then rest again: every step with the true pose of its frame."""
    rig, coupling = request.param.split(", ")
    recording = open_points("stop-and-go", 0, rig=rig, start_s=2.0, duration_s=10.5, tracks=100)
    config = load(None, {"map.enabled": False, "ekf.coupling": coupling, "graph.coupling": coupling})
    slam = Slam(config, recording.rig, recording.imu_noise)
    taken = [step for value in recording.events() for step in slam.feed(value)]
    truth = recording.true_states(np.array([step.front.frame.t_ns for step in taken])).T_world_body
    return list(zip(taken, truth, strict=True))


def motions(steps: list[tuple[Step, Array]], name: str) -> list[tuple[Array, Array, float]]:
    """Return between frames the published motion, the true one, and the filter's sigma of position in metres."""
    out = []
    for (a, true_a), (b, true_b) in pairwise(steps):
        shown = [step.T_map_body if name == "map" else step.front.T_odom_body for step in (a, b)]
        if shown[0] is None or shown[1] is None or b.front.state is None:
            continue
        sigma_m = float(np.sqrt(np.trace(b.front.state.covariance[3:6, 3:6])))
        out.append((invert(shown[0]) @ shown[1], invert(true_a) @ true_b, sigma_m))
    return out


@pytest.mark.parametrize("name", ["odom", "map"])
def test_nothing_moves_at_rest(steps: list[tuple[Step, Array]], name: str, request: pytest.FixtureRequest) -> None:
    """Loosely coupled, what a body that has just stopped still has of speed is up to 4.3 mm a frame, one camera."""
    begun = [(step, true) for step, true in steps if step.T_map_body is not None]
    still = [shown for shown, true, _ in motions(begun, name) if np.linalg.norm(true[:3, 3]) < 1e-5]
    assert len(still) > 20
    limit_m = 5e-3 if "mono, loose" in request.node.name else 1e-3
    assert max(np.linalg.norm(shown[:3, 3]) for shown in still) < limit_m


@pytest.mark.parametrize("name", ["odom", "map"])
def test_a_step_errs_less_than_the_filter_says_of_its_place(steps: list[tuple[Step, Array]], name: str) -> None:
    ratios = [
        np.linalg.norm((invert(true) @ shown)[:3, 3]) / (3.0 * sigma_m) for shown, true, sigma_m in motions(steps, name)
    ]
    assert len(ratios) > 120
    assert max(ratios) < 1.0


@pytest.mark.parametrize("name", ["odom", "map"])
def test_orientation_from_frame_to_frame_is_the_gyroscopes(steps: list[tuple[Step, Array]], name: str) -> None:
    errors = [turn_rad(true, shown) for shown, true, _ in motions(steps, name)]
    assert (
        np.rad2deg(np.sqrt(np.mean(np.square(errors)))) < 0.06
    )  # 0.01 of it is the gyroscope's own, the rest its bias as the start knew it


def test_the_published_pose_is_still_the_estimate(
    steps: list[tuple[Step, Array]], request: pytest.FixtureRequest
) -> None:
    apart = [
        step_m(step.front.T_odom_body, step.front.estimate.T_odom_body)
        for step, _ in steps
        if step.front.estimate is not None and step.front.T_odom_body is not None
    ]
    most_m = 0.05 if "mono, loose" in request.node.name else 0.02  # its motions lack scale
    assert np.sqrt(np.mean(np.square(apart))) < most_m


def turns_published(graph_sigma_rad_s: float) -> tuple[Array, Array]:
    """Return attitudes [N, 3, 3] of a body that has set off, as inertial data carry them on, and as estimated.

    The graph says all the time, with this sigma, that the gyro bias about x is 0.01 rad/s more than the filter's.
    """
    recording = open_points("stop-and-go", 0, rig="stereo", start_s=2.0, duration_s=2.5, tracks=60)
    slam = Slam(load(None, {"map.enabled": False, "loop.enabled": False}), recording.rig, recording.imu_noise)
    before, after, update = [], [], None
    for value in recording.events():
        for step in slam.feed(value):
            if step.front.estimate is not None and update is not None:
                before.append(step.front.estimate.T_odom_before[:3, :3])
                after.append(step.front.estimate.T_odom_body[:3, :3])
            update = step.keyframes[-1].update if step.keyframes else update
            if update is not None and step.front.state is not None:
                state, P = step.front.state, np.eye(15) * graph_sigma_rad_s**2
                wrong = replace(state, gyro_bias_rad_s=state.gyro_bias_rad_s + np.array([0.01, 0.0, 0.0]), covariance=P)
                slam.front.feed_back(replace(update, newest=wrong))
    return np.array(before), np.array(after)


def test_turns_are_published_by_the_surer_gyro_bias() -> None:
    """A surer graph turns what is published from frame to frame, an unsure one not; the filter knows of neither."""
    (sure, after_sure), (unsure, after_unsure) = turns_published(1e-6), turns_published(1.0)
    apart = [turn_rad(a, b) for a, b in zip(sure, unsure, strict=True)][-12:]
    assert len(apart) == 12
    np.testing.assert_allclose(apart, 0.01 * 0.05, rtol=0.05)
    np.testing.assert_array_equal(after_sure, after_unsure)
