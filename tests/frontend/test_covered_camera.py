"""Stereo with one camera covered: the other goes on, says so, and the usual one is taken again when it sees."""

from dataclasses import replace

import numpy as np
import pytest
from test_frontends import motions, recording, run

from vislam.core.geometry import invert, se3_log, transform_points
from vislam.core.messages import Array, Frame, Tracking

_COVERED = range(12, 40)


def covered(frame: Frame, cameras: tuple[int, ...]) -> Frame:
    dark = tuple(np.full_like(image, 3) if i in cameras else image for i, image in enumerate(frame.images))
    return replace(frame, images=dark)


def covering(cameras: tuple[int, ...]) -> tuple[list[Frame], Array]:
    _, frames, poses = recording("stereo")
    return [covered(f, cameras) if f.index in _COVERED else f for f in frames], poses


@pytest.mark.parametrize("camera", [0, 1])
def test_stereo_goes_on_with_the_camera_that_sees(camera: int) -> None:
    frames, poses = covering((camera,))
    results = run("stereo", frames)
    assert all(r.vo.tracking is not Tracking.LOST for r in results)
    errors = np.array([se3_log(invert(true) @ T) for true, T, _ in motions(results, frames, poses)])
    assert np.rad2deg(np.linalg.norm(errors[:, :3], axis=1)).max() < 0.3
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.02
    keyframes = [r.keyframe for r in results if r.keyframe is not None]
    assert any(k.frame.index in _COVERED for k in keyframes)  # it is not one keyframe's depth that lasts
    assert [k.id for k in keyframes] == list(range(len(keyframes)))


def test_following_the_second_camera_is_said_until_the_first_sees_again() -> None:
    frames, _ = covering((0,))
    results = run("stereo", frames)
    for result in results[12:40]:
        assert (result.vo.tracking is Tracking.DEGRADED and "cam1 is followed" in result.reason) or result.keyframe
    assert any(r.reason == "cam0 sees again" for r in results[40:42])
    assert all(r.vo.tracking is Tracking.OK for r in results[42:])
    assert len(results[-1].observations.track_ids) > 60


def test_what_the_second_camera_sees_is_told_as_the_first_would() -> None:
    """Estimators know the pixels of cam0 alone: where a point's depth is known, they are told where it would be."""
    frames, poses = covering((0,))
    results = run("stereo", frames)
    world, clear, _ = recording("stereo")
    camera, T_body_cam = world.rig.cameras[0], world.rig.T_body_cams[0]
    seen = {i: results[i].observations for i in (11, 14, 20)}
    assert len(seen[14].track_ids) > 40 and camera.contains(seen[14].pixels_px).all()
    _, a, b = np.intersect1d(seen[11].track_ids, seen[14].track_ids, return_indices=True)
    assert len(a) > 30
    exact = world.draw(0, invert(T_body_cam) @ poses[11] @ T_body_cam)[1]
    before = seen[11].pixels_px[a]
    z = exact[before[:, 1].round().astype(int), before[:, 0].round().astype(int)]
    points = transform_points(poses[11] @ T_body_cam, camera.unproject(before) * z[:, None])
    there = camera.project(transform_points(np.asarray(invert(poses[14] @ T_body_cam)), points))
    assert np.median(np.linalg.norm(there - seen[14].pixels_px[b], axis=1)) < 0.7
    assert len(clear) == len(frames)


def test_a_cover_so_short_that_the_keyframe_stays_leaves_the_tracks_alone() -> None:
    _, frames, _ = recording("stereo")
    blinking = [covered(f, (0,)) if f.index in (3, 4) else f for f in frames[:12]]
    results = run("stereo", blinking)
    assert [r.vo.tracking for r in results[3:5]] == [Tracking.DEGRADED] * 2
    assert all(r.vo.tracking is Tracking.OK for r in results[5:])
    shared = np.intersect1d(results[2].observations.track_ids, results[6].observations.track_ids)
    assert len(shared) > 0.5 * len(results[2].observations.track_ids)


def test_both_cameras_covered_is_lost_and_found_again() -> None:
    frames, _ = covering((0, 1))
    results = run("stereo", frames)
    assert all(r.vo.tracking is Tracking.LOST for r in results[12:40])
    assert results[-1].vo.tracking is Tracking.OK


def test_cameras_covered_one_after_the_other_do_not_lose_it() -> None:
    _, frames, poses = recording("stereo")
    turns = ((), (1,), (), (0,))  # for eight frames each; both see for a while in between
    taking_turns = [covered(f, turns[f.index // 8 % 4]) for f in frames]
    results = run("stereo", taking_turns)
    assert all(r.vo.tracking is not Tracking.LOST for r in results)
    errors = np.array([se3_log(invert(true) @ T) for true, T, _ in motions(results, taking_turns, poses)])
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.03


def test_a_covered_right_camera_is_said() -> None:
    frames, _ = covering((1,))
    results = run("stereo", frames)
    told = [r for r in results[12:40] if "no depth" in r.reason]
    assert told and all(r.vo.tracking is Tracking.DEGRADED for r in told)
    assert all(r.vo.tracking is Tracking.OK for r in results[:12])
