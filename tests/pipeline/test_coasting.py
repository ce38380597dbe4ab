"""Where a body goes that nothing measures: the spread that is stated covers how far motions really are from habit."""

from dataclasses import replace

import numpy as np
import pytest

from vislam import Frame, Observations
from vislam.core import Tracking, VoMeasurement, invert, se3_log, so3_exp, so3_log, transform
from vislam.core.chi_square import chi_square_limit
from vislam.frontend import TrackResult
from vislam.pipeline.chain import KeyframeChain
from vislam.pipeline.coasting import Coasting
from vislam.pipeline.dark import unseen_keyframe
from vislam.sim.motion.motions import world_motion

NS = 1_000_000_000


@pytest.mark.parametrize("name", ["laps", "stop-and-go", "cart-laps"])
def test_the_stated_covariance_covers_how_far_worlds_are_from_constant_velocity(name: str) -> None:
    spline = world_motion(name, np.random.default_rng(5), 60.0)
    t_s = np.arange(0.0, 59.0, 0.1)
    poses, coasting, beyond, asked = spline.at(t_s).T_world_body, Coasting(), 0, 0
    for k, T in enumerate(poses[:-30]):
        coasting.follow(round(t_s[k] * NS), T)
        for ahead in (2, 5, 10, 25) if k > 20 else ():
            found = coasting.ahead(round(t_s[k + ahead] * NS))
            assert found is not None
            off = se3_log(invert(T @ found[0]) @ poses[k + ahead])
            beyond += off @ np.linalg.solve(found[1], off) > chi_square_limit(0.99, 6)
            asked += 1
    assert beyond <= 0.03 * asked  # brakes and turns come at once: of 100 that should be inside, 97 are


