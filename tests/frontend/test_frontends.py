"""The three front ends on drawn worlds with exact truth, and on every kind of bad frame."""

import hashlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import invert, se3_log
from vislam.core.messages import Array, Frame, ImuSpan, Tracking
from vislam.frontend import FrontEnd, TrackResult, make_frontend
from worlds.corner import FRAME_NS, T_BODY_CAM, World, path

CONFIG = FrontEndConfig(track_sigma_px=0.1, readout_s=0.0, keyframe_parallax_px=12.0, described_features=300)
VISION_ALONE = replace(CONFIG, depth_alone=False)
COUNT = 50


@cache
def recording(kind: str) -> tuple[World, tuple[Frame, ...], Array]:
    world = World(kind)
    poses = path(COUNT)
    return world, tuple(world.frames(poses)), poses


def run(kind: str, frames: tuple[Frame, ...] | list[Frame], config: FrontEndConfig = CONFIG) -> list[TrackResult]:
    front_end = make_frontend(config, recording(kind)[0].rig, seed=3)
    assert front_end.mode == kind
    return [front_end.track(frame, None) for frame in frames]


@cache
def usual(kind: str) -> list[TrackResult]:
    """What the front end makes of a whole recording."""
    return run(kind, recording(kind)[1])


def motions(
    results: list[TrackResult], frames: list[Frame] | tuple[Frame, ...], poses: Array
) -> list[tuple[Array, Array, TrackResult]]:
    """Pair each measured motion with the true one: (true T_key_body, measured, result)."""
    pairs, key = [], {}
    for result, frame, T in zip(results, frames, poses, strict=True):
        if result.vo.T_keyframe_body is not None and key:
            pairs.append((invert(key[result.vo.keyframe_id]) @ T, result.vo.T_keyframe_body, result))
        if result.keyframe is not None:
            whole = result.keyframe.frame
            assert whole.index == frame.index and all(a is b for a, b in zip(whole.images, frame.images, strict=True))
            key[result.keyframe.id] = T
    return pairs


def digest(results: list[TrackResult]) -> str:
    sha = hashlib.sha256()
    for r in results:
        for part in (r.vo.T_keyframe_body, r.vo.covariance, r.observations.track_ids, r.observations.pixels_px):
            sha.update(b"-" if part is None else np.ascontiguousarray(part).tobytes())
        if r.keyframe is not None:
            sha.update(r.keyframe.descriptors.tobytes() + r.keyframe.keypoints_px.tobytes())
    return sha.hexdigest()


@pytest.mark.parametrize("kind", ["rgbd", "stereo"])
def test_metric_motion_is_accurate_and_its_covariance_honest(kind: str) -> None:
    _, frames, poses = recording(kind)
    results = usual(kind)
    assert all(r.vo.tracking is Tracking.OK for r in results)
    errors = [(se3_log(invert(true) @ T), r.vo.covariance) for true, T, r in motions(results, frames, poses)]
    rotation = np.array([np.linalg.norm(e[:3]) for e, _ in errors])
    translation = np.array([np.linalg.norm(e[3:]) for e, _ in errors])
    assert np.rad2deg(rotation.max()) < 0.15 and translation.max() < 0.008
    assert np.median(translation) < 0.003
    nees = np.array([e @ np.linalg.solve(C, e) / 6.0 for e, C in errors])
    # drawn walls have no lens, and are sharper than any image: tracks scatter by a fifth of the noise that is told
    assert 0.05 < np.median(nees) < 2.0
    ids = [r.keyframe.id for r in results if r.keyframe is not None]
    assert ids == list(range(len(ids))) and 3 <= len(ids) <= 15


@pytest.mark.parametrize("kind", ["rgbd", "stereo"])
def test_the_chain_of_keyframes_ends_where_the_camera_is(kind: str) -> None:
    _, _, poses = recording(kind)
    T_odom_key, T = np.eye(4), np.eye(4)
    for result in usual(kind):
        assert result.vo.T_keyframe_body is not None
        T = T_odom_key @ result.vo.T_keyframe_body
        if result.keyframe is not None:
            T_odom_key = T
    error = se3_log(invert(poses[-1]) @ T)
    assert np.linalg.norm(error[3:]) < 0.012 and np.rad2deg(np.linalg.norm(error[:3])) < 0.25


