"""Trajectories: exact against evo, strict against damaged files, consistent under change of world."""

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vislam.core.errors import DataError, StorageError, UsageError
from vislam.core.files import write_text
from vislam.core.geometry import se3_exp, sim3, transform
from vislam.core.messages import NavState
from vislam.trajectory import (
    Pairs,
    Trajectory,
    align,
    associate,
    ate,
    coverage,
    evaluate,
    read_kitti,
    read_states_csv,
    read_trajectory,
    read_tum,
    rpe,
    scale_error,
    write_kitti,
    write_states_csv,
    write_tum,
)

START_NS = 1_403_636_582_763_560_001  # odd nanosecond: lost by any reader that goes through a float


def smooth(count: int, seed: int = 3, period_ns: int = 50_000_000) -> Trajectory:
    rng = np.random.default_rng(seed)
    t = np.arange(count) * period_ns * 1e-9
    phase = rng.uniform(0, 6, 3)
    positions = np.stack(
        [3 * np.sin(0.5 * t + phase[0]), 2 * np.sin(0.7 * t + phase[1]), 0.2 * np.sin(t + phase[2])], 1
    )
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([0.4 * t, 0.2 * np.sin(t), 0.1 * np.cos(t)], 1)).as_matrix()
    poses[:, :3, 3] = positions
    return Trajectory(START_NS + np.arange(count) * period_ns, poses)


def noisy(truth: Trajectory, seed: int = 5, shift_ns: int = 0) -> Trajectory:
    """The truth seen from another world, scaled by 1.1, with noise, its clock shifted within the association gap."""
    rng = np.random.default_rng(seed)
    noise = np.array([se3_exp(x) for x in rng.normal(0, 0.02, (len(truth), 6))])
    moved = Trajectory(truth.t_ns + shift_ns, truth.T_world_body @ noise)
    return moved.transformed(sim3(1.1, Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([4.0, -1.0, 2.0])))


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    # relative seconds, since evo keeps stamps as float seconds
    return PoseTrajectory3D(
        poses_se3=list(trajectory.T_world_body.copy()), timestamps=(trajectory.t_ns - START_NS) * 1e-9
    )


# agreement with evo


@pytest.mark.parametrize("mode", ["se3", "sim3"])
@pytest.mark.parametrize("estimate_is_longer", [False, True])
def test_ate_equals_evo(mode, estimate_is_longer):
    truth, estimate = smooth(600), noisy(smooth(600), shift_ns=3_000_000)
    if estimate_is_longer:
        truth = Trajectory(truth.t_ns[::3], truth.T_world_body[::3])
    else:
        estimate = Trajectory(estimate.t_ns[20:500:3], estimate.T_world_body[20:500:3])
    pairs = associate(estimate, truth, "nearest")
    ours = ate(pairs.aligned(align(pairs, mode)))

    reference, theirs = sync.associate_trajectories(as_evo(truth), as_evo(estimate), max_diff=0.01)
    theirs.align(reference, correct_scale=mode == "sim3")
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, theirs))
    expected = ape.get_all_statistics()
    assert len(pairs) == reference.num_poses
    for name, key in (("rmse_m", "rmse"), ("mean_m", "mean"), ("median_m", "median"), ("max_m", "max")):
        assert ours[name] == pytest.approx(expected[key], abs=1e-9)
    assert ours["rmse_m"] > 0.01  # the noise is really there


@pytest.mark.parametrize("length_m", [1.0, 5.0, 10.0])
def test_rpe_over_distance_equals_evo(length_m):
    truth, estimate = smooth(500), noisy(smooth(500))
    pairs = associate(estimate, truth, "nearest")
    errors = rpe(pairs, length_m=length_m)
    for relation, ours in (
        (metrics.PoseRelation.translation_part, errors.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, errors.rotation_rad),
    ):
        theirs = metrics.RPE(
            relation, delta=length_m, delta_unit=metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
        )
        theirs.process_data((as_evo(truth), as_evo(estimate)))
        np.testing.assert_allclose(ours, theirs.error, atol=1e-9)
    assert len(errors.translation_m) > 100


def test_rpe_over_time_equals_evo_over_frames():
    truth, estimate = smooth(300), noisy(smooth(300))
    errors = rpe(associate(estimate, truth), duration_s=1.0)
    theirs = metrics.RPE(metrics.PoseRelation.translation_part, 20, metrics.Unit.frames, all_pairs=True)
    theirs.process_data((as_evo(truth), as_evo(estimate)))
    # the last starts reach the end after 0.95 and 0.9 s, which the tolerance of 10 % lets through
    assert len(errors.translation_m) == 282
    np.testing.assert_allclose(errors.translation_m[:280], theirs.error, atol=1e-9)


