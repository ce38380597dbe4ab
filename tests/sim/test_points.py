"""Simulated vision: what is projected agrees with the truth, every option does what it says, nothing is random."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.needs import missing
from vislam.core.errors import DataError, UsageError
from vislam.core.geometry import transform_points
from vislam.core.messages import Array, Frame, ImuSample
from vislam.runs.sources import open_source
from vislam.sim import PointRecording, open_points
from vislam.sim.points.followed import scramble
from vislam.sim.sensing import CONSUMER_IMU
from vislam.vision.features import match
from worlds.recordings import angles_rad, frames, real, samples

PERFECT = {"pixel_sigma_px": 0.0, "outlier_share": 0.0, "dropout_share": 0.0, "stereo_sigma_px": 0.0}


def errors_px(recording: PointRecording, count: int = 60) -> tuple[Array, Array]:
    """Return distances in pixels from where the followed landmarks really are, left [N] and right [N]."""
    tracker = recording.tracker()
    rig, left, right = recording.true_rig, [], []
    for t_ns in recording.frame_times_ns[:count]:
        t_s = float(t_ns - recording.zero_ns) * 1e-9
        seen = tracker.see(t_s, False)
        T_cam_world = np.linalg.inv(recording.motion.at(np.array([t_s])).T_world_body[0] @ rig.T_body_cams[0])
        rows = np.searchsorted(tracker.track_ids_all, seen.track_ids)
        points = transform_points(T_cam_world, recording.field.points_m[tracker.landmarks[rows]])
        left.append(np.linalg.norm(seen.pixels_px - rig.cameras[0].project(points), axis=1))
        if seen.right_px is not None:
            T_right_left = np.linalg.inv(rig.T_cam0_cam1)
            expected = rig.cameras[1].project(transform_points(T_right_left, points))
            right.append(np.linalg.norm(seen.right_px - expected, axis=1))
        if seen.depth_m is not None:
            right.append(seen.depth_m - points[:, 2])
    return np.concatenate(left), np.concatenate(right) if right else np.empty(0)


def test_without_noise_pixels_are_where_the_landmarks_are() -> None:
    recording = open_points("handheld-room", seed=2, duration_s=4.0, **PERFECT)
    left, right = errors_px(recording)
    assert left.max() < 1e-9 and np.nanmax(right) < 1e-9 and np.isfinite(right).mean() > 0.85


def test_noise_has_the_size_that_was_asked_for() -> None:
    recording = open_points("laps", seed=3, duration_s=8.0, pixel_sigma_px=0.7, outlier_share=0.0, stereo_sigma_px=0.4)
    left, right = errors_px(recording)
    assert np.sqrt(np.mean(left**2) / 2.0) == pytest.approx(0.7, rel=0.03)
    assert np.sqrt(np.nanmean(right**2) / 2.0) == pytest.approx(np.hypot(0.7, 0.4), rel=0.03)
    depth = errors_px(open_points("laps", seed=3, duration_s=8.0, rig="rgbd", outlier_share=0.0))[1]
    assert 0.002 < np.nanstd(depth) < 0.06 and 0.4 < np.isfinite(depth).mean() < 0.99


@pytest.mark.data
@pytest.mark.parametrize("name", ["v101", "v201"])
def test_pixels_on_a_real_recording_agree_with_its_truth(data_root: Path, name: str) -> None:
    """Against the poses of the file itself, of which the motion used only a part, at the frames' stamps."""
    if not (data_root / f"euroc_{name}_imu").is_dir():
        missing(f"{data_root}/euroc_{name}_imu")
    recording = open_source(real(data_root, name) + ",pixel_sigma_px=0,outlier_share=0,start_s=10,duration_s=6")
    assert isinstance(recording, PointRecording)
    left, _ = errors_px(recording)
    assert left.max() < 1e-6
    truth, stamps = recording.truth(), recording.frame_times_ns[1:-1]
    assert np.abs(truth.at(stamps)[:, :3, 3] - recording.true_states(stamps).T_world_body[:, :3, 3]).max() < 1e-3
    states = recording.true_states(stamps)
    step = np.diff(states.T_world_body[:, :3, 3], axis=0) / 0.05
    mean = 0.5 * (states.velocity_world_m_s[1:] + states.velocity_world_m_s[:-1])
    assert np.abs(step - mean).max() < 0.05 and np.isnan(states.gyro_bias_rad_s).all()
    imu = samples(recording)
    assert len(imu) == pytest.approx(6 * 200, abs=4)
    assert imu[0].t_ns <= recording.frame_times_ns[0] and imu[-1].t_ns >= recording.frame_times_ns[-1]


