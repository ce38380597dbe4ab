"""Front ends on points that were followed elsewhere: the same odometry, without a single image."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from vislam.config import FrontEndConfig
from vislam.core import DataError
from vislam.core.geometry import invert, se3_log, so3_log, transform_points
from vislam.core.messages import Array, Frame, Keyframe, Observations, Tracking
from vislam.frontend import TrackResult, make_frontend
from vislam.frontend.intake import Intake
from vislam.frontend.metric import MetricFrontEnd
from vislam.frontend.tracker import Tracker, given_rows
from vislam.frontend.view import ImageDepth, StereoDepth
from vislam.sim import PointRecording, open_points
from vislam.vision.two_view import RotationPrior, direction_given_rotation, refine_two_view

CONFIG = FrontEndConfig()


def driven(
    recording: PointRecording, config: FrontEndConfig = CONFIG
) -> Iterator[tuple[Frame, TrackResult, Array, Array | None]]:
    """Yield frame, result, true pose of the body and that of the keyframe that the result refers to."""
    frontend = make_frontend(config, recording.rig, 0)
    T_true = recording.true_states(recording.frame_times_ns).T_world_body
    keyframes: dict[int, Array] = {}
    frames = (event for event in recording.events() if isinstance(event, Frame))
    for frame, T in zip(frames, T_true, strict=True):
        result = frontend.track(frame, None)
        yield frame, result, T, keyframes.get(result.vo.keyframe_id)
        if result.keyframe is not None:
            keyframes[result.keyframe.id] = T


@pytest.mark.parametrize("rig", ["stereo", "rgbd"])
def test_metric_odometry_is_accurate_and_knows_how_much(rig: str) -> None:
    errors, nees, tracking = [], [], []
    for _, result, T_true, T_key in driven(open_points("handheld-room", seed=1, rig=rig, duration_s=15.0)):
        tracking.append(result.vo.tracking)
        if T_key is not None and result.vo.T_keyframe_body is not None:
            error = se3_log(invert(invert(T_key) @ T_true) @ result.vo.T_keyframe_body)
            errors.append(error)
            nees.append(error @ np.linalg.solve(result.vo.covariance, error))
    rms = np.sqrt(np.mean(np.array(errors) ** 2, axis=0))
    print(f"seed 1, {rig}: {rms[:3] * 1e3} mrad, {rms[3:] * 1e3} mm, NEES {np.mean(nees):.1f} of 6")
    assert len(errors) > 290 and tracking.count(Tracking.LOST) == 0
    assert rms[:3].max() < 1.5e-3 and rms[3:].max() < 4e-3
    assert 3.0 < np.mean(nees) < 15.0


def test_one_cameras_directions_are_as_sure_as_parallax_allows() -> None:
    """Soon after a keyframe noise has a say in each track's depth, and the direction leans; seeds 1 to 3."""
    squares, soon = [], []
    for seed in (1, 2, 3):
        recording = open_points("handheld-room", seed=seed, rig="mono", duration_s=10.0)
        T_body_cam = recording.rig.T_body_cams[0]
        for _, result, T_true, T_key in driven(recording):
            T = result.vo.T_keyframe_body
            if T_key is None or T is None or not T[:3, 3].any():
                continue
            way = (invert(T_key @ T_body_cam) @ T_true @ T_body_cam)[:3, 3]
            axes = np.linalg.svd((T_body_cam[:3, :3] @ way)[None])[2][1:].T  # across the way
            error, to_key = axes.T @ T[:3, 3], axes.T @ T[:3, :3]
            squares.append(error @ np.linalg.solve(to_key @ result.vo.covariance[3:, 3:] @ to_key.T, error) / 2.0)
            soon.append(result.median_parallax_px < 10.0)
    nees = np.array(squares)
    print(
        f"NEES of {len(nees)} directions {nees.mean():.1f}, of {sum(soon)} with little parallax {nees[soon].mean():.1f}"
    )
    assert 0.3 < nees[soon].mean() < 4.0