# alignment, scale, coverage


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.lists(st.floats(-50, 50), min_size=3, max_size=3),
    st.floats(0.1, 10),
)
def test_alignment_undoes_a_change_of_world(rotation, translation, scale):
    truth = smooth(80)
    R = Rotation.from_rotvec(rotation).as_matrix()
    yaw = Rotation.from_rotvec([0, 0, rotation[2]]).as_matrix()
    t = np.array(translation)
    for mode, change in (
        ("se3", sim3(1.0, R, t)),
        ("sim3", sim3(scale, R, t)),
        ("yaw", sim3(1.0, yaw, t)),
        ("first", sim3(1.0, R, t)),
    ):
        pairs = associate(truth.transformed(change), truth)
        aligned = pairs.aligned(align(pairs, mode))
        assert ate(aligned)["max_m"] < 1e-7
        assert aligned.rotation_errors_rad().max() < 1e-6
    assert scale_error(associate(truth.transformed(sim3(scale, R, t)), truth)) == pytest.approx(1 / scale - 1, rel=1e-9)


@pytest.mark.filterwarnings("error")
def test_there_is_no_scale_without_motion():
    still = Trajectory(smooth(10).t_ns, np.tile(np.eye(4), (10, 1, 1)))
    for pairs in (associate(still, smooth(10)), associate(smooth(10), still)):
        assert np.isnan(scale_error(pairs))


def test_yaw_alignment_does_not_hide_a_tilt():
    truth = smooth(200)
    tilted = truth.transformed(transform(Rotation.from_rotvec([0.05, 0, 0]).as_matrix(), np.zeros(3)))
    pairs = associate(tilted, truth)
    assert ate(pairs.aligned(align(pairs, "se3")))["rmse_m"] < 1e-9
    assert ate(pairs.aligned(align(pairs, "yaw")))["rmse_m"] > 0.01


def test_evaluate_of_the_truth_itself_is_zero_and_of_noise_is_the_noise():
    truth = smooth(400)
    perfect = evaluate(truth, truth, "yaw")
    assert perfect["ate_rmse_m"] < 1e-12
    assert perfect["rpe_1s_m"] < 1e-12
    assert perfect["coverage"] == 1.0
    assert perfect["scale"] == pytest.approx(1.0)
    assert perfect["path_m"] == pytest.approx(truth.path_m)

    rng = np.random.default_rng(0)
    poses = truth.T_world_body.copy()
    poses[:, :3, 3] += rng.normal(0, 0.05, (len(truth), 3))
    result = evaluate(Trajectory(truth.t_ns, poses), truth, "se3")
    assert result["ate_rmse_m"] == pytest.approx(0.05 * np.sqrt(3), rel=0.05)
    assert result["rpe_1s_m"] == pytest.approx(0.05 * np.sqrt(6), rel=0.05)
    ten = result["rpe_segments"]["10"]
    assert ten["percent"] == pytest.approx(100 * ten["m"] / 10, rel=0.02)


def test_evaluate_of_an_estimate_that_stands_still_has_no_scale():
    truth = smooth(100)
    result = evaluate(Trajectory(truth.t_ns, np.tile(np.eye(4), (100, 1, 1))), truth, "se3")
    assert result["scale"] is None
    assert result["ate_rmse_m"] > 0.1


def test_coverage_counts_holes_and_the_span_of_the_recording():
    truth = smooth(401)  # 20 s
    kept = np.r_[0:101, 301:401]  # a hole from 5 s to 15.05 s
    estimate = Trajectory(truth.t_ns[kept], truth.T_world_body[kept])
    assert coverage(estimate, truth) == pytest.approx((5.0 + 4.95) / 20.0)
    assert coverage(truth, truth) == 1.0
    head = Trajectory(truth.t_ns[:101], truth.T_world_body[:101])
    assert coverage(head, truth) == pytest.approx(0.25)
    assert coverage(head, truth, span_ns=(int(truth.t_ns[0]), int(truth.t_ns[100]))) == 1.0
    assert coverage(Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4))), truth) == 0.0