def test_same_seed_same_frames_another_seed_others() -> None:
    def digest(seed: int) -> list[bytes]:
        recording = open_points("handheld-room", seed=seed, duration_s=3.0)
        parts = []
        for event in recording.events():
            if isinstance(event, Frame):
                assert event.tracks is not None and event.tracks.descriptors is not None and event.images == ()
                parts.append(event.tracks.pixels_px.tobytes() + event.tracks.descriptors.tobytes())
            else:
                assert isinstance(event, ImuSample)
                parts.append(event.t_ns.to_bytes(8) + event.gyro_rad_s.tobytes() + event.accel_m_s2.tobytes())
        return parts

    first = digest(5)
    assert first == digest(5) and first != digest(6)
    recording = open_points("still", duration_s=2.0)
    assert [f.tracks.pixels_px.tobytes() for f in frames(recording) if f.tracks] == [
        f.tracks.pixels_px.tobytes() for f in frames(recording) if f.tracks
    ]


def test_events_come_in_time_order_and_as_many_as_promised() -> None:
    recording = open_points("straight", duration_s=5.0, camera_hz=12.5, lost_share=0.3, time_offset_s=0.02)
    stamps = [event.t_ns for event in recording.events()]
    assert stamps == sorted(stamps)
    seen = frames(recording)
    assert len(seen) == recording.frame_count and [f.index for f in seen] == list(range(len(seen)))
    assert set(np.round(np.diff([f.t_ns for f in seen]) / 80e6).astype(int).tolist()) > {1, 2}


def shared(before: Frame, after: Frame) -> tuple[Array, Array]:
    assert before.tracks is not None and after.tracks is not None
    a, b = before.tracks, after.tracks
    _, i, j = np.intersect1d(a.track_ids, b.track_ids, assume_unique=True, return_indices=True)
    return a.pixels_px[i], b.pixels_px[j]


def test_tracks_persist_and_their_number_holds() -> None:
    seen = frames(open_points("laps", seed=1, duration_s=20.0, tracks=120))
    counts = np.array([len(f.tracks.track_ids) for f in seen if f.tracks is not None])
    assert counts.max() <= 120 and np.median(counts) >= 115
    common = [len(shared(a, b)[0]) for a, b in pairwise(seen)]
    assert np.mean(common) > 0.85 * counts.mean()
    for frame in seen:
        assert frame.tracks is not None
        assert (np.diff(frame.tracks.track_ids) > 0).all()
        assert frame.tracks.pixels_px.min() >= 0.0 and (frame.tracks.pixels_px <= [751.0, 479.0]).all()


def test_share_of_outliers_is_what_was_asked_for() -> None:
    """Of a body at rest, everything more than five sigma from its own median is an outlier or has slipped."""
    recording = open_points("still", seed=4, duration_s=20.0, outlier_share=0.2, pixel_sigma_px=0.5)
    tracker, slipped, far, total = recording.tracker(), 0, 0, 0
    T_cam_world = np.linalg.inv(recording.motion.at(np.zeros(1)).T_world_body[0] @ recording.true_rig.T_body_cams[0])
    home = recording.true_rig.cameras[0].project(transform_points(T_cam_world, recording.field.points_m))
    began: dict[int, int] = {}
    for t_ns in recording.frame_times_ns:
        seen = tracker.see(float(t_ns - recording.zero_ns) * 1e-9, False)
        for track, landmark in zip(tracker.track_ids_all.tolist(), tracker.landmarks.tolist(), strict=True):
            began.setdefault(track, landmark)
        expected = home[[began[track] for track in seen.track_ids.tolist()]]
        far += int((np.linalg.norm(seen.pixels_px - expected, axis=1) > 2.5).sum())
        total += len(seen.track_ids)
        slipped += int(tracker.slipped.sum())
    assert slipped / total == pytest.approx(0.7 * 0.2, rel=0.15)
    assert far / total == pytest.approx(0.2, rel=0.15)


def test_dropouts_come_back_and_lives_end() -> None:
    options = {"outlier_share": 0.0, "duration_s": 15.0, "track_life_s": 1.5}
    seen = frames(open_points("still", seed=2, dropout_share=0.1, **options))
    counts = np.array([len(f.tracks.track_ids) for f in seen if f.tracks is not None])
    assert counts.mean() == pytest.approx(0.9 * 200, rel=0.02)
    steady = frames(open_points("still", seed=2, dropout_share=0.0, **options))
    lasting = [len(shared(a, b)[0]) / 200 for a, b in zip(steady[:-20], steady[20:], strict=True)]
    assert np.mean(lasting) == pytest.approx(np.exp(-1.0 / 1.5), abs=0.04)


