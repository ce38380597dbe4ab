"""What the front half does to its filter is done to the filter that is published, breaks of the stream included."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from vislam import Slam, open_source
from vislam.config import load
from vislam.core import Frame, ImuSample, NavState, Observations
from vislam.hw.health import Health
from vislam.live.corrections import Corrections
from vislam.live.fast import FastPath
from vislam.live.wire.published_pose import PublishedPose

_WORLD = "points:laps,rig=stereo,camera_hz=10,tracks=60,duration_s="
_LOOSE = {"ekf.coupling": "loose", "loop.enabled": False, "map.enabled": False}


def drive(
    seconds: int, options: dict[str, Any], change: Callable[[Any, float], Any]
) -> tuple[list[PublishedPose], dict[str, int], list[NavState]]:
    """Return poses after each message and at the end, messages by kind, and the front half's states."""
    config, recording = load(overrides=_LOOSE | options), open_source(f"{_WORLD}{seconds}")
    assert recording.imu_noise is not None
    slam, published = Slam(config, recording.rig, recording.imu_noise), list[PublishedPose]()
    fast = FastPath(config, recording.imu_noise, recording.rig.T_body_cam0, published.append)
    corrections, told, states = Corrections(slam.front), dict[str, int](), list[NavState]()
    events = recording.events()
    first_ns = next(events).t_ns
    for event in events:
        if (value := change(event, (event.t_ns - first_ns) * 1e-9)) is None:
            continue
        if isinstance(value, ImuSample):
            fast.add(value)
        for step in slam.feed(value):
            for message in corrections.of_step(step.front):
                fast.correct(message)
                told[type(message).__name__] = told.get(type(message).__name__, 0) + 1
                fast.publish(0, lambda: Health(0))
        assert slam.front.inertial is not None
        if (state := slam.front.inertial.filtering.state) is not None:
            states.append(state)
    fast.publish(0, lambda: Health(0))
    assert fast.counters["rebases"] == told.get("Rebase", 0)
    return published, told, states


def test_after_a_hole_in_camera_and_imu_both_filters_begin_again_alike() -> None:
    """In the hole the body may have turned by any angle: the loose filter is levelled by the samples after it."""
    alike = {"publish.enabled": False}
    published, told, states = drive(8, alike, lambda value, since_s: None if 3.0 < since_s < 5.5 else value)
    assert told["Rebase"] == 1
    assert published[-1].t_ns == states[-1].t_ns
    T = states[-1].T_world_body
    np.testing.assert_allclose(published[-1].T_odom_base, T, atol=1e-9)
    np.testing.assert_allclose(published[-1].velocity_m_s, T[:3, :3].T @ states[-1].velocity_world_m_s, atol=1e-6)


def test_many_short_holes_without_sight_do_not_carry_the_filter_away() -> None:
    """None is long enough to begin again, and together they leave neither tilt nor speed."""

    def blind(value: Any, since_s: float) -> Any:
        if since_s < 3.0:
            return value
        if isinstance(value, Frame):
            return replace(value, tracks=Observations(np.zeros(0, dtype=np.int64), np.zeros((0, 2))))
        return None if since_s % 1.2 < 0.9 else value

    _, told, states = drive(20, {}, blind)
    assert told["Rebase"] > 1
    assert max(np.linalg.norm(state.velocity_world_m_s) for state in states) < 10.0
    assert max(np.linalg.norm(state.T_world_body[:3, 3]) for state in states) < 20.0


def test_a_run_that_gives_gravity_up_publishes_no_pose_from_a_guess() -> None:
    """It begins in motion: a state level by the newest samples alone is never confirmed, and vision goes on alone."""
    give_up = {"init.give_up_s": 1.0}
    published, told, _ = drive(8, give_up, lambda value, since_s: None if since_s < 3.0 else value)
    assert told["Start"] and told["GaveUp"]
    assert Health.INVALID in published[-1].health and np.isinf(published[-1].pose_covariance).all()
    assert published[-1].reset_counter > published[0].reset_counter