def test_interpolated_association_never_bridges_a_gap_of_the_truth():
    truth = smooth(200)
    holed = Trajectory(np.delete(truth.t_ns, np.s_[50:100]), np.delete(truth.T_world_body, np.s_[50:100], axis=0))
    pairs = associate(truth, holed)
    assert len(pairs) == 150
    assert pairs.total == 200
    assert ate(pairs)["max_m"] < 1e-12
    early = Trajectory(truth.t_ns - 30_000_000_000, truth.T_world_body)
    with pytest.raises(DataError, match="same clock"):
        evaluate(early, truth, "se3")


def test_interpolation_is_exact_on_constant_velocity_and_never_extrapolates():
    step = se3_exp(np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]))
    poses = np.array([np.linalg.matrix_power(step, k) for k in range(5)])
    poses[:, 0, 3] = np.arange(5)
    trajectory = Trajectory(np.arange(5) * 100, poses)
    half = trajectory.at(250)
    np.testing.assert_allclose(Rotation.from_matrix(half[:3, :3]).as_rotvec(), [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(half[:3, 3], [2.5, 0, 0])
    np.testing.assert_allclose(trajectory.at(np.array([0, 400])), poses[[0, 4]], atol=1e-12)
    with pytest.raises(DataError, match="covers 0 to 400"):
        trajectory.at(401)


def test_single_pose_trajectory_answers_at_its_own_time_only():
    one = Trajectory(np.array([7]), np.eye(4)[None])
    np.testing.assert_array_equal(one.at(7), np.eye(4))
    with pytest.raises(DataError):
        one.at(8)


# files


def test_files_keep_every_nanosecond_and_nanometre(tmp_path):
    trajectory = smooth(50)
    path = tmp_path / "poses"
    write_tum(trajectory, path)
    back = read_trajectory(path)
    np.testing.assert_array_equal(back.t_ns, trajectory.t_ns)
    np.testing.assert_allclose(back.T_world_body, trajectory.T_world_body, atol=5e-9)
    assert [p.name for p in tmp_path.iterdir()] == ["poses"]  # no temporary file stays


def test_kitti_file_with_its_times(tmp_path):
    trajectory = smooth(20)
    write_kitti(trajectory, tmp_path / "00.txt")
    back = read_kitti(tmp_path / "00.txt", trajectory.t_ns)
    np.testing.assert_allclose(back.T_world_body, trajectory.T_world_body, atol=1e-9)
    with pytest.raises(DataError, match="20 poses but there are 3 times"):
        read_kitti(tmp_path / "00.txt", trajectory.t_ns[:3])


@pytest.mark.parametrize("rest", ["", ",0,0,0,0,0,0,0,0,0"])
def test_both_layouts_of_euroc_put_the_quaternion_w_first(tmp_path, rest):
    q = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_quat()
    path = tmp_path / "data.csv"
    path.write_text(f"#timestamp, ...\n{START_NS},1,2,3,{q[3]},{q[0]},{q[1]},{q[2]}{rest}\r\n")
    pose = read_trajectory(path).T_world_body[0]
    np.testing.assert_allclose(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3])


GOOD = "1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD + "3.0 nan 0 0 0 0 0 1\n", "poses.tum:3: NaN"),
        (GOOD + "3.0 0 0 0 0 0 0 0\n", "poses.tum:3: quaternion has norm 0"),
        (GOOD + "1.5 0 0 0 0 0 0 1\n", "poses.tum:3: time stamp"),
        (GOOD + "3.0 0 0 0 0 0", "poses.tum:3: expected 8 columns, got 6"),
        (GOOD + "x 0 0 0 0 0 0 1\n", "poses.tum:3: 'x' is not a time stamp"),
        (GOOD + "1e999 0 0 0 0 0 0 1\n", "out of range"),
        (GOOD + "nan 0 0 0 0 0 0 1\n", "out of range"),
        (GOOD + "3.0 1_0 0 0 0 0 0 1\n", "poses.tum:3"),
        (GOOD + "3.0 a 0 0 0 0 0 1\n", "poses.tum:3: could not convert"),
        ("# only a comment\n", "holds no poses"),
        ("", "holds no poses"),
        ("0 " * 20000, "line longer than"),
    ],
)
def test_damaged_tum_files_name_their_line(tmp_path, text, message):
    path = tmp_path / "poses.tum"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        read_tum(path)


def test_of_poses_of_one_time_the_first_is_taken_as_a_run_does_and_that_is_said(tmp_path, caplog):
    path = tmp_path / "poses.tum"
    path.write_text(GOOD + "2.0 5 5 5 0 0 0 1\n3.0 0 0 0 0 0 0 1\n")
    assert read_tum(path).positions_m[:, 0].tolist() == [0.0, 0.0, 0.0]
    assert "poses.tum: rows of a time that was there already from 1.00 to 1.00 s (1); left out" in caplog.text