def test_outages_are_frames_without_tracks() -> None:
    options = {"outage_begin_s": 1.0, "outage_length_s": 0.5, "outage_every_s": 2.0}
    recording = open_points("straight", duration_s=6.0, **options)
    seen = frames(recording)
    empty = np.array([f.tracks is not None and len(f.tracks.track_ids) == 0 for f in seen])
    since_s = np.array([f.t_ns - seen[0].t_ns for f in seen]) * 1e-9
    assert (empty == (since_s >= 1.0 - 1e-9) & ((since_s - 1.0 + 1e-9) % 2.0 < 0.5)).all() and empty.sum() == 30
    before, after = seen[int(np.flatnonzero(empty)[0]) - 1], seen[int(np.flatnonzero(empty)[9]) + 1]
    assert len(shared(before, after)[0]) == 0  # nothing is followed across half a second of darkness


def test_stamps_are_early_by_the_time_offset() -> None:
    plain, shifted = (open_points("laps", seed=1, duration_s=5.0, time_offset_s=s, **PERFECT) for s in (0.0, 0.03))
    a, b = frames(plain), frames(shifted)
    assert {f.t_ns - g.t_ns for f, g in zip(a, b, strict=True)} == {30_000_000}
    assert np.array_equal(a[50].tracks.pixels_px, b[50].tracks.pixels_px) if a[50].tracks and b[50].tracks else False
    assert np.array_equal(plain.truth().t_ns, shifted.truth().t_ns)
    assert np.array_equal(shifted.frame_times_ns - 30_000_000, [f.t_ns for f in b])


def test_rig_that_is_told_is_turned_by_what_was_asked_for() -> None:
    recording = open_points("still", duration_s=1.0, extrinsic_rotation_deg=2.0)
    R = recording.rig.T_body_cams[0][:3, :3].T @ recording.true_rig.T_body_cams[0][:3, :3]
    assert np.rad2deg(angles_rad(R[None]))[0] == pytest.approx(2.0)
    assert np.allclose(recording.rig.T_cam0_cam1, recording.true_rig.T_cam0_cam1)
    assert np.allclose(recording.rig.T_body_cams[0][:3, 3], recording.true_rig.T_body_cams[0][:3, 3])
    plain = open_points("still", duration_s=1.0)
    assert np.allclose(plain.rig.T_body_cams[1], plain.true_rig.T_body_cams[1])


def test_rolling_shutter_shears_by_the_rate_of_turning() -> None:
    """A landmark in row v is seen readout * (v / 479 - 0.5) later than the stamp."""
    recording = open_points("turn-in-place", duration_s=9.0, readout_s=0.02, rig="mono", **PERFECT)
    tracker = recording.tracker()
    for t_ns in recording.frame_times_ns[:150]:
        t_s = float(t_ns - recording.zero_ns) * 1e-9
        seen = tracker.see(t_s, False)
    rows = np.searchsorted(tracker.track_ids_all, seen.track_ids)
    points = recording.field.points_m[tracker.landmarks[rows]]
    late_s = t_s + 0.02 * (seen.pixels_px[:, 1] / 479.0 - 0.5)
    T = np.linalg.inv(recording.motion.at(late_s).T_world_body @ recording.true_rig.T_body_cams[0])
    expected = recording.true_rig.cameras[0].project(np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3])
    assert np.linalg.norm(seen.pixels_px - expected, axis=1).max() < 0.05
    shear = np.linalg.norm(errors_px(recording, 151)[0].reshape(-1)[-100:])
    assert shear > 10.0


def test_person_fills_a_part_of_the_image_and_moves_together() -> None:
    seen = frames(
        open_points("still", seed=1, duration_s=8.0, moving_share=0.4, moving_begin_s=2.0, moving_length_s=4.0)
    )
    shares, moved = [], []
    for before, after in pairwise(seen):
        a, b = shared(before, after)
        shift = np.linalg.norm(b - a, axis=1)
        shares.append(np.mean(shift > 6.0) if len(a) else 0.0)
        moved.append(np.median(shift[shift > 6.0]) if (shift > 6.0).sum() > 20 else 0.0)
    shares = np.array(shares)
    assert shares[:38].max() < 0.1 and shares[125:].max() < 0.1
    # it stands still where it turns round; in between it fills what was asked for, plus the usual outliers
    assert 0.33 < np.quantile(shares[45:115], 0.75) < 0.5
    together = np.array(moved)[shares > 0.33]
    assert together.min() > 6.0 and together.max() < 13.0  # 203 px/s at most, at 20 frames a second