@pytest.mark.parametrize("rig", ["stereo", "rgbd"])
@pytest.mark.parametrize("pixel_sigma_px", [0.3, 1.0])
def test_motions_are_as_sure_as_tracks_scatter(rig: str, pixel_sigma_px: float) -> None:
    nees: list[list[float]] = []
    for seed in (1, 2, 3):
        points = open_points("handheld-room", seed=seed, rig=rig, duration_s=6.0, pixel_sigma_px=pixel_sigma_px)
        for _, result, T_true, T_key in list(driven(points))[20:]:  # before, the noise is not known
            if T_key is not None and result.vo.T_keyframe_body is not None:
                error = se3_log(invert(invert(T_key) @ T_true) @ result.vo.T_keyframe_body)
                blocks = (slice(0, 3), slice(3, 6))
                nees.append([error[s] @ np.linalg.solve(result.vo.covariance[s, s], error[s]) / 3.0 for s in blocks])
    mean = np.mean(nees, axis=0)
    print(f"{rig}, {pixel_sigma_px} px: NEES per degree of freedom {mean[0]:.2f} of turns, {mean[1]:.2f} of ways")
    assert len(nees) > 250 and ((mean > 0.5) & (mean < 2.0)).all()


def beside_a_walker(recording: PointRecording, since: int) -> Iterator[Frame]:
    """Yield frames of which, from one on, two in three tracks are of a body that goes to and fro before the camera."""
    frames, camera = (event for event in recording.events() if isinstance(event, Frame)), recording.true_rig.cameras[0]
    rng = np.random.default_rng(1)
    cloth_m = np.column_stack([rng.uniform(-0.4, 0.4, (140, 2)), rng.uniform(1.9, 2.1, 140)])
    for k, frame in enumerate(frames):
        given = frame.tracks
        assert given is not None and given.depth_m is not None
        seen_m = (cloth_m + np.array([0.4 * np.sin(0.1 * (k - since)), 0.0, 0.0]))[: 140 * (k >= since)]
        pixels = camera.project(seen_m) + 0.3 * rng.standard_normal((len(seen_m), 2))
        ids = 1_000_000 + 1000 * (k // 8) + np.arange(len(seen_m))  # cloth turns: tracks end, others begin
        yield replace(frame, tracks=Observations(
            np.concatenate([given.track_ids[:70], ids]), np.vstack([given.pixels_px[:70], pixels]),
            depth_m=np.concatenate([given.depth_m[:70], seen_m[:, 2]]),
        ))  # fmt: skip


def test_what_walks_before_the_camera_does_not_lead_it_away_though_most_new_tracks_are_its_own() -> None:
    recording = open_points("handheld-room", seed=1, rig="rgbd", duration_s=8.0)
    since = 60
    frontend, keyframes = make_frontend(CONFIG, recording.rig, 0), dict[int, Array]()
    T_true = recording.true_states(recording.frame_times_ns).T_world_body
    others, errors_m = [], []
    for frame, T in zip(beside_a_walker(recording, since), T_true, strict=True):
        result = frontend.track(frame, None)
        others.append(result.others)
        if result.vo.T_keyframe_body is not None and result.vo.keyframe_id in keyframes:
            error = invert(invert(keyframes[result.vo.keyframe_id]) @ T) @ result.vo.T_keyframe_body
            errors_m.append(np.linalg.norm(error[:3, 3]))
        if result.keyframe is not None:
            keyframes[result.keyframe.id] = T
    two, mean_m, most_m = np.array(others) > 0, np.mean(errors_m[since:]), np.max(errors_m)
    print(f"two motions in {two.sum()} frames; errors of {1e3 * mean_m:.0f} mm, {1e3 * most_m:.0f} mm at most")
    assert not two[:since].any() and two[since:].sum() >= 10
    assert len(errors_m) > 140 and mean_m < 0.03 and most_m < 0.1  # most tracks followed: 71 and 263 mm


def test_mono_odometry_tells_turns_and_directions() -> None:
    recording = open_points("laps", seed=1, rig="mono", duration_s=15.0)
    lever = recording.true_rig.T_body_cams[0]
    turns, directions = [], []
    for _, result, T_true, T_key in driven(recording):
        vo = result.vo
        if T_key is None or vo.T_keyframe_body is None:
            continue
        R = (invert(T_key) @ T_true)[:3, :3].T @ vo.T_keyframe_body[:3, :3]
        turns.append(np.linalg.norm(so3_log(np.ascontiguousarray(R))))
        if vo.T_keyframe_body[:3, 3].any():
            moved = T_key[:3, :3].T @ ((T_true @ lever)[:3, 3] - (T_key @ lever)[:3, 3])
            cosine = moved @ vo.T_keyframe_body[:3, 3] / np.linalg.norm(moved)
            directions.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    print(f"seed 1: {np.median(turns) * 1e3:.1f} mrad, {np.rad2deg(np.median(directions)):.1f} deg median")
    assert len(turns) > 250 and np.median(turns) < 5e-3
    assert len(directions) > 150 and np.median(directions) < np.deg2rad(4.0)


def test_ids_and_pixels_are_those_that_were_given_and_outliers_do_not_come_back() -> None:
    """What a keyframe drops is not taken up again under the same id, while it lasts."""
    seen, last_kept, dropped = 0, set[int](), set[int]()
    for frame, result, _, _ in driven(open_points("handheld-room", seed=3, duration_s=8.0, outlier_share=0.2)):
        assert frame.tracks is not None
        given = given_rows(frame.tracks, frame.tracks.pixels_px, result.observations.track_ids)
        assert np.array_equal(given, result.observations.pixels_px)
        seen += len(result.observations.track_ids)
        if result.keyframe is not None:
            kept, there = set(result.observations.track_ids.tolist()), set(frame.tracks.track_ids.tolist())
            dropped = (dropped | (last_kept - kept)) & there
            assert not dropped & kept
            last_kept = kept
            assert result.observations.right_px is not None
            right = given_rows(frame.tracks, np.asarray(frame.tracks.right_px), result.observations.track_ids)
            measured = np.isfinite(result.observations.right_px[:, 0])
            assert measured.mean() > 0.5 and np.array_equal(result.observations.right_px[measured], right[measured])
    assert seen > 5000


def test_outage_is_lost_and_odometry_starts_again() -> None:
    options = {"outage_begin_s": 4.0, "outage_length_s": 1.0}
    results = list(driven(open_points("handheld-room", seed=1, duration_s=8.0, **options)))
    tracking = [result.vo.tracking for _, result, _, _ in results]
    assert all(state == Tracking.LOST for state in tracking[80:99])
    assert tracking[110:].count(Tracking.OK) > 40 and Tracking.LOST not in tracking[5:79]
    assert any("points were given" in result.reason for _, result, _, _ in results[80:100])
    assert any(result.reason.startswith("restarted") for _, result, _, _ in results[95:105])


def test_rolling_shutter_is_found_from_given_tracks_and_undone_in_both_images() -> None:
    recording = open_points("handheld-room", seed=1, readout_s=0.02, duration_s=8.0)
    frontend = make_frontend(CONFIG, recording.rig, 0)
    assert isinstance(frontend, MetricFrontEnd)
    by_shutter_px, disparities_px = list[Array](), list[Array]()
    for frame in (event for event in recording.events() if isinstance(event, Frame)):
        seen = frontend.track(frame, None).observations
        if seen.instant_px is not None and seen.right_px is not None and seen.right_instant_px is not None:
            moved_px = seen.instant_px - seen.pixels_px
            bent_px = np.abs(seen.right_instant_px - seen.right_px - moved_px)
            by_shutter_px.append(np.abs(moved_px).ravel())
            disparities_px.append(bent_px[np.isfinite(bent_px)])
    found_s = frontend.learned.readout_s
    moved, bent = (float(np.mean(np.concatenate(px))) for px in (by_shutter_px, disparities_px))
    print(f"seed 1: {found_s} of 0.02 s; undoing it moves a pixel by {moved:.2f} px, a disparity by {bent:.2f} px")
    assert found_s == pytest.approx(0.02, abs=0.003)
    assert moved > 0.5 and bent < 0.2 * moved


def test_keyframes_behind_a_rolling_shutter_agree_where_their_features_are() -> None:
    """Loops are verified by them: at 100 deg/s rows at top and bottom are up to 10 px from where they belong."""
    recording = open_points("handheld-room", seed=1, rig="rgbd", readout_s=0.03, pixel_sigma_px=0.2, duration_s=8.0)
    camera, T_body_cam = recording.rig.cameras[0], recording.rig.T_body_cams[0]
    last: tuple[Array, Keyframe] | None = None
    off_px: dict[str, list[Array]] = {"seen": [], "kept": []}
    for frame, result, T_true, _ in driven(recording, replace(CONFIG, readout_s=0.03)):
        new = result.keyframe
        if new is None or new.id == 0:  # nobody knows how fast the first one moves
            continue
        if last is not None:
            T_key, old = last
            assert old.frame.tracks is not None and frame.tracks is not None and old.points_body_m is not None
            old_points = given_rows(old.frame.tracks, old.points_body_m, frame.tracks.track_ids)
            there = transform_points(np.asarray(invert(T_true @ T_body_cam) @ T_key), old_points)
            expected = camera.project(there)
            for name, pixels in (("seen", frame.tracks.pixels_px), ("kept", new.keypoints_px)):
                off_px[name].append(np.linalg.norm(pixels - expected, axis=1))
        last = T_true, new
    seen, kept = (float(np.nanmedian(np.concatenate(off_px[name]))) for name in ("seen", "kept"))
    print(f"seed 1, {len(off_px['kept'])} pairs of keyframes: {seen:.2f} px by pixels as seen, {kept:.2f} px as kept")
    assert kept < 0.5 * seen


def test_person_does_not_carry_the_odometry_away() -> None:
    recording = open_points("handheld-room", seed=2, duration_s=10.0, moving_share=0.4, moving_begin_s=2.0)
    errors = []
    for _, result, T_true, T_key in driven(recording):
        if T_key is not None and result.vo.T_keyframe_body is not None:
            errors.append(np.linalg.norm((invert(invert(T_key) @ T_true) @ result.vo.T_keyframe_body)[:3, 3]))
    print(f"seed 2: {np.median(errors) * 1e3:.1f} mm median, {np.quantile(errors, 0.95) * 1e3:.1f} mm at 95 %")
    assert len(errors) > 180 and np.median(errors) < 5e-3 and np.quantile(errors, 0.95) < 0.02


def test_keyframes_carry_what_recognises_them() -> None:
    for rig in ("mono", "stereo", "rgbd"):
        recording = open_points("handheld-room", seed=1, rig=rig, duration_s=2.0)
        keyframe = next(result.keyframe for _, result, _, _ in driven(recording) if result.keyframe is not None)
        tracks = keyframe.frame.tracks
        assert tracks is not None and np.array_equal(keyframe.descriptors, tracks.descriptors)
        assert np.array_equal(keyframe.keypoints_px, tracks.pixels_px)
        if rig == "mono":
            assert keyframe.points_body_m is None
        else:
            assert keyframe.points_body_m is not None and np.isfinite(keyframe.points_body_m[:, 0]).mean() > 0.5
    plain = open_points("handheld-room", seed=1, duration_s=2.0, descriptors=False)
    keyframe = next(result.keyframe for _, result, _, _ in driven(plain) if result.keyframe is not None)
    assert keyframe.descriptors.shape == (0, 32) and keyframe.points_body_m is not None
    assert len(keyframe.points_body_m) == 0


# -- the door --------------------------------------------------------------------------------------------------------


def first_frame() -> tuple[PointRecording, Frame]:
    recording = open_points("still", duration_s=1.0)
    return recording, next(event for event in recording.events() if isinstance(event, Frame))


def test_points_that_cannot_be_are_left_out_and_counted() -> None:
    recording, frame = first_frame()
    assert frame.tracks is not None
    pixels = frame.tracks.pixels_px.copy()
    pixels[3], pixels[5], pixels[8] = [np.nan, 10.0], [-1.0, 10.0], [10.0, 480.0]
    intake = Intake(recording.rig, 0)
    accepted, dt_s = intake.accept(replace(frame, tracks=replace(frame.tracks, pixels_px=pixels)))
    assert dt_s == 0.0 and accepted.tracks is not None and intake.refused_tracks == 3
    left = np.delete(np.arange(len(pixels)), [3, 5, 8])
    for name in ("track_ids", "pixels_px", "right_px", "descriptors"):
        kept = getattr(accepted.tracks, name)
        expected = (pixels if name == "pixels_px" else getattr(frame.tracks, name))[left]
        assert np.array_equal(kept, expected, equal_nan=name == "right_px")


def test_tracks_that_do_not_fit_together_are_refused() -> None:
    recording, frame = first_frame()
    tracks = frame.tracks
    assert tracks is not None and tracks.right_px is not None
    twice = tracks.track_ids.copy()
    twice[4] = twice[7]
    wrong = {
        "a track id came twice": replace(tracks, track_ids=twice),
        "pixels_px of shape": replace(tracks, pixels_px=tracks.pixels_px[:-1]),
        "right_px of shape": replace(tracks, right_px=tracks.right_px[:, :1]),
        "depth_m of shape": replace(tracks, depth_m=np.zeros((len(twice), 1))),
        "descriptors of shape": replace(tracks, descriptors=np.zeros((len(twice), 16), dtype=np.uint8)),
    }
    for words, given in wrong.items():
        with pytest.raises(DataError, match=words):
            make_frontend(CONFIG, recording.rig, 0).track(replace(frame, tracks=given), None)
    with pytest.raises(DataError, match="no image and no tracks"):
        make_frontend(CONFIG, recording.rig, 0).track(replace(frame, tracks=None), None)


# -- the parts -------------------------------------------------------------------------------------------------------


def given(ids: list[int], pixels: Array) -> Frame:
    tracks = Observations(np.array(ids, dtype=np.int64), pixels, pixels - [10.0, 0.0], np.full(len(ids), 2.0))
    return Frame(0, 0, (), tracks=tracks)


def test_tracker_follows_by_id_and_takes_no_more_than_it_may() -> None:
    rng = np.random.default_rng(0)
    tracker = Tracker(replace(CONFIG, max_tracks=5, max_misses=1))
    pixels = rng.uniform(20.0, 400.0, (7, 2))
    assert tracker.begin(given([2, 3, 5, 7, 11, 13, 17], pixels), np.zeros(0, dtype=np.bool_), np.empty((0, 2))) == 5
    assert tracker.ids.tolist() == [2, 3, 5, 7, 11]
    found = tracker.follow(given([11, 3, 99], pixels[:3] + 1.0), pixels[:5])
    assert np.array_equal(np.isfinite(found[:, 0]), [False, True, False, False, True])
    assert np.array_equal(found[1], pixels[1] + 1.0) and np.array_equal(found[4], pixels[0] + 1.0)
    good = np.isfinite(found[:, 0])
    assert tracker.judge(good).all() and tracker.judge(good).tolist() == good.tolist()
    assert tracker.ids.tolist() == [3, 11]
    again = given([2, 3, 11, 19], pixels[:4])  # 2 was missed too often: its id is spent
    assert tracker.begin(again, np.ones(2, dtype=np.bool_), pixels[:2]) == 1 and tracker.ids.tolist() == [3, 11, 19]
    tracker.forget()
    assert tracker.begin(again, np.zeros(0, dtype=np.bool_), np.empty((0, 2))) == 4


def test_depth_sensors_read_what_was_given() -> None:
    recording, frame = first_frame()
    tracks = frame.tracks
    assert tracks is not None and tracks.right_px is not None
    stereo, ids = StereoDepth(recording.rig, CONFIG), tracks.track_ids[::-1].copy()
    pixels = given_rows(tracks, tracks.pixels_px, ids)
    xy = recording.rig.cameras[0].normalise(pixels)
    reading = stereo.measure(frame, pixels, xy, np.full(len(xy), np.nan), ids)
    assert stereo.available(frame) and reading.right_px is not None
    known = np.isfinite(reading.rho)
    assert known.mean() > 0.5 and np.array_equal(reading.right_px[known], tracks.right_px[::-1][known])
    assert np.isnan(stereo.measure(frame, pixels, xy, np.full(len(xy), np.nan)).rho).all()
    flat = given([1, 2, 3], np.full((3, 2), 50.0))
    assert flat.tracks is not None
    depths = replace(flat, tracks=replace(flat.tracks, depth_m=np.array([2.0, 20.0, np.nan])))
    image = ImageDepth(CONFIG)
    rho = image.measure(depths, np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(3), np.array([2, 1, 4])).rho
    assert image.available(depths) and np.array_equal(np.isfinite(rho), [False, True, False]) and rho[1] == 0.5


def test_keyframes_follow_each_other_while_moving() -> None:
    new = [result for _, result, _, _ in driven(open_points("laps", duration_s=9.0)) if result.keyframe is not None]
    stamps = [result.keyframe.t_ns for result in new if result.keyframe is not None]
    assert len(new) > 8 and new[0].reason == "first keyframe"
    assert all(b - a <= 2_100_000_000 for a, b in pairwise(stamps))


@pytest.mark.parametrize("seed", range(5))
def test_gross_outliers_do_not_decide_the_direction(seed: int) -> None:
    """Wrong matches over half the image have fifty times the parallax of true ones."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(3.0, 8.0, 150)
    key_xy = rng.uniform([-0.7, -0.45], [0.7, 0.45], (150, 2))
    direction = np.array([0.8, 0.36, 0.48])
    moved = np.column_stack([key_xy, np.ones(150)]) * z[:, None] - 0.06 * direction
    xy = moved[:, :2] / moved[:, 2:] + rng.normal(0.0, 5e-4, (150, 2))
    xy[:12] = rng.uniform([-0.7, -0.45], [0.7, 0.45], (12, 2))
    start = direction_given_rotation(np.eye(3), key_xy, xy)
    assert start is not None
    prior = RotationPrior(np.eye(3), 5e-4)
    found = refine_two_view(prior.R_key_cam, start, key_xy, xy, 7e-4, CONFIG.cauchy, prior)
    off_deg = np.rad2deg(np.arccos(np.clip(found.direction_key @ direction, -1.0, 1.0)))
    print(f"seed {seed}: start {np.rad2deg(np.arccos(abs(start @ direction))):.1f} deg off, refined {off_deg:.1f} deg")
    assert np.rad2deg(np.arccos(abs(start @ direction))) < 30.0
    assert found.converged and off_deg < 6.0