def test_a_body_in_steady_motion_goes_on_and_one_without_habit_nowhere() -> None:
    coasting = Coasting()
    assert coasting.ahead(0) is None
    step = transform(so3_exp(np.array([0.0, 0.0, 0.02])), np.array([0.1, 0.0, 0.0]))
    T = np.eye(4)
    for k in range(30):
        coasting.follow(k * NS // 10, T)
        T = T @ step
    short, long = coasting.ahead(round(3.0 * NS)), coasting.ahead(round(3.4 * NS))
    assert short is not None and long is not None
    np.testing.assert_allclose(short[0], step, atol=2e-3)
    np.testing.assert_allclose(long[0], np.linalg.matrix_power(step, 5), atol=0.03)
    assert 0.0 < so3_log(long[0][:3, :3])[2] < 0.1  # who turns is about to stop
    assert long[1][3, 3] > 50.0 * short[1][3, 3]
    coasting.restart()
    assert coasting.ahead(round(4.0 * NS)) is None


def test_a_turn_that_ends_while_nothing_is_seen_is_within_what_is_stated() -> None:
    """As of a camera in a hand, 170 deg/s, whose motion before was calm."""
    coasting, T, rates_deg_s = Coasting(), np.eye(4), [20.0] * 60 + [50.0, 90.0, 130.0, 170.0]
    for k, rate_deg_s in enumerate(rates_deg_s):
        T = T @ transform(so3_exp(np.deg2rad([0.0, 0.1 * rate_deg_s, 0.0])), np.array([0.05, 0.0, 0.0]))
        coasting.follow(k * NS // 10, T)
    found = coasting.ahead((len(rates_deg_s) + 4) * NS // 10)
    assert found is not None
    true = transform(so3_exp(np.deg2rad([0.0, 31.0, 0.0])), np.array([0.25, 0.0, 0.0]))
    off = se3_log(invert(found[0]) @ true)
    assert np.linalg.norm(off[:3]) < np.deg2rad(45.0)  # 54 at a constant rate
    assert off @ np.linalg.solve(found[1], off) < chi_square_limit(0.9, 6)


def test_a_submap_that_habit_ties_takes_its_velocity_on_and_what_is_not_known_of_it() -> None:
    through, over = Coasting(), Coasting()
    for coasting in (through, over):
        for k in range(30):
            coasting.follow(k * NS // 10, transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0])))
    over.go_on(33 * NS // 10, transform(np.eye(3), np.array([3.3, 0.0, 0.0])))
    whole, rest = through.ahead(37 * NS // 10), over.ahead(37 * NS // 10)
    assert whole is not None and rest is not None
    np.testing.assert_allclose(rest[0][:3, 3], [0.4, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(rest[1], whole[1])  # no less: the velocity is as old
    fresh = Coasting()
    fresh.go_on(0, np.eye(4))
    assert fresh.ahead(NS) is None


def test_a_pose_known_worse_than_a_jerk_takes_a_body_tells_nothing_of_its_velocity() -> None:
    coasting = Coasting()
    for k in range(10):
        assert coasting.follow(k * NS // 10, transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0])), 0.01)
    assert not coasting.follow(NS, transform(np.eye(3), np.array([0.1, 0.0, 0.0])), 0.6)
    ahead = coasting.ahead(round(1.1 * NS))
    assert ahead is not None
    np.testing.assert_allclose(ahead[0][:3, 3], [0.2, 0.0, 0.0], atol=1e-6)


def test_a_wild_motion_leaves_less_to_expect() -> None:
    calm, wild, rng = Coasting(), Coasting(), np.random.default_rng(2)
    T_calm, T_wild, speed = np.eye(4), np.eye(4), np.zeros(3)
    for k in range(100):
        speed = 0.9 * speed + 0.2 * rng.normal(size=3)
        T_calm, T_wild = T_calm @ transform(np.eye(3), np.array([0.1, 0.0, 0.0])), T_wild @ transform(np.eye(3), speed)
        calm.follow(k * NS // 10, T_calm)
        wild.follow(k * NS // 10, T_wild)
    one, other = calm.ahead(105 * NS // 10), wild.ahead(105 * NS // 10)
    assert one is not None and other is not None
    assert other[1][3, 3] > 10.0 * one[1][3, 3]


@pytest.mark.parametrize(("off_m", "is_lost", "is_refused"), [
    (0.15, False, False), (0.5, False, True), (0.05, True, False), (0.15, True, True),
])  # fmt: skip
def test_a_frame_one_panel_off_is_refused_and_a_jerk_only_after_a_loss(
    off_m: float, is_lost: bool, is_refused: bool
) -> None:
    chain = KeyframeChain(np.eye(4), 5.0)
    placed = VoMeasurement(0, -1, np.eye(4), np.eye(6) * 1e-6, True, Tracking.OK, 50)
    for k in range(20):
        moved = transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
        chain.follow(replace(placed, t_ns=k * NS // 10, T_keyframe_body=moved), False)
    frames = 1
    if is_lost:
        chain.follow(replace(placed, t_ns=2 * NS, T_keyframe_body=None, tracking=Tracking.LOST), False)
        frames = 2
    moved = transform(np.eye(3), np.array([1.9 + 0.1 * frames - off_m, 0.0, 0.0]))
    assert chain.contradicts(replace(placed, t_ns=(19 + frames) * NS // 10, T_keyframe_body=moved)) is is_refused


@pytest.mark.parametrize("is_torn", [False, True])
def test_a_submap_is_tied_by_habit_unless_an_unknown_time_has_passed(is_torn: bool) -> None:
    chain, frame = KeyframeChain(np.eye(4), 5.0), Frame(2 * NS, 20, ())
    for k in range(20):
        moved = transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
        chain.follow(VoMeasurement(k * NS // 10, 0, moved, np.eye(6) * 1e-6, True, Tracking.OK, 50), False)
    placed = VoMeasurement(2 * NS, 0, np.eye(4), np.eye(6), True, Tracking.OK, 50)
    nothing = Observations(np.empty(0, np.int64), np.empty((0, 2)))
    first = TrackResult(placed, nothing, unseen_keyframe(0, frame), 0.0, "")
    chain.extend(chain.packet(first, unseen_keyframe(0, frame), None, None, 0.0), None, None)
    if is_torn:
        chain.tear()
    keyframe = unseen_keyframe(1, frame)
    lost = VoMeasurement(2 * NS, 0, None, np.eye(6), True, Tracking.LOST, 0)
    track = TrackResult(lost, nothing, keyframe, 0.0, "")
    assert chain.packet(track, keyframe, None, None, 0.0).is_tied is not is_torn