def test_told_imu_noise_is_off_by_the_factor() -> None:
    recording = open_points("still", duration_s=5.0, imu_noise_factor=0.1)
    assert recording.imu_noise is not None
    assert recording.imu_noise.gyroscope_noise_density == pytest.approx(0.1 * CONSUMER_IMU.gyroscope_noise_density)
    assert recording.imu_noise.accelerometer_random_walk == pytest.approx(0.1 * CONSUMER_IMU.accelerometer_random_walk)
    assert recording.imu_noise.rate_hz == CONSUMER_IMU.rate_hz
    gyro = np.array([sample.gyro_rad_s for sample in samples(recording)])
    assert gyro.std(axis=0).mean() == pytest.approx(CONSUMER_IMU.gyroscope_noise_density * np.sqrt(200.0), rel=0.05)


def test_exact_imu_is_exact_and_biases_walk_across_pieces() -> None:
    exact = open_points("still", duration_s=2.0, imu_noise=False, gravity_m_s2=9.7)
    accel = np.array([s.accel_m_s2 for s in samples(exact)])
    assert np.ptp(accel, axis=0).max() < 1e-12 and np.linalg.norm(accel[7]) == pytest.approx(9.7)
    recording = open_points("still", seed=9, duration_s=45.0)
    sensed = samples(recording)
    stamps = np.array([s.t_ns for s in sensed])
    states = recording.true_states(stamps)
    steps = np.diff(states.accel_bias_m_s2, axis=0)
    expected = CONSUMER_IMU.accelerometer_random_walk / np.sqrt(CONSUMER_IMU.rate_hz)
    assert steps.std() == pytest.approx(expected, rel=0.05) and np.abs(steps).max() < 6.0 * expected  # no seam
    force = np.array([s.accel_m_s2 for s in sensed]) - states.accel_bias_m_s2
    up = states.T_world_body[:, 2, :3] * 9.81
    assert (force - up).std() == pytest.approx(CONSUMER_IMU.accelerometer_noise_density * np.sqrt(200.0), rel=0.03)
    assert np.abs((force - up).mean(axis=0)).max() < 2e-3


def test_landmarks_are_recognised_when_they_come_again_and_not_elsewhere() -> None:
    seen = frames(open_points("laps", seed=1, duration_s=48.0, camera_hz=5.0))
    first = seen[40].tracks
    assert first is not None and first.descriptors is not None
    counts = []
    for frame in seen[41:]:
        assert frame.tracks is not None and frame.tracks.descriptors is not None
        counts.append(len(match(first.descriptors, frame.tracks.descriptors)))
    assert counts[0] > 100
    assert max(counts[60:120]) < 20  # on the other side of the block
    assert max(counts[150:]) > 40  # a lap later
    plain = frames(open_points("still", duration_s=1.0, descriptors=False))
    assert plain[0].tracks is not None and plain[0].tracks.descriptors is None
    assert len(np.unique(scramble(np.arange(1000, dtype=np.uint64)))) == 1000


def test_an_hour_is_made_piece_by_piece() -> None:
    recording = open_points("laps", duration_s=3600.0, camera_hz=10.0)
    assert recording.frame_count == 36_000 and recording.duration_s == 3600.0
    events = recording.events()
    first = [next(events) for _ in range(500)]
    assert sum(isinstance(event, Frame) for event in first) == pytest.approx(24, abs=2)
    assert len(recording.truth()) == 360_001


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("points:laps,nonsense=1", "no option 'nonsense'; there are: rig"),
        ("points:laps,tracks", "write points:laps,option=value"),
        ("points:laps,tracks=many", "option tracks"),
        ("points:laps,outlier_share=1.5", "option outlier_share"),
        ("points:laps,camera_hz=0", "option camera_hz"),
        ("points:laps,rig=lidar", "option rig"),
        ("points:handheld-room,duration_s=500", "lasts 34.0 s, asked for 500 s"),
        ("points:laps,start_s=-1", "option start_s"),
        ("sim:workshop-cart,x", "write sim:workshop-cart,option=value"),
    ],
)
def test_wrong_options_are_refused_with_what_is_possible(uri: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        open_source(uri)


def test_a_place_without_a_recording_names_the_motions(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"does not exist.*simulated motions are: still"):
        open_source("points:nowhere")
    (tmp_path / "mav0" / "imu0").mkdir(parents=True)
    with pytest.raises(DataError, match="lacks an IMU"):
        open_source(f"points:{tmp_path}")
    with pytest.raises(UsageError, match="no world 'moon'"):
        open_points("moon")