def test_mono_tells_rotation_and_direction_of_the_camera() -> None:
    _, frames, poses = recording("mono")
    results = usual("mono")
    assert all(r.vo.tracking is Tracking.OK and not r.vo.has_scale for r in results)
    lever = T_BODY_CAM[:3, 3]
    nees, angles, turned = [], [], []
    for true, T, r in motions(results, frames, poses):
        turned.append(np.rad2deg(np.linalg.norm(se3_log(invert(true) @ T)[:3])))
        moved = true[:3, 3] + true[:3, :3] @ lever - lever
        direction = T[:3, 3]
        if not direction.any():
            assert r.vo.covariance[3, 3] == pytest.approx(1.0)
            continue
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        error = np.cross(direction, moved / np.linalg.norm(moved))
        angles.append(np.rad2deg(np.linalg.norm(error)))
        assert direction @ moved > 0.0
        covariance = r.vo.covariance[3:, 3:]
        along = T[:3, :3].T @ direction
        assert abs(along @ covariance @ along) < 1e-9 * np.trace(covariance)
        nees.append(np.sum(error**2) / np.trace(covariance))
    assert np.median(turned) < 0.1 and max(turned) < 0.3
    assert len(angles) > 20 and np.median(angles) < 2.0
    assert 0.1 < np.median(nees) < 4.0
    assert all(r.keyframe is None or r.keyframe.points_body_m is None for r in results)


def test_metric_keyframes_carry_points_and_depths() -> None:
    for kind in ("rgbd", "stereo"):
        world, _, poses = recording(kind)
        keyframes = [r for r in usual(kind) if r.keyframe is not None]
        last = keyframes[-1]
        assert last.keyframe is not None and last.keyframe.points_body_m is not None
        points, pixels = last.keyframe.points_body_m, last.keyframe.keypoints_px
        known = np.isfinite(points[:, 0])
        assert known.sum() > 0.5 * len(points) > 50
        in_cam = (points[known] - T_BODY_CAM[:3, 3]) @ T_BODY_CAM[:3, :3]
        assert np.allclose(world.rig.cameras[0].project(in_cam), pixels[known], atol=1e-6)
        truth_z = 1.0 / in_cam[:, 2]
        exact = world.draw(0, invert(T_BODY_CAM) @ poses[last.keyframe.frame.index] @ T_BODY_CAM)[1]
        z = exact[pixels[known, 1].round().astype(int), pixels[known, 0].round().astype(int)]
        assert np.median(np.abs(truth_z - 1.0 / z)) < 0.01
        assert last.observations.depth_m is not None and np.isfinite(last.observations.depth_m).mean() > 0.5
        assert (last.observations.right_px is not None) == (kind == "stereo")


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_two_runs_give_the_same_bytes(kind: str) -> None:
    _, frames, _ = recording(kind)
    assert digest(run(kind, frames[:25])) == digest(usual(kind)[:25])


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_a_camera_at_rest_stays_where_it_is(kind: str) -> None:
    world = recording(kind)[0]
    frames = [world.frame(i, np.eye(4)) for i in range(20)]
    results = run(kind, frames)
    assert [r.keyframe is not None for r in results] == [True] + [False] * 19
    for result in results[1:]:
        assert result.vo.T_keyframe_body is not None and result.vo.tracking is Tracking.OK
        error = se3_log(result.vo.T_keyframe_body)
        assert np.rad2deg(np.linalg.norm(error[:3])) < 0.1
        assert np.linalg.norm(error[3:]) < 0.004  # for mono: no parallax, no direction


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_blackout_is_lost_and_the_keyframe_is_found_again(kind: str) -> None:
    _, frames, poses = recording(kind)
    dark = [replace(f, images=tuple(np.full_like(i, 4) for i in f.images)) if 10 <= f.index < 14 else f for f in frames]
    results = run(kind, dark[:20], VISION_ALONE)
    for result in results[10:14]:
        assert result.vo.tracking is Tracking.LOST and result.vo.T_keyframe_body is None and result.keyframe is None
        assert "tracks" in result.reason
    assert all(r.vo.tracking is not Tracking.LOST for r in results[14:])
    for true, T, _ in motions(results, dark[:20], poses[:20]):
        assert np.rad2deg(np.linalg.norm(se3_log(invert(true) @ T)[:3])) < 0.6


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_a_long_blackout_restarts_with_a_keyframe_that_is_lost(kind: str) -> None:
    _, frames, _ = recording(kind)
    dark = [replace(f, images=tuple(np.full_like(i, 4) for i in f.images)) if 10 <= f.index < 22 else f for f in frames]
    # another scene when the light comes back: turned by half a turn, so that nothing can be recognised
    dark[22:] = [replace(f, images=tuple(np.ascontiguousarray(i[::-1, ::-1]) for i in f.images),
                         depth_m=None if f.depth_m is None else np.ascontiguousarray(f.depth_m[::-1, ::-1]))
                 for f in dark[22:]]  # fmt: skip
    if kind == "stereo":  # turned images swap left and right
        dark[22:] = [replace(f, images=f.images[::-1]) for f in dark[22:]]
    results = run(kind, dark[:30], VISION_ALONE)
    assert all(r.vo.tracking is Tracking.LOST for r in results[10:23])
    assert "corners" in results[20].reason and "grey 4" in results[20].reason
    first = results[22]
    assert first.keyframe is not None and first.vo.keyframe_id == first.keyframe.id - 1
    assert first.vo.T_keyframe_body is None and first.reason.startswith("restarted")
    assert all(r.vo.tracking is not Tracking.LOST and r.vo.keyframe_id >= first.keyframe.id for r in results[23:])