def test_other_unreadable_files(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        read_tum(tmp_path / "missing.tum")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00garbage")
    with pytest.raises(DataError, match="not text"):
        read_tum(tmp_path / "binary")
    (tmp_path / "sheared.txt").write_text("2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(DataError, match="not a rotation"):
        read_kitti(tmp_path / "sheared.txt", np.array([0]))


def test_writing_to_a_full_disk_or_a_missing_folder_is_one_clear_error(tmp_path):
    with pytest.raises(StorageError, match="cannot be written"):
        write_tum(smooth(3), tmp_path / "no" / "such" / "folder.tum")
    target = tmp_path / "folder"
    target.mkdir()
    with pytest.raises(StorageError):
        write_text(target, "text")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_trajectory_refuses_what_is_no_trajectory():
    eye = np.tile(np.eye(4), (2, 1, 1))
    for t_ns, poses in (
        (np.array([1, 1]), eye),
        (np.array([2, 1]), eye),
        (np.array([1.0, 2.0]), eye),
        (np.array([1, 2]), eye * 2),
        (np.array([1, 2]), np.full_like(eye, np.nan)),
        (np.array([1, 2]), eye @ np.diag([-1.0, 1, 1, 1])),
        (np.array([1]), eye),
    ):
        with pytest.raises(DataError):
            Trajectory(t_ns, poses)


def test_unknown_alignment_lists_the_known_ones():
    with pytest.raises(UsageError, match="se3, sim3, yaw, first, none"):
        evaluate(smooth(5), smooth(5), "umeyama")


def test_states_csv_keeps_every_bit(tmp_path):
    rng = np.random.default_rng(1)
    truth = smooth(5)
    states = []
    for t_ns, T in zip(truth.t_ns, truth.T_world_body, strict=True):
        A = rng.normal(size=(15, 15))
        states.append(NavState(int(t_ns), T, *rng.normal(size=(3, 3)), A @ A.T))
    path = tmp_path / "states.csv"
    write_states_csv(path, [0, 1, 2, 5, 9], states)
    ids, back = read_states_csv(path)
    np.testing.assert_array_equal(ids, [0, 1, 2, 5, 9])
    for wrote, read in zip(states, back, strict=True):
        assert read.t_ns == wrote.t_ns
        np.testing.assert_allclose(read.T_world_body, wrote.T_world_body, atol=1e-15)
        np.testing.assert_array_equal(read.velocity_world_m_s, wrote.velocity_world_m_s)
        np.testing.assert_array_equal(np.triu(read.covariance), np.triu(wrote.covariance))
        np.testing.assert_array_equal(read.covariance, read.covariance.T)
    text = path.read_text().splitlines()
    fields = text[1].split(",")
    for column, refused in (
        (9, False),
        (137, False),
        (2, True),
        (8, True),
    ):  # velocity, covariance, position, quaternion
        damaged = ",".join([*fields[:column], "nan", *fields[column + 1 :]])
        path.write_text("\n".join([text[0], damaged]) + "\n")
        if refused:
            with pytest.raises(DataError, match=r"states\.csv:2: NaN"):
                read_states_csv(path)
        else:
            read_states_csv(path)
    path.write_text("\n".join(text[:-1]) + "\n" + text[-1][:200])
    with pytest.raises(DataError, match=r"states.csv:6: expected 138 columns"):
        read_states_csv(path)
    path.write_text("\n".join(text[1:]))
    with pytest.raises(DataError, match="header"):
        read_states_csv(path)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "poses", "path_m"),
    [
        ("tum_fr1_desk/groundtruth.txt", 2335, 10.6),
        ("euroc_mh01_17s/mav0/mocap0/data.csv", 3720, 6.48),
        ("euroc_v101_imu/mav0/mocap0/data.csv", 2895, 58.35),
    ],
)
def test_real_truth_files(data_root, name, poses, path_m):
    truth = read_trajectory(data_root / name)
    assert len(truth) == poses
    assert truth.path_m == pytest.approx(path_m, abs=0.05)


def test_pairs_report_how_many_poses_found_a_partner():
    truth = smooth(100)
    head = Trajectory(truth.t_ns[:40], truth.T_world_body[:40])
    pairs = associate(truth, head)
    assert isinstance(pairs, Pairs)
    assert (len(pairs), pairs.total) == (40, 100)
