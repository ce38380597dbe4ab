"""What the front half does to its filter is done to the filter that is published, breaks of the stream included."""

import numpy as np

from vislam import Slam, open_source
from vislam.config import load
from vislam.core import ImuSample
from vislam.hw.health import Health
from vislam.live.corrections import Corrections
from vislam.live.fast import FastPath
from vislam.live.notices import GaveUp, Start
from vislam.live.wire.published_pose import PublishedPose

_WORLD = "points:laps,rig=stereo,camera_hz=10,tracks=60,duration_s=8"
_NS = 1_000_000_000


def test_after_a_hole_in_camera_and_imu_both_filters_begin_again_alike() -> None:
    """In the hole the body may have turned by any angle: the loose filter is levelled by the samples after it."""
    options = {"ekf.coupling": "loose", "loop.enabled": False, "map.enabled": False, "publish.enabled": False}
    config, recording = load(overrides=options), open_source(_WORLD)
    assert recording.imu_noise is not None
    slam, published = Slam(config, recording.rig, recording.imu_noise), list[PublishedPose]()
    fast = FastPath(config, recording.imu_noise, recording.rig.T_body_cam0, published.append)
    corrections = Corrections(slam.front)
    events = recording.events()
    first_ns = next(events).t_ns
    for value in events:
        if 3 * _NS < value.t_ns - first_ns < 5.5 * _NS:
            continue
        if isinstance(value, ImuSample):
            fast.add(value)
        for step in slam.feed(value):
            for message in corrections.of_step(step.front):
                fast.correct(message)
    fast.publish(0, lambda: Health(0))
    assert fast.counters["rebases"] == 1
    assert slam.front.inertial is not None
    state = slam.front.inertial.filtering.state
    assert state is not None
    assert published[-1].t_ns == state.t_ns
    np.testing.assert_allclose(published[-1].T_odom_base, state.T_world_body, atol=1e-9)
    np.testing.assert_allclose(
        published[-1].velocity_m_s, state.T_world_body[:3, :3].T @ state.velocity_world_m_s, atol=1e-6
    )


def test_a_run_that_gives_gravity_up_publishes_no_pose_from_a_guess() -> None:
    """It begins in motion: a state level by the newest samples alone is never confirmed, and vision goes on alone."""
    options = {"ekf.coupling": "loose", "loop.enabled": False, "map.enabled": False, "init.give_up_s": 1.0}
    config, recording = load(overrides=options), open_source(_WORLD)
    assert recording.imu_noise is not None
    slam, published = Slam(config, recording.rig, recording.imu_noise), list[PublishedPose]()
    fast = FastPath(config, recording.imu_noise, recording.rig.T_body_cam0, published.append)
    corrections, told = Corrections(slam.front), set[type]()
    events = recording.events()
    first_ns = next(events).t_ns
    for value in events:
        if value.t_ns - first_ns < 3 * _NS:
            continue
        if isinstance(value, ImuSample):
            fast.add(value)
        for step in slam.feed(value):
            for message in corrections.of_step(step.front):
                fast.correct(message)
                told.add(type(message))
                fast.publish(0, lambda: Health(0))
    fast.publish(0, lambda: Health(0))
    assert {Start, GaveUp} <= told
    assert Health.INVALID in published[-1].health and np.isinf(published[-1].pose_covariance).all()
    assert published[-1].reset_counter > published[0].reset_counter
