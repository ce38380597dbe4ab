"""The fast path: a twin of vision's filter that publishes at the rate of samples and says what its poses are worth."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from multiprocessing import Pipe

import numpy as np
import pytest

from vislam import open_source
from vislam.config import Config, load
from vislam.core import Frame, ImuSample, MagSample, StageClock
from vislam.core.geometry import invert, se3_exp, so3_log, transform
from vislam.ekf import Correction, Ekf, Hint
from vislam.frontend.result import lost_motion
from vislam.hw.health import Health
from vislam.live.corrections import Corrections
from vislam.live.fast import FastPath
from vislam.live.notices import CameraHealth, Doubted, MapMoved, ToFast
from vislam.live.processes.fast import Messages
from vislam.live.wire.published_pose import PublishedPose
from vislam.pipeline import Front, odometry
from worlds.corrections import CART_IMU, CONFIG, VisionWorld
from worlds.motion import T0_NS
from worlds.parts import GRAVITY_M_S2, MACHINE

_WELL = lambda: Health(0)  # noqa: E731
_LATE_NS = 90_000_000


def run(
    world: VisionWorld, late_ns: int = _LATE_NS, others: list[tuple[int, ToFast]] | None = None, config: Config = CONFIG
) -> tuple[FastPath, list[PublishedPose], list[Hint]]:
    """Feed samples at their times and messages `late_ns` after theirs; publish with each sample."""
    poses: list[PublishedPose] = []
    fast = FastPath(config, CART_IMU, np.eye(4), poses.append)
    waiting: list[tuple[int, ToFast]] = [(world.start.state.t_ns + late_ns, world.start)]
    waiting += [(c.t_ns + late_ns, c) for c in world.corrections] + (others or [])
    waiting.sort(key=lambda entry: entry[0])
    hints = []
    for sample in world.samples:
        hint = fast.add(sample)
        hints += [] if hint is None else [hint]
        while waiting and waiting[0][0] <= sample.t_ns:
            fast.correct(waiting.pop(0)[1])
        fast.publish(sample.t_ns + 200_000, _WELL)
    return fast, poses, hints


@pytest.fixture(scope="module")
def world() -> VisionWorld:
    return VisionWorld.make(seed=4, duration_s=12.0)


def true_position(world: VisionWorld, t_ns: int) -> np.ndarray:
    return world.motion.pose((t_ns - T0_NS) * 1e-9)[:3, 3]


def test_it_agrees_with_a_filter_that_got_everything_in_time(world: VisionWorld) -> None:
    """The twin beside vision hears of frames at once; this one late. They have to agree or `odom` is two frames."""
    twin = Ekf(CONFIG.ekf, CART_IMU, MACHINE, np.eye(4))
    events = sorted([*world.samples, *world.corrections], key=lambda e: (e.t_ns, isinstance(e, Correction)))
    for event in events:
        if isinstance(event, ImuSample):
            twin.predict(event)
        elif not twin.initialised:
            twin.initialise(world.start.state, world.start.vo)
            event.apply(twin)
        else:
            event.apply(twin)
    bare = replace(CONFIG, publish=replace(CONFIG.publish, enabled=False))  # the estimate itself
    _, poses, _ = run(world, late_ns=_LATE_NS, config=bare)
    settled = [pose for pose in poses if pose.t_ns > T0_NS + int(3e9)]
    fast, _, _ = run(world, late_ns=0)
    assert fast.filter_counters["vo_accepted"] > 80
    final, on_time = settled[-1], twin.state()
    late, poses_late, _ = run(world, late_ns=_LATE_NS, config=bare)
    assert late.filter_counters["rewinds"] > 80
    # both of this process's filters have now seen all that is older than the last frames: bring these in, too
    for correction in world.corrections:
        if correction.t_ns + _LATE_NS > world.samples[-1].t_ns:
            late.correct(correction)
    late.publish(final.published_ns + 1, _WELL)  # the newest pose after all is in
    np.testing.assert_allclose(poses_late[-1].T_odom_base, on_time.T_world_body, atol=1e-9)


def test_poses_are_near_the_truth_and_their_covariance_says_how_near(world: VisionWorld) -> None:
    _, poses, _ = run(world)
    errors, nees = [], []
    for pose in poses[200::10]:
        e = pose.T_odom_base[:3, 3] - true_position(world, pose.t_ns)
        errors.append(np.linalg.norm(e))
        nees.append(e @ np.linalg.solve(pose.pose_covariance[:3, :3], e))
    assert np.max(errors) < 0.2
    assert 0.2 < np.mean(nees) < 9.0  # one run, errors correlated in time: a coarse check
    speeds = [p.velocity_m_s @ p.velocity_m_s for p in poses[200:]]
    truth = [world.motion.at((p.t_ns - T0_NS) * 1e-9)[1] for p in poses[200:]]
    assert np.sqrt(np.mean([(np.sqrt(s) - np.linalg.norm(v)) ** 2 for s, v in zip(speeds, truth, strict=True)])) < 0.05


def test_odom_does_not_jump_when_a_large_loop_closes(world: VisionWorld) -> None:
    """A loop moves map by five metres and a radian; nothing of it may be seen in odom."""
    at_ns = T0_NS + int(6e9)
    jump = MapMoved(7, se3_exp(np.array([0.0, 0.0, 1.0, 4.0, -3.0, 0.1])))
    _, poses, _ = run(world, others=[(at_ns, jump)])
    _, without, _ = run(world)
    assert [p.map_revision for p in (poses[500], poses[-1])] == [0, 7]
    assert np.linalg.norm(poses[-1].T_map_odom[:3, 3]) > 4.0
    fastest = max(np.linalg.norm(world.motion.at(t)[1]) for t in np.arange(0.0, 12.0, 0.05))
    for before, after, same in zip(poses[150:-1], poses[151:], without[151:], strict=False):
        dt = (after.t_ns - before.t_ns) * 1e-9
        moved = np.linalg.norm(after.T_odom_base[:3, 3] - before.T_odom_base[:3, 3])
        assert moved < fastest * dt + 0.03  # a correction by vision, late by 90 ms, is a step of millimetres
        np.testing.assert_array_equal(after.T_odom_base, same.T_odom_base)


def test_a_doubt_travels_with_every_pose_until_it_is_over(world: VisionWorld) -> None:
    begin_ns, end_ns = T0_NS + int(4e9), T0_NS + int(6e9)
    _, poses, _ = run(world, others=[(begin_ns, Doubted(True)), (end_ns, Doubted(False))])
    doubted = [pose.t_ns for pose in poses if Health.DOUBTFUL in pose.health]
    assert doubted == [pose.t_ns for pose in poses if begin_ns <= pose.t_ns < end_ns]
    assert not any(Health.INVALID in pose.health for pose in poses if pose.t_ns in set(doubted))


def test_an_older_revision_of_the_map_does_not_overtake_a_newer_one(world: VisionWorld) -> None:
    new, old = MapMoved(9, transform(np.eye(3), np.ones(3))), MapMoved(8, np.eye(4))
    _, poses, _ = run(world, others=[(T0_NS + int(2e9), new), (T0_NS + int(3e9), old)])
    assert poses[-1].map_revision == 9
    np.testing.assert_allclose(poses[-1].T_map_odom, new.T_map_odom, atol=1e-3)


def test_a_correction_by_vision_or_by_the_map_is_no_step_of_the_published_pose(world: VisionWorld) -> None:
    """Half a metre of correction by the graph, at 200 Hz: both poses go on as the body does, and the map arrives."""
    at_ns, moved = T0_NS + int(4e9), MapMoved(7, transform(np.eye(3), np.array([0.3, -0.4, 0.0])))
    _, poses, _ = run(world, others=[(at_ns, moved)])
    _, without, _ = run(world)
    for a, b in pairwise(pose for pose in poses if pose.t_ns > T0_NS + int(2e9)):
        steps = (invert(a.T_odom_base) @ b.T_odom_base, invert(a.T_map_base) @ b.T_map_base)
        true = invert(world.motion.pose((a.t_ns - T0_NS) * 1e-9)) @ world.motion.pose((b.t_ns - T0_NS) * 1e-9)
        for step in steps:
            error = invert(true) @ step
            assert np.linalg.norm(error[:3, 3]) < 0.005 + 0.5 * np.linalg.norm(true[:3, 3])
            assert np.linalg.norm(so3_log(np.ascontiguousarray(error[:3, :3]))) < 1e-3
    there = moved.T_map_odom @ without[-1].T_odom_base
    np.testing.assert_allclose(poses[-1].T_map_base[:3, 3], there[:3, 3], atol=0.02)


def test_a_place_that_is_found_is_taken_at_once_and_none_is_claimed_before(world: VisionWorld) -> None:
    """In the map of another run: what was half a metre off until then is not paid back with motion; odom never jumps.

    What comes after is: ten centimetres more are no step of the pose in map.
    """
    begin_ns, found_ns, later_ns = (T0_NS + int(s * 1e9) for s in (0.1, 4.0, 6.0))
    found, later = (transform(np.eye(3), np.array([x, -0.4, 0.0])) for x in (0.3, 0.4))
    moves = [MapMoved(3, np.eye(4), False), MapMoved(4, found, True), MapMoved(5, later, True)]
    others = list(zip((begin_ns, found_ns, later_ns), moves, strict=True))
    _, poses, _ = run(world, others=others)
    _, without, _ = run(world)
    for pose, same in zip(poses, without, strict=True):
        np.testing.assert_array_equal(pose.T_odom_base, same.T_odom_base)
    nowhere = {pose.t_ns for pose in poses if Health.NOT_IN_MAP in pose.health}
    assert nowhere == {pose.t_ns for pose in poses if begin_ns <= pose.t_ns < found_ns}
    smoothed = [invert(same.T_map_odom) @ pose.T_map_odom for pose, same in zip(poses, without, strict=True)]
    off_m = {pose.t_ns: np.linalg.norm((T - found)[:3, 3]) for pose, T in zip(poses, smoothed, strict=True)}
    first_ns = min(t for t in off_m if t >= found_ns)
    print(f"off where it was found by {1e3 * off_m[first_ns]:.2f} mm")
    assert off_m[first_ns] < 0.02  # what corrections of the filter are still owed in odom
    steps = np.abs(np.diff([off_m[t] for t in sorted(off_m) if t >= later_ns - 10_000_000]))
    assert steps.max() < 0.01
    assert off_m[max(off_m)] == pytest.approx(0.1, abs=0.02)


def test_an_outage_is_dead_reckoning_at_once_invalid_by_sigma_and_over_when_vision_is_back() -> None:
    world = VisionWorld.make(seed=6, duration_s=24.0).lost(6.0, 16.0)
    lost = lost_motion(T0_NS + int(6e9), 6, True)
    frame = Correction(lost.t_ns, lost, world.corrections[0].observations, False, False, None)
    _, poses, _ = run(world, others=[(lost.t_ns + _LATE_NS, frame)])
    by_time = {round((p.t_ns - T0_NS) * 1e-9, 2): p for p in poses}
    assert Health.VISION_OK in by_time[6.0].health
    assert Health.INVALID not in by_time[6.0].health
    first = by_time[6.1]
    assert Health.DEAD_RECKONING in first.health
    assert Health.VISION_OK not in first.health
    invalid = [t for t, p in by_time.items() if 6.1 < t < 16.0 and Health.INVALID in p.health]
    assert invalid, "sigma never passed the limit in ten seconds"
    grown = by_time[invalid[0]].pose_covariance.trace() - by_time[6.0].pose_covariance.trace()
    sigma_v = np.sqrt(np.trace(by_time[invalid[0]].twist_covariance[:3, :3]))
    assert grown > 0.8 * CONFIG.live.drift_sigma_m**2 or sigma_v > 0.8 * CONFIG.live.velocity_sigma_m_s
    assert by_time[15.0].vision_age_s == pytest.approx(9.1, abs=0.15)


def test_a_camera_that_comes_back_makes_the_pose_valid_again() -> None:
    """The front end starts a new keyframe after the hole; the filter goes on from where it is, without a jump."""
    world = VisionWorld.make(seed=6, duration_s=20.0)
    hole = world.lost(6.0, 9.0)
    first = next(c for c in hole.corrections if (c.t_ns - T0_NS) * 1e-9 >= 9.0)
    again = Correction(
        first.t_ns, lost_motion(first.t_ns, 5, True), first.observations, False, False, first.vo.keyframe_id
    )
    _, poses, _ = run(hole, others=[(first.t_ns, again)])
    back = [p for p in poses if p.t_ns > T0_NS + int(12e9)]
    assert all(Health.VISION_OK in p.health and Health.INVALID not in p.health for p in back[::20])
    steps = [np.linalg.norm(b.T_odom_base[:3, 3] - a.T_odom_base[:3, 3]) for a, b in pairwise(back)]
    assert max(steps) < 0.08


def test_no_samples_is_told_at_once_and_over_when_they_are_back(world: VisionWorld) -> None:
    hole = [s for s in world.samples if not 7.0 <= (s.t_ns - T0_NS) * 1e-9 < 8.0]
    fast, poses, _ = run(replace(world, samples=hole))
    assert fast.filter_counters["imu_gaps"] == 1
    fast.publish(world.samples[-1].t_ns + 150_000_000, _WELL)  # a heartbeat without a sample
    assert Health.IMU_MISSING in poses[-1].health
    assert Health.INVALID in poses[-1].health
    assert poses[-1].t_ns == world.samples[-1].t_ns
    assert Health.IMU_MISSING not in poses[-2].health
    assert Health.INVALID not in poses[-2].health


def test_a_step_of_the_clock_that_tears_a_tight_filter_reaches_the_published_one() -> None:
    recording = open_source("points:laps,rig=stereo,duration_s=6,camera_hz=10,tracks=80")
    config, poses = load(None, {"ekf.coupling": "tight"}), list[PublishedPose]()
    front = Front(config, recording.rig, recording.imu_noise, StageClock())
    corrections = Corrections(front)
    fast = FastPath(config, recording.imu_noise, np.eye(4), poses.append)

    def values() -> Iterator[ImuSample | MagSample | Frame]:
        for value in recording.events():
            if isinstance(value, ImuSample):
                fast.add(value)
            yield replace(value, follows_step=value.index == 40) if isinstance(value, Frame) else value

    sigmas_m: dict[int, float] = {}
    for step in odometry(front, values()):
        for message in corrections.of_step(step):
            fast.correct(message)
        fast.publish(step.frame.t_ns, _WELL)
        sigmas_m[step.frame.index] = float(np.sqrt(poses[-1].pose_covariance[0, 0]))
    assert sigmas_m[39] < 0.5 and sigmas_m[40] > 4.0


def test_before_the_start_poses_say_that_they_are_none() -> None:
    poses: list[PublishedPose] = []
    fast = FastPath(CONFIG, CART_IMU, np.eye(4), poses.append)
    fast.publish(10**12, lambda: Health.IMU_MISSING | Health.GYRO_FAULT)
    assert poses[0].health == Health.INVALID | Health.IMU_MISSING | Health.GYRO_FAULT
    assert np.isinf(poses[0].pose_covariance).all()
    fast.correct(CameraHealth(Health.CAMERA_MISSING))
    fast.publish(10**12 + 1, _WELL)
    assert Health.CAMERA_MISSING in poses[1].health
    assert Health.GYRO_FAULT in poses[1].health  # passing events stay for half a second
    fast.publish(10**12 + int(2e9), _WELL)
    assert Health.GYRO_FAULT not in poses[2].health


def test_a_cart_that_stands_while_the_camera_is_away_does_not_drift() -> None:
    """Rest from inertial data alone: offered while the filter sees no speed, and the other twin is told."""
    rng = np.random.default_rng(8)
    world = VisionWorld.make(seed=6, duration_s=3.0)
    white = np.repeat([CART_IMU.gyroscope_noise_density, CART_IMU.accelerometer_noise_density], 3) * np.sqrt(
        CART_IMU.rate_hz
    )
    values = np.array([0.01, -0.02, 0.005, 0.02, -0.03, GRAVITY_M_S2 + 0.02]) + rng.normal(size=(4000, 6)) * white
    samples = [ImuSample(T0_NS + k * 10_000_000, v[:3].copy(), v[3:].copy()) for k, v in enumerate(values)]
    still = replace(world.start.state, T_world_body=np.eye(4), velocity_world_m_s=np.zeros(3))
    begun = replace(world.start, state=replace(still, gyro_bias_rad_s=values[0, :3] * 0.0))
    sigmas = np.repeat([1e-3, 1e-3, 0.02, 0.03, 0.05], 3)
    begun = replace(begun, state=replace(begun.state, covariance=np.diag(sigmas**2)))
    fast, poses, hints = run(replace(world, samples=samples, start=begun, corrections=[]))
    assert len(hints) > 350
    assert fast.counters["rests_without_vision"] > 350
    assert np.linalg.norm(poses[-1].T_odom_base[:3, 3]) < 0.1
    assert Health.AT_REST in poses[-1].health
    assert Health.INVALID not in poses[-1].health


def test_messages_are_taken_one_at_a_time_until_their_sender_ends() -> None:
    """A sample waits for one at most; a process that was killed in the middle of one does no harm."""
    (hears_a, says_a), (hears_b, says_b) = Pipe(duplex=False), Pipe(duplex=False)
    messages, taken = Messages([hears_a, hears_b]), []
    messages.take(taken.append)
    assert taken == []
    for number in (1, 2):
        says_a.send(number)
    says_b.send(3)
    says_b.close()
    for expected in ([1, 3], [1, 3, 2], [1, 3, 2]):
        messages.take(taken.append)
        assert taken == expected
    os.write(says_a.fileno(), b"\0\0\0\7half")
    says_a.close()
    messages.take(taken.append)
    messages.take(taken.append)
    assert taken == [1, 3, 2]


def test_the_fast_process_loads_no_heavy_package() -> None:
    code = (
        "import vislam.live.processes.fast, sys; "
        "print([m for m in ('gtsam', 'open3d', 'cv2', 'rerun', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