@pytest.mark.parametrize("kind", ["stereo", "rgbd"])
def test_a_gap_of_three_seconds_is_bridged_by_recognition(kind: str) -> None:
    """After the gap the camera looks at the same place from elsewhere: the descriptors find it."""
    world, frames, poses = recording(kind)
    late = world.frame(6, path(200)[80], t_ns=frames[5].t_ns + 3_000_000_000)
    results = run(kind, [*frames[:6], late])
    found = results[-1]
    assert found.vo.tracking is not Tracking.LOST, found.reason
    true = invert(poses[0]) @ path(200)[80]
    assert found.vo.keyframe_id == 0 and found.vo.T_keyframe_body is not None
    assert np.linalg.norm(se3_log(invert(true) @ found.vo.T_keyframe_body)[3:]) < 0.02


def test_a_front_end_that_begins_at_a_keyframe_has_the_habits_that_were_learned_there() -> None:
    world, frames, _ = recording("rgbd")
    front = make_frontend(CONFIG, world.rig, 0)
    newest = [frame for frame in frames if front.track(frame, None).keyframe is not None][-1]
    habits = front.learned.habits
    after = make_frontend(CONFIG, world.rig, 0)
    after.begin_at(9, front.learned)
    after.track(newest, None)
    assert np.linalg.norm(habits[:6]) > 0.01 and habits[7] > 10
    assert np.array_equal(after.learned.habits, habits)


def test_a_gap_into_another_place_restarts() -> None:
    world, frames, _ = recording("stereo")
    away = np.diag([-1.0, -1.0, 1.0, 1.0])  # turned by 180 degrees: the walls are behind
    other = World("stereo", seed=99)
    late = replace(other.frame(6, np.eye(4)), t_ns=frames[5].t_ns + 3_000_000_000)
    assert away.shape == (4, 4)
    result = run("stereo", [*frames[:6], late])[-1]
    assert result.vo.tracking is Tracking.LOST and result.keyframe is not None and world is not other


@pytest.mark.parametrize("kind", ["stereo", "rgbd"])
def test_frames_without_depth_are_tracked_but_make_no_keyframe(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _, frames, poses = recording(kind)
    monkeypatch.setattr("vislam.frontend.keyframes._KEYFRAME_MIN_ALIVE_UNFIT", 0.0)
    poor = [f if f.index % 7 == 0 else replace(f, images=f.images[:1], depth_m=None) for f in frames]
    results = run(kind, poor)
    assert all(r.vo.tracking is not Tracking.LOST for r in results)
    assert all(r.keyframe is None or r.keyframe.frame.index % 7 == 0 for r in results)
    for true, T, _ in motions(results, poor, poses):
        assert np.linalg.norm(se3_log(invert(true) @ T)[3:]) < 0.012


def test_depth_that_comes_late_places_the_first_keyframe() -> None:
    _, frames, poses = recording("rgbd")
    late = [replace(f, depth_m=None) if f.index < 8 else f for f in frames[:20]]
    results = run("rgbd", late)
    assert results[0].keyframe is not None and results[0].keyframe.id == 0
    assert all(r.vo.tracking is Tracking.DEGRADED and not r.vo.has_scale for r in results[1:8])
    assert results[8].keyframe is not None and results[8].vo.keyframe_id == 0
    for true, T, r in motions(results, late, poses[:20]):
        error = se3_log(invert(true) @ T)
        assert not r.vo.has_scale or np.linalg.norm(error[3:]) < 0.012


def test_before_the_first_depth_the_turn_is_told_and_how_far_parallax_may_have_hidden_in_it() -> None:
    _, frames, poses = recording("rgbd")
    late = [replace(f, depth_m=None) if f.index < 15 else f for f in frames[:16]]
    nees = []
    for true, T, r in motions(run("rgbd", late), late, poses[:16]):
        if r.vo.has_scale:
            continue
        assert not T[:3, 3].any() and r.vo.covariance[3, 3] == pytest.approx(1.0)
        error = se3_log(invert(true) @ T)[:3]
        assert np.linalg.norm(error) < 0.6 * np.linalg.norm(se3_log(true)[:3])
        nees.append(error @ np.linalg.solve(r.vo.covariance[:3, :3], error) / 3.0)
    assert len(nees) == 14 and 0.1 < np.median(nees) < 2.0


def test_before_the_first_depth_an_imu_tells_the_turn_alone() -> None:
    world, frames, _ = recording("rgbd")
    front_end = make_frontend(CONFIG, world.rig, seed=3)
    still = np.zeros((2, 3))
    for f in frames[:8]:
        span = ImuSpan(np.array([f.t_ns - FRAME_NS, f.t_ns]), still, still)
        result = front_end.track(replace(f, depth_m=None), span)
        assert f.index == 0 or result.vo.tracking is Tracking.LOST


def test_depth_that_never_comes_is_said() -> None:
    _, frames, _ = recording("rgbd")
    results = run("rgbd", [replace(f, depth_m=None) for f in frames[:12]])
    assert sum(r.keyframe is not None for r in results) == 1
    assert all("no depth" in r.reason for r in results[1:])
    empty = [replace(f, depth_m=np.full_like(f.depth_m, np.nan)) for f in frames[:3] if f.depth_m is not None]
    assert all(r.keyframe is None and "have depth" in r.reason for r in run("rgbd", empty))


def test_dark_start_waits_for_light() -> None:
    _, frames, _ = recording("stereo")
    dark = [replace(f, images=tuple(np.zeros_like(i) for i in f.images)) if f.index < 3 else f for f in frames[:6]]
    results = run("stereo", dark)
    assert [r.vo.keyframe_id for r in results[:3]] == [-1] * 3
    assert all(r.vo.tracking is Tracking.LOST and r.keyframe is None for r in results[:3])
    assert results[3].keyframe is not None and results[3].keyframe.id == 0
    assert np.array_equal(results[3].vo.T_keyframe_body, np.eye(4)) and results[3].vo.tracking is Tracking.OK


def test_the_gyroscope_carries_tracks_through_a_fast_turn() -> None:
    world = recording("mono")[0]
    poses = [np.eye(4)] * 3 + [rotation_z(0.4)] * 2
    frames = [world.frame(i, T) for i, T in enumerate(poses)]
    without = run("mono", frames)
    front_end = make_frontend(CONFIG, world.rig, seed=3)
    results = [front_end.track(frames[0], None)]
    for i in range(1, len(frames)):
        rate = np.tile([0.0, 0.0, 0.4 / (FRAME_NS * 1e-9) if i == 3 else 0.0], (11, 1))
        t_ns = np.linspace(frames[i - 1].t_ns, frames[i].t_ns, 11).astype(np.int64)
        results.append(front_end.track(frames[i], ImuSpan(t_ns, rate, np.zeros((11, 3)))))
    T = results[3].vo.T_keyframe_body
    assert T is not None and results[3].vo.inliers > 50
    assert np.rad2deg(np.linalg.norm(se3_log(invert(poses[3]) @ T)[:3])) < 0.5
    assert without[3].vo.inliers < 20  # the search from the old place does not reach


def rotation_z(angle: float) -> Array:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T


@pytest.mark.parametrize("kind", ["mono", "stereo", "rgbd"])
def test_frames_that_do_not_fit_are_refused(kind: str) -> None:
    world, frames, _ = recording(kind)
    front_end: FrontEnd = make_frontend(CONFIG, world.rig, seed=0)
    front_end.track(frames[1], None)
    with pytest.raises(DataError, match="does not come after"):
        front_end.track(frames[0], None)
    with pytest.raises(DataError, match="does not come after"):
        front_end.track(frames[1], None)
    with pytest.raises(DataError, match="calibration is for 320x240"):
        front_end.track(replace(frames[2], images=tuple(i[:100] for i in frames[2].images)), None)
    with pytest.raises(DataError, match="no image"):
        front_end.track(replace(frames[3], images=()), None)


def test_modes_ask_for_what_they_need() -> None:
    assert make_frontend(FrontEndConfig(), World("rgbd").rig, 0).mode == "rgbd"
    with pytest.raises(UsageError, match="two cameras"):
        make_frontend(FrontEndConfig(mode="stereo"), World("mono").rig, 0)
    with pytest.raises(UsageError, match="depth images"):
        make_frontend(FrontEndConfig(mode="rgbd"), World("stereo").rig, 0)
    assert make_frontend(FrontEndConfig(mode="mono"), World("stereo").rig, 0).mode == "mono"
